"""Smooth spheres and capsules roll, rest and carry cloth as the exact surfaces do."""

import math
import pickle

import core_steps
import ipctk
import numpy as np
import pytest
import scenes
import torch
from differences import F64, directions, mismatch
from scipy.spatial.transform import Rotation

import diffcloth_torch as dc
from diffcloth_torch import _kernels as kernels

G = 9.81
D_HAT = 1e-3
DEFAULT = dc.SolverOptions()
BARRIER = dc.ContactOptions(barrier_distance=D_HAT)


def quaternion(rotation):
    return rotation.as_quat()[[3, 0, 1, 2]].tolist()


def aslope(angle, make, **keywords):
    """A body on an incline, half the barrier distance above it, and the direction downhill."""
    slope = Rotation.from_euler("y", angle)
    normal, downhill = slope.apply([0, 0, 1]), slope.apply([1, 0, 0])
    plane = dc.RigidBody.plane(8.0, pose=[0, 0, 0, *quaternion(slope)], friction=0.6)
    body = make(normal * (0.05 + D_HAT / 2), slope, friction=0.6, motion="dynamic", **keywords)
    return [plane, body], normal, downhill


def ball(at, slope, **keywords):
    return dc.RigidBody.sphere(0.05, smooth=True, pose=[*at, *quaternion(slope)], **keywords)


def pill(at, slope, **keywords):
    """Across the slope."""
    across = slope * Rotation.from_euler("x", math.pi / 2)
    return dc.RigidBody.capsule(0.05, 0.2, smooth=True, pose=[*at, *quaternion(across)], **keywords)


def rolled(bodies, seconds, dt, solver=DEFAULT):
    sim = dc.Simulator(dc.Scene([], bodies), dt, contact=BARRIER, solver=solver)
    with torch.no_grad():
        return sim, sim.rollout(sim.initial_state(), steps=round(seconds / dt))


HOLLOW = np.eye(3) * 2 / 3 * 0.05**2  # per mass
ROLLING = {
    "ball": (ball, {"density": 500.0}, 2 / 5),
    "hollow": (ball, {"mass": 0.2, "inertia": 0.2 * HOLLOW}, 2 / 3),
    # Along its axis: the cylinder has m r^2 / 2, the balls at its ends 2/5 m r^2.
    "pill": (pill, {"density": 500.0}, (0.2 / 2 + 4 / 3 * 0.05 * 2 / 5) / (0.2 + 4 / 3 * 0.05)),
}


@pytest.mark.parametrize("name", ROLLING)
def test_a_smooth_body_rolls_down_an_incline_as_round_bodies_do(name):
    """Acceleration g sin / (1 + I / (m r^2)), up to the order of h, and spin v / r.

    r counts from the surface of the incline, which is half the barrier distance away.
    """
    make, keywords, moment = ROLLING[name]
    angle, seconds = 0.3, 0.2
    bodies, normal, downhill = aslope(angle, make, **keywords)
    errors = []
    for dt in (0.01, 0.005):
        _, states = rolled(bodies, seconds, dt)
        radius = float(states[-1].body_poses[1, :3] @ torch.tensor(normal))
        assert 0.05 < radius < 0.05 + D_HAT
        velocity = states[-1].body_velocities[1]
        speed = float(velocity[:3] @ torch.tensor(downhill))
        expected = seconds * G * math.sin(angle) / (1 + moment * (0.05 / radius) ** 2)
        errors.append(speed / expected - 1)
        # The body creeps below the slip velocity according to the ratio of friction to its bound.
        # In a step that rotates the body by phi, friction's arm rotates too: a share cos(phi) of
        # the arm counts.
        spin = float(velocity[4])
        share = moment / (1 + moment) * math.tan(angle) / 0.6
        creep = 1e-3 * (1 - math.sqrt(1 - share))
        turned = speed * (spin * dt) ** 2 / 2
        assert abs(speed - radius * spin) < creep + turned + 1e-4 * speed
        torch.testing.assert_close(
            velocity[[1, 3, 5]], torch.zeros(3, dtype=F64), atol=1e-6, rtol=0
        )
    assert abs(errors[1]) < 0.6 * abs(errors[0]) + 1e-4
    assert abs(errors[1]) < 2e-3


@pytest.mark.parametrize(("rings", "least", "most"), [(5, -0.03, -0.01), (10, -0.01, 0.01)])
def test_a_cylinder_of_many_sides_rolls_nearly_as_a_round_one(rings, least, most):
    """The cylinder starts on a side. A round one would be faster by gap / radius, 1 %."""
    angle, seconds = 0.3, 0.4
    side = math.tau / (6 * rings)

    def can(at, slope, **keywords):
        turn = slope * Rotation.from_euler("x", math.pi / 2)
        turn *= Rotation.from_euler("z", math.pi / 2 - side / 2)
        pose = [*at, *quaternion(turn)]
        return dc.RigidBody.cylinder(0.05, 0.2, rings=rings, pose=pose, **keywords)

    bodies, _, downhill = aslope(angle, can, density=500.0)
    _, states = rolled(bodies, seconds, 0.005)
    speed = float(states[-1].body_velocities[1, :3] @ torch.tensor(downhill))
    assert least < speed / (seconds * G * math.sin(angle) / 1.5) - 1 < most


