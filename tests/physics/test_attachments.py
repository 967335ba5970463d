"""Springs between points: closed forms, momentum, seams and picking."""

import math

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.geometry.poses import transform

F64 = torch.float64
DT = 0.01


def sheet(name="sheet", size=4, offset=(0.0, 0.0, 0.0), **options):
    return dc.Cloth.grid(size, size, 0.3, name=name, pose=[*offset, 1, 0, 0, 0], **options)


def masses(sim):
    """Lumped masses of the cloth vertices [kg]."""
    result = torch.zeros(sum(len(c.vertices) for c in sim.scene.cloths), dtype=F64)
    for name, cloth in zip(sim.scene.cloth_names, sim.scene.cloths, strict=True):
        X = np.array(cloth.rest_positions)
        for corners in cloth.faces:
            a, b, c = X[corners]
            area = 0.5 * np.linalg.norm(np.cross(b - a, c - a))
            rows = torch.as_tensor(np.array(corners), dtype=torch.int64)
            result[sim.slices[name].start + rows] += cloth.material.density * area / 3
    return result


@pytest.mark.parametrize("scheme", ["coupled", "split", "projective"])
def test_a_target_at_a_vertex_is_a_soft_pin(scheme):
    stiffness = 40.0
    pinned = dc.Simulator(
        dc.Scene([sheet(soft_pins={"a": [0, 5]}, pin_stiffness=stiffness)]), DT, scheme=scheme
    )
    attached = dc.Simulator(
        dc.Scene([sheet()], attachments=[dc.Attachment(("sheet", [0, 5]), stiffness=stiffness)]),
        DT,
        scheme=scheme,
    )
    targets = pinned.initial_state().positions[[0, 5]] + 0.02
    after = pinned.step(pinned.initial_state(), dc.Control(soft_pins=targets))
    other = attached.step(attached.initial_state(), dc.Control(attachments=targets))
    torch.testing.assert_close(other.positions, after.positions, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("scheme", ["split", "projective"])
def test_local_global_iterations_find_the_same_minimum(scheme):
    attachments = [
        dc.Attachment(("sheet", [5, 6, 9], [0.2, 0.3, 0.5]), stiffness=40.0, name="point"),
        dc.Attachment(("sheet", 0), ("sheet", 15), stiffness=20.0, rest_length=0.5),  # spreads
    ]
    ends = []
    for elastic in ("newton", "projective"):
        solver = dc.SolverOptions(elastic=elastic, tolerance=1e-9)
        scene = dc.Scene([sheet()], attachments=attachments)
        sim = dc.Simulator(scene, DT, scheme=scheme, solver=solver)
        state = sim.initial_state()
        target = state.positions[[9]] + 0.03
        for _ in range(5):
            state = sim.step(state, dc.Control(attachments=target))
        ends.append(state.positions)
    assert float((ends[0] - sim.initial_state().positions).norm()) > 0.01
    torch.testing.assert_close(ends[0], ends[1], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("rest", [0.0, 0.3])
def test_a_point_mass_on_a_spring_is_the_implicit_euler_recursion(rest):
    """A free ball between targets on the vertical: one equation in one unknown."""
    mass, stiffness, weight = 0.2, 15.0, 0.6
    ball = dc.RigidBody.sphere(0.05, motion="dynamic", mass=mass, name="ball")
    spring = dc.Attachment(("ball", [0, 0, 0]), stiffness=stiffness, rest_length=rest, name="s")
    # A step of 1e-10 m is below the tolerance.
    solver = dc.SolverOptions(tolerance=1e-8)
    sim = dc.Simulator(dc.Scene([], [ball], attachments=[spring]), DT, solver=solver)
    control = sim.control(attachments={"s": [[0, 0, 1.0]]}, attachment_weights={"s": [weight]})
    state = sim.initial_state()
    z, v, k = 0.0, 0.0, weight * stiffness
    for _ in range(30):
        state = sim.step(state, control)
        # m (z' - z - h v + h^2 g) / h^2 = k (1 - z' - L)
        z_next = (mass * (z + DT * v - DT**2 * 9.81) / DT**2 + k * (1.0 - rest)) / (
            mass / DT**2 + k
        )
        z, v = z_next, (z_next - z) / DT
        assert state.body_poses[0, 2].item() == pytest.approx(z, abs=1e-9)


def sewn_to_box():
    box = dc.RigidBody.box(
        (0.1, 0.1, 0.1), motion="dynamic", mass=0.2, pose=[0, 0, 0.3, 1, 0, 0, 0], name="box"
    )
    spring = dc.Attachment(
        ("sheet", [5, 10]),
        ("box", [[0.05, 0.02, -0.05], [-0.03, 0.0, -0.05]]),
        stiffness=30.0,
        rest_length=[0.0, 0.1],
        name="seam",
    )
    # Without contact, because lagged friction has a moment.
    scene = dc.Scene(
        [sheet()],
        [box],
        gravity=(0, 0, 0),
        ignore_contact=[("sheet", "box")],
        attachments=[spring],
    )
    return dc.Simulator(
        scene,
        DT,
        contact=dc.ContactOptions(self_contact=False),
        solver=dc.SolverOptions(tolerance=1e-12),
    )


def test_a_free_body_and_cloth_keep_their_momentum():
    sim = sewn_to_box()
    state, m = sim.initial_state(), masses(sim)
    state = state.replace(
        body_velocities=torch.tensor([[0.3, -0.2, 0.1, 1.0, 2.0, -1.0]], dtype=F64)
    )
    before = 0.2 * state.body_velocities[0, :3]
    reference = torch.as_tensor(before)
    for _ in range(20):
        after = sim.step(state)
        # Per step: momentum gained by the sheet, plus the reaction on the box and its moment.
        gained = m[:, None] * (after.velocities - state.velocities) / DT
        points = torch.from_numpy(
            transform(np.array(sim.scene.bodies[0].vertices), after.body_poses[0].numpy())
        )
        force = gained.sum(0) + after.body_forces.sum(0)
        moment = torch.linalg.cross(after.positions, gained).sum(0)
        moment = moment + torch.linalg.cross(points, after.body_forces).sum(0)
        size = float(after.body_forces.norm())
        assert size > 0.01
        assert float(force.norm()) < 1e-12 * size
        assert float(moment.norm()) < 1e-12 * size
        state = after
    momentum = 0.2 * state.body_velocities[0, :3] + (m[:, None] * state.velocities).sum(0)
    assert float((m[:, None] * state.velocities).sum(0).norm()) > 0.01 * float(reference.norm())
    assert float((momentum - reference).norm()) < 1e-12 * float(reference.norm())


def test_a_released_attachment_has_no_effect():
    sim = sewn_to_box()
    state = sim.initial_state()
    released = sim.step(state, sim.control(attachment_weights={"seam": [0.0, 0.0]}))
    assert torch.equal(released.positions, state.positions)
    assert not torch.equal(sim.step(state).positions, state.positions)
    assert sim.energy(state, parts=True)["attachments"] > 0.0


def tube(rest_length, stiffness=50.0, size=8):
    """Two panels back to back, sewn together along their long sides."""
    gap = 0.02
    panels = [sheet("front", size, (0, 0, 0)), sheet("back", size, (0, 0, gap))]
    first, last = np.arange(size) * size, np.arange(size) * size + size - 1
    sides = np.concatenate([first, last]).tolist()
    seam = dc.Attachment(
        ("front", sides), ("back", sides), stiffness=stiffness, rest_length=rest_length, name="seam"
    )
    scene = dc.Scene(panels, gravity=(0, 0, 0), attachments=[seam])
    return dc.Simulator(scene, DT, contact=dc.ContactOptions(barrier_distance=5e-3)), sides


@pytest.mark.parametrize("rest_length", [0.0, 6e-3])
def test_two_panels_sewn_into_a_tube_stay_together_and_apart(rest_length):
    sim, sides = tube(rest_length)
    state = sim.initial_state()
    n = len(state.positions) // 2
    # Inflate the tube: seamed vertices stay, the middle moves away.
    forces = torch.zeros_like(state.positions)
    forces[:n, 2], forces[n:, 2] = -2e-3, 2e-3
    control = dc.Control(forces=forces)
    for _ in range(60):
        state = sim.step(state, control)
        assert state.report.minimum_distance > 0.0
    front, back = state.positions[:n], state.positions[n:]
    apart = (back - front).norm(dim=1)
    inside = np.setdiff1d(np.arange(n), sides)
    # 5e-3 is the reach of the barrier; 2e-3 N pull 4e-5 m out of 50 N/m.
    assert apart[sides].max() < max(5e-3, rest_length) + 2e-3
    assert apart[inside].max() > 0.03
    # Beside an impulse of 0.08 N s on each panel.
    total = (masses(sim)[:, None] * state.velocities).sum(0)
    assert float(total.norm()) < 1e-10


@pytest.mark.parametrize(("rest_length", "rise"), [(0.0, 40), (6e-3, 1)])
def test_a_stiff_seam_closes(rest_length, rise):
    """The weight rises at once if the rest length exceeds the barrier's reach, else gradually."""
    sim, sides = tube(rest_length, stiffness=5000.0)
    state = sim.initial_state()
    n = len(state.positions) // 2
    for k in range(50):
        weights = torch.full((len(sides),), min(1.0, (k + 1) / rise) ** 3)
        state = sim.step(state, sim.control(attachment_weights={"seam": weights}))
    apart = (state.positions[n:] - state.positions[:n]).norm(dim=1)[sides]
    assert float(apart.max()) < max(5e-3, rest_length + 1e-4)


def test_a_kinematic_hand_carries_and_releases_a_sheet():
    hand = dc.RigidBody.box(
        0.04, motion="kinematic", pose=[-0.15, -0.15, 0.06, 1, 0, 0, 0], name="hand"
    )
    grasp = dc.Attachment(
        ("sheet", 0), ("hand", [0, 0, -0.03]), stiffness=200.0, rest_length=0.0, name="grasp"
    )
    scene = dc.Scene([sheet()], [hand], attachments=[grasp])
    sim = dc.Simulator(scene, DT)
    state = sim.initial_state()
    pose = state.body_poses.clone()
    for _k in range(30):
        pose = pose + torch.tensor([[0.002, 0, 0.002, 0, 0, 0, 0]], dtype=F64)
        state = sim.step(state, dc.Control(body_poses=pose))
        assert math.dist(state.positions[0], pose[0, :3] + torch.tensor([0, 0, -0.03])) < 0.03
    # The hand feels the weight of the sheet, about.
    weight = 9.81 * float(masses(sim).sum())
    assert 0.2 * weight < -float(state.body_forces[:, 2].sum()) < 5 * weight
    let_go = sim.control(body_poses=pose, attachment_weights={"grasp": [0.0]})
    fallen = sim.step(state, let_go)
    assert float(fallen.body_forces.abs().max()) == 0.0
    assert fallen.positions[0, 2] < state.positions[0, 2]


def test_the_parameters_of_a_scene_without_contact_can_be_given_back():
    """No pair touches: the stiffness of the barrier has no meaning, but is one that is accepted."""
    sim = sewn_to_box()
    state, parameters = sim.initial_state(), sim.default_parameters()
    assert parameters.barrier_stiffness > 0.0
    after = sim.step(state, None, parameters)
    assert torch.equal(after.positions, sim.step(state).positions)


def test_the_energy_counts_targets_and_weights_of_a_control():
    """w k / 2 (|p - c| - L)^2 by hand; pins that move and forces count for nothing."""
    weights = torch.tensor([0.25, 0.0, 1.0], dtype=F64)
    point = dc.Attachment(
        ("sheet", [5, 6, 9], [0.2, 0.3, 0.5]), stiffness=40.0, rest_length=0.01, name="point"
    )
    seam = dc.Attachment(("sheet", 0), ("sheet", 15), stiffness=20.0, rest_length=0.5, name="seam")
    cloth = sheet(soft_pins={"soft": [3]}, pin_stiffness=60.0, pins={"hard": [12]})
    sim = dc.Simulator(dc.Scene([cloth], attachments=[point, seam]), DT)
    state = sim.initial_state(3)
    x = state.positions
    target, soft = x[:, [9]] + 0.03, x[:, [3]] + torch.tensor([0.0, 0.0, 0.02], dtype=F64)
    control = dc.Control(
        pins={"hard": x[:, [12]] + 0.5},
        soft_pins=soft,
        forces=torch.full_like(x, 0.3),
        attachments=target,
        attachment_weights={"point": weights[:, None], "seam": weights[:, None]},
    )
    parts = sim.energy(state, control=control, parts=True)
    at = 0.2 * x[:, 5] + 0.3 * x[:, 6] + 0.5 * x[:, 9]
    of_point = 20.0 * ((at - target[:, 0]).norm(dim=-1) - 0.01) ** 2
    of_seam = 10.0 * ((x[:, 0] - x[:, 15]).norm(dim=-1) - 0.5) ** 2
    expected = {
        "attachments": weights * (of_point + of_seam),
        "soft_pins": 30.0 * ((x[:, 3] - soft[:, 0]) ** 2).sum(dim=-1),
    }
    for name, energy in expected.items():
        torch.testing.assert_close(parts[name], energy, rtol=1e-13, atol=1e-16)
    plain = sim.energy(state, parts=True)
    torch.testing.assert_close(plain["attachments"], of_seam, rtol=1e-13, atol=0.0)
    assert not plain["soft_pins"].any()
    for name in ("stretch", "bending", "contact", "gravity"):
        assert torch.equal(parts[name], plain[name]), name
    assert torch.equal(sim.energy(state, control=control), sum(parts.values()))


def test_the_energy_refuses_a_bad_control():
    sim = dc.Simulator(
        dc.Scene([sheet()], attachments=[dc.Attachment(("sheet", 5), stiffness=40.0)]), DT
    )
    state = sim.initial_state()
    with pytest.raises(dc.InvalidInput, match=r"`control\.attachments` must have"):
        sim.energy(state, control=dc.Control(attachments=torch.zeros(2, 3, dtype=F64)))
    with pytest.raises(dc.InvalidInput, match="must set the target"):
        sim.energy(state, control=dc.Control(attachment_weights=torch.ones(1, dtype=F64)))
