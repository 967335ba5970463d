"""Elasticity and time integration against closed forms, through the public interface.

The expected numbers come from theory: the inextensible elastica under its own weight or an end
load, the catenary, free fall, and the recursions of implicit Euler.
"""

import numpy as np
import pytest
import scipy.integrate
import torch
from physics_scenes import (
    F64,
    WEIGHTLESS,
    jittered_sheet,
    lumped_masses,
    rotation,
    settle,
    strip,
    tensor,
)

import diffcloth_torch as dc

NO_CONTACT = dc.ContactOptions(self_contact=False)


def make_sim(cloths, dt, *, gravity=WEIGHTLESS, tolerance=1e-10, **keywords):
    scene = dc.Scene(cloths if isinstance(cloths, list) else [cloths], gravity=gravity)
    solver = dc.SolverOptions(tolerance=tolerance)
    return dc.Simulator(scene, dt, contact=NO_CONTACT, solver=solver, **keywords)


# --- Membrane ------------------------------------------------------------------------------------


def edge_loads(vertices, faces, stretches, k_s):
    """Forces that hold an affine stretch of a square: tractions k_s (s - 1) on its edges."""
    loads = np.zeros_like(vertices)
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, count = np.unique(sides, axis=0, return_counts=True)
    for a, b in edges[count == 1]:
        tangent = (vertices[b] - vertices[a])[:2]
        length = np.linalg.norm(tangent)
        normal = np.array([tangent[1], -tangent[0]]) / length
        middle = 0.5 * (vertices[a] + vertices[b])[:2] - vertices[:, :2].mean(axis=0)
        normal *= np.sign(normal @ middle)
        force = k_s * (np.array(stretches) - 1) * normal * length
        loads[[a, b], :2] += 0.5 * force
    return loads


@pytest.mark.parametrize("stretches", [(1.2, 1.0), (1.3, 1.1)])
def test_an_affine_stretch_is_held_by_its_edge_tractions(stretches):
    k_s = 200.0
    vertices, faces = jittered_sheet(6, 1.0)
    sim = make_sim(dc.Cloth(vertices, faces, material=dc.Material(stretch=k_s)), 0.01)
    R = rotation([1, 2, 3], 0.7)
    stretched = vertices * [*stretches, 1.0] @ R.T
    loads = edge_loads(vertices, faces, stretches, k_s) @ R.T
    state = sim.initial_state().replace(positions=tensor(stretched))
    after = sim.step(state, dc.Control(forces=loads))
    assert (after.positions - state.positions).abs().max() < 1e-10
    # Without the loads the sheet springs back at once.
    assert (sim.step(state).positions - state.positions).abs().max() > 1e-3


def test_rigid_motion_and_folding_cost_no_membrane_energy():
    k_s, area = 1e4, 1.0
    material = dc.Material(stretch=k_s, bending=0.0)
    vertices, faces = strip(8, 9, 1.0, 1.0)
    sim = make_sim(dc.Cloth(vertices, faces, material=material), 0.01)
    x = vertices @ rotation([3, 1, 2], 1.1).T + [5, -3, 2]
    state = sim.initial_state()
    assert abs(sim.energy(state.replace(positions=tensor(x)))) < 1e-12 * k_s * area
    fold = vertices.copy()
    beyond = vertices[:, 0] > 0.5
    hinge = rotation([0, 1, 0], -2.0)
    fold[beyond] = (vertices[beyond] - [0.5, 0, 0]) @ hinge.T + [0.5, 0, 0]
    # The fold runs along a row of vertices: no diagonal crosses x = 0.5.
    assert abs(sim.energy(state.replace(positions=tensor(fold)))) < 1e-12 * k_s * area


@pytest.mark.parametrize("over", [1.5, 5.0])
@pytest.mark.parametrize("yarn", ["warp", "weft"])
@pytest.mark.parametrize("name", ["tablecloth", "denim", "blanket"])
def test_a_dead_load_along_a_yarn_strains_it_by_its_stiffness(name, yarn, over):
    """The strain is T / k for any shear stiffness, and the sides are straight.

    With a strain that grows quadratically with shear, S_ww - 1 = |w| cos - 1, a strip would shear
    spontaneously from T = 2 k_wf (1 + T / k) on. Loads are multiples of this T, up to a strain of
    0.6.
    """
    material = dc.fabrics.material(name)
    k = material.stretch if yarn == "warp" else material.stretch_weft
    ratio = 2 * material.stretch_shear / k
    tension = k * min(over * ratio / (1 - ratio), 0.6)
    rows, columns, length, width = 7, 18, 0.3, 0.12
    direction = [1.0, 0.0, 0.0] if yarn == "warp" else [0.0, 1.0, 0.0]
    ends = np.arange(rows)[:, None] * columns + [0, columns - 1]
    cloth = dc.Cloth.grid(
        *(rows, columns, (length, width)),
        material=material,
        directions=direction,
        pins={"clamp": ends[:, 0]},
    )
    loads = np.zeros((rows * columns, 3))
    loads[ends[:, 1], 0] = tension * width / (rows - 1)
    loads[ends[[0, -1], 1], 0] /= 2
    sim = make_sim(cloth, 0.01, tolerance=1e-8)
    rest = sim.equilibrium(sim.initial_state(), dc.Control(forces=tensor(loads)))
    assert rest.report.iterations < 60
    x = rest.positions.numpy() - cloth.vertices
    np.testing.assert_allclose(x[ends[:, 1], 0] / length, tension / k, rtol=1e-6)
    assert np.abs(x[:, 1:]).max() < 1e-6 * length


