"""Bodies and robots of a scene together: rows, limits, and couplings in two solves."""

import re
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
import torch
from mechanisms import F64, tensor
from torch import Tensor

import diffcloth_torch as dc
from diffcloth_torch.dynamics.dynamics import Dynamics
from diffcloth_torch.dynamics.limits import ZONE, limit_stiffness
from diffcloth_torch.dynamics.staggering import added_mass_numbers, cloth_to_rigid, rigid_to_cloth
from diffcloth_torch.geometry.rotation import quaternion_exp, quaternion_matrix, rotate
from diffcloth_torch.model.assembly import assemble
from diffcloth_torch.model.defaults import scene_parameters
from diffcloth_torch.robots import GRIPPER
from diffcloth_torch.sim.start import choose_slip_rates

H = 0.01


class Solution(NamedTuple):
    coordinates: Tensor
    body_forces: Tensor


def make_scene(actuation="pd", gravity=(0, 0, -9.81), base="floating"):
    bodies = [
        dc.RigidBody.plane(4.0, name="floor"),
        dc.RigidBody.box(0.2, motion="dynamic", mass=0.5, pose=[0, -1, 1, 1, 0, 0, 0], name="a"),
        dc.RigidBody.box(0.2, motion="kinematic", pose=[0, 1, 1, 1, 0, 0, 0], name="hand"),
        dc.RigidBody.box([0.1, 0.2, 0.3], motion="dynamic", mass=2.0, pose=[1, 1, 1, 0, 1, 0, 0]),
    ]
    cloth = dc.Cloth.grid(3, 3, 0.2, pose=[0, 0, 3, 1, 0, 0, 0])
    gains = {"stiffness": 40.0, "damping": 2.0} if "pd" in actuation else {}
    robot = dc.Robot.load(
        GRIPPER, base=base, actuation=actuation, pose=[2, 0, 1, 1, 0, 0, 0], name="grip", **gains
    )
    return dc.Scene([cloth], bodies, [robot], gravity=gravity)


def raised(poses, row):
    """Poses with one body 1 cm higher."""
    return poses.index_add(1, torch.tensor([row]), tensor([[[0, 0, 0.01, 0, 0, 0, 0]]]))


def fields(assembly, moved, seed=0, batch=1):
    """State and control in motion, and the parameters of the scene, with their leading axis."""
    rng = np.random.default_rng(seed)
    K, J, R = len(assembly.body_poses), len(assembly.joint_positions), len(assembly.base_poses)

    def noise(*shape, scale=1.0):
        return tensor(scale * rng.normal(size=(batch, *shape)))

    body_poses = tensor(assembly.body_poses)[None] + noise(K, 7, scale=0.02)
    base_poses = tensor(assembly.base_poses)[None] + noise(R, 7, scale=0.02)
    joints = tensor(assembly.joint_positions)[None] + noise(J, scale=0.003)
    state = {
        "body_poses": body_poses,
        "body_velocities": noise(K, 6),
        "joint_positions": joints,
        "joint_velocities": noise(J, scale=0.1),
        "base_poses": base_poses,
        "base_velocities": noise(R, 6),
    }
    control = {
        "body_poses": raised(body_poses, moved),
        "body_wrenches": noise(K, 6),
        "joint_positions": joints + noise(J, scale=0.003),
        "joint_velocities": noise(J, scale=0.1),
        "joint_efforts": noise(J, scale=0.1),
        "base_poses": base_poses + noise(R, 7, scale=0.01),
        "base_wrenches": noise(R, 6, scale=0.01),  # on a light gripper
    }
    return state, control


def parameters_of(scene, assembly):
    defaults = scene_parameters(scene, assembly, True)
    defaults |= choose_slip_rates(assembly, dc.ContactOptions())
    return {name: value[None] for name, value in defaults.items() if value.dim()}


@pytest.fixture
def world():
    scene = make_scene()
    assembly = assemble(scene)
    return assembly, Dynamics(assembly, H), parameters_of(scene, assembly), *fields(assembly, 2)


