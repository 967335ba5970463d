"""Coordinates as unknowns: gradients of a step of the core by every input, against differences."""

import numpy as np
import pytest
from bodies.core_mechanisms import DT, CoreScene, chain, one_body, trees

OUTPUTS = (
    *("positions", "velocities", "body_forces", "contact_forces", "pin_forces"),
    "coordinates",
)
TURNED = [0.9887, 0.0897, 0.1195, 0.0]  # a quaternion, not quite of unit length
BOXES = ([0.08, 0.08, 0.05], [0.05, 0.04, 0.12], [0.04, 0.04, 0.1], [0.03, 0.05, 0.06])


def body_in_contact():
    """A free box that has fallen onto the cloth: the inputs of its third step in contact."""
    scene = CoreScene(one_body(), [[0.1, 0.12, 0.08]])
    mass, inertia = 0.2, np.diag([3.5e-4, 2.7e-4, 4.1e-4])
    metric = np.zeros((6, 6))
    metric[:3, :3], metric[3:, 3:] = mass * np.eye(3), inertia
    metric /= DT**2
    q = np.array([0.02, 0.01, 0.07, 0.01, -0.02, 0.03])
    speed = np.array([0.3, 0.1, -1.5, 1.0, 2.0, -1.0])
    frame = [0.001, 0.002, -0.001, *TURNED]
    touching, result = 0, None
    while True:
        target = q + DT * speed + DT**2 * np.array([0, 0, -9.81, 0, 0, 0])
        arrays = scene.inputs(
            result,
            body_poses=[frame],
            body_targets=[frame],
            coordinates=q,
            coordinate_ends=q,
            coordinate_targets=target,
            coordinate_metric=metric.ravel(),
        )
        result = scene.forward(arrays)
        touching += int(result["contact_count"][0] > 0)
        if touching == 3:
            return scene, arrays
        speed = (result["coordinates"][0] - q) / DT
        q = result["coordinates"][0]


def with_bounds(arrays, scene, name):
    """Inputs of the last step with a joint term of the hinge, of which one part is active."""
    n = arrays["coordinates"].shape[1]
    hinge, stiffness = n - 2, 40.0
    slip = float(scene.forward(arrays)["coordinates"][0, hinge] - arrays["coordinates"][0, hinge])
    metric = arrays["coordinate_metric"].reshape(1, n, n).copy()
    metric[0, hinge, hinge] += stiffness  # of the drive
    speed = abs(slip) / DT
    terms = np.tile([0.0, 0.0, 0.0, 1e30, 1e30, 0.0, 1.0], (1, n, 1))
    terms[0, hinge] = {
        "limit": [0.0, 1.3, stiffness, 1.0, 1e30, 0.0, 1.0],
        "slow": [0.0, 0.0, stiffness, 1e30, 0.9 * speed, 0.0, 1.0],
        "creep": [0.0, 0.0, stiffness, 1e30, 1e30, 2.0, 2.0 * speed],
        "slide": [0.0, -0.95, stiffness, 1.0, 1e30, 0.2, 0.1 * speed],
    }[name]
    terms[0, hinge, 0] = arrays["coordinates"][0, hinge] - 1e-3 * slip
    return arrays | {"coordinate_metric": metric.reshape(1, -1), "joint_terms": terms}


def chain_in_contact(*, free, light=False):
    """A chain that lands on the cloth; its hinge is beyond its limit, its slide is prescribed.

    A `light` chain has no limit: the effect of its joints on their own lever arms then counts.
    """
    rng = np.random.default_rng(1)
    trees = chain(free=free)
    if light:
        trees["coordinate_upper"] = np.full_like(trees["coordinate_upper"], np.inf)
    scene = CoreScene(trees, BOXES, cells=6)
    n = 8 if free else 2
    factor = rng.standard_normal((n, n))
    metric = (0.01 * factor @ factor.T + 0.05 * np.eye(n)) / DT**2
    if light:
        metric *= 0.02
    q = np.array([0.198, 0.01])
    frame = np.array([-0.05, 0, 0.27, *TURNED])
    if free:
        q = np.array([-0.05, 0, 0.27, 0.01, -0.02, 0.03, *q])
        frame[:3] = 0.001, 0.002, 0.003
    speed = np.zeros(n)
    speed[-2] = 3.0
    touching, result = 0, None
    while True:
        end = frame.copy()
        target, ends = q + DT * speed, q.copy()
        ends[-1] += 0.4 * DT
        if free:
            target[2] = q[2] - 1.5 * DT
        else:
            end[2] -= 1.5 * DT
            end[3:] += 0.01 * rng.standard_normal(4)
        arrays = scene.inputs(
            result,
            body_poses=[frame],
            body_targets=[end],
            coordinates=q,
            coordinate_ends=ends,
            coordinate_targets=target,
            coordinate_metric=metric.ravel(),
        )
        result = scene.forward(arrays)
        touching += int(result["contact_count"][0] > 0)
        if touching == 3:
            assert light or result["coordinates"][0][-2] > 0.2  # beyond the limit, within its zone
            return scene, arrays
        speed = 0.9 * (result["coordinates"][0] - q) / DT
        speed[-2] += 0.5
        q, frame = result["coordinates"][0], end


