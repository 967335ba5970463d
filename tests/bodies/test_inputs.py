"""Controls, states and parameters of bodies and robots: names, defaults, refused values."""

import numpy as np
import pytest
import torch
from body_scenes import F64, make_scene

import diffcloth_torch as dc
from diffcloth_torch.model.assembly import assemble
from diffcloth_torch.model.defaults import scene_parameters
from diffcloth_torch.sim.inputs.control_fields import check_control, control_fields
from diffcloth_torch.sim.inputs.layout import Layout
from diffcloth_torch.sim.inputs.parameter_fields import default_fields, parameter_fields
from diffcloth_torch.sim.inputs.state_fields import state_fields

JOINTS = ("arm/slide", "arm/turn", "arm/spin", "hold/left_finger_joint", "hold/right_finger_joint")
SLIDE, TURN, SPIN, LEFT, RIGHT = range(5)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("robots"))


@pytest.fixture(scope="module")
def layout(scene):
    return Layout(assemble(scene))


def rows(*shape, seed=0):
    return torch.rand(shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def make_state(scene, batch=()):
    """A state in motion, of which nothing is zero."""
    joints = torch.tensor([0.1, 0.2, 0.3, 0.01, 0.02], dtype=F64).expand(*batch, 5)
    bodies = torch.tensor(np.array([body.pose for body in scene.bodies])).expand(*batch, 3, 7)
    bases = torch.tensor(np.array([robot.pose for robot in scene.robots])).expand(*batch, 2, 7)
    cloth = torch.tensor(scene.cloths[0].vertices).expand(*batch, 9, 3)
    return dc.State(
        positions=cloth,
        velocities=rows(*batch, 9, 3),
        body_poses=bodies,
        soft_pin_targets=rows(*batch, 0, 3),
        body_forces=rows(*batch, 4 + 8 + 8 + 8 + 24, 3),
        time=rows(*batch),
        body_velocities=rows(*batch, 3, 6),
        joint_positions=joints,
        joint_velocities=rows(*batch, 5),
        joint_targets=2 * joints,
        joint_efforts=rows(*batch, 5),
        base_poses=bases,
        base_velocities=rows(*batch, 2, 6),
    )


def complete(layout, scene, control=None, batch=()):
    fields, size = state_fields(layout, make_state(scene, batch))
    return fields, control_fields(layout, control, fields, size)


def test_the_joints_are_in_the_order_of_robots_and_files(layout):
    assert layout.joint_names == JOINTS
    assert layout.permissions.actuation == ("position", "pd", "torque", "velocity", "velocity")
    assert layout.is_dynamic


def test_an_unset_control_holds_prescribed_things_and_pd_targets(layout, scene):
    state, control = complete(layout, scene)
    assert torch.equal(control["body_poses"], state["body_poses"])
    assert torch.equal(control["base_poses"], state["base_poses"])
    held = state["joint_positions"].clone()
    held[:, TURN] = state["joint_targets"][:, TURN]
    assert torch.equal(control["joint_positions"], held)
    for name in ("joint_velocities", "joint_efforts", "body_wrenches", "base_wrenches"):
        assert not control[name].any()
    assert control["body_wrenches"].shape == (1, 3, 6)
    assert control["base_wrenches"].shape == (1, 2, 6)


def test_a_tensor_sets_the_joints_whose_actuation_reads_it(layout, scene):
    given = torch.tensor([0.25, 1.5, 99.0, 99.0, 99.0], dtype=F64)
    state, control = complete(
        layout,
        scene,
        dc.Control(joint_positions=given, joint_velocities=given, joint_efforts=given),
    )
    positions = state["joint_positions"][0].clone()
    positions[[SLIDE, TURN]] = given[[SLIDE, TURN]]
    assert torch.equal(control["joint_positions"][0], positions)
    assert control["joint_velocities"][0].tolist() == [0, 1.5, 0, 99, 99]
    assert control["joint_efforts"][0].tolist() == [0, 1.5, 99, 0, 0]


def test_names_set_single_rows_and_hold_the_others(layout, scene):
    pose = torch.tensor([0.0, 1.0, 1.1, 1.0, 0.0, 0.0, 0.0], dtype=F64)
    state, control = complete(
        layout,
        scene,
        dc.Control(
            joint_positions={"slide": 0.25},
            joint_velocities={"hold/left_finger_joint": 0.5, "turn": -1},
            joint_efforts={"arm/spin": np.array(2.0)},
            body_poses={"hand": pose},
            body_wrenches={"brick": [1, 2, 3, 4, 5, 6]},
            base_wrenches={"hold": [1.0] * 6},
        ),
    )
    assert control["joint_positions"][0, SLIDE] == 0.25
    assert control["joint_positions"][0, TURN] == state["joint_targets"][0, TURN]
    assert control["joint_velocities"][0].tolist() == [0, -1, 0, 0.5, 0]
    assert control["joint_efforts"][0].tolist() == [0, 0, 2, 0, 0]
    assert torch.equal(control["body_poses"][0, 1], pose)
    assert torch.equal(control["body_poses"][0, [0, 2]], state["body_poses"][0, [0, 2]])
    assert control["body_wrenches"][0, 2].tolist() == [1, 2, 3, 4, 5, 6]
    assert not control["body_wrenches"][0, :2].any()
    assert control["base_wrenches"][0, 1].tolist() == [1] * 6


def test_a_batch_takes_shared_and_own_values(layout, scene):
    own = rows(3) / 10
    _, control = complete(
        layout,
        scene,
        dc.Control(joint_positions={"slide": own, "turn": 0.5}, joint_efforts=rows(3, 5)),
        batch=(3,),
    )
    assert torch.equal(control["joint_positions"][:, SLIDE], own)
    assert control["joint_positions"][:, TURN].tolist() == [0.5] * 3
    assert torch.equal(control["joint_efforts"][:, SPIN], rows(3, 5)[:, SPIN])
    with pytest.raises(
        dc.InvalidInput, match=r"`control.joint_positions\['arm/slide'\]` has a batch axis"
    ):
        complete(layout, scene, dc.Control(joint_positions={"slide": own}))
    with pytest.raises(dc.InvalidInput, match="must have 3 environments"):
        complete(layout, scene, dc.Control(joint_efforts=rows(2, 5)), batch=(3,))


@pytest.mark.parametrize("actuation", ["position", "velocity", "torque"])
def test_a_gradient_by_values_that_move_no_joint_is_refused(actuation):
    robot = dc.Robot.load(dc.robots.GRIPPER, actuation=actuation)
    cloth = dc.Cloth.grid(2, 2, size=0.1, pose=[1, 0, 0, 1, 0, 0, 0])
    layout = Layout(assemble(dc.Scene([cloth], robots=[robot])))
    own = {"position": "joint_positions", "velocity": "joint_velocities", "torque": "joint_efforts"}
    for field in own.values():
        values = torch.zeros(2, dtype=F64)
        check_control(layout, dc.Control(**{field: values}))
        control = dc.Control(**{field: values.requires_grad_()})
        if field == own[actuation]:
            check_control(layout, control)
        else:
            with pytest.raises(
                dc.InvalidInput, match=f"`control.{field}` must not require a gradient"
            ):
                check_control(layout, control)


@pytest.mark.parametrize("named", [True, False])
def test_gradients_reach_set_and_held_joints(layout, scene, named):
    given = torch.tensor([0.1, 0.4, 0.0, 0.0, 0.0], dtype=torch.float32, requires_grad=True)
    targets = {"slide": given[0], "turn": given[1]} if named else given
    state, size = state_fields(layout, make_state(scene))
    state["joint_positions"] = state["joint_positions"].clone().requires_grad_()
    control = control_fields(layout, dc.Control(joint_positions=targets), state, size)
    control["joint_positions"].sum().backward()
    assert given.grad.tolist() == [1, 1, 0, 0, 0]
    assert given.grad.dtype == torch.float32
    assert state["joint_positions"].grad[0].tolist() == [0, 0, 1, 1, 1]


MOVED = [[0, 0, 0.1, 1, 0, 0, 0], [0, 1, 1, 1, 0, 0, 0], [0, -1, 1, 1, 0, 0, 0]]


@pytest.mark.parametrize(
    ("control", "message"),
    [
        (
            {"joint_positions": [0.0] * 4},
            r"`control.joint_positions` must have shape \[5\] or \[B, 5\]",
        ),
        ({"joint_positions": {"elbow": 0.0}}, r"'arm/slide', .* 'elbow' is none of them"),
        ({"joint_positions": {"slide": [0.0, 0.0, 0.0]}}, None),
        (
            {"joint_positions": {"slide": [[0.0]]}},
            r"`control.joint_positions\['slide'\]` must have shape",
        ),
        ({"joint_positions": {"slide": np.nan}}, r"`control.joint_positions\['slide'\]` .*got nan"),
        ({"joint_positions": {"slide": None}}, "leave the name out"),
        ({"joint_positions": {"slide": 0.0, "arm/slide": 0.0}}, "once, got it twice"),
        ({"joint_positions": {"spin": 0.0}}, "'position' or 'pd'; that of 'arm/spin' is 'torque'"),
        ({"joint_velocities": {"slide": 0.0}}, "'velocity' or 'pd'; .*'arm/slide' is 'position'"),
        ({"joint_efforts": {"slide": 0.0}}, "'torque' or 'pd'; that of 'arm/slide' is 'position'"),
        (
            {"joint_positions": {"slide": 0.31}},
            r"limits -0.2 and 0.3 of 'arm/slide', got 0.31 in the row \[0\]",
        ),
        (
            {"joint_positions": [0.0, -1.1, 0.0, 0.0, 0.0]},
            r"limits -1 and 1.8 of 'arm/turn', got -1.1 in the row \[1\]",
        ),
        ({"body_wrenches": [[0.0] * 6, [0.0] * 6, [1.0]]}, "rectangular"),
        ({"body_wrenches": {"hand": [0, 0, 1, 0, 0, 0]}}, r"zero in the row \[1\]: .*kinematic"),
        ({"body_wrenches": {"floor": [0, 0, 1, 0, 0, 0]}}, r"zero in the row \[0\]: .*static"),
        ({"base_wrenches": [[1.0] * 6, [0.0] * 6]}, r"zero in the row \[0\]: .*'arm' is fixed"),
        ({"body_poses": MOVED}, r"keep the row \[0\] of the state: the body 'floor' is static"),
        (
            {"body_poses": {"brick": [0, -1, 1.1, 1, 0, 0, 0]}},
            r"keep the row \[2\] .*dynamic; make it motion=\"kinematic\"",
        ),
        (
            {"base_poses": {"hold": [0, -1, 1.1, 1, 0, 0, 0]}},
            r"keep the row \[1\] .*floating; make it base=\"kinematic\"",
        ),
        ({"base_poses": {"arm": [0] * 7}}, "quaternion"),
        ({"base_poses": {"leg": [0] * 7}}, "names 'arm', 'hold'; 'leg' is none of them"),
    ],
)
def test_a_bad_control_is_refused(layout, scene, control, message):
    if message is None:
        message = "batch axis"
    with pytest.raises(dc.InvalidInput, match=message):
        complete(layout, scene, dc.Control(**control))


def test_a_name_that_two_robots_have_must_be_written_out(tmp_path, scene):
    grippers = [
        dc.Robot.load(dc.robots.GRIPPER, name=name, pose=[0, 0, z, 1, 0, 0, 0], stiffness=1.0)
        for name, z in (("one", 1.0), ("two", 2.0))
    ]
    layout = Layout(assemble(dc.Scene([], [], grippers)))
    with pytest.raises(dc.InvalidInput, match="'left_finger_joint' is the name of several"):
        check_control(layout, dc.Control(joint_positions={"left_finger_joint": 0.0}))
    full = {"two/left_finger_joint": 0.01}
    assert check_control(layout, dc.Control(joint_positions=full)).joint_positions == full


def test_a_limit_that_was_rounded_to_float32_is_accepted(layout, scene):
    limit = torch.tensor(0.3, dtype=torch.float32)
    assert limit.double() > 0.3
    complete(layout, scene, dc.Control(joint_positions={"slide": limit}))


def test_scenes_without_robots_refuse_their_names():
    layout = Layout(assemble(dc.Scene([dc.Cloth.grid(2, 2)])))
    with pytest.raises(dc.InvalidInput, match="names none, the scene has nothing of the kind"):
        check_control(layout, dc.Control(joint_positions={"slide": 0.0}))
    assert not layout.is_dynamic
    assert not layout.has_coordinates


@pytest.mark.parametrize(
    "field",
    [
        "body_velocities",
        "joint_positions",
        "joint_velocities",
        "joint_targets",
        "base_poses",
        "base_velocities",
    ],
)
def test_state_tensors_are_checked(layout, scene, field):
    state = make_state(scene)
    bad = getattr(state, field).clone()
    bad[-1] = torch.nan
    with pytest.raises(dc.InvalidInput, match=rf"`state.{field}` must be finite"):
        state_fields(layout, state.replace(**{field: bad}))
    with pytest.raises(dc.InvalidInput, match=rf"`state.{field}` must have shape"):
        state_fields(layout, state.replace(**{field: bad[:-1]}))
    with pytest.raises(TypeError, match=rf"`state.{field}` must be a dense float64"):
        state_fields(layout, state.replace(**{field: bad.float()}))


def test_a_joint_beyond_the_zone_of_its_limit_is_refused(layout, scene):
    """Joints that forces move: `turn` has the range -1 .. 1.8, at which its mimic joint ends."""
    state = make_state(scene)

    def at(*positions):
        return state.replace(joint_positions=torch.tensor(positions, dtype=F64))

    state_fields(layout, at(0.1, 1.8 + 0.027, 50.0, 0.01, 0.02))
    state_fields(layout, at(7.0, 0.0, 0.0, -1.0, 1.0))  # prescribed
    with pytest.raises(
        dc.InvalidInput, match=r"-1\.028 and 1\.828 .*'arm/turn', got 1\.829 at \[1\]"
    ):
        state_fields(layout, at(0.1, 1.8 + 0.029, 0.0, 0.01, 0.02))


def test_the_joint_beyond_its_limit_is_named_in_any_environment(layout, scene):
    state = make_state(scene, (4,))
    joints = state.joint_positions.clone()
    joints[3, TURN] = 1.9
    with pytest.raises(dc.InvalidInput, match=r"'arm/turn', got 1\.9 at \[1\]"):
        state_fields(layout, state.replace(joint_positions=joints))
    targets = joints.clone()
    targets[3, TURN] = -1.5
    with pytest.raises(
        dc.InvalidInput, match=r"-1 and 1\.8 of 'arm/turn', got -1\.5 in the row \[1\]"
    ):
        complete(layout, scene, dc.Control(joint_positions=targets), (4,))


def test_a_base_without_orientation_is_refused(layout, scene):
    state = make_state(scene)
    with pytest.raises(dc.InvalidInput, match=r"`state.base_poses` .*quaternion"):
        state_fields(layout, state.replace(base_poses=torch.zeros(2, 7, dtype=F64)))


# --- Parameters ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def defaults(scene):
    return scene_parameters(scene, assemble(scene), True)


def with_row(tensor, row, value):
    changed = tensor.clone()
    changed[row] = value
    return changed


@pytest.mark.parametrize(
    ("name", "row", "value", "message"),
    [
        (
            "body_mass",
            2,
            0.0,
            r"`parameters.body_mass` must be > 0 in the row \[2\], that of 'brick', ",
        ),
        ("body_mass", 0, -1.0, r"`parameters.body_mass` must be finite and >= 0, got -1 at \[0\]"),
        ("link_mass", 1, 0.0, r"`parameters.link_mass` must be > 0 in the row \[1\]"),
        (
            "body_inertia",
            2,
            -1.0,
            r"`parameters.body_inertia` must be positive definite in the row \[2\]",
        ),
        (
            "link_inertia",
            3,
            0.0,
            r"`parameters.link_inertia` must be positive definite in the row \[3\], that of 'arm/",
        ),
        ("link_center", 0, np.inf, r"`parameters.link_center` must be finite, got inf at \[0, 0\]"),
        ("joint_stiffness", 1, -1.0, r"`parameters.joint_stiffness` .*got -1 at \[1\]"),
        ("joint_armature", 4, np.nan, r"`parameters.joint_armature` .*got nan at \[4\]"),
    ],
)
def test_a_bad_parameter_is_refused(layout, defaults, name, row, value, message):
    wrong = dc.Parameters(**{name: with_row(defaults[name], row, value)})
    with pytest.raises(dc.InvalidInput, match=message):
        parameter_fields(layout, wrong, default_fields(defaults), None)


def test_a_link_that_is_given_mass_needs_an_inertia_that_is_not_negative(tmp_path):
    names, mass = ("base", "arm", "tip"), '<inertial><mass value="1"/>{}</inertial>'
    inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    parts = [f'<link name="{n}">{mass.format(inertia) if n != "tip" else ""}</link>' for n in names]
    parts += [
        f'<joint name="{a}{b}" type="{kind}"><parent link="{a}"/><child link="{b}"/></joint>'
        for a, b, kind in (("base", "arm", "continuous"), ("arm", "tip", "fixed"))
    ]
    path = tmp_path / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    robot = dc.Robot.load(path, actuation="torque")
    scene = dc.Scene([], robots=[robot])
    simulator = dc.Simulator(scene, 0.01, contact=dc.ContactOptions(barrier_distance=1e-3))
    given = simulator.default_parameters()
    tip = list(robot.link_names).index("tip")
    mass = with_row(given.link_mass, tip, 0.2)
    for scale, is_accepted in ((0.02, True), (0.0, True), (-0.02, False)):
        inertia = with_row(given.link_inertia, tip, scale * torch.eye(3, dtype=F64))
        changed = given.replace(link_mass=mass, link_inertia=inertia)
        if is_accepted:
            simulator.step(simulator.initial_state(), None, changed)
            continue
        with pytest.raises(dc.InvalidInput, match="must be positive semi-definite in the row"):
            simulator.step(simulator.initial_state(), None, changed)


def test_rows_of_bodies_that_no_force_moves_are_free(layout, defaults):
    given = dc.Parameters(
        body_mass=with_row(defaults["body_mass"], 0, 7.0),
        body_inertia=with_row(defaults["body_inertia"], 1, -1.0),
    )
    fields = parameter_fields(layout, given, default_fields(defaults), None)
    assert fields["body_mass"].tolist() == [[7.0, 0.0, 0.5]]
    assert fields["body_inertia"].shape == (1, 3, 3, 3)


def test_an_inertia_means_its_symmetric_part(layout, defaults):
    skew = torch.tensor([[0, 1.0, 2], [-1, 0, 3], [-2, -3, 0]], dtype=F64)
    given = dc.Parameters(body_inertia=defaults["body_inertia"] + skew)
    parameter_fields(layout, given, default_fields(defaults), None)


def test_batched_parameters_have_one_axis_more(layout, defaults):
    given = dc.Parameters(
        body_mass=1.0 + rows(2, 3), link_inertia=defaults["link_inertia"].expand(2, -1, -1, -1)
    )
    fields = parameter_fields(layout, given, default_fields(defaults), 2)
    assert fields["body_mass"].shape == (2, 3)
    assert fields["link_inertia"].shape[:2] == (2, 8)
    assert fields["gravity"].shape == (1, 3)


def test_a_link_that_is_a_point_keeps_its_parameters(tmp_path):
    """The point has no inertia of its own; the link attached by a fixed joint has one."""
    point = '<inertial><mass value="1"/></inertial>'
    arm = point.replace("/></", '/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></')
    parts = [f'<link name="{n}">{own}</link>' for n, own in (("base", ""), ("arm", arm))]
    parts.append(f'<link name="tip">{point}</link>')
    parts += [
        f'<joint name="{a}{b}" type="{kind}"><parent link="{a}"/><child link="{b}"/></joint>'
        for a, b, kind in (("base", "arm", "continuous"), ("arm", "tip", "fixed"))
    ]
    path = tmp_path / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    scene = dc.Scene([], robots=[dc.Robot.load(path, actuation="torque")])
    simulator = dc.Simulator(scene, 0.01, contact=dc.ContactOptions(barrier_distance=1e-3))
    given = simulator.default_parameters()
    simulator.step(simulator.initial_state(), parameters=given)
    # The base is fixed to the world: its inertia moves nothing.
    odd = given.replace(link_inertia=with_row(given.link_inertia, 0, -torch.eye(3)))
    simulator.step(simulator.initial_state(), parameters=odd)
    for row, message in ((1, "positive definite"), (2, "positive semi-definite")):
        wrong = given.replace(link_inertia=with_row(given.link_inertia, row, -torch.eye(3)))
        with pytest.raises(dc.InvalidInput, match=message):
            simulator.step(simulator.initial_state(), parameters=wrong)