def test_rows_of_a_prediction(world):
    _, dynamics, parameters, state, control = world
    p = dynamics.predict(state, control, parameters)
    assert p.body_poses.shape == p.body_targets.shape == (1, 5, 7)
    assert dynamics.coordinate_count == 6 + 6 + 6 + 2
    for rows in (p.coordinates, p.coordinate_ends, p.coordinate_targets):
        assert rows.shape == (1, 20)
    assert p.coordinate_metric.shape == (1, 36 + 36 + 64)
    # Rows that are not free remain unchanged; a free root's frame is the same at both ends.
    assert torch.equal(p.body_poses[:, [0, 2]], state["body_poses"][:, [0, 2]])
    assert torch.equal(p.body_targets[:, [0, 2]], control["body_poses"][:, [0, 2]])
    assert torch.equal(p.body_poses[:, [1, 3, 4]], p.body_targets[:, [1, 3, 4]])
    # Points of a free root are at c + exp(w) (S v), here equal to the state's points.
    v = tensor([[0.1, 0.2, -0.3]])
    for row, pose, first in ((1, state["body_poses"][0, 1], 0), (4, state["base_poses"][0, 0], 12)):
        c, w = p.coordinates[0, first : first + 3], p.coordinates[0, first + 3 : first + 6]
        S = p.body_poses[0, row]
        got = c + rotate(quaternion_exp(w), rotate(S[3:], v) + S[:3])
        unit = torch.nn.functional.normalize(pose[3:], dim=0)
        torch.testing.assert_close(got, pose[:3] + rotate(unit, v), rtol=0, atol=1e-14)


def origins(dynamics, state, parameters):
    """Poses of bodies and robots one step earlier, flattened as the cloth solve receives them."""
    places = dynamics.last_places(state, parameters)
    return torch.cat([values.flatten(1) for values in places.values()], dim=1)


def test_the_last_places_are_where_the_velocities_come_from(world):
    _, dynamics, parameters, state, _ = world
    last = dynamics.last_places(state, parameters)
    roots = {
        ("body_poses", 1): (parameters["body_center"][0, 1], state["body_velocities"][0, 1]),
        ("body_poses", 3): (parameters["body_center"][0, 3], state["body_velocities"][0, 3]),
        ("base_poses", 0): (parameters["link_center"][0, 0], state["base_velocities"][0, 0]),
    }
    v = tensor([0.1, 0.2, -0.3])
    for (field, row), (center, twist) in roots.items():
        points = []
        for pose in (state[field][0, row], last[field][0, row]):
            unit = torch.nn.functional.normalize(pose[3:], dim=0)
            points.append((pose[:3] + rotate(unit, center), rotate(unit, v)))
        (middle, arm), (middle_before, arm_before) = points
        back = rotate(quaternion_exp(-H * twist[3:]), arm)
        torch.testing.assert_close(middle_before, middle - H * twist[:3], rtol=0, atol=1e-14)
        torch.testing.assert_close(arm_before, back, rtol=0, atol=1e-14)
    assert torch.equal(last["body_poses"][:, [0, 2]], state["body_poses"][:, [0, 2]])
    joints = state["joint_positions"] - H * state["joint_velocities"]
    assert torch.equal(last["joint_positions"], joints)


def test_last_places_of_prescribed_joints_equal_the_start():
    scene = make_scene(actuation=("position", "pd"), base="fixed")
    assembly = assemble(scene)
    dynamics = Dynamics(assembly, H)
    state, _ = fields(assembly, 2)
    last = dynamics.last_places(state, parameters_of(scene, assembly))
    assert dynamics.prescribed[12:].tolist() == [True, False]
    assert torch.equal(last["base_poses"], state["base_poses"])
    assert torch.equal(last["joint_positions"][:, 0], state["joint_positions"][:, 0])
    assert not torch.equal(last["joint_positions"][:, 1], state["joint_positions"][:, 1])


ROLLER = """
<robot name="roller">
  <link name="wheel"><inertial><origin xyz="0 0.3 0"/><mass value="0.5"/>{moments}</inertial></link>
  <link name="trunk"><inertial><origin xyz="0.1 0 0.2"/><mass value="2"/>{moments}</inertial></link>
  <joint name="hub" type="continuous"><parent link="trunk"/><child link="wheel"/></joint>
</robot>"""


def roller(folder, base):
    path = folder / "roller.urdf"
    moments = '<inertia ixx="1e-2" iyy="1e-2" izz="1e-2" ixy="0" ixz="0" iyz="0"/>'
    path.write_text(ROLLER.format(moments=moments))
    return dc.Robot.load(path, base=base, actuation="torque")


