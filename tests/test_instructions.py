"""The level of instructions: its choice, refused values, and levels with different bits."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from processes import run_python

ROOT = Path(__file__).resolve().parents[1]
VARIABLE = "DIFFCLOTH_INSTRUCTIONS"
LEVELS = ("portable", "avx2", "avx512")
CHOSEN = "from diffcloth_torch import build_info; print(build_info()['instructions'])"


def run(*command, level):
    environment = os.environ | {VARIABLE: level}
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT)


@pytest.fixture(scope="module")
def supported():
    """Levels that this processor and this build have, by the message that refuses another."""
    message = run(sys.executable, "-c", CHOSEN, level="mmx").stderr.splitlines()[-1]
    found = re.fullmatch(
        rf"ImportError: {VARIABLE} must be one of (.*), which this build and this processor "
        "have, got 'mmx'",
        message,
    )
    assert found, message
    return found[1].split(", ")


def test_the_environment_chooses_among_the_supported_levels_alone(supported):
    assert set(supported) <= set(LEVELS)
    for level in (*LEVELS, ""):
        result = run(sys.executable, "-c", CHOSEN, level=level)
        if level in supported:
            assert result.stdout == f"{level}\n"
        else:
            assert result.stderr.endswith(f"got '{level}'\n")


def test_the_fastest_level_is_the_default(supported):
    environment = {name: value for name, value in os.environ.items() if name != VARIABLE}
    assert run_python(CHOSEN, env=environment) == f"{supported[-1]}\n"


def test_the_command_line_refuses_a_level_in_a_sentence():
    refused = run(sys.executable, "-m", "diffcloth_torch", "info", level="mmx")
    assert refused.returncode == 2
    assert refused.stderr.startswith(f"Error: {VARIABLE} must be one of portable")


STEPS = """
import torch
import diffcloth_torch as dc

sheet = dc.Cloth.grid(9, 9, 0.3, pose=[0.0, 0.0, 0.0815, 1.0, 0.0, 0.0, 0.0])
woven = dc.Material(stretch=900.0, stretch_weft=300.0, stretch_shear=60.0, damping=1e-3)
other = dc.Cloth.grid(7, 7, 0.2, pose=[0.0, 0.0, 0.083, 1.0, 0.0, 0.0, 0.0], material=woven)
ball = dc.RigidBody.sphere(0.08, motion="dynamic", density=200.0)
simulator = dc.Simulator(dc.Scene([sheet, other], [ball]), 0.01)
state = simulator.initial_state()
for _ in range(6):
    state = simulator.step(state)
start = state.positions.clone().requires_grad_()
end = simulator.step(state.replace(positions=start))
assert end.report.contact_count > 0
end.positions.square().sum().backward()
found = torch.cat([end.positions.detach(), end.velocities.detach(), start.grad])
print(*(number.hex() for number in found.flatten().tolist()))
"""


@pytest.mark.slow
def test_levels_differ_in_bits_only_where_one_has_no_fused_multiply_add(supported):
    """A step with contact, friction, woven cloth and a body, and its gradient."""
    found = {level: run_python(STEPS, env=os.environ | {VARIABLE: level}) for level in supported}
    fused = [found[level] for level in supported if level != "portable"]
    assert len(set(fused)) <= 1
    if fused:
        assert found["portable"] != fused[0]


@pytest.mark.skipif(sys.platform != "linux", reason="needs bash and Linux on x86-64")
def test_a_script_chooses_the_level_of_torch_and_numpy_too():
    code = CHOSEN + "; import torch; print(torch.backends.cpu.get_cpu_capability())"
    script = ROOT / "scripts" / "at_level"
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    result = subprocess.run(
        [script, "portable", sys.executable, "-W", "error", "-c", code],
        capture_output=True, text=True, env=os.environ | {"PATH": path}, check=False,
    )  # fmt: skip
    assert result.stdout == "portable\nDEFAULT\n", result.stderr
    refused = subprocess.run([script, "mmx", "true"], capture_output=True, text=True, check=False)
    assert refused.returncode == 2
    assert "portable|avx2|avx512" in refused.stderr
