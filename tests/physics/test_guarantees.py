"""No intersection at any speed, in states and on paths, judged by ipctk."""

import numpy as np
import pytest
import torch
from physics_scenes import (
    Judge,
    jittered_sheet,
    matrix,
    quaternion,
    solver_path,
    tensor,
)
from public_data import public

import diffcloth_torch as dc

DT = 0.01


def curtain(pins):
    """Vertical sheet in the yz-plane, 0.5 m wide, in general position; pins "top" or "all"."""
    vertices, faces = jittered_sheet(7, 0.5)
    vertices = (vertices - [0.25, 0, 0]) @ matrix(quaternion([0, 1, 0], np.pi / 2)).T
    z, y = vertices[:, 2], vertices[:, 1]
    edge = z > 0.249
    if pins == "all":
        edge = (np.abs(z) > 0.249) | (np.abs(y) > 0.249)
    material = dc.Material(stretch=100.0, bending=1e-5)
    return dc.Cloth(vertices, faces, material=material, pins={"p": np.flatnonzero(edge)})


def bodies():
    tilted = quaternion([1, 2, 3], 0.2)
    start = [-0.06, 0.02, -0.05, *tilted]
    return {
        "plate": dc.RigidBody.box([0.01, 0.3, 0.3], motion="kinematic", pose=start),
        "rod": dc.RigidBody.box([0.3, 0.008, 0.008], motion="kinematic", pose=[-0.2, *start[1:]]),
        "ball": dc.RigidBody.sphere(0.05, subdivisions=1, motion="kinematic", pose=start),
    }


def attempt(sim, judge, state, control):
    """Step and judge the whole path; None if the step is refused as infeasible or too hard.

    After a refusal the given state has its bits, and a step without motion still works.
    """
    before = state.positions.clone(), state.velocities.clone(), state.body_poses.clone()
    path = solver_path(sim, state, control)
    assert judge.is_free_path(path)
    try:
        after = sim.step(state, control)
    except (dc.InfeasibleMotion, dc.NotConverged) as failure:
        error = failure
    else:
        assert judge.is_free(after)
        assert np.abs(path[-1] - judge.points(after)).max() < 1e-12
        assert after.report.motion_fraction == 1
        return after
    if isinstance(error, dc.InfeasibleMotion):
        assert 0 <= error.report.motion_fraction < 1
    now = state.positions, state.velocities, state.body_poses
    assert all(torch.equal(a, b) for a, b in zip(before, now, strict=True))
    assert sim.step(state).report.converged
    return None


SLOW = pytest.mark.slow


@pytest.mark.quick("*-10.0", "*-plate-*-100.0", "*-rod-*-100.0")
@pytest.mark.parametrize(
    ("pins", "speed"),
    [("top", 10.0), ("all", 10.0), ("top", 100.0), pytest.param("all", 100.0, marks=SLOW)],
)
@pytest.mark.parametrize("body", ["plate", "rod", "ball"])
@pytest.mark.parametrize("scheme", ["coupled", pytest.param("split", marks=SLOW)])
def test_a_fast_body_never_passes_through(speed, body, pins, scheme):
    sim = dc.Simulator(dc.Scene([curtain(pins)], [bodies()[body]]), DT, scheme=scheme)
    judge = Judge(sim)
    state = sim.initial_state()
    poses = state.body_poses.clone()
    for _ in range(2):
        poses[0, 0] += speed * DT
        after = attempt(sim, judge, state, dc.Control(body_poses=poses))
        if after is None:
            break
        state = after
    else:
        assert state.positions[:, 0].max() > poses[0, 0]  # carried in front of it


@pytest.mark.parametrize("degrees", [60.0, 179.0])
@pytest.mark.parametrize("pins", ["top", "all"])
def test_a_fast_turning_body_never_passes_through(degrees, pins):
    # A wing hinged beside the curtain starts pointing away and rotates through the curtain.
    wing = dc.RigidBody.box([0.3, 0.2, 0.01])
    hinged = wing.vertices + np.array([0.15, 0, 0])
    start = quaternion([0, 1, 0], np.pi - 0.6)
    body = dc.RigidBody(hinged, wing.faces, motion="kinematic", pose=[-0.05, 0.01, -0.1, *start])
    sim = dc.Simulator(dc.Scene([curtain(pins)], [body]), DT)
    judge = Judge(sim)
    state = sim.initial_state()
    poses = state.body_poses.clone()
    angle, moved = np.pi - 0.6, 0
    for _ in range(3):
        angle += np.radians(degrees)
        poses[0, 3:] = tensor(quaternion([0, 1, 0], angle))
        after = attempt(sim, judge, state, dc.Control(body_poses=poses))
        if after is None:
            break
        moved += 1
        state = after
    if pins == "top" and degrees == 60.0:
        assert moved > 0  # a hanging cloth can yield