def test_the_last_place_of_a_base_is_that_of_its_root_link(tmp_path):
    """For any order of links in the file, the root turns about its own center of mass."""
    robot = roller(tmp_path, "floating")
    scene = dc.Scene([], [], [robot])
    assembly = assemble(scene)
    state, _ = fields(assembly, 0)
    spin = torch.tensor([[[0, 0, 0, 1.0, -2.0, 3.0]]], dtype=F64)
    last = Dynamics(assembly, H).last_places(
        {**state, "base_velocities": spin}, parameters_of(scene, assembly)
    )
    center = tensor([0.1, 0, 0.2])
    here, before = (
        pose[0, 0, :3] + rotate(torch.nn.functional.normalize(pose[0, 0, 3:], dim=0), center)
        for pose in (state["base_poses"], last["base_poses"])
    )
    assert not torch.equal(state["base_poses"], last["base_poses"])
    torch.testing.assert_close(before, here, rtol=0, atol=1e-14)


def test_a_motion_that_ends_early_is_one_that_was_to_end_there(tmp_path):
    scene = dc.Scene([], make_scene().bodies, [roller(tmp_path, "kinematic")])
    assembly = assemble(scene)
    dynamics, parameters = Dynamics(assembly, H), parameters_of(scene, assembly)
    state, control = fields(assembly, 2)
    there = {
        name: state[name] + 0.4 * (control[name] - state[name])
        for name in ("body_poses", "base_poses")
    }
    asked = dynamics.predict(state, control, parameters)
    ended = dynamics.end_at(asked, torch.cat(list(there.values()), dim=1))
    expected = dynamics.predict(state, control | there, parameters)
    forces = tensor(np.random.default_rng(2).normal(size=(1, len(assembly.body_vertices), 3)))
    found, wanted = (
        dynamics.advance(p, asked.coordinate_targets, forces) for p in (ended, expected)
    )
    for name, values in wanted.items():
        torch.testing.assert_close(found[name], values, rtol=0, atol=1e-12, msg=name)