def test_a_strip_stretches_under_its_own_weight():
    # The elongation w L^2 / (2 k_s) is exact for rows of lumped weight. The lumped masses of the
    # corners are uneven, but by reciprocity the end's mean displacement, weighted as a uniform end
    # load, does not depend on this for small strains.
    cells, rows, length, width, density, k_s, g = 20, 4, 2.0, 0.3, 0.3, 6e4, 9.81
    vertices, faces = strip(cells, rows, length, width)
    material = dc.Material(stretch=k_s, density=density)
    cloth = dc.Cloth(vertices, faces, material=material, pins={"top": range(rows)})
    sim = make_sim(cloth, 0.5, gravity=(g, 0, 0))
    after = settle(sim, sim.initial_state())
    ends = after.positions[-rows:, 0].numpy() - length
    elongation = np.average(ends, weights=[0.5, 1, 1, 0.5])
    assert elongation / length == pytest.approx(density * g * length / (2 * k_s), rel=1e-6)


# --- Bending -------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 4, 1.2, np.pi / 2])
def test_a_sheet_on_a_cylinder_has_the_energy_of_its_curvature(angle):
    # E = D c^2 A / 2; the membrane is weak because chords are shorter than arcs.
    D, c, size = 2.0, 0.3, 1.0
    vertices, faces = jittered_sheet(8, size)
    material = dc.Material(stretch=1e-4, bending=D, poisson=0.3)
    sim = make_sim(dc.Cloth(vertices, faces, material=material), 0.01)
    d = np.array([np.cos(angle), np.sin(angle), 0])
    e = np.array([-np.sin(angle), np.cos(angle), 0])
    s, t = vertices @ d, vertices @ e
    wrapped = np.outer(np.sin(c * s) / c, d) + np.outer(t, e)
    wrapped[:, 2] = (1 - np.cos(c * s)) / c
    energy = sim.energy(sim.initial_state().replace(positions=tensor(wrapped)))
    assert energy.item() / (0.5 * D * c**2 * size**2) == pytest.approx(1, abs=0.05)


def clamped_strip(D, *, density, cells, rows=3):
    """Horizontal strip of nu = 0, clamped by two pinned columns; its free part is 1 m long."""
    cell = 1 / cells
    vertices, faces = strip(cells + 1, rows, 1 + cell, 4 * cell)
    vertices[:, 0] -= cell
    material = dc.Material(stretch=1e3, bending=D, poisson=0.0, density=density)
    return dc.Cloth(vertices, faces, material=material, pins={"clamp": range(2 * rows)})


# Heavy elastica: Gamma = w L^3 / D, tip drop H / L and reach W / L.
HEAVY = [(1.0, 0.123471, 0.991246), (8.0, 0.640631, 0.724425)]


@pytest.mark.parametrize(("gamma", "drop", "reach"), HEAVY)
def test_a_heavy_cantilever_bends_like_the_elastica(gamma, drop, reach):
    D, g = 1e-2, 10.0

    def tip(cells):
        cloth = clamped_strip(D, density=gamma * D / g, cells=cells)
        sim = make_sim(cloth, 0.5, gravity=(0, 0, -g), tolerance=1e-8)
        return settle(sim, sim.initial_state(), speed=1e-5).positions[-3:].mean(dim=0).numpy()

    coarse, fine = tip(20), tip(40)
    expected = np.array([reach, -drop])
    assert fine[[0, 2]] == pytest.approx(expected, rel=0.03)
    # The clamp adds about half a cell of free length: an error of first order, and no other.
    assert (2 * fine - coarse)[[0, 2]] == pytest.approx(expected, rel=0.005)


# Elastica under a dead load at its end: alpha = P L^2 / (D b), tip deflection w / L.
SHEARED = [(0.8, 0.24945), (2.4, 0.54455), (4.0, 0.66996)]