CASES = {
    "body": body_in_contact,
    "chain": lambda: chain_in_contact(free=False),
    "light": lambda: chain_in_contact(free=False, light=True),
    "floating": lambda: chain_in_contact(free=True),
}


BOUNDS = ["chain-limit", "light-slow", "floating-creep", "chain-slide"]


@pytest.fixture(scope="module", params=[*CASES, *BOUNDS])
def case(request):
    name, _, bound = request.param.partition("-")
    scene, arrays = CASES[name]()
    if bound:
        arrays = with_bounds(arrays, scene, bound)
    rng = np.random.default_rng(2)
    # Friction measures motion from other origins than the start, as in a staggered coupling.
    start = scene.core.path({k: v[:1] for k, v in arrays.items()})[0]
    away = 0.3 * DT * rng.standard_normal(start.shape)
    arrays = {**arrays, "friction_origins": (start - away)[None]}
    result = scene.forward(arrays)
    cotangents = {name: rng.standard_normal(result[name].shape) for name in OUTPUTS}
    return scene, arrays, cotangents, scene.gradients(arrays, cotangents)


# Inputs, each with the step of its difference quotient.
STEPS = {
    "positions": 1e-7,
    "velocities": 1e-5,
    "body_poses": 1e-7,
    "body_targets": 1e-7,
    "pin_targets": 1e-7,
    "forces": 1e-5,
    "gravity": 1e-4,
    "stretch": 1e-2,
    "density": 1e-6,
    "friction": 1e-5,
    "thickness": 1e-8,
    "barrier_distance": 1e-8,
    "rest_positions": 1e-7,
    "coordinates": 1e-7,
    "coordinate_ends": 1e-7,
    "friction_origins": 1e-7,
    "coordinate_targets": 1e-7,
    "coordinate_metric": 1e-3,
    "joint_terms": 1e-6,
}


@pytest.mark.parametrize("name", STEPS)
def test_gradients_agree_with_differences(case, name):
    scene, arrays, cotangents, gradients = case
    if name == "coordinate_ends" and not gradients[name].any():
        pytest.skip("nothing is prescribed in this tree")
    if name == "joint_terms" and name not in arrays:
        pytest.skip("no joint has a term")
    if name not in arrays:
        arrays = {**arrays, name: scene.simulator.default_parameters().rest_positions.numpy()[None]}
        gradients = scene.gradients(arrays, cotangents)
    rng = np.random.default_rng(3)
    direction = rng.standard_normal(arrays[name].shape)
    if name in ("friction", "thickness"):
        direction = abs(direction)
    if name == "joint_terms":
        direction *= arrays[name] < 1e20  # larger values denote a missing limit
        direction[..., [3, 4, 6]] *= 10.0
        assert ((gradients[name] * direction) != 0.0).sum() >= 2
    if name == "coordinate_metric":
        n = int(direction.size**0.5)
        direction = direction.reshape(n, n)
        direction = (direction + direction.T).reshape(1, -1)

    def loss(sign):
        moved = {**arrays, name: arrays[name] + sign * STEPS[name] * direction}
        result = scene.forward(moved)
        return sum((result[key] * cotangents[key]).sum() for key in OUTPUTS)

    quotient = (loss(1) - loss(-1)) / (2 * STEPS[name])
    assert (gradients[name] * direction).sum() == pytest.approx(quotient, rel=1e-5, abs=1e-6)