def test_fields_of_the_state_after(world):
    assembly, dynamics, parameters, state, control = world
    p = dynamics.predict(state, control, parameters)
    forces = torch.zeros(1, len(assembly.body_vertices), 3, dtype=F64)
    after = dynamics.advance(p, p.coordinate_targets, forces)
    assert set(after) == {*state, "joint_efforts"}
    for name, values in state.items():
        assert after[name].shape == values.shape
    assert not after["body_velocities"][0, 0].any()
    assert torch.equal(after["body_poses"][:, [0, 2]], control["body_poses"][:, [0, 2]])
    # Momentum: v + h (g + f / m)
    gravity = parameters["gravity"].reshape(3)
    for k, mass in ((1, 0.5), (3, 2.0)):
        push = control["body_wrenches"][0, k, :3] / mass
        expected = state["body_velocities"][0, k, :3] + H * (gravity + push)
        torch.testing.assert_close(after["body_velocities"][0, k, :3], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("speed", [1.2, 0.9])
def test_a_body_that_turns_fast_must_not_have_contact(world, speed):
    """The limit applies before and after the step; contact of other bodies does not count."""
    assembly, dynamics, parameters, state, control = world
    fast = tensor([0, 0, 0, speed / H, 0, 0]) * tensor([0, 1, 0, 0])[:, None]
    state = {**state, "body_velocities": fast[None]}
    none = torch.zeros(1, len(assembly.body_vertices), 3, dtype=F64)
    on = [int(assembly.body_vertex_start[k]) for k in (1, 3)]
    p = dynamics.predict(state, control, parameters)
    after = dynamics.advance(p, p.coordinate_targets, none)

    def far(vertex, fields=after):
        forces = none if vertex is None else none.index_fill(1, torch.tensor([vertex]), 0.01)
        return dynamics.turned_too_far(p, fields, forces)

    assert not far(None)
    assert not far(on[1])
    if speed > 1.0:
        assert "body 'a' turns at" in far(on[0])[0]
        return
    assert not far(on[0])
    spun = {**after, "body_velocities": 1.2 * after["body_velocities"]}
    assert "body 'a' turns at" in far(on[0], spun)[0]


def test_the_first_of_several_bodies_that_turn_too_far_is_named(world):
    """The error has its speed, the larger of before and after, and a sufficient time step.

    Forces that cancel also count as contact.
    """
    assembly, dynamics, parameters, state, control = world
    spins = tensor([[0, 0, 0], [0, 2.0 / H, 0], [0, 0, 0], [0, 3.0 / H, 0]])
    state = {**state, "body_velocities": torch.nn.functional.pad(spins, (3, 0))[None]}
    p = dynamics.predict(state, control, parameters)
    forces = torch.zeros(1, len(assembly.body_vertices), 3, dtype=F64)
    after = dynamics.advance(p, p.coordinate_targets, forces)
    after = {**after, "body_velocities": 2.0 * after["body_velocities"]}
    for k in (1, 3):
        forces[0, int(assembly.body_vertex_start[k])] = tensor([1.0, -1.5, 0.2])
    (sentence,) = dynamics.turned_too_far(p, after, forces).values()
    assert sentence.startswith("body 'a' turns at")
    speed = after["body_velocities"][0, 1, 3:].norm()
    assert f"at {speed:.3g} rad/s" in sentence
    assert 0.98 < speed * float(re.search(r"at most (\S+) s", sentence)[1]) < 1.0


@pytest.mark.parametrize("by", ["kick", "prediction"])
def test_forces_turn_a_body_about_its_center_of_mass(world, by):
    """The body's angular momentum about the origin grows by h times the moments of the forces.

    The forces act on its points at the end of the step (kick) or at the start (prediction).
    """
    assembly, dynamics, parameters, state, control = world
    rng = np.random.default_rng(11)
    parameters |= {"body_center": tensor(rng.uniform(-0.1, 0.1, (1, 4, 3)))}
    parameters |= {"gravity": torch.zeros(1, 1, 3, dtype=F64)}
    control |= {"body_wrenches": torch.zeros(1, 4, 6, dtype=F64)}
    forces = torch.zeros(1, len(assembly.body_vertices), 3, dtype=F64)
    rows = slice(*assembly.body_vertex_start[[1, 2]].tolist())
    forces[0, rows] = tensor(rng.normal(size=(rows.stop - rows.start, 3)))

    def step(acting, kick):
        p = dynamics.predict(state, control, parameters, acting)
        after = dynamics.advance(p, p.coordinate_targets, 0 * forces, kick)
        return after, dynamics.totals(after, parameters).momentum[0]

    after, momentum = step(*((None, forces) if by == "kick" else (forces, None)))
    pose = (after if by == "kick" else state)["body_poses"][0, 1]
    unit = torch.nn.functional.normalize(pose[3:], dim=0)
    points = pose[:3] + rotate(unit, tensor(assembly.body_vertices[rows]))
    moments = torch.linalg.cross(points, forces[0, rows])
    expected = H * torch.cat([forces[0, rows], moments], dim=-1).sum(0)
    torch.testing.assert_close(momentum - step(None, None)[1], expected, rtol=0, atol=1e-12)


def test_inertias_mean_their_symmetric_part(world):
    assembly, dynamics, parameters, state, control = world
    names = ("body_inertia", "link_inertia")
    skew = tensor([[0, 0.1, -0.2], [-0.1, 0, 0.3], [0.2, -0.3, 0]])
    size = {name: parameters[name].abs().amax((-1, -2), keepdim=True) for name in names}
    other = parameters | {name: parameters[name] + size[name] * skew for name in names}
    forces = torch.zeros(1, len(assembly.body_vertices), 3, dtype=F64)

    def results(given):
        p = dynamics.predict(state, control, given)
        after = dynamics.advance(p, p.coordinate_targets, forces)
        return p.coordinate_metric, *after.values(), *dynamics.totals(after, given)

    for got, expected in zip(results(other), results(parameters), strict=True):
        torch.testing.assert_close(got, expected, rtol=1e-10, atol=1e-12)


def test_a_scene_of_static_and_kinematic_bodies_passes_through():
    bodies = [
        dc.RigidBody.plane(4.0),
        dc.RigidBody.box(0.2, motion="kinematic", pose=[0, 1, 1, 1, 0, 0, 0]),
    ]
    scene = dc.Scene([dc.Cloth.grid(3, 3, 0.2, pose=[0, 0, 3, 1, 0, 0, 0])], bodies)
    assembly = assemble(scene)
    dynamics = Dynamics(assembly, H)
    state, control = fields(assembly, 1)
    p = dynamics.predict(state, control, parameters_of(scene, assembly))
    assert p.coordinates.shape == (1, 0)
    assert torch.equal(p.body_poses, state["body_poses"])
    assert torch.equal(p.body_targets, control["body_poses"])
    after = dynamics.advance(p, p.coordinates, torch.zeros(1, 12, 3, dtype=F64))
    assert torch.equal(after["body_poses"], control["body_poses"])


def test_a_robot_under_position_control_needs_no_masses():
    scene = make_scene(actuation="position", base="fixed")
    assembly = assemble(scene)
    parameters = parameters_of(scene, assembly)
    dynamics = Dynamics(assembly, H)
    state, control = fields(assembly, 2)
    assert not {name for name in parameters if name.startswith(("link_", "joint_"))}
    p = dynamics.predict(state, control, parameters)
    forces = tensor(np.random.default_rng(0).normal(size=(1, len(assembly.body_vertices), 3)))
    ends = torch.where(dynamics.prescribed, p.coordinate_ends, 0.0)
    after, alone = (dynamics.advance(p, ends, f) for f in (forces, 0 * forces))
    assert torch.equal(after["joint_positions"], control["joint_positions"])
    contact = after["joint_efforts"] - alone["joint_efforts"]
    # The constraint resists contact too: fingers slide along y, apart from each other.
    rows = dict(zip(assembly.surface_names[1:], range(99), strict=False))
    for j, finger in enumerate(("left_finger", "right_finger")):
        s = rows[f"grip/{finger}"]
        own = forces[0, slice(*assembly.body_vertex_start[s : s + 2].tolist())].sum(0)
        # The axis in the world: by differences of the link's frame.
        axis = finger_axis(dynamics, state, j)
        torch.testing.assert_close(contact[0, j], -(own @ axis), atol=1e-12, rtol=0)


def finger_axis(dynamics, state, joint):
    chain = dynamics._robots[0]
    quaternion = torch.nn.functional.normalize(state["base_poses"][0, 0, 3:], dim=-1)
    base = quaternion_matrix(quaternion)
    links = np.flatnonzero(chain.mechanism.dof == joint)
    link = int(links[0])
    return base @ tensor(chain.mechanism.offset[link][:3, :3] @ chain.mechanism.axis[link])


# Limits


def test_a_joint_rests_on_its_limit_near_its_beginning():
    """Weight against the slope of the barrier k b(u), b = -(u - w)^2 log(u / w)."""
    scene = make_scene(actuation="torque", base="fixed")
    assembly = assemble(scene)
    k = limit_stiffness(assembly, H, scene.gravity).positions
    assert k.shape == (14,)
    assert not k[:12].any()
    mechanism = assembly.mechanisms[-1]
    for j in range(2):
        width = ZONE * (mechanism.upper[j] - mechanism.lower[j])
        weight = 9.81 * mechanism.mass[mechanism.dof == j].sum()
        u = width * np.linspace(0.5, 1, 1001)[:-1]
        force = k[12 + j] * (2 * (u - width) * np.log(u / width) + (u - width) ** 2 / u)
        share = 1 - u[np.argmin(abs(force - weight))] / width
        assert share < 0.12


@pytest.mark.parametrize("dt", [0.01, 0.002])
def test_a_limit_without_weight_is_as_stiff_as_its_joint_is_heavy(dt):
    """k = M_jj / h^2: the joint's own inertia turns back a joint that meets its limit in a step."""
    assembly = assemble(make_scene(actuation="torque", base="fixed"))
    (hand,) = assembly.mechanisms[-1:]
    heavy = replace(assembly, joint_armature=np.array([0.02, 0.05]))
    k = limit_stiffness(heavy, dt, np.zeros(3)).positions
    fingers = [hand.mass[hand.dof == j].sum() for j in range(2)]  # they slide
    np.testing.assert_allclose(k[12:], (fingers + heavy.joint_armature) / dt**2, rtol=1e-12)


def test_joints_without_a_limit_to_keep_have_no_barrier():
    assembly = assemble(make_scene(actuation="position", base="fixed"))
    assert not np.concatenate(limit_stiffness(assembly, H, np.zeros(3))).any()


# Couplings


def spring_forces(assembly, coordinates):
    """Artificial cloth forces, linear in the coordinates of the bodies."""
    rng = np.random.default_rng(5)
    shape = (coordinates.shape[1], len(assembly.body_vertices) * 3)
    matrix = tensor(rng.normal(size=shape, scale=0.01))
    return (coordinates @ matrix).reshape(len(coordinates), -1, 3)


def solvers(assembly, seen, among=0.0):
    """Solves without contact, but with the forces `among` between bodies and robots."""

    def solve_rigid(prediction):
        seen.append(("rigid", prediction))
        forces = torch.zeros(1, len(assembly.body_vertices), 3, dtype=F64) + among
        ends = prediction.coordinate_targets
        return Solution(ends, forces)

    def solve_cloth(prediction, coordinates, origins=None):
        seen.append(("cloth", coordinates))
        pushed = coordinates if origins is None else coordinates + origins.sin().sum(1)[:, None]
        return Solution(coordinates, spring_forces(assembly, pushed))

    return solve_rigid, solve_cloth


def total_force(assembly, forces, row):
    return forces[0, slice(*assembly.body_vertex_start[row : row + 2].tolist())].sum(0)


def test_rigid_to_cloth_gives_the_impulse_to_velocities(world):
    assembly, dynamics, parameters, state, control = world
    seen = []
    p = dynamics.predict(state, control, parameters)
    result = rigid_to_cloth(dynamics, p, *solvers(assembly, seen))
    assert [name for name, _ in seen] == ["rigid", "cloth"]
    free = dynamics.advance(p, p.coordinate_targets, 0 * result.body_forces)
    for name in ("body_poses", "joint_positions", "base_poses"):
        assert torch.equal(result.fields[name], free[name])
    for k, mass in ((1, 0.5), (3, 2.0)):
        kick = H * total_force(assembly, result.body_forces, k) / mass
        got = (result.fields["body_velocities"] - free["body_velocities"])[0, k, :3]
        torch.testing.assert_close(got, kick, rtol=1e-12, atol=1e-12)


def test_cloth_to_rigid_lets_the_cloth_go_first(world):
    assembly, dynamics, parameters, state, control = world
    seen, checked = [], []

    def predict(contact):
        return dynamics.predict(state, control, parameters, contact)

    last = origins(dynamics, state, parameters)

    def check_path(cloth, prediction, start, end):
        checked.append((start, end))

    result = cloth_to_rigid(dynamics, predict, last, *solvers(assembly, seen), check_path)
    assert [name for name, _ in seen] == ["cloth", "rigid"]
    p = predict(None)
    assert torch.equal(seen[0][1], p.coordinates)  # nothing is prescribed: all is still
    ((start, end),) = checked
    moved = seen[1][1]
    assert torch.equal(start, moved.coordinates)
    assert torch.equal(end, moved.coordinate_targets)
    free = dynamics.advance(p, p.coordinate_targets, 0 * result.body_forces)
    for k, mass in ((1, 0.5), (3, 2.0)):
        push = H * total_force(assembly, result.body_forces, k) / mass
        got = (result.fields["body_velocities"] - free["body_velocities"])[0, k]
        torch.testing.assert_close(got[:3], push, rtol=1e-10, atol=1e-10)
        shift = (result.fields["body_poses"] - free["body_poses"])[0, k, :3]
        assert shift.norm() > 0
    assert (result.fields["joint_velocities"] != free["joint_velocities"]).all()


def test_the_cloth_meets_prescribed_joints_at_their_end_and_others_at_rest():
    """Order `cloth_to_rigid`: other coordinates move after the cloth, from their start values."""
    scene = make_scene(actuation=("position", "pd"), base="fixed")
    assembly = assemble(scene)
    dynamics, parameters = Dynamics(assembly, H), parameters_of(scene, assembly)
    state, control = fields(assembly, 2)
    seen, ways = [], []

    def predict(contact):
        return dynamics.predict(state, control, parameters, contact)

    last = origins(dynamics, state, parameters)
    solve = solvers(assembly, seen)
    cloth_to_rigid(dynamics, predict, last, *solve, lambda *way: ways.append(way[2:]))
    ((_, held), (_, moved)), ((start, end),) = seen, ways
    assert torch.equal(held[:, 12], control["joint_positions"][:, 0])
    others = [i for i in range(14) if i != 12]
    assert torch.equal(held[:, others], predict(None).coordinates[:, others])
    assert torch.equal(start[:, 12], end[:, 12])
    assert torch.equal(start[:, 12], control["joint_positions"][:, 0])
    assert torch.equal(start[:, others], moved.coordinates[:, others])
    assert (end != start)[:, others].all()


@pytest.mark.parametrize("order", ["rigid_to_cloth", "cloth_to_rigid"])
def test_forces_among_bodies_are_in_the_result_and_held(order):
    """A step's forces are the sum of both solves, and prescribed joints' efforts balance both."""
    scene = make_scene(actuation="position", base="fixed")
    assembly = assemble(scene)
    dynamics, parameters = Dynamics(assembly, H), parameters_of(scene, assembly)
    state, control = fields(assembly, 2)
    forces = np.random.default_rng(4).normal(size=(1, len(assembly.body_vertices), 3))

    def solved(among):
        seen = []
        solve_rigid, solve_cloth = solvers(assembly, seen, among)
        predict = partial(dynamics.predict, state, control, parameters)
        if order == "rigid_to_cloth":
            return rigid_to_cloth(dynamics, predict(None), solve_rigid, solve_cloth)
        last = origins(dynamics, state, parameters)
        return cloth_to_rigid(dynamics, predict, last, solve_rigid, solve_cloth, lambda *_: None)

    one, other = solved(tensor(forces)), solved(0.0)
    assert one.cloth.body_forces.any()
    torch.testing.assert_close(
        one.body_forces - other.body_forces, tensor(forces), rtol=0, atol=1e-12
    )
    efforts = (one.fields["joint_efforts"] - other.fields["joint_efforts"])[0]
    rows = assembly.surface_names[1:]
    for j, finger in enumerate(("left_finger", "right_finger")):
        push = total_force(assembly, tensor(forces), rows.index(f"grip/{finger}"))
        axis = finger_axis(dynamics, state, j)
        torch.testing.assert_close(efforts[j], -(push @ axis), rtol=0, atol=1e-12)


@pytest.mark.parametrize("order", ["rigid_to_cloth", "cloth_to_rigid"])
def test_gradients_through_couplings(world, order):
    assembly, dynamics, parameters, state, control = world
    names = ("body_poses", "body_velocities", "joint_velocities", "base_velocities")

    def go(*values):
        now = state | dict(zip(names, values[:4], strict=True))
        physical = parameters | {"body_mass": values[4], "link_mass": values[5]}

        def predict(contact):
            return dynamics.predict(now, control, physical, contact)

        solve = solvers(assembly, [])
        if order == "rigid_to_cloth":
            result = rigid_to_cloth(dynamics, predict(None), *solve)
        else:
            last = origins(dynamics, now, physical)
            result = cloth_to_rigid(dynamics, predict, last, *solve, lambda *_: None)
        return (*result.fields.values(), result.body_forces)

    inputs = [state[name] for name in names] + [parameters["body_mass"], parameters["link_mass"]]
    inputs = [t.clone().requires_grad_() for t in inputs]
    # Forces of order 10 on light bodies: differences of velocities of order 10.
    assert torch.autograd.gradcheck(go, inputs, rtol=1e-5, atol=1e-6, fast_mode=True)


def test_added_mass_numbers(world):
    assembly, _, _, state, _ = world
    frames = torch.eye(4, dtype=F64).repeat(1, 7, 1, 1)
    frames[0, :4, :3, 3] = state["body_poses"][0, :, :3]
    frames[0, 4:, 2, 3] = 50.0
    masses = tensor([[0, 0.5, 0, 2.0, 1, 1, 1]])
    # Three vertices: at body "a" (half a side of 0.1 and the reach of 0.01), just beyond, far away.
    turned = torch.linalg.matrix_exp(tensor([[0, -0.5, 0], [0.5, 0, 0], [0, 0, 0]]))
    frames[0, 1, :3, :3], at = turned, frames[0, 1, :3, 3]
    positions = (at + tensor([[0.109, 0, 0.1], [0.111, 0, 0], [9, 9, 9]]) @ turned.T)[None]
    forces = torch.zeros(1, len(assembly.body_vertices), 3, dtype=F64)
    forces[0, assembly.body_vertex_start[1], 2] = -6.0
    forces[0, assembly.body_vertex_start[0], 2] = 6.0
    numbers = added_mass_numbers(
        assembly, frames, masses, positions, tensor([[0.1, 0.2, 0.4]]), forces, tensor([0.01]), H
    )
    expected = (0.1 + H * H * 3.0 * 6.0 / 0.01) / 0.5
    torch.testing.assert_close(numbers, tensor([[0, expected, 0, 0, 0, 0, 0]]))
