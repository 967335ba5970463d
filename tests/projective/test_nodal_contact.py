"""Dry friction at vertices: Coulomb's law without smoothing, and exact gradients of one step."""

import numpy as np
import pytest
import torch
from nodal_scenes import (
    BODIES,
    CASES,
    DT,
    assert_gradients_are_those_of_differences,
    counts,
    on_body,
)
from scenes import F64, tensor_noise

import diffcloth_torch as dc

G = 9.81


def loss(step, generator):
    """A sum of all outputs with random weights."""
    weights = [torch.randn(36, 3, dtype=F64, generator=generator) for _ in range(2)]
    forces = {
        name: torch.randn(getattr(step.state, name).shape, dtype=F64, generator=generator)
        for name in ("body_forces", "contact_forces", "pin_forces")
    }

    def value(changes=None):
        after = step(changes)
        return (
            (after.positions * weights[0]).sum()
            + DT * (after.velocities * weights[1]).sum()
            + sum(1e-2 * (getattr(after, name) * w).sum() for name, w in forces.items())
        )

    return value


def sizes_of(step):
    """Steps of the differences."""
    sizes = {}
    for name, tensor in step.inputs.items():
        size = 1e-6 if name in ("state.positions", "control.pins") else 1e-4
        largest = float(tensor.abs().max()) if name.startswith("parameters") else 1.0
        sizes[name] = size * max(1.0, largest)
    return sizes


@pytest.mark.quick("plane-sticking", "sphere-sticking", "capsule-sticking", "box-sticking")
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("kind", BODIES)
def test_gradients_of_a_step_are_those_of_differences(kind, case):
    step = on_body(kind, case)
    found = dict(zip(("taking_off", "sticking", "slipping"), counts(step()), strict=True))
    assert sum(found.values()) > 0
    assert found[case] > 0 or kind != "plane"
    generator = torch.Generator().manual_seed(0)
    value = loss(step, generator)
    assert_gradients_are_those_of_differences(value, step.inputs, sizes_of(step), generator)


def test_gradients_of_a_step_in_air_are_those_of_differences():
    """Air bends the outputs more than dry friction does, and differences are off by more."""
    step = on_body("plane", "slipping", drag=0.1)
    assert {"parameters.normal_drag", "parameters.air_density"} <= set(step.inputs)
    generator = torch.Generator().manual_seed(0)
    assert_gradients_are_those_of_differences(
        loss(step, generator), step.inputs, sizes_of(step), generator, most=2e-4
    )


@pytest.mark.parametrize("scheme", ["projective", "split"])
@pytest.mark.parametrize("case", CASES)
def test_forces_change_the_momentum(case, scheme):
    step = on_body("plane", case, scheme=scheme)
    after, sim = step(), step.sim
    masses = sim.vertex_masses()[:, None]
    change = (masses * (after.velocities - step.state.velocities)).sum(0) / DT
    spring = sim.default_parameters().pin_stiffness * (
        after.soft_pin_targets[0] - after.positions[35]
    )
    given = (masses * sim.default_parameters().gravity + step.inputs["control.forces"]).sum(
        0
    ) + spring
    total = given + after.contact_forces.sum(0) + after.pin_forces.sum(0)
    torch.testing.assert_close(change, total, rtol=1e-7, atol=1e-7)
    on_all = after.contact_forces.sum(0) + after.body_forces.sum(0)
    assert on_all.abs().max() < 1e-12
    pair = after.report.contacts["cloth0", "body0"]
    assert pair.count == sum(counts(after)[1:])
    torch.testing.assert_close(pair.force, after.body_forces.sum(0), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("kind", "share"), [("plane", 0.3), ("box", 0.1)])