@pytest.mark.parametrize(("alpha", "deflection"), SHEARED)
def test_a_cantilever_under_end_shear_bends_like_the_elastica(alpha, deflection):
    D = 1e-2

    def tip(cells):
        cloth = clamped_strip(D, density=0.01, cells=cells)
        sim = make_sim(cloth, 0.5, tolerance=1e-8)
        forces = np.zeros_like(cloth.vertices)
        forces[-3:, 2] = alpha * D * (4 / cells) * np.array([0.25, 0.5, 0.25])
        after = settle(sim, sim.initial_state(), dc.Control(forces=forces), speed=1e-5)
        return after.positions[-3:, 2].mean().item()

    coarse, fine = tip(20), tip(40)
    assert fine == pytest.approx(deflection, rel=0.02)
    assert 2 * fine - coarse == pytest.approx(deflection, rel=0.005)


def droop_of_the_elastica(gamma):
    """Drop of the tip over the length of a heavy elastica: theta'' = -gamma (1 - s) cos theta."""

    def slope(s, y):
        return np.stack([y[1], -gamma * (1 - s) * np.cos(y[0])])

    s = np.linspace(0, 1, 50)

    def ends(at_clamp, at_tip):
        return np.array([at_clamp[0], at_tip[1]])

    solution = scipy.integrate.solve_bvp(
        slope, ends, s, np.stack([-0.5 * s, -0.5 + 0 * s]), tol=1e-8
    )
    t = np.linspace(0, 1, 2001)
    return np.trapezoid(np.sin(solution.sol(t)[0]), t)


