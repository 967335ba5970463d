"""Examples of docs/extending.md that change Python alone, applied to a copy of the package."""

import shutil
import subprocess
import sys
from pathlib import Path

import extended_tree
import pytest

ROOT = extended_tree.ROOT

CHECKS = {
    "Add a field of a control": """
import torch
import diffcloth_torch as dc

sim = dc.Simulator(dc.Scene([dc.Cloth.grid(3, 3)], [dc.RigidBody.sphere(
    0.1, motion="dynamic", mass=1.0, pose=[0, 0, -5, 1, 0, 0, 0])]), 0.01)
state = sim.initial_state(2)
a = torch.tensor([[1.0, 0.0, 2.0], [0.0, 3.0, 0.0]], dtype=torch.float64, requires_grad=True)
after = sim.step(state, dc.Control(frame_acceleration=a))
expected = 0.01 * (torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64) - a)
torch.testing.assert_close(after.velocities, expected[:, None].expand(2, 9, 3), rtol=0, atol=1e-8)
torch.testing.assert_close(after.body_velocities[:, 0, :3], expected, rtol=0, atol=1e-8)
(gradient,) = torch.autograd.grad(after.velocities.sum(), a)
torch.testing.assert_close(gradient, torch.full_like(a, -0.09), rtol=1e-8, atol=0)
again = sim.step(state, dc.Control(frame_acceleration=torch.zeros(3, dtype=torch.float64)))
assert torch.equal(again.positions, sim.step(state).positions)
try:
    sim.step(state, dc.Control(frame_acceleration=torch.zeros(2, dtype=torch.float64)))
except dc.InvalidInput as error:
    assert "`control.frame_acceleration` must have shape" in str(error), error
else:
    raise AssertionError("a wrong shape must be refused")
""",
    "Add a shape of bodies": """
from pathlib import Path
import numpy as np
import diffcloth_torch as dc

wedge = dc.RigidBody.wedge([0.2, 0.3, 0.4], motion="dynamic", mass=2.0)
np.testing.assert_allclose(wedge.center, [0.1 / 3, 0.0, -0.2 / 3], atol=1e-12)
try:
    dc.RigidBody.wedge([0.2, -0.3, 0.4])
except dc.InvalidInput as error:
    assert "RigidBody.wedge: `size` must be" in str(error), error
else:
    raise AssertionError("a negative length must be refused")
Path("wedge.yaml").write_text('''
task: drape
scene:
  cloths:
    - name: sheet
      shape: {kind: grid, rows: 5, columns: 5, size: 0.5}
      pose: {position: [0, 0, 0.25]}
  bodies: [{name: ramp, shape: {kind: wedge, size: [0.2, 0.3, 0.4]}}]
simulation: {dt: 0.01, steps: 5}
''')
scene, simulator, task = dc.load_config("wedge.yaml")
state = simulator.initial_state()
for _ in range(task.steps):
    state = simulator.step(state)
assert state.report.converged and float(state.report.minimum_distance) > 0
""",
}


def copy_of_the_package(folder: Path) -> None:
    """Sources, compiled modules and the pages that their tests read."""
    shutil.copytree(
        ROOT / "diffcloth_torch",
        folder / "diffcloth_torch",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    for name in ("docs/notation.md", "tests/model/test_quantities.py"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, folder / name)


def run_in(folder: Path, *arguments: str) -> None:
    """Run Python with the package of a folder."""
    result = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(folder), "PYTHONWARNINGS": "error"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.recipe
@pytest.mark.slow
@pytest.mark.parametrize("title", CHECKS)
def test_an_example_that_changes_python(title, tmp_path):
    if not (ROOT / ".git").exists():
        pytest.skip("needs a clone")
    copy_of_the_package(tmp_path)
    text = extended_tree.section_of_page(title)
    for name, lines in extended_tree.changes_of_page(text).items():
        file = tmp_path / name
        file.write_text(extended_tree.patched(name, file.read_text(), lines))
    run_in(tmp_path, "-c", CHECKS[title])
    # Tests of the tables report a docstring or a row of the notation that is missing.
    tables = ("tests/model/test_quantities.py", "-k", "docstrings or notation or table_names")
    run_in(tmp_path, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *tables)
