"""Packages of extras: the package runs without them, and an error names the extra."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import diffcloth_torch as dc
from diffcloth_torch.extras import from_extra

WITHOUT = """
import sys
sys.modules["matplotlib"] = None  # as if it were not installed
import diffcloth_torch as dc
from diffcloth_torch.cli import main
from diffcloth_torch.config import shapes
from diffcloth_torch.optimize.fit_page import _image
from diffcloth_torch.viewers import curves, labels, layers

simulator = dc.Simulator(dc.Scene([dc.Cloth.grid(4, 4)]), 0.01)
print(simulator.step(simulator.initial_state()).report.status)
for use in (
    lambda: shapes.disk(1.0, 0.3),
    lambda: curves.draw_loss_curve("loss.png", [1.0]),
    lambda: labels._font(12),
    lambda: layers.colors([1.0], 1.0),
    lambda: _image(None, (1, 1), "cost"),
):
    try:
        use()
    except dc.InvalidInput as error:
        print(error)
main(["optimize", *sys.argv[1:]])
"""

CURVES = "curves need Matplotlib: run  pip install 'diffcloth-torch[viewer]'  ("


def test_without_matplotlib_simulations_run_and_pictures_name_the_extra(tmp_path):
    config = Path(__file__).parents[1] / "configs" / "push_cube.yaml"
    arguments = [config, "--viewer", "meshes", "--out", tmp_path / "out"]
    result = subprocess.run(
        [sys.executable, "-c", WITHOUT, *map(str, arguments)], capture_output=True, text=True
    )
    status, *messages = result.stdout.splitlines()
    assert status == "converged", result.stderr
    extras = [message.partition("diffcloth-torch[")[2].partition("]")[0] for message in messages]
    assert extras == ["viewer", "viewer", "viewer", "viewer", "fit"]
    assert all("matplotlib" in message.rpartition("  (")[2] for message in messages)
    assert messages[1].startswith(CURVES)
    # The optimization ends before its first step.
    assert result.returncode == 2
    assert result.stderr.startswith(f"Error: {' '.join(CURVES.split())}")


def test_an_extra_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "absent", None)
    with pytest.raises(dc.InvalidInput, match=r"^x: run  pip install 'diffcloth-torch\[y\]'  \("):
        from_extra("absent", "y", "x")
    assert from_extra("sys", "y", "x") is sys