@pytest.mark.parametrize("alternating", [False, True])
@pytest.mark.parametrize(
    ("cells", "rows", "width"),
    [
        pytest.param(30, 4, 0.01, id="31 x 4"),
        pytest.param(40, 3, 0.01, id="41 x 3"),
        pytest.param(24, 5, 0.008, id="25 x 5"),
        pytest.param(30, 2, 0.01, id="31 x 2"),
    ],
)
def test_a_narrow_strip_droops_like_the_elastica(cells, rows, width, alternating):
    # Held at its middle column, which symmetry keeps level. Most triangles are at the boundary.
    D, density, length, g = 1e-3, 0.2, 0.3, 9.81
    material = dc.Material(stretch=3e3, bending=D, poisson=0.0, density=density)
    vertices, faces = strip(cells, rows, length, width, alternating=alternating)
    middle = range(cells // 2 * rows, (cells // 2 + 1) * rows)
    cloth = dc.Cloth(vertices, faces, material=material, pins={"middle": middle})
    sim = make_sim(cloth, 0.5, gravity=(0, 0, -g), tolerance=1e-8)
    z = settle(sim, sim.initial_state(), speed=1e-5).positions[:, 2].reshape(-1, rows)
    expected = droop_of_the_elastica(density * g * (length / 2) ** 3 / D)
    assert -z[[0, -1]].mean().item() / (length / 2) == pytest.approx(expected, rel=0.01)


# Sag of the catenary of span 1 by its length.
CATENARY = [(1.1, 0.200301), (1.5, 0.502633), (2.0, 0.796388)]


@pytest.mark.parametrize(("length", "sag"), CATENARY)
def test_a_light_strip_hangs_in_a_catenary(length, sag):
    cells, rows, g = 32, 2, 9.81
    rest, faces = strip(cells, rows, length, 0.05)
    # Start on the half of an ellipse of about that length; only its ends matter.
    t = np.pi * rest[:, 0] / length
    start = np.stack([0.5 - 0.5 * np.cos(t), rest[:, 1], -0.9 * sag * np.sin(t)], axis=-1)
    material = dc.Material(stretch=2e3, bending=1e-9, density=0.1)
    ends = [*range(rows), *range(cells * rows, (cells + 1) * rows)]
    cloth = dc.Cloth(start, faces, material=material, rest_positions=rest, pins={"ends": ends})
    sim = make_sim(cloth, 0.1, gravity=(0, 0, -g), tolerance=1e-6)
    after = settle(sim, sim.initial_state(), steps=200, speed=1e-4)
    assert -after.positions[:, 2].min().item() == pytest.approx(sag, rel=0.01)


# --- Time integration ----------------------------------------------------------------------------


@pytest.mark.parametrize("k_s", [1.0, 1e6])
@pytest.mark.parametrize("scheme", ["coupled", "split"])
def test_free_fall_is_implicit_eulers(k_s, scheme):
    # z_n = z_0 + n h v_0 - g h^2 n (n + 1) / 2
    h, g, steps = 0.01, 9.81, 20
    vertices, faces = jittered_sheet(5, 0.5)
    material = dc.Material(stretch=k_s, damping=1e-3)
    sim = make_sim(
        dc.Cloth(vertices, faces, material=material), h, gravity=(0, 0, -g), scheme=scheme
    )
    v_0 = torch.tensor([0.3, -0.2, 1.0], dtype=F64)
    state = sim.initial_state()
    state = state.replace(velocities=v_0.expand_as(state.velocities).clone())
    for _ in range(steps):
        state = sim.step(state)
    expected = sim.initial_state().positions + steps * h * v_0
    expected[:, 2] -= g * h**2 * steps * (steps + 1) / 2
    assert (state.positions - expected).abs().max() < 1e-10


def test_a_mass_on_a_soft_pin_follows_implicit_euler():
    # A triangle in translation is one mass on one spring: its three vertices weigh the same.
    h, k, m, x_0, steps = 0.01, 50.0, 0.3, 0.1, 100
    corners = np.array([[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(0.75), 0]])
    material = dc.Material(density=3 * m / (0.25 * np.sqrt(3)))
    cloth = dc.Cloth(
        corners, [[0, 1, 2]], material=material, soft_pins={"all": range(3)}, pin_stiffness=k
    )
    sim = make_sim(cloth, h)
    offset = torch.tensor([x_0, 0, 0], dtype=F64)
    state = sim.initial_state()
    state = state.replace(positions=state.positions + offset)
    x, v = x_0, 0.0
    energies = []
    for _ in range(steps):
        state = sim.step(state)
        v = (v - h * k / m * x) / (1 + h**2 * k / m)
        x += h * v
        energies.append(0.5 * k * x**2 + 0.5 * m * v**2)
    moved = state.positions - tensor(corners)
    assert moved[:, 0].numpy() == pytest.approx(np.full(3, x), abs=1e-8)
    assert state.velocities[:, 0].numpy() == pytest.approx(np.full(3, v), abs=1e-8)
    # The amplitude falls by 1 / sqrt(1 + w^2 h^2) a step.
    loss = (energies[-1] / energies[0]) ** (0.5 / (steps - 1))
    assert loss == pytest.approx(1 / np.sqrt(1 + k / m * h**2), rel=1e-10)


def test_a_swinging_cloth_converges_at_first_order():
    vertices, faces = jittered_sheet(6, 0.5)
    top = np.flatnonzero(vertices[:, 0] == 0)
    material = dc.Material(stretch=20.0, bending=1e-4)
    cloth = dc.Cloth(vertices, faces, material=material, pins={"edge": top})

    def end(h):
        sim = make_sim(cloth, h, gravity=(0, 0, -9.81), tolerance=1e-9)
        state = sim.initial_state()
        for _ in range(round(0.24 / h)):
            state = sim.step(state)
        return state.positions

    a, b, c = (end(h) for h in (4e-3, 2e-3, 1e-3))
    order = torch.log2((a - b).norm() / (b - c).norm()).item()
    assert 0.85 < order < 1.15


@pytest.mark.rounding
def test_a_flat_sheet_hung_by_two_corners_buckles():
    # A planar solution would be a saddle: the Hessian's smallest eigenvalue is negative.
    vertices, faces = strip(11, 12, 1.0, 1.0)
    pins = {"corners": [0, 11]}
    cloth = dc.Cloth(vertices, faces, material=dc.Material(stretch=1e4), pins=pins)
    sim = make_sim(cloth, 0.05, gravity=(9.81, 0, 0), tolerance=1e-6)
    state = sim.step(sim.initial_state())
    assert state.positions[:, 2].abs().max() > 1e-4


def spin(damping, steps=20):
    vertices, faces = jittered_sheet(5, 0.5)
    material = dc.Material(stretch=1e4, bending=1e-3, damping=damping)
    sim = make_sim(dc.Cloth(vertices, faces, material=material), 0.01)
    masses = tensor(lumped_masses(vertices, faces, material.density))[:, None]
    omega = tensor([0.5, 1.0, 2.0]).expand(len(vertices), 3)
    state = sim.initial_state()
    x = state.positions
    center = (masses * x).sum(0) / masses.sum()
    state = state.replace(velocities=torch.linalg.cross(omega, x - center))
    momenta = []
    for _ in range(steps):
        momenta.append((masses * torch.linalg.cross(state.positions, state.velocities)).sum(0))
        state = sim.step(state)
    return momenta


def test_damping_does_not_brake_a_rigid_rotation():
    free, damped = spin(0.0), spin(1e-3)
    assert free[0].norm() > 0
    loss = 1 - free[-1].norm() / free[0].norm()
    loss_damped = 1 - damped[-1].norm() / damped[0].norm()
    assert 0 < loss < 0.05
    assert loss_damped == pytest.approx(loss.item(), rel=1e-3)