def test_gradients_of_losses_add_up(kind, share):
    """Each loss has a separate adjoint solve, as precise as the step's equations."""
    step = on_body(kind, "slipping")
    v = (share * step.inputs["state.velocities"]).requires_grad_()
    positions = step({"state.velocities": v}).positions
    weights = tensor_noise((6, *positions.shape), 1.0, 1)
    losses = [*(positions * weights).sum((-1, -2)), (positions * weights.sum(0)).sum()]
    *parts, whole = (torch.autograd.grad(loss, v, retain_graph=True)[0] for loss in losses)
    assert (sum(parts) - whole).abs().max() < 8e-12 * whole.abs().max()


def test_the_normal_turns_with_the_vertex():
    # On a sphere the gradient by positions is far off if the contact frame is kept constant.
    # For this loss of a sliding sheet the derivative comes only from the frame.
    step = on_body("sphere", "slipping", moving=False)
    x = step.inputs["state.positions"].clone().requires_grad_()
    step({"state.positions": x}).velocities[:, 2].sum().backward()
    direction = torch.zeros_like(x)
    direction[:, 0] = 1.0
    difference = sum(
        sign
        * step({"state.positions": x.detach() + sign * 1e-6 * direction}).velocities[:, 2].sum()
        for sign in (-1, 1)
    )
    assert (x.grad * direction).sum().item() == pytest.approx(difference.item() / 2e-6, rel=1e-6)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("kind", ["plane", "sphere"])
def test_projective_dynamics_agrees_with_newton(kind, case):
    newton = on_body(kind, case, tolerance=1e-10)
    local_global = on_body(kind, case, tolerance=1e-9, elastic="projective")
    after, expected = local_global(newton.inputs), newton()
    assert after.report.counts["local_global"] > 0
    assert counts(after) == counts(expected)
    assert (after.positions - expected.positions).abs().max() < 1e-8


def test_a_tape_of_projective_dynamics_gives_the_gradient_of_newton():
    steps = [
        on_body("sphere", "slipping", tolerance=1e-9, elastic=e) for e in ("newton", "projective")
    ]
    gradients = []
    for step in steps:
        x = steps[0].inputs["state.positions"].clone().requires_grad_()
        after = step({**steps[0].inputs, "state.positions": x})
        gradients.append(torch.autograd.grad((after.positions**2).sum(), x)[0])
    torch.testing.assert_close(*gradients, rtol=1e-6, atol=1e-8)


def patch(friction, incline=0.0, dt=0.01, scheme="projective", **options):
    """A small sheet on a plane tilted about y, in contact; and the direction down the plane."""
    sheet = dc.Cloth.grid(3, 3, size=(0.1, 0.1))
    c, s = np.cos(incline), np.sin(incline)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    vertices = (np.array(sheet.vertices) + np.array([0, 0, 9.9e-4])) @ R.T
    cloth = dc.Cloth(
        vertices,
        sheet.faces,
        material=dc.Material(stretch=500.0, bending=1e-3, density=0.2, friction=friction),
    )
    turn = [np.cos(incline / 2), 0, np.sin(incline / 2), 0]
    floor = dc.RigidBody.plane(
        1.0, pose=[0, 0, 0, *turn], friction=friction, thickness=2e-3, nodal_contact=True
    )
    sim = dc.Simulator(
        dc.Scene([cloth], [floor]),
        dt,
        scheme=scheme,
        contact=dc.ContactOptions(self_contact=False),
        solver=dc.SolverOptions(tolerance=1e-9, **options),
    )
    return sim, sim.initial_state(), torch.from_numpy(R @ [1.0, 0.0, 0.0])


