"""Observed points of cloth are the same material points at every size of its mesh."""

from __future__ import annotations

import pytest
import torch

import diffcloth_torch.envs as envs
from diffcloth_torch.envs.key_points import KeyPoints
from diffcloth_torch.envs.sheets import SIDE

# Sheets whose shape at the start does not depend on the size of the mesh.
ALIKE = ("FoldCloth", "DropCloth", "LiftCloth", "HangCloth", "GraspCloth", "HitCloth", "PushCube")


def grid(rows, columns):
    """Places (row, column) of vertices in units of the sheet, [1, N, 2]."""
    v, u = torch.meshgrid(
        torch.linspace(0, 1, rows, dtype=torch.float64),
        torch.linspace(0, 1, columns, dtype=torch.float64),
        indexing="ij",
    )
    return torch.stack([v, u], dim=-1).reshape(1, -1, 2)


@pytest.mark.parametrize("size", [(4, 4), (5, 9), (7, 7), (12, 8), (25, 24), (2, 3)])
@pytest.mark.parametrize("shape", [(4, 4), (2, 5)])
def test_points_are_evenly_spaced_from_edge_to_edge(size, shape):
    places = grid(*size)
    points = KeyPoints.on_grid(size, shape)
    assert len(points) == shape[0] * shape[1]
    torch.testing.assert_close(points.of(places), grid(*shape), rtol=0, atol=1e-14)
    bilinear = places.prod(dim=-1, keepdim=True)
    torch.testing.assert_close(
        points.of(bilinear), grid(*shape).prod(dim=-1, keepdim=True), rtol=0, atol=1e-14
    )


@pytest.mark.parametrize(("size", "step"), [(4, 1), (7, 2), (13, 4)])
def test_points_at_vertices_are_these_vertices(size, step):
    values = torch.randn(2, size * size, 3, generator=torch.Generator().manual_seed(0))
    chosen = values.reshape(2, size, size, 3)[:, ::step, ::step].reshape(2, -1, 3)
    assert torch.equal(KeyPoints.on_grid((size, size)).of(values), chosen)


@pytest.mark.parametrize("name", ALIKE)
def test_a_start_is_observed_alike_at_every_size(name):
    first = {}
    for size in (7, 8, 12):
        env = envs.make(name, 2, size=size)
        observation, _ = env.reset(seed=3)
        first[size] = observation[:, env.task.observation_slices["positions"]]
    for size in (8, 12):
        # The cube, and hence the frame of PushCube, is a tenth of an edge above the table.
        torch.testing.assert_close(
            first[size], first[7], rtol=0, atol=2e-3 if name == "PushCube" else 1e-6
        )


def test_strips_are_observed_at_the_vertices_of_0_1():
    env = envs.make("TwoCloths", 1, size=4)
    env.reset(seed=0)
    positions = env.env_state.state.positions[0]
    assert len(positions) == 150
    rows = [0, 8, 16, 24, 31, 39, 47, 55, 63, 71, 78, 86, 94, 102, 110, 118, 125, 133, 141, 149]
    seen = env.task.features(env.env_state)["positions"].reshape(20, 3)
    assert torch.equal(seen, positions[rows])


@pytest.mark.parametrize("name", ["FoldCloth", "HitCloth", "TwoCloths"])
def test_all_vertices_are_particles(name):
    env = envs.make(name, 1, size=8, observation="particles", frame="world")
    env.reset(seed=0)
    seen, state = env.task.features(env.env_state), env.env_state.state
    assert seen["velocities"].numel() == state.velocities.numel()
    unit = SIDE if name == "FoldCloth" else 1.0
    assert torch.equal(seen["positions"], state.positions.flatten(1) / unit)


def test_a_point_does_not_depend_on_the_number_of_rows():
    generator = torch.Generator().manual_seed(1)
    values = torch.randn(33, 81, 3, dtype=torch.float64, generator=generator)
    points = KeyPoints.on_grid((9, 9))
    together = points.of(values)
    for row in range(33):
        assert torch.equal(points.of(values[row : row + 1])[0], together[row])