def test_the_gradient_by_a_metric_is_symmetric(case):
    """The metric is symmetric too: neither of its triangles has a gradient of its own."""
    _, arrays, _, gradients = case
    n = arrays["coordinates"].shape[1]
    gradient = gradients["coordinate_metric"].reshape(n, n)
    assert abs(gradient - gradient.T).max() <= 1e-12 * abs(gradient).max()
    assert gradient.any()


def test_a_body_prescribed_where_a_free_one_went_leaves_the_cloth_where_it_was():
    # Without friction, whose lagged quantities would use the body's previous iterate.
    scene, arrays = body_in_contact()
    arrays["friction"] = 0 * arrays["friction"]
    result = scene.forward(arrays)
    prescribed = CoreScene(one_body(free=False), [[0.1, 0.12, 0.08]])
    poses = []
    for q in (arrays["coordinates"][0], result["coordinates"][0]):
        poses.append(world_pose(arrays["body_poses"][0, 0], q))
    same = {name: a for name, a in arrays.items() if not name.startswith("coordinate")}
    same["body_poses"], same["body_targets"] = (np.array([[pose]]) for pose in poses)
    again = prescribed.forward(same)
    assert np.abs(again["positions"] - result["positions"]).max() < 1e-8
    assert np.abs(again["body_forces"] - result["body_forces"]).max() < 1e-5


def world_pose(frame, q):
    """Pose of a free link: c + exp(w) (S v)."""
    from scipy.spatial.transform import Rotation

    w, x, y, z = frame[3:]
    turn = Rotation.from_rotvec(q[3:])
    x, y, z, w = (turn * Rotation.from_quat([x, y, z, w])).as_quat()
    return [*(q[:3] + turn.apply(frame[:3])), w, x, y, z]


@pytest.mark.parametrize("name", ["positions", "coordinates", "body_poses", "coordinate_targets"])
def test_tangents_are_the_transpose_of_gradients(case, name):
    """This holds also if friction measures motion from separately given origins."""
    scene, arrays, cotangents, gradients = case
    direction = np.random.default_rng(4).standard_normal(arrays[name].shape)
    result = scene.forward(arrays, tape=True)
    tape = {key: array for key, array in result.items() if key.startswith("tape_")}
    given = {name: direction[None]}
    change = scene.core.tangent(arrays, tape, result["kept"], given, 1, 1)
    along = sum((change[key][0] * cotangents[key]).sum() for key in OUTPUTS)
    assert along == pytest.approx((gradients[name] * direction).sum(), rel=1e-8, abs=1e-10)


@pytest.mark.parametrize("what", ["body", "joint", "mimic", "both"])
def test_prescribed_bodies_and_joints_turn_along_their_arcs(what):
    """A third of a turn per step, far from the cloth: points do not follow chords of the arc."""
    angle = 2.0
    if what == "body":
        scene = CoreScene(one_body(free=False), BOXES[:1])
        start = [5.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
        end = [5.0, 0.0, 0.0, np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)]
        arrays = scene.inputs(body_poses=[start], body_targets=[end])
    else:
        joint = {"lower": [-np.inf], "upper": [np.inf], "limit_stiffness": [0.0]}
        axes = [[0, 0, 0], [0, 0, 1]]
        times = [0, 4 if what == "mimic" else 1]
        tree = trees(
            False, [0, 1], [np.eye(4)] * 2, axes, [-1, 0], times, [0, 0], prescribed=[1], **joint
        )
        scene = CoreScene(tree, [[0.02] * 3, BOXES[0]])
        frame = [5.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
        of_root = angle / 2 if what == "both" else 0.0
        end = [5.0, 0.0, 0.0, np.cos(of_root / 2), 0.0, 0.0, np.sin(of_root / 2)]
        arrays = scene.inputs(
            body_poses=[frame],
            body_targets=[end],
            coordinates=[0.0],
            coordinate_ends=[(angle - of_root) / times[1]],
            coordinate_targets=[0.0],
            coordinate_metric=[1.0],
        )
    ways = scene.core.path(arrays)
    arms = ways[:, -8:, :2] - [5.0, 0.0]
    assert len(ways) > 2
    radius = np.linalg.norm(arms[0], axis=1)
    middle = np.linalg.norm(arms[1:] + arms[:-1], axis=2) / 2
    # The middle of a chord of ten degrees.
    assert (middle > (np.cos(np.radians(5.0)) - 1e-9) * radius).all()
    turned = np.arccos((arms[0] * arms[-1]).sum(1) / radius**2)
    np.testing.assert_allclose(turned, angle, atol=1e-9)