def test_a_body_driven_far_into_a_pinned_cloth_stretches_it_or_is_refused():
    sim = dc.Simulator(dc.Scene([curtain("all")], [bodies()["ball"]]), DT)
    judge = Judge(sim)
    state = sim.initial_state()
    poses = state.body_poses.clone()
    for _ in range(3):
        poses[0, 0] += 0.15
        after = attempt(sim, judge, state, dc.Control(body_poses=poses))
        if after is None:
            break
        state = after
    else:
        assert state.positions[:, 0].max() > poses[0, 0] + 0.04


def squeeze(gap, push, **keywords):
    """A free cloth between two plates at distance `gap`, which are pushed together."""
    vertices, faces = jittered_sheet(4, 0.3)
    cloth = dc.Cloth(vertices - [0.15, 0, 0], faces, material=dc.Material(**keywords))
    slabs = [
        dc.RigidBody.box(
            [0.5, 0.5, 0.1], motion="kinematic", pose=[0, 0, side * (0.05 + gap), 1, 0, 0, 0]
        )
        for side in (-1, 1)
    ]
    far = dc.RigidBody.sphere(0.1, pose=[5, 5, 5, 1, 0, 0, 0])
    sim = dc.Simulator(dc.Scene([cloth], [far, *slabs]), DT)
    state = sim.initial_state()
    poses = state.body_poses.clone()
    poses[1, 2] += push
    poses[2, 2] -= push
    return sim, state, dc.Control(body_poses=poses)


@pytest.mark.parametrize("gap", [0.01, 0.05])
def test_a_cloth_squeezed_to_nothing_is_infeasible(gap):
    sim, state, control = squeeze(gap, gap + 1e-4)
    judge = Judge(sim)
    assert attempt(sim, judge, state, control) is None
    with pytest.raises(dc.InfeasibleMotion, match="body 'body1', body 'body2'") as caught:
        sim.step(state, control)
    assert "body0" not in str(caught.value)
    fraction = caught.value.report.motion_fraction
    assert f"{fraction:.3g}" in str(caught.value)
    assert gap / (gap + 1e-4) - 0.1 < fraction < gap / (gap + 1e-4)


def test_a_cloth_between_plates_that_leave_room_is_fine():
    sim, state, control = squeeze(0.01, 0.009)
    after = attempt(sim, Judge(sim), state, control)
    assert after is not None
    assert after.body_forces.abs().max() > 1e-3


def test_thick_surfaces_squeezed_below_their_thickness_are_infeasible():
    sim, state, control = squeeze(0.01, 0.0085, thickness=4e-3)
    assert attempt(sim, Judge(sim), state, control) is None


def test_pins_driven_into_a_body_are_infeasible():
    cloth = curtain("top")
    wall = dc.RigidBody.box([0.02, 1.0, 1.0], pose=[0.05, 0, 0, 1, 0, 0, 0])
    sim = dc.Simulator(dc.Scene([cloth], [wall]), DT)
    judge = Judge(sim)
    state = sim.initial_state()
    pins = state.positions[list(cloth.pins["p"])]
    ahead = tensor([1.0, 0, 0])
    assert attempt(sim, judge, state, dc.Control(pins=pins + 0.05 * ahead)) is None
    assert attempt(sim, judge, state, dc.Control(pins=pins + 0.5 * ahead)) is None  # beyond it
    assert attempt(sim, judge, state, dc.Control(pins=pins + 0.03 * ahead)) is not None


# --- Public meshes -------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:Cloth.load. .* is 28 m long:UserWarning")
def test_two_layers_thrown_at_each_other_stop():
    # The straight motion from t0 to t1 makes the layers pass through each other.
    before = dc.Cloth.load(public("pairs/thick-cloth_t0.ply"))
    target = dc.Cloth.load(public("pairs/thick-cloth_t1.ply"))
    sim = dc.Simulator(dc.Scene([before], gravity=(0, 0, 0)), DT)
    judge = Judge(sim)
    state = sim.initial_state()
    way = tensor(target.vertices - before.vertices)
    assert not judge.is_free_path([before.vertices, before.vertices + 2 * way.numpy()])
    state = state.replace(velocities=2 * way / DT)
    for _ in range(2):
        state = attempt(sim, judge, state, None)


def test_a_sock_falls_on_a_cow():
    sock = dc.Cloth.load(public("cloth/diffcloth_sock482.obj"))
    size = np.ptp(sock.vertices, axis=0).max()
    sock = dc.Cloth.load(public("cloth/diffcloth_sock482.obj"), scale=0.4 / size)
    cow = dc.RigidBody.load(public("obstacles/spot.ply"), scale=0.3)
    low, high = sock.vertices.min(axis=0), sock.vertices.max(axis=0)
    top = cow.vertices[:, 2].max()
    shift = [*(-0.5 * (low + high))[:2], top - low[2] + 5e-3]
    sock = dc.Cloth.load(
        public("cloth/diffcloth_sock482.obj"), scale=0.4 / size, pose=[*shift, 1, 0, 0, 0]
    )
    sim = dc.Simulator(dc.Scene([sock], [cow]), DT)
    judge = Judge(sim)
    state = sim.initial_state()
    for _ in range(5):
        state = attempt(sim, judge, state, None)
