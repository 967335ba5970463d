"""The step of second order: momentum, order, drag, rest, bits and refused options."""

from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch

import diffcloth_torch as dc

F64 = torch.float64
SECOND = "second_order"


def sheet(n=5, side=0.5, pins=None, **material):
    grid = dc.Cloth.grid(n, n, side)
    vertices = np.array(grid.vertices)
    vertices[:, :2] += np.random.default_rng(0).uniform(-0.01, 0.01, (n * n, 2)) * side
    return dc.Cloth(vertices, grid.faces, pins=pins, material=dc.Material(**material))


def simulator(cloth, h=0.01, integrator=SECOND, gravity=(0, 0, -9.81), tolerance=1e-9, **options):
    return dc.Simulator(
        dc.Scene([cloth], gravity=gravity),
        h,
        integrator=integrator,
        contact=dc.ContactOptions(self_contact=False),
        solver=dc.SolverOptions(tolerance=tolerance),
        **options,
    )


def rolled(sim, steps, state=None):
    state = sim.initial_state() if state is None else state
    with torch.no_grad():
        for _ in range(steps):
            state = sim.step(state)
    return state


def spinning(sim, spin):
    state = sim.initial_state()
    masses = sim.vertex_masses()[:, None]
    center = (masses * state.positions).sum(dim=0) / masses.sum()
    x = state.positions - center
    omega = torch.tensor(spin, dtype=F64)
    return state.replace(velocities=torch.linalg.cross(omega.expand_as(x), x) + 0.2)


def angular(sim, state):
    """Angular momentum about the center of mass."""
    masses = sim.vertex_masses()[:, None]
    center = (masses * state.positions).sum(dim=0) / masses.sum()
    momentum = sim.momentum(state)
    return momentum[3:] - torch.linalg.cross(center, momentum[:3])


@pytest.mark.parametrize("spin", [(0, 0, 5.0), (5.0, 0, 0), (3.0, 1.0, 4.0)])
def test_a_free_sheet_keeps_its_momentum(spin):
    left = {}
    for integrator in ("implicit_euler", SECOND):
        sim = simulator(sheet(), gravity=(0, 0, 0), integrator=integrator)
        start = spinning(sim, spin)
        after = rolled(sim, 50, start)
        left[integrator] = (angular(sim, after).norm() / angular(sim, start).norm()).item()
        change = (sim.momentum(after) - sim.momentum(start))[:3].norm()
        assert change < 1e-12 * sim.momentum(start)[:3].norm() * 50
    assert left["implicit_euler"] < 0.93
    assert 0.995 < left[SECOND] < 1.005


def test_errors_fall_with_the_square_of_the_time_step():
    """Over .3 s of a soft sheet that swings from one edge in air, with drag."""
    edge = range(20, 25)
    cloth = sheet(pins={"edge": edge}, stretch=20.0, bending=1e-3, normal_drag=1.5)

    def end(h, integrator):
        return rolled(simulator(cloth, h, integrator), round(0.3 / h)).positions

    exact = end(0.01 / 16, SECOND)
    errors = {
        (h, name): (end(h, name) - exact).abs().max().item()
        for h in (0.01, 0.005, 0.0025)
        for name in ("implicit_euler", SECOND)
    }
    assert errors[0.0025, SECOND] < 0.33 * errors[0.005, SECOND]
    assert errors[0.005, SECOND] < 0.4 * errors[0.01, SECOND]
    assert errors[0.0025, SECOND] < 0.1 * errors[0.0025, "implicit_euler"]
    assert errors[0.0025, "implicit_euler"] > 0.4 * errors[0.005, "implicit_euler"]


def test_damping_is_of_second_order():
    """Over .3 s of a soft, damped sheet that falls into its hanging shape."""
    cloth = sheet(pins={"edge": range(20, 25)}, stretch=2.0, bending=1e-3, damping=0.05)
    upright = np.stack([cloth.vertices[:, 0], 0 * cloth.vertices[:, 0], cloth.vertices[:, 1]], 1)
    held = dc.Cloth(
        upright,
        cloth.faces,
        rest_positions=cloth.vertices,
        pins=dict(cloth.pins),
        material=cloth.material,
    )

    def end(h):
        return rolled(simulator(held, h), round(0.3 / h)).positions

    exact = end(0.01 / 16)
    coarse, middle, fine = ((end(h) - exact).norm().item() for h in (0.01, 0.005, 0.0025))
    assert fine < 0.3 * middle
    assert middle < 0.3 * coarse


@pytest.mark.parametrize(("damping", "h"), [(0.01, 0.005), (0.01, 0.02), (0.1, 0.005)])
def test_damping_of_a_violent_motion_gains_no_energy(damping, h):
    """Velocities of 1 m/s at random: edges of .125 m turn by up to .4 rad in a step of .02 s."""
    sim = simulator(sheet(damping=damping), h=h, gravity=(0, 0, 0))
    noise = torch.Generator().manual_seed(0)
    start = sim.initial_state()
    moving = torch.randn(start.velocities.shape, generator=noise, dtype=F64)
    energies = []
    state = start.replace(velocities=moving)
    with torch.no_grad():
        for _ in range(20):
            energies.append((sim.kinetic_energy(state) + sim.energy(state)).item())
            state = sim.step(state)
    assert max(energies[1:]) < energies[0], energies
    assert energies[-1] < 0.7 * energies[0], energies