@pytest.mark.parametrize("scheme", ["projective", "split"])
@pytest.mark.parametrize("friction", [0.1, 0.3, 0.5, 0.7])
def test_a_sheet_sticks_without_creep_below_its_friction_angle_and_slides_above(friction, scheme):
    sim, state, _ = patch(friction, np.arctan(friction) - 1e-3, scheme=scheme)
    start = state.positions
    for _ in range(20):
        state = sim.step(state)
    assert counts(state) == (0, 9, 0)
    assert (state.positions - start).abs().max() < 1e-12

    sim, state, down = patch(friction, np.arctan(friction) + 1e-3, scheme=scheme)
    for _ in range(20):
        state = sim.step(state)
    assert counts(state) == (0, 0, 9)
    theta = np.arctan(friction) + 1e-3
    acceleration = G * (np.sin(theta) - friction * np.cos(theta))
    speeds = state.velocities @ down
    torch.testing.assert_close(
        speeds, torch.full_like(speeds, 0.2 * acceleration), rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize("tolerance", np.geomspace(1e-2, 1e-9, 8))
def test_the_residual_of_a_step_is_below_the_tolerance(tolerance):
    for case in CASES:
        after = on_body("sphere", case, tolerance=float(tolerance))()
        assert after.report.residual <= tolerance


def test_a_slide_accelerates_as_coulomb_says():
    # mu .49 on tan(theta) = .5: a = g (sin - mu cos) = .087743 m/s^2.
    sim, state, down = patch(0.49, np.arctan(0.5))
    for _ in range(10):
        state = sim.step(state)
    assert (state.velocities @ down).mean().item() / 0.1 == pytest.approx(0.087743, rel=1e-5)


@pytest.mark.parametrize("excess", [1e-2, 1e-5, 1e-7])
def test_a_vertex_that_hardly_slips_hardly_moves_across(excess):
    """Friction turns with the slip: v_y = (1 - mu g_z / g_x) h g_y, for a small g_y."""
    h, mu = 0.01, 0.5
    sim, state, _ = patch(mu, dt=h)
    # Soft cloth: masses alone determine the size of a slip.
    given = sim.default_parameters().replace(
        stretch=torch.tensor(0.01, dtype=F64), bending=torch.tensor(1e-8, dtype=F64)
    )
    pull = mu / (1 - excess) * 5.0
    gravity = torch.tensor([pull, 0.0, -5.0], dtype=F64, requires_grad=True)
    after = sim.step(state, None, given.replace(gravity=gravity))
    assert counts(after) == (0, 0, 9)
    (gradient,) = torch.autograd.grad(after.velocities[:, 1].mean(), gravity)
    assert gradient[1].item() == pytest.approx(h * excess, rel=1e-6)


@pytest.mark.parametrize(("v_0", "mu"), [(2.0, 0.5), (10.0, 0.8)])
def test_stopping_distance_and_its_gradients(v_0, mu):
    # Implicit Euler of a = -mu g: v_k = v_0 - k mu g h until the stop in the last, shorter step.
    h = 0.01
    sim, state, _ = patch(mu, dt=h)
    speed = torch.tensor(v_0, dtype=F64, requires_grad=True)
    friction = torch.tensor(mu, dtype=F64, requires_grad=True)
    direction = torch.tensor([1.0, 0.0, 0.0], dtype=F64)
    x = state.positions
    state = state.replace(velocities=speed * direction.expand_as(x))
    parameters = sim.default_parameters().replace(friction=friction)
    steps = int(v_0 / (mu * G * h))
    for _ in range(steps + 3):
        state = sim.step(state, None, parameters)
    assert state.velocities.detach().abs().max() < 1e-9
    distance = (state.positions - x)[:, 0].mean()
    expected = h * (steps * v_0 - 0.5 * steps * (steps + 1) * mu * G * h)
    assert distance.item() == pytest.approx(expected, rel=1e-7)
    d_speed, d_friction = torch.autograd.grad(distance, (speed, friction))
    assert d_speed.item() == pytest.approx(h * steps, rel=1e-6)
    assert d_friction.item() == pytest.approx(-0.5 * h * h * G * steps * (steps + 1), rel=1e-6)


def test_a_vertex_that_falls_straight_down_slips_on_a_smooth_floor():
    """Without friction a vertex slips even at zero slip: its tangential velocity is free."""
    sim, state, _ = patch(0.0)
    velocities = torch.zeros_like(state.velocities)
    velocities[:, 2] = -0.1
    velocities.requires_grad_()
    after = sim.step(state.replace(velocities=velocities))
    assert counts(after) == (0, 0, 9)
    weights = sim.vertex_masses() / sim.vertex_masses().sum()
    (gradient,) = torch.autograd.grad(weights @ after.positions[:, 0], velocities)
    torch.testing.assert_close(gradient[:, 0], DT * weights, rtol=1e-9, atol=0)


def test_a_floor_bears_the_weight_and_no_more():
    sim, state, _ = patch(0.5)
    for _ in range(5):
        state = sim.step(state)
    weight = 0.2 * 0.1 * 0.1 * G
    torch.testing.assert_close(
        state.body_forces.sum(0), torch.tensor([0.0, 0.0, -weight], dtype=F64), rtol=1e-7, atol=1e-9
    )


@pytest.mark.parametrize("x", [30.0, -1.5, 0.8])
def test_a_floor_bears_cloth_beyond_its_mesh(x):
    """A plane is infinite."""
    floor = dc.RigidBody.plane(1.0, thickness=2e-3, nodal_contact=True)
    sheet = dc.Cloth.grid(3, 3, size=(0.1, 0.1), pose=[x, 0.3, 9.9e-4, 1, 0, 0, 0])
    sim = dc.Simulator(dc.Scene([sheet], [floor]), DT, scheme="projective")
    state = sim.step(sim.initial_state())
    assert counts(state)[1] == 9
    weight = sim.default_parameters().density * 0.1 * 0.1 * G
    force = state.body_forces[:, 2]
    torch.testing.assert_close(force.sum(), -weight, rtol=1e-6, atol=0)
    points = state.positions.clamp(-0.5, 0.5)
    center = force @ torch.tensor(floor.vertices) / force.sum()
    # Vertices of the sheet have different weights.
    torch.testing.assert_close(center[:2], points.mean(0)[:2], rtol=0, atol=0.01)


@pytest.mark.parametrize("thick", [0, 1])
def test_cloths_touch_at_their_own_thickness_and_friction(thick):
    """Two sheets glide low over a floor; one sheet is thick and rough."""
    sheets = [
        dc.Cloth.grid(
            3,
            3,
            size=(0.1, 0.1),
            pose=[0.3 * i, 0, 0.006, 1, 0, 0, 0],
            material=dc.Material(thickness=0.012 if i == thick else 0.002, friction=0.1 + 0.3 * i),
        )
        for i in range(2)
    ]
    floor = dc.RigidBody.plane(1.0, thickness=2e-3, friction=0.4, nodal_contact=True)
    sim = dc.Simulator(dc.Scene(sheets, [floor]), DT, scheme="projective")
    state = sim.initial_state()
    glide = torch.tensor([1.0, 0.0, -0.1], dtype=F64).expand_as(state.positions)
    after = sim.step(state.replace(velocities=glide))
    assert counts(after) == (0, 0, 9)
    one, other = after.velocities[9 * thick :][:9], after.velocities[9 * (1 - thick) :][:9]
    assert one[:, 2].abs().max() < 1e-9
    torch.testing.assert_close(other[:, 2], torch.full((9,), -0.1 - DT * G, dtype=F64))
    friction = sim.default_parameters().friction[thick, 2]
    torch.testing.assert_close(one[:, 0], (1.0 - friction * (0.1 + DT * G)).expand(9))


@pytest.mark.parametrize("thick_first", [True, False])
def test_a_vertex_touches_the_body_whose_band_it_is_deepest_in(thick_first):
    """The vertex is nearer to a thin wall's surface, but deeper in the band of a thick floor."""
    floor = dc.RigidBody.plane(1.0, thickness=0.04, nodal_contact=True)
    wall = dc.RigidBody.plane(
        1.0, pose=[-1e-3, 0, 0, 1, 0, 1, 0], thickness=4e-3, nodal_contact=True
    )
    sheet = dc.Cloth.grid(3, 3, size=(0.1, 0.1), pose=[0.05, 0, 0.01, 1, 0, 0, 0])
    bodies = [floor, wall] if thick_first else [wall, floor]
    sim = dc.Simulator(dc.Scene([sheet], bodies), DT, scheme="projective")
    after = sim.step(sim.initial_state())
    assert counts(after)[1] == 9
    assert after.report.contacts["cloth0", f"body{1 - thick_first}"].count == 9


def test_an_obstacle_carries_a_sticking_sheet():
    sim, state, _ = patch(0.8)
    body = sim.scene.bodies[0]
    moving = dc.RigidBody.plane(
        1.0, motion="kinematic", pose=body.pose, friction=0.8, thickness=2e-3, nodal_contact=True
    )
    sim = dc.Simulator(
        dc.Scene(sim.scene.cloths, [moving]),
        0.01,
        scheme="projective",
        contact=dc.ContactOptions(self_contact=False),
        solver=dc.SolverOptions(tolerance=1e-10),
    )
    state = sim.initial_state()
    for k in range(1, 6):
        poses = state.body_poses.clone()
        poses[0, 0] = 1e-4 * k
        state = sim.step(state, dc.Control(body_poses=poses))
    assert counts(state)[1] == 9
    moved = state.positions - sim.initial_state().positions
    torch.testing.assert_close(
        moved, torch.tensor([5e-4, 0, 0], dtype=F64).expand_as(moved), rtol=0, atol=1e-10
    )


@pytest.mark.parametrize("missing", [1e-9, 0.1, 0.24, -0.01])
def test_a_sheet_that_arrives_at_the_very_end_of_a_step_touches(missing):
    """The floor stops a sheet that would enter in the last quarter of the step, and no other."""
    sim, state, _ = patch(0.5)
    gap, speed = 1e-3, 1.0
    # Free fall would end below the height of contact by the share `missing` of its path.
    way = DT * (speed + DT * G)
    x = state.positions.clone()
    x[:, 2] = gap + way * (1 - missing)
    velocities = torch.zeros_like(x)
    velocities[:, 2] = -speed
    after = sim.step(state.replace(positions=x, velocities=velocities))
    assert sum(counts(after)) == (9 if missing > 0 else 0)


def test_a_body_touches_halfway_whatever_the_sign_of_its_quaternion():
    """A box passes by and rotates; only halfway is the box at the sheet."""
    sheet = dc.Cloth.grid(3, 3, size=(0.1, 0.1), pose=[0, 0, 0.045, 1, 0, 0, 0])
    start = [-0.5, 0.01, -0.01, 1.0, 0.02, -0.03, 0.3]
    box = dc.RigidBody.box(
        (0.4, 0.3, 0.1), motion="kinematic", pose=start, friction=0.3, nodal_contact=True
    )
    sim = dc.Simulator(
        dc.Scene([sheet], [box]),
        DT,
        scheme="projective",
        contact=dc.ContactOptions(self_contact=False),
        solver=dc.SolverOptions(tolerance=1e-10),
    )
    state = sim.initial_state()
    assert counts(sim.step(state)) == (0, 0, 0)

    def height(end):
        return (sim.step(state, dc.Control(body_poses=end)).positions[:, 2] ** 2).sum()

    found = []
    for sign in (1.0, -1.0):
        end = torch.tensor([[0.5, -0.01, 0.01, 1.0, 0.07, 0.1, -0.4]], dtype=F64)
        end[0, 3:] *= sign
        end.requires_grad_()
        after = sim.step(state, dc.Control(body_poses=end))
        (gradient,) = torch.autograd.grad((after.positions[:, 2] ** 2).sum(), end)
        # Tangents are the transpose.
        direction = tensor_noise((1, 7), 1.0, 3)
        _, change = torch.func.jvp(height, (end.detach(),), (direction,))
        torch.testing.assert_close(change, (gradient * direction).sum(), rtol=1e-8, atol=0)
        gradient[0, 3:] *= sign
        found.append((after.positions.detach(), gradient))
    assert counts(after)[2] > 4
    (one, by_one), (other, by_other) = found
    torch.testing.assert_close(other, one, rtol=0, atol=1e-14)
    torch.testing.assert_close(by_other, by_one, rtol=1e-9, atol=1e-15)
    assert by_one[0, 3:].abs().max() > 1e-3 * by_one.abs().max()


def test_contacts_of_a_batch_are_those_of_its_environments():
    step = on_body("sphere", "slipping")
    states = dc.stack([step.state, step.state.replace(velocities=0.5 * step.state.velocities)])
    both = step.sim.step(states)
    for i in range(2):
        one = step.sim.step(states[i])
        assert torch.equal(both.positions[i], one.positions)
        assert torch.equal(both.body_forces[i], one.body_forces)


def test_split_leaves_nodal_bodies_out_of_the_barrier():
    step = on_body("plane", "slipping", scheme="split")
    after = step()
    assert counts(after)[2] > 0
    assert after.report.contact_count == 0
    assert step.sim.default_parameters().barrier_distance is None


@pytest.mark.parametrize("metric", ["energy", "elastic"])
def test_gradients_of_nodes_and_barrier_in_one_step_are_those_of_differences(metric):
    """Nodal contact forces of split's first stage persist in the second, where a ball presses."""
    step = on_body("plane", "slipping", scheme="split", moving=False)
    (cloth,), (floor,) = step.sim.scene.cloths, step.sim.scene.bodies
    at = step.state.positions.mean(0) + torch.tensor([0.01, 0.02, 0.0335], dtype=F64)
    ball = dc.RigidBody.sphere(
        0.03, subdivisions=1, motion="kinematic", pose=[*at.tolist(), 1, 0.1, 0, 0.2]
    )
    sim = dc.Simulator(
        dc.Scene([cloth], [floor, ball], gravity=(0.4, -0.3, -9.81)),
        DT,
        scheme="split",
        contact=dc.ContactOptions(
            self_contact=False, barrier_distance=4e-3, barrier_stiffness=20.0, slip_velocity=0.05
        ),
        solver=dc.SolverOptions(tolerance=1e-11, metric=metric),
    )
    start = sim.initial_state()
    state = start.replace(
        positions=step.state.positions,
        velocities=step.state.velocities,
        soft_pin_targets=step.state.soft_pin_targets,
    )
    parameters = sim.default_parameters()
    after = sim.step(state)
    assert sum(counts(after)) > 0
    assert after.report.contact_count > 0
    inputs = {"velocities": state.velocities, "body_poses": start.body_poses}
    inputs |= {n: getattr(parameters, n) for n in ("stretch", "bending", "density", "friction")}
    generator = torch.Generator().manual_seed(1)
    weights = {
        name: torch.randn(getattr(after, name).shape, dtype=F64, generator=generator) * scale
        for name, scale in (
            *(("positions", 1.0), ("velocities", DT), ("body_forces", 1e-2)),
            *(("contact_forces", 1e-2), ("pin_forces", 1e-2)),
        )
    }

    def value(changes):
        fields = {n: changes[n] for n in ("velocities", "body_poses") if n in changes}
        physical = {n: v for n, v in changes.items() if n not in fields}
        control = dc.Control(body_poses=changes.get("body_poses", start.body_poses))
        fields.pop("body_poses", None)
        end = sim.step(state.replace(**fields), control, parameters.replace(**physical))
        return sum((w * getattr(end, n)).sum() for n, w in weights.items())

    sizes = {n: 1e-5 * max(1.0, float(v.abs().max())) for n, v in inputs.items()}
    sizes["body_poses"] = 1e-6
    assert_gradients_are_those_of_differences(value, inputs, sizes, generator)
