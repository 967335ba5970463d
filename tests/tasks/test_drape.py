"""Drapes that are shipped, and the meshes that they load."""

from __future__ import annotations

import runpy
import shutil

import numpy as np
import pytest
from short_tasks import CONFIGS

from diffcloth_torch.geometry.poses import transform
from diffcloth_torch.tasks.registry import load_task
from diffcloth_torch.tasks.simulation import simulate


def test_the_tablecloth_starts_above_the_chair():
    task = load_task(CONFIGS / "drape.yaml")
    chair = task.scene.bodies[0]
    assert task.scene.cloths[0].vertices[:, 2].min() > chair.vertices[:, 2].max()


def test_meshes_of_configurations_are_the_output_of_their_script():
    made = runpy.run_path(str(CONFIGS.parent / "scripts" / "make_meshes.py"))["texts"]()
    files = {path.name: path for path in (CONFIGS / "meshes").iterdir()}
    assert set(files) == set(made)
    for name, path in files.items():
        assert path.read_text() == made[name]


def test_own_meshes_are_draped_by_a_plain_clone(tmp_path):
    """A copy of only the configurations: a bell-shaped cloth over a standing skittle."""
    shutil.copytree(CONFIGS, tmp_path / "configs")
    task = load_task(tmp_path / "configs/drape_own.yaml", ["simulation.steps=24"])
    bell, (skittle, _) = task.scene.cloths[0], task.scene.bodies
    placed = transform(skittle.vertices, skittle.pose)
    assert np.ptp(placed[:, 2]) == pytest.approx(0.38)
    assert placed[:, 2].min() == pytest.approx(0, abs=1e-9)
    triangles = skittle.vertices[skittle.faces]
    assert np.linalg.det(triangles).sum() > 0  # faces point outward
    lengths = np.linalg.norm(np.diff(bell.vertices[bell.faces], axis=1), axis=-1)
    assert lengths.max() < 2.5 * lengths.min()
    states = list(simulate(task))
    assert states[-1].report.converged
    assert states[-1].report.contact_count > 0
    # The fall has ended on the skittle's head.
    assert states[-1].positions[:, 2].max() > 0.38