def test_a_smooth_ball_rolls_on_another_round_body():
    """A ball rolls down from the top of a fixed ball, according to its gap share and energy."""
    large = dc.RigidBody.sphere(0.4, smooth=True, friction=0.8)
    start = 0.3
    gap = D_HAT / 2
    at = (0.45 + gap) * np.array([math.sin(start), 0, math.cos(start)])
    small = dc.RigidBody.sphere(
        0.05, smooth=True, friction=0.8, motion="dynamic", density=500.0, pose=[*at, 1, 0, 0, 0]
    )
    _, states = rolled([large, small], 0.3, 0.0025)
    end = states[-1]
    at_end = end.body_poses[1, :3]
    way = at_end.norm()
    speed, spin = end.body_velocities[1, :3].norm(), end.body_velocities[1, 4]
    assert at_end[0] > at[0] + 0.03
    # Each ball's rolling radius is its share of the distance between the centers.
    assert float(spin) == pytest.approx(float(speed / (way * 0.05 / 0.45)), rel=3e-3)
    gained = G * (at[2] - float(at_end[2]))
    inertia = 2 / 5 * 0.05**2
    assert float(speed**2 / 2 + inertia * spin**2 / 2) == pytest.approx(gained, rel=0.02)


def test_spin_passes_from_one_round_body_to_another():
    """Two equal balls touch in free fall; one spins, and friction spins the other oppositely."""
    gap = 0.4 * D_HAT
    balls = [
        dc.RigidBody.sphere(
            0.05, smooth=True, motion="dynamic", mass=0.2, pose=[x, 0, 0, 1, 0, 0, 0], friction=1.0
        )
        for x in (-0.05 - gap / 2, 0.05 + gap / 2)
    ]
    sim = dc.Simulator(
        dc.Scene([], balls, gravity=[0, 0, 0]),
        0.002,
        contact=dc.ContactOptions(barrier_distance=D_HAT),
        solver=dc.SolverOptions(tolerance=1e-9),
    )
    state = sim.initial_state()
    turning = state.body_velocities.clone()
    turning[0] = torch.tensor([0.05, 0.0, 0.0, 0.0, 0.0, 3.0])
    turning[1] = torch.tensor([-0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    before = state.replace(body_velocities=turning)
    after = sim.step(before)
    assert after.report.contact_count == 1
    spins = after.body_velocities[:, 5]
    assert spins[1] < -0.01
    # Friction acts midway between the balls, so both receive the same torque.
    torch.testing.assert_close(spins[0] - 3.0, spins[1], rtol=1e-3, atol=0)
    for at in (before, after):
        momentum = 0.2 * at.body_velocities[:, :3].sum(dim=0)
        torch.testing.assert_close(momentum, torch.zeros(3, dtype=F64), atol=1e-10, rtol=0)
    inertia = 2 / 5 * 0.2 * 0.05**2
    angular = 0.2 * torch.linalg.cross(after.body_poses[:, :3], after.body_velocities[:, :3])
    total = angular.sum(dim=0)[2] + inertia * spins.sum()
    # Relative to the spin that friction transfers; the error is the non-tangential part of slip.
    assert float(total / inertia - 3.0) == pytest.approx(0.0, abs=0.02 * float(spins[1].abs()))


@pytest.mark.parametrize("lies", [True, False], ids=["along", "across"])
def test_a_capsule_rests_on_two_boxes(lies):
    """The ends lie on the boxes' tops, or the side on their edges; each box carries half."""
    along = Rotation.from_euler("y", math.pi / 2)
    boxes = [
        dc.RigidBody.box([0.1, 0.3, 0.1], pose=[x, 0, -0.05, 1, 0, 0, 0], name=name)
        for x, name in ((-0.12, "left"), (0.12, "right"))
    ]
    # Across, its axis runs between them, and their upper edges hold it.
    reach = 0.07 - 1e-9
    height = math.sqrt(0.1**2 - reach**2) if not lies else 0.1
    turn = along if lies else Rotation.from_euler("x", math.pi / 2)
    pose = [0, 0, height + 1e-3, *quaternion(turn)]
    capsule = dc.RigidBody.capsule(
        0.1, 0.2, smooth=True, motion="dynamic", density=300.0, pose=pose, name="pill"
    )
    sim, states = rolled([*boxes, capsule], 1.0, 0.01)
    end = states[-1]
    assert end.body_velocities[2].abs().max() < 1e-3
    assert (end.body_poses[2, :3] - torch.tensor([0.0, 0, height])).norm() < 2e-3
    wrenches = sim.contact_wrenches(end)
    weight = capsule.mass * G
    assert float(wrenches["pill"][2]) == pytest.approx(weight, rel=1e-4)
    for name in ("left", "right"):
        assert float(wrenches[name][2]) == pytest.approx(-weight / 2, rel=1e-3)
    assert wrenches["pill"][3:].abs().max() < 1e-3 * weight
    points = sim.contacts(end).on("pill")
    # On the skin: as far from the axis as the radius.
    axis = torch.tensor(turn.as_matrix()[:, 2])
    arms = points.points[points.mask][:, 1] - end.body_poses[2, :3]
    at = (arms @ axis).clamp(-0.1, 0.1)
    distances = (arms - at[:, None] * axis).norm(dim=1)
    torch.testing.assert_close(distances, torch.full_like(distances, 0.1), rtol=1e-9, atol=0)
    assert (points.gaps[points.mask] > 0).all()
    assert (points.gaps[points.mask] < D_HAT).all()


def test_mass_properties_are_those_of_the_analytic_body():
    """The properties of finer meshes converge to the analytic values."""
    sphere = dc.RigidBody.sphere(0.3, smooth=True, motion="dynamic", density=200.0)
    mass = 200 * 4 / 3 * math.pi * 0.3**3
    assert sphere.mass == pytest.approx(mass, rel=1e-14)
    np.testing.assert_allclose(sphere.inertia, 2 / 5 * mass * 0.3**2 * np.eye(3), rtol=1e-14)
    fine = dc.RigidBody.sphere(0.3, subdivisions=6, motion="dynamic", density=200.0)
    assert fine.mass == pytest.approx(sphere.mass, rel=1e-3)
    smooth, mesh = (
        dc.RigidBody.capsule(0.2, 0.5, smooth=smooth, motion="dynamic", density=100.0)
        for smooth in (True, False)
    )
    assert smooth.mass == pytest.approx(mesh.mass, rel=0.03)
    ratio = np.diag(smooth.inertia) / smooth.mass / (np.diag(mesh.inertia) / mesh.mass)
    np.testing.assert_allclose(ratio, 1.0, rtol=0.02)
    # By quadrature: z from end to end, disks of radius rho.
    z = np.linspace(-0.45, 0.45, 400001)
    rho_sq = 0.04 - np.maximum(np.abs(z) - 0.25, 0) ** 2
    volume, along = (np.trapezoid(f, z) for f in (math.pi * rho_sq, math.pi * rho_sq**2 / 2))
    across = np.trapezoid(math.pi * (rho_sq**2 / 4 + rho_sq * z**2), z)
    assert smooth.mass == pytest.approx(100 * volume, rel=1e-9)
    np.testing.assert_allclose(
        np.diag(smooth.inertia), 100 * np.array([across, across, along]), rtol=1e-9
    )


def heap():
    """A sheet on a fixed capsule; on the sheet a ball, touched by another ball and a box."""
    X, faces = scenes.grid(5, 5, edge=0.06, seed=2)
    X = X - X.mean(axis=0)
    material = scenes.material(faces, stretch=200.0, thickness=1e-3)
    cloth = dc.Cloth(X + np.array([0, 0, 4e-3]), faces, rest_positions=X, material=material)
    across = quaternion(Rotation.from_euler("xyz", [0.1, 1.55, 0.4]))
    keywords = {"smooth": True, "motion": "dynamic", "friction": 0.5, "thickness": 1e-3}
    bodies = [
        dc.RigidBody.capsule(
            0.3, 0.5, smooth=True, thickness=1e-3, pose=[0.01, 0.02, -0.31, *across]
        ),
        dc.RigidBody.sphere(0.04, mass=0.05, pose=[0.02, 0.01, 0.055, 1, 0, 0, 0], **keywords),
        dc.RigidBody.sphere(0.03, mass=0.03, pose=[0.0965, 0.02, 0.05, 1, 0.1, 0, 0], **keywords),
        dc.RigidBody.capsule(
            0.02, 0.06, mass=0.04, pose=[0.02, -0.0575, 0.055, 1, 0.2, 0.7, 0], **keywords
        ),
        dc.RigidBody.box(
            [0.05, 0.06, 0.05],
            motion="dynamic",
            mass=0.05,
            thickness=2e-3,
            pose=[-0.054, 0.015, 0.06, 1, 0.05, -0.04, 0.1],
        ),
    ]
    contact = dc.ContactOptions(barrier_distance=0.01, barrier_stiffness=60.0, slip_velocity=0.02)
    solver = dc.SolverOptions(tolerance=1e-12, max_iterations=2000)
    sim = dc.Simulator(dc.Scene([cloth], bodies), 0.005, contact=contact, solver=solver)
    state = sim.initial_state()
    speeds = state.body_velocities.clone()
    speeds[1] = torch.tensor([0.1, 0.02, -0.2, 0.5, 1.0, 0.3])
    speeds[2] = torch.tensor([-0.2, -0.05, -0.1, -0.5, 0.2, 0.8])
    speeds[3] = torch.tensor([0.05, 0.3, -0.1, 0.3, 0.2, -0.8])
    speeds[4] = torch.tensor([0.2, 0.0, -0.1, 0.0, 0.4, 0.2])
    state = state.replace(body_velocities=speeds)
    with torch.no_grad():
        for _ in range(4):
            state = sim.step(state)
    return sim, state.detach()


@pytest.fixture(scope="module")
def in_contact():
    return heap()


def test_everything_in_the_heap_touches(in_contact):
    """Premise of the tests below: without contact they would prove little."""
    sim, state = in_contact
    pairs = {tuple(pair) for pair in sim.step(state).report.contacts}
    expected = {
        ("cloth0", "body0"),
        ("cloth0", "body1"),
        ("body1", "body2"),
        ("body1", "body3"),
        ("body1", "body4"),
    }
    assert expected <= pairs, pairs


STATE = {"positions": 1e-6, "velocities": 1e-4, "body_poses": 1e-6, "body_velocities": 1e-4}
PARAMETERS = {
    "friction": 1e-4,
    "thickness": 1e-6,
    "barrier_stiffness": 1e-2,
    "barrier_distance": 1e-7,
    "slip_velocity": 1e-6,
    "rest_positions": 1e-6,
    "body_mass": 1e-6,
    "body_inertia": 1e-4,
}


@pytest.mark.parametrize("name", [*STATE, *PARAMETERS])
def test_gradients_are_central_differences(in_contact, name):
    sim, state = in_contact
    given = state if name in STATE else sim.default_parameters()
    weights = torch.Generator().manual_seed(4)

    def noise(like):
        return torch.randn(like.shape, dtype=F64, generator=weights)

    end = sim.step(state)
    scales = {"positions": 1.0, "body_poses": 1.0, "body_velocities": 0.01, "body_forces": 1e-3}
    shares = {field: scale * noise(getattr(end, field)) for field, scale in scales.items()}

    def loss(value):
        changed = given.replace(**{name: value})
        after = sim.step(changed) if name in STATE else sim.step(state, parameters=changed)
        assert after.report.converged
        return sum((share * getattr(after, field)).sum() for field, share in shares.items())

    value = getattr(given, name).clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(value), value)
    assert gradient.any()
    step = (STATE | PARAMETERS)[name]
    for d in directions(value.detach(), torch.Generator().manual_seed(5)):
        if name.startswith("body_") and name in PARAMETERS:
            d[0] = 0  # the fixed capsule has no mass
        if name == "body_inertia":
            d = 0.5 * (d + d.mT) * given.body_inertia.diagonal(dim1=-2, dim2=-1).mean()
        with torch.no_grad():
            error = mismatch(lambda x: float(loss(x)), value.detach(), gradient, d, step, rtol=1e-5)
        assert error < 1e-5


def test_tangents_are_the_transpose_of_gradients(in_contact):
    sim, state = in_contact
    core, inputs = core_steps.inputs_of(sim, lambda: sim.step(state))
    result = core.forward(inputs, True, 1)
    moved = core_steps.check_pairs(core, inputs, result)
    assert {"positions", "coordinates", "body_forces"} <= moved


def drape(body, n=16, steps=40, **keywords):
    """A sheet falls onto a body; the simulator and the state of every step."""
    cloth = dc.Cloth.grid(n, n, size=0.5)
    sim = dc.Simulator(dc.Scene([cloth], [body]), 0.01, **keywords)
    with torch.no_grad():
        return sim, sim.rollout(sim.initial_state(), steps=steps)


def below(kind, radius=0.12, **keywords):
    """A sphere or a level capsule with its top 5 mm below the origin, and its axis."""
    at = [0.013, 0.007, -radius - 0.005]
    if kind == "sphere":
        body = dc.RigidBody.sphere(radius, pose=[*at, 1, 0, 0, 0], **keywords)
        return body, np.array([at])
    turn = Rotation.from_euler("ZYX", [0.3, math.pi / 2, 0])
    body = dc.RigidBody.capsule(radius, 0.2, pose=[*at, *quaternion(turn)], **keywords)
    return body, at + 0.1 * np.outer([-1, 1], turn.apply([0, 0, 1]))


def distance(x, faces, ends):
    """Distance between a skeleton (a point or a segment) and triangles [m]."""
    smallest = min(ipctk.point_triangle_distance(p, *x[f]) for p in ends for f in faces)
    if len(ends) == 2:
        edges = {tuple(sorted((f[k], f[k - 1]))) for f in faces for k in range(3)}
        pairs = (ipctk.edge_edge_distance(*x[list(e)], *ends) for e in edges)
        smallest = min(smallest, *pairs)
    return math.sqrt(smallest)


@pytest.mark.parametrize("scheme", ["coupled", "split"])
@pytest.mark.parametrize("kind", ["sphere", "capsule"])
def test_no_point_of_a_cloth_enters_a_smooth_body(kind, scheme):
    body, ends = below(kind, smooth=True)
    # The report is of all pairs: folds of the sheet may be nearer to each other than to the body.
    sim, states = drape(body, scheme=scheme, contact=dc.ContactOptions(self_contact=False))
    faces = np.array(sim.scene.cloths[0].faces)
    gaps = [distance(state.positions.numpy(), faces, ends) - 0.12 for state in states]
    assert min(gaps) > 0
    assert gaps[-1] < float(sim.default_parameters().barrier_distance)
    # The report has the same minimum distance whenever a pair is in contact.
    reported = [float(state.report.minimum_distance) for state in states]
    touching = [k for k, value in enumerate(reported) if math.isfinite(value)]
    assert len(touching) > 20
    for k in touching:
        assert reported[k] == pytest.approx(gaps[k], abs=1e-12)
    # The contact points have the same gap.
    contacts = sim.contacts(states[-1]).on(sim.scene.body_names[0])
    assert float(contacts.gaps[contacts.mask].min()) == pytest.approx(gaps[-1], abs=1e-12)
    skin = contacts.points[contacts.mask][:, 1].numpy()
    axis = ends[-1] - ends[0]
    share = np.clip((skin - ends[0]) @ axis / max(axis @ axis, 1e-300), 0, 1)
    from_axis = np.linalg.norm(skin - ends[0] - share[:, None] * axis, axis=1)
    assert from_axis.max() < 0.12 * (1 + 1e-12)
    # If both the axis and one of its ends act, the sphere around the end lies within.
    assert from_axis.min() > 0.12 * ((1 - 1e-12) if len(ends) == 1 else 0.999)


@pytest.mark.parametrize("kind", ["sphere", "capsule"])
def test_a_smooth_body_carries_the_weight_of_the_cloth(kind):
    """At rest, friction holds the sheet in place and the body carries its weight."""
    body, _ = below(kind, smooth=True, friction=2.0)
    sim, states = drape(body, n=10, solver=dc.SolverOptions(tolerance=1e-7))
    state = sim.equilibrium(states[-1])
    weight = float(sim.default_parameters().density * 0.25 * G)
    assert float(sim.contact_wrenches(state)["body0"][2]) == pytest.approx(-weight, rel=1e-6)


def raised(body, seconds=0.4, height=0.06, n=10):
    """A sheet pinned at its rim over a body that rises and then stays."""
    cloth = dc.Cloth.grid(n, n, size=0.5)
    x = np.array(cloth.vertices)
    rim = np.flatnonzero(np.abs(x[:, :2]).max(axis=1) > 0.249)
    cloth = dc.Cloth(
        x, cloth.faces, pins={"rim": rim}, material=dc.Material(stretch=100.0, friction=0.0)
    )
    contact = dc.ContactOptions(barrier_distance=2e-3, barrier_stiffness=2000.0)
    solver = dc.SolverOptions(tolerance=1e-9)
    sim = dc.Simulator(dc.Scene([cloth], [body]), 0.01, contact=contact, solver=solver)
    state = sim.initial_state()
    poses = state.body_poses.clone()
    for k in range(round(seconds / 0.01)):
        poses[0, 2] = state.body_poses[0, 2] if k >= 12 else poses[0, 2] + height / 12
        state = sim.step(state, dc.Control(body_poses=poses.clone()))
    return sim, state


def test_finer_meshes_converge_to_the_smooth_body():
    """Rest positions of a taut sheet on a smooth sphere, against meshes of the sphere."""
    ends = []
    for keywords in ({"smooth": True}, *({"subdivisions": k} for k in (1, 2, 4))):
        body, _ = below("sphere", motion="kinematic", friction=0.0, **keywords)
        ends.append(raised(body)[1].positions)
    smooth, *meshes = ends
    off = [float((mesh - smooth).norm(dim=1).max()) for mesh in meshes]
    assert off[0] > 2 * off[1] > 4 * off[2], off


BELT = {"radius": 0.1, "width": 0.12, "length": 0.5, "tension": 1.0, "kappa": 2000.0, "d_hat": 2e-3}


def belt(columns, rows, jitter):
    """A belt over half a capsule, pinned at one end, pulled at the other, without friction."""
    radius, width, length, tension, kappa, d_hat = BELT.values()
    X, faces = scenes.grid(rows, columns, edge=1.0, seed=1, jitter=jitter)
    X = X * [length / (columns - 1), width / (rows - 1), 0]
    X = X - (X.max(axis=0) + X.min(axis=0)) / 2
    edge = length / (columns - 1)
    rho = radius + 1.2e-3 + (1.45 * edge) ** 2 / 8 / radius
    angle = np.clip(X[:, 0] / rho, -math.pi / 2, math.pi / 2)
    hanging = np.maximum(np.abs(X[:, 0]) - rho * math.pi / 2, 0)
    x = np.stack([rho * np.sin(angle), X[:, 1], rho * np.cos(angle) - hanging], axis=1)
    at_end = np.abs(X[:, 0]) > length / 2 - 0.49 * edge
    left, right = (np.flatnonzero(at_end & (side * X[:, 0] > 0)) for side in (-1, 1))
    material = dc.Material(stretch=2000.0, bending=1e-7, density=0.1, damping=0.02, friction=0.0)
    cloth = dc.Cloth(x, faces, rest_positions=X, material=material, pins={"left": left})
    pose = [0, 0, 0, *quaternion(Rotation.from_euler("x", math.pi / 2))]
    body = dc.RigidBody.capsule(radius, 0.4, smooth=True, pose=pose, friction=0.0)
    sim = dc.Simulator(
        dc.Scene([cloth], [body], gravity=[0, 0, 0]),
        0.02,
        contact=dc.ContactOptions(
            barrier_distance=d_hat, barrier_stiffness=kappa, self_contact=False
        ),
    )
    state = sim.initial_state()
    right = right[np.argsort(X[right, 1])]
    share = np.gradient(X[right, 1])
    share[[0, -1]] /= 2
    forces = torch.zeros_like(state.positions)
    forces[right, 2] = -torch.tensor(tension * share / share.sum())
    with torch.no_grad():
        for _ in range(30):
            state = sim.step(state, dc.Control(forces=forces))
    return sim, state


def gap_under(share):
    """Gap at which the share `share` of a quarter of the barrier carries the belt's pressure."""
    radius, width, _, tension, kappa, d_hat = BELT.values()
    low, high = 0.0, d_hat
    for _ in range(60):
        gap = (low + high) / 2
        d = radius + gap
        slope = -2 * d * kernels.barrier_derivatives(d * d, radius, d_hat)[1]
        carries = 0.25 * share * kappa * slope > tension / (width * d)
        low, high = (gap, high) if carries else (low, gap)
    return high


@pytest.mark.parametrize("jitter", [0.0, 0.15], ids=["aligned", "jittered"])
def test_the_gap_under_a_pressure_does_not_know_the_mesh_of_the_cloth(jitter):
    """T / (w r) presses a belt on a capsule; a third of the edges of a grid is along its axis."""
    gaps = []
    for columns, rows in ((25, 9), (33, 11), (49, 13)):
        sim, state = belt(columns, rows, jitter)
        contacts = sim.contacts(state)
        forces = contacts.normal_forces
        # Half a turn of the belt with T / r per length in all directions.
        expected = math.pi * BELT["tension"]
        assert float(forces.sum()) == pytest.approx(expected, rel=5e-3)
        gaps.append(float((contacts.gaps * forces).sum() / forces.sum()))
    # Pressure is uneven at edges of an irregular mesh, but its sum is the same as on the grid.
    np.testing.assert_allclose(gaps, gap_under(2 / 3), rtol=0.03 if jitter else 5e-3)
    assert np.ptp(gaps) < (0.04 if jitter else 1e-3) * np.mean(gaps)


def test_the_orientation_of_a_sphere_does_not_change_a_sheet():
    """The facets of a mesh do have an effect."""
    spreads = []
    for keywords in ({"smooth": True}, {"subdivisions": 1}):
        ends = []
        for angle in (0.0, 0.21, 0.43, 0.66):
            turn = quaternion(Rotation.from_rotvec(angle * np.array([0.6, 0.64, 0.48])))
            body = dc.RigidBody.sphere(
                0.12,
                pose=[0.013, 0.007, -0.125, *turn],
                motion="kinematic",
                friction=0.0,
                **keywords,
            )
            ends.append(raised(body, seconds=0.2, n=8)[1].positions)
        spreads.append(max(float((end - ends[0]).norm(dim=1).max()) for end in ends))
    assert spreads[0] < 1e-8
    assert spreads[1] > 1e-3


def test_a_loss_has_no_facets():
    """Third differences along a sweep of a capsule's heading, which facets would increase."""

    def end(heading, **keywords):
        turn = quaternion(Rotation.from_euler("ZYX", [heading, 1.45, 0]))
        body = dc.RigidBody.capsule(
            0.12,
            0.2,
            pose=[0.013, 0.007, -0.14, *turn],
            motion="kinematic",
            friction=0.0,
            **keywords,
        )
        return float(raised(body, seconds=0.2, n=8)[1].positions[:, 2].sum())

    headings = 0.4 + 0.004 * np.arange(9)
    rough = []
    for smooth in (True, False):
        values = np.array([end(h, smooth=smooth) for h in headings])
        rough.append(np.abs(np.diff(values, 3)).max() / np.abs(np.diff(values)).max())
    assert rough[0] < 0.3 * rough[1], rough


def thrown(kind, radius, thickness):
    """A loss and its gradient for a body thrown onto a sheet; its mass ignores its radius."""
    moments = 1e-3 * np.eye(3)
    keywords = {"motion": "dynamic", "mass": 0.2, "center": [0, 0, 0], "inertia": moments}
    keywords |= {"smooth": True, "thickness": thickness, "friction": 0.5}
    keywords |= {"pose": [0.02, 0.01, 0.085, 0.9, 0.3, 0.2, 0.1]}
    if kind == "sphere":
        body = dc.RigidBody.sphere(radius, **keywords)
    else:
        body = dc.RigidBody.capsule(radius, 0.06, **keywords)
    edges = [i for i in range(64) if i % 8 in (0, 7)]
    material = dc.Material(stretch=100.0, friction=0.5)
    cloth = dc.Cloth.grid(8, 8, size=0.3, pins={"edges": edges}, material=material)
    contact = dc.ContactOptions(barrier_distance=5e-3, barrier_stiffness=300.0, slip_velocity=0.02)
    solver = dc.SolverOptions(tolerance=1e-12, max_iterations=1000)
    sim = dc.Simulator(dc.Scene([cloth], [body]), 0.005, contact=contact, solver=solver)
    start = sim.initial_state()
    speed = torch.tensor([[0.2, 0.1, -1.0, 1.0, 2.0, 3.0]], dtype=F64)
    state = start.replace(body_velocities=speed)
    parameters = sim.default_parameters()
    given = parameters.thickness.clone().requires_grad_()
    for _ in range(8):
        state = sim.step(state, parameters=parameters.replace(thickness=given))
    assert state.report.contact_count > 3
    generator = torch.Generator().manual_seed(3)
    weights = torch.randn(state.positions.shape, dtype=F64, generator=generator)
    loss = (state.positions * weights).sum() + state.body_poses.cos().sum()
    (gradient,) = torch.autograd.grad(loss, given)
    return state.detach(), float(loss.detach()), float(gradient[1])


@pytest.mark.parametrize("kind", ["sphere", "capsule"])
def test_thickness_of_a_body_on_cloth_is_radius(kind):
    """Twice the gradient by thickness therefore equals the gradient by radius."""
    whole, _, gradient = thrown(kind, 0.05, 2e-3)
    part, _, same = thrown(kind, 0.045, 12e-3)
    for field in ("positions", "body_poses", "body_velocities", "contact_forces"):
        torch.testing.assert_close(getattr(whole, field), getattr(part, field), rtol=0, atol=1e-12)
    assert same == pytest.approx(gradient, rel=1e-9)
    h = 1e-5
    found = (thrown(kind, 0.05 + h, 2e-3)[1] - thrown(kind, 0.05 - h, 2e-3)[1]) / (2 * h)
    assert 2 * gradient == pytest.approx(found, rel=1e-4)


@pytest.mark.parametrize("threads", [1, 3])
def test_bits_do_not_depend_on_threads_or_batches(in_contact, threads):
    sim, state = in_contact
    faster = state.replace(body_velocities=1.1 * state.body_velocities)
    batch = dc.stack([state, faster, state])
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        together = sim.step(batch)
    finally:
        torch.set_num_threads(before)
    for k, alone in enumerate((sim.step(state), sim.step(faster), sim.step(state))):
        for name in ("positions", "body_poses", "body_velocities", "body_forces"):
            assert torch.equal(getattr(together, name)[k], getattr(alone, name)), name


@pytest.mark.parametrize("height", [-0.15, 0.01], ids=["within", "across"])
@pytest.mark.parametrize("kind", ["sphere", "capsule"])
def test_smooth_bodies_that_overlap_at_the_start_are_named(kind, height):
    keywords = {"smooth": True, "pose": [0.03, 0.01, height, 1, 0, 0, 0], "name": "it"}
    if kind == "sphere":
        body = dc.RigidBody.sphere(0.2, **keywords)
    else:
        body = dc.RigidBody.capsule(0.1, 0.3, **keywords)
    scene = dc.Scene([dc.Cloth.grid(8, 8, size=0.5)], [body])
    with pytest.raises(dc.IntersectingState, match=r"body 'it' .*cloth 'cloth0' face"):
        dc.Simulator(scene, 0.01)


@pytest.mark.parametrize("apart", [0.25, 0.35])
def test_smooth_bodies_overlap_according_to_their_radii(apart):
    balls = [
        dc.RigidBody.sphere(
            radius, smooth=True, motion="dynamic", mass=0.3, pose=[x, 0, 0, 1, 0, 0, 0]
        )
        for radius, x in ((0.1, 0.0), (0.2, apart))
    ]
    options = dc.ContactOptions(barrier_distance=2e-3)
    if apart > 0.3:
        dc.Simulator(dc.Scene([], balls), 0.01, contact=options)
        return
    with pytest.raises(dc.IntersectingState, match=r"overlap by 0.05 m"):
        dc.Simulator(dc.Scene([], balls), 0.01, contact=options)


def test_an_attachment_to_a_smooth_body_holds():
    """The attachment point is fixed in the body's frame and rotates with the body."""
    ball = dc.RigidBody.sphere(
        0.1, smooth=True, motion="dynamic", mass=0.3, pose=[0, 0, -0.3, 1, 0, 0, 0], name="ball"
    )
    sheet = dc.Cloth.grid(5, 5, size=0.4, pins={"all": list(range(25))})
    string = dc.Attachment(
        ("cloth0", 12), ("ball", [0.06, 0.0, 0.08]), stiffness=200.0, rest_length=0.1
    )
    sim = dc.Simulator(dc.Scene([sheet], [ball], attachments=[string]), 0.01)
    state = sim.initial_state()
    with torch.no_grad():
        for _ in range(200):
            state = sim.step(state.replace(body_velocities=0.9 * state.body_velocities))
    wrench = sim.contact_wrenches(state)["ball"]
    assert float(wrench[2]) == pytest.approx(0.3 * G, rel=1e-2)
    # The ball hangs by the point, with its center below.
    w, x, y, z = state.body_poses[0, 3:].tolist()
    arm = Rotation.from_quat([x, y, z, w]).apply([0.06, 0.0, 0.08])
    np.testing.assert_allclose(arm[:2], 0, atol=5e-3)
    assert arm[2] == pytest.approx(0.1, rel=1e-2)


@pytest.mark.parametrize("coupling", ["monolithic", "rigid_to_cloth", "cloth_to_rigid"])
@pytest.mark.filterwarnings("ignore::diffcloth_torch.AddedMassWarning")
def test_couplings_agree_on_smooth_bodies(coupling):
    """A heavy ball falls onto a sheet over a capsule: every coupling supports the ball."""
    ball = dc.RigidBody.sphere(
        0.06, smooth=True, motion="dynamic", density=3000.0, pose=[0.02, 0.01, 0.08, 1, 0, 0, 0]
    )
    turn = quaternion(Rotation.from_euler("y", math.pi / 2))
    pill = dc.RigidBody.capsule(0.05, 0.4, smooth=True, pose=[0, 0, -0.06, *turn])
    sheet = dc.Cloth.grid(10, 10, size=0.5, pins={"corners": [0, 9, 90, 99]})
    sim = dc.Simulator(dc.Scene([sheet], [ball, pill]), 0.002, coupling=coupling)
    with torch.no_grad():
        state = sim.rollout(sim.initial_state(), steps=60)[-1]
    assert 0.05 < float(state.body_poses[0, 2]) < 0.065
    assert state.body_forces.shape == (8, 3)


def test_a_smooth_body_is_drawn_and_exported_as_its_mesh(tmp_path):
    ball = dc.RigidBody.sphere(0.1, subdivisions=1, smooth=True, pose=[0, 0, -0.11, 1, 0, 0, 0])
    sim = dc.Simulator(dc.Scene([dc.Cloth.grid(6, 6, size=0.3)], [ball]), 0.01)
    state = sim.rollout(sim.initial_state(), steps=20)[-1]
    vertices, faces = state.meshes()["body0"]
    assert vertices.shape == (42, 3)
    torch.testing.assert_close(vertices, torch.from_numpy(ball.vertices - [0, 0, 0.11]))
    assert len(faces) == 80
    state.export(tmp_path / "ball.obj", bodies=True)
    dc.render(sim.scene, state, tmp_path / "ball.png", contact_forces=True)
    kept = pickle.loads(pickle.dumps(sim.scene.bodies[0]))
    assert kept.smooth
    assert repr(kept) == "RigidBody(static, 80 faces, smooth)"


def test_bodies_that_cannot_be_smooth_are_refused():
    with pytest.raises(dc.InvalidInput, match=r"RigidBody\.capsule can be smooth"):
        dc.RigidBody.cylinder(0.1, 0.2, smooth=True)
    with pytest.raises(dc.InvalidInput, match="`smooth` must not be set with `nodal_contact`"):
        dc.RigidBody.sphere(0.1, smooth=True, nodal_contact=True)
    with pytest.raises(TypeError, match="`smooth` must be True or False, got int"):
        dc.RigidBody.capsule(0.1, 0.2, smooth=1)
    with pytest.raises(dc.InvalidInput, match="one of them, got neither"):
        dc.RigidBody.sphere(0.1, smooth=True, motion="dynamic")
    with pytest.raises(dc.InvalidInput, match="got True for a box, which is exact as a mesh"):
        dc.RigidBody.box(0.1, smooth=True)
    with pytest.raises(dc.InvalidInput, match="got True for a plane"):
        dc.RigidBody.plane(0.1, smooth=True)


def test_split_steps_are_those_of_the_same_sum():
    body, _ = below("sphere", smooth=True)
    ends = [drape(body, n=10, steps=15, scheme=scheme)[1][-1] for scheme in ("coupled", "split")]
    torch.testing.assert_close(*(end.positions for end in ends), atol=1e-5, rtol=0)


def test_projective_steps_touch_the_smooth_surface_in_any_case():
    """The projective scheme's contact is nodal and always uses the analytic surface."""
    ends = []
    for smooth in (True, False):
        body, _ = below("sphere", smooth=smooth)
        ends.append(drape(body, n=10, steps=15, scheme="projective")[1][-1].positions)
    assert torch.equal(*ends)