def test_damping_does_not_strain_a_sheet_that_turns():
    sim = simulator(sheet(damping=0.05), gravity=(0, 0, 0))
    start = spinning(sim, (3.0, 0.0, 4.0))
    with torch.no_grad():
        state = start
        for _ in range(30):
            state = sim.step(state)
            strain = sim.energy(state, parts=True)["stretch"] / sim.kinetic_energy(start)
            assert strain < 0.01
    assert (angular(sim, state).norm() / angular(sim, start).norm()).item() > 0.999


def test_a_sheet_at_rest_stays_as_by_euler():
    """Without velocities there is no shift: both integrators minimize the same sum."""
    case = scenes.regime("sticking")
    rest = case.state.replace(velocities=torch.zeros_like(case.state.velocities))
    second = scenes.regime("sticking", integrator=SECOND)
    still = case.where(state=rest), second.where(state=rest)
    # Without air and damping, because drag and damping depend on the integrator's mean velocity.
    none = torch.zeros((), dtype=F64)
    parameters = {"air_density": none, "damping": none}
    ends = [replace(c, parameters=parameters).step().positions for c in still]
    torch.testing.assert_close(*ends, rtol=0, atol=1e-9)


def test_a_batch_and_threads_have_the_bits_of_one():
    case = scenes.regime("stacked", integrator=SECOND)
    other = case.state.replace(velocities=case.state.velocities * 0.7)
    with torch.no_grad():
        alone = [case.sim.step(state) for state in (case.state, other)]
        before = torch.get_num_threads()
        try:
            torch.set_num_threads(2)
            both = case.sim.step(dc.stack([case.state, other]))
        finally:
            torch.set_num_threads(before)
    for k, state in enumerate(alone):
        assert torch.equal(both.positions[k], state.positions)
        assert torch.equal(both.velocities[k], state.velocities)


def test_velocities_of_the_initial_state_are_half_a_step_early():
    sim = simulator(sheet())
    fall = torch.tensor([0, 0, -9.81], dtype=F64)
    state = sim.initial_state()
    torch.testing.assert_close(
        state.velocities, (-0.005 * fall).expand_as(state.velocities), rtol=0, atol=1e-9
    )
    after = rolled(sim, 10, state)
    fallen = after.positions - state.positions
    torch.testing.assert_close(fallen, (0.5 * 0.1**2 * fall).expand_as(fallen), rtol=0, atol=1e-9)
    given = sim.initial_state(2).velocities
    assert torch.equal(given[0], state.velocities)


def test_given_velocities_are_converted():
    sim = simulator(sheet())
    thrown = torch.tensor([1.0, 0.0, 2.0], dtype=F64)
    state = sim.initial_state()
    state = dc.at_half_step(state.replace(velocities=thrown.expand_as(state.velocities)))
    fall = torch.tensor([0, 0, -9.81], dtype=F64)
    after = rolled(sim, 10, state)
    moved = after.positions - state.positions
    expected = 0.1 * thrown + 0.5 * 0.1**2 * fall
    torch.testing.assert_close(moved, expected.expand_as(moved), rtol=0, atol=1e-9)


def test_the_conversion_needs_a_simulator_of_second_order():
    euler = simulator(sheet(), integrator="implicit_euler")
    with pytest.raises(dc.InvalidInput, match=r"at_half_step: the simulator of `state`"):
        dc.at_half_step(euler.initial_state())
    with pytest.raises(dc.InvalidInput, match=r"at_half_step: needs a simulator"):
        dc.at_half_step(euler.initial_state(), simulator=euler)


def test_unsupported_options_are_refused_by_name():
    scene = dc.Scene([sheet()])
    with pytest.raises(dc.InvalidInput, match=r"`integrator` 'second_order' needs scheme"):
        dc.Simulator(scene, 0.01, scheme="split", integrator=SECOND)
    with pytest.raises(dc.InvalidInput, match=r"needs coupling 'monolithic'"):
        dc.Simulator(scene, 0.01, coupling="rigid_to_cloth", integrator=SECOND)
    with pytest.raises(dc.InvalidInput, match=r"Simulator: `integrator`"):
        dc.Simulator(scene, 0.01, integrator="leapfrog")


def test_a_file_keeps_the_integrator(tmp_path):
    sim = simulator(sheet())
    torch.save(sim, tmp_path / "sim.pt")
    again = torch.load(tmp_path / "sim.pt", weights_only=False)
    assert again.integrator == SECOND
    assert "integrator='second_order'" in repr(again)
    assert torch.equal(rolled(again, 3).positions, rolled(sim, 3).positions)


def test_a_step_that_does_not_converge_is_a_value():
    case = scenes.regime("stacked", integrator=SECOND)
    solver = dc.SolverOptions(max_iterations=1, throw=False)
    sim = dc.Simulator(
        case.sim.scene, case.sim.dt, contact=case.sim.contact, solver=solver, integrator=SECOND
    )
    after = sim.step(case.state)
    assert not after.report.converged
    assert after.report.status == "not_converged"
