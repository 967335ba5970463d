"""Sheets that swing, fall and fold on bodies gain no energy, however stiff, in any time step."""

import numpy as np
import pytest
from physics_scenes import lumped_masses, rotation
from torch import tensor

import diffcloth_torch as dc

SEEDS = range(20)
QUICK = (3, 5, 9, 11, 14, 17)
ALONG_Y = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]


def obstacle(kind, place):
    """A body with its top (a capsule along y: its axis) at `place`."""
    x, y, z = place
    if kind == "capsule":
        return dc.RigidBody.capsule(0.05, 1.0, pose=[x, y, z, *ALONG_Y])
    if kind == "box":
        return dc.RigidBody.box([0.1, 0.8, 0.1], pose=[x, y, z, 1, 0, 0, 0])
    return dc.RigidBody.plane(4.0, pose=[0, 0, z, 1, 0, 0, 0])


def passive_scene(seed):
    """Scene, time step [s] and velocity [m/s] of a sheet without driving forces."""
    r = np.random.default_rng(seed)
    motion, kind = ("swing", "fall", "fold")[seed % 3], ("capsule", "box", "floor")[seed // 3 % 3]
    n, size = int(r.integers(6, 10)), r.uniform(0.35, 0.6)
    stretch, dt = 10 ** r.uniform(np.log10(50), np.log10(5000)), 10 ** r.uniform(-2.5, -1.53)
    material = dc.Material(
        stretch=stretch,
        bending=10 ** r.uniform(-5, -3.5),
        density=r.uniform(0.1, 0.3),
        friction=r.uniform(0, 0.5),
    )
    flat = dc.Cloth.grid(n, n, size)
    rest = flat.vertices - flat.vertices.mean(axis=0)
    vertices = rest + 1e-4 * r.standard_normal((len(rest), 1)) * [0, 0, 1]
    speed, pins = np.zeros(3), {}
    if motion == "swing":
        pins = {"edge": np.flatnonzero(np.isclose(rest[:, 0], rest[:, 0].min())).tolist()}
        bodies = [
            obstacle(kind, (r.uniform(-0.03, 0.08) - size / 2, 0, -r.uniform(0.3, 0.8) * size))
        ]
    else:
        if motion == "fold":
            vertices = vertices @ rotation((0, 1, 0), r.uniform(0.8, 1.4)).T
        speed = np.array([*r.uniform(-0.5, 0.5, 2), r.uniform(-1.5, 0)])
        low = vertices[:, 2].min() - 0.02
        top = low if kind == "floor" else low - 0.05
        bodies = [obstacle(kind, (0.02, 0.03, top))]
        if kind != "floor":
            bodies.append(obstacle("floor", (0, 0, low - 0.3)))
    cloth = dc.Cloth(vertices, flat.faces, rest_positions=rest, material=material, pins=pins)
    return dc.Scene([cloth], bodies), dt, speed


def energy_gained(scene, dt, speed=(0.0, 0.0, 0.0), *, metric=None, duration=0.5):
    """Largest rise of the energy of `split` above an earlier value, over m g .2 m."""
    solver = dc.SolverOptions(metric=metric)
    sim = dc.Simulator(scene, dt, scheme="split", solver=solver)
    (cloth,) = scene.cloths
    masses = tensor(lumped_masses(cloth.rest_positions, cloth.faces, cloth.material.density))
    state = sim.initial_state()
    state = state.replace(velocities=state.velocities + tensor(np.asarray(speed)))
    energies, touched = [], False
    for _ in range(round(duration / dt)):
        kinetic = 0.5 * (masses[:, None] * state.velocities**2).sum().item()
        energies.append(sim.energy(state).item() + kinetic)
        state = sim.step(state)
        touched |= state.report.contact_count > 0
    assert touched
    energies = np.array(energies) / (masses.sum().item() * 9.81 * 0.2)
    return (energies - np.minimum.accumulate(energies)).max()


@pytest.mark.parametrize(
    "seed", [s if s in QUICK else pytest.param(s, marks=pytest.mark.slow) for s in SEEDS]
)
def test_passive_sheets_gain_no_energy_in_split(seed):
    assert energy_gained(*passive_scene(seed)) < 0.02


def swing(stretch):
    """A sheet of .45 m that swings onto a capsule below its pinned edge."""
    flat = dc.Cloth.grid(
        8, 8, 0.45, material=dc.Material(stretch=stretch, bending=1e-4, density=0.2)
    )
    rest = flat.vertices - flat.vertices.mean(axis=0)
    noise = 1e-4 * np.random.default_rng(1).standard_normal((len(rest), 1)) * [0, 0, 1]
    edge = np.flatnonzero(np.isclose(rest[:, 0], rest[:, 0].min())).tolist()
    cloth = dc.Cloth(
        rest + noise, flat.faces, rest_positions=rest, material=flat.material, pins={"edge": edge}
    )
    return dc.Scene([cloth], [obstacle("capsule", (-0.225, 0, -0.22))])


@pytest.mark.parametrize(("stretch", "dt"), [(5000.0, 0.03), (3000.0, 0.02), (500.0, 0.024)])
def test_a_sheet_that_swings_onto_a_capsule_gains_no_energy_in_split(stretch, dt):
    assert energy_gained(swing(stretch), dt) < 0.02


def test_a_metric_that_resists_turns_gains_energy_where_the_energy_itself_does_not():
    """A stiff sheet turns far in a step; therefore `elastic` is not the default (see the guide)."""
    scene, dt = swing(5000.0), 0.03
    assert energy_gained(scene, dt, metric="elastic") > 0.3
    assert energy_gained(scene, dt, metric="energy") < 0.02
