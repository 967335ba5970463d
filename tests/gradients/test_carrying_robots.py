"""Gradients through public robots that carry a sheet, by differences."""

import pytest
import torch
from differences import mismatch
from robot_packages import carrying, inside_its_limits, robot_file

import diffcloth_torch as dc

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings(
        "ignore:.*dropped .* faces", "ignore::diffcloth_torch.BarrierStartWarning"
    ),
]

F64 = torch.float64
EXAMPLES = "example-robot-data"
ROBOTS = [
    pytest.param(EXAMPLES, "ur5_robot.urdf", id="arm UR5"),
    pytest.param(EXAMPLES, "so100.urdf", id="arm SO-100"),
    pytest.param(EXAMPLES, "panda_collision.urdf", id="arm Panda"),
    pytest.param(EXAMPLES, "allegro_left_hand.urdf", id="hand Allegro"),
    pytest.param("dexmate-urdf", "dexd_gripper.urdf", id="hand Dexmate"),
    pytest.param("airo-models", "robotiq_2f_85.urdf", id="hand Robotiq"),
    pytest.param("differentiable-robot-model", "fetch.urdf", id="mobile Fetch"),
    pytest.param(
        "hello-robot-stretch-urdf",
        "stretch_description_RE2V0_tool_none.urdf",
        id="mobile Stretch",
    ),
    pytest.param(EXAMPLES, "pr2.urdf", id="mobile PR2"),
    pytest.param(EXAMPLES, "talos_reduced.urdf", id="humanoid Talos"),
    pytest.param("jvrc-description", "jvrc1.urdf", id="humanoid JVRC-1"),
    pytest.param(EXAMPLES, "icub_reduced.urdf", id="humanoid iCub"),
]
DRIVEN = [
    pytest.param(EXAMPLES, "ur5_robot.urdf", id="arm UR5"),
    pytest.param(EXAMPLES, "allegro_left_hand.urdf", id="hand Allegro"),
    pytest.param(EXAMPLES, "talos_left_arm.urdf", id="humanoid Talos"),
]

# Four steps, each solved to 1e-9 m/s: differences resolve derivatives to this share.
TOLERANCE = 1e-4


def check_gradients(run, inputs, directions, state):
    """Compare the gradient of a loss over all outputs with differences, input by input."""
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(state.positions.shape, dtype=F64, generator=generator)

    def loss(*given):
        end = run(*given)
        rows = torch.linspace(1, 2, end.joint_positions.shape[-1], dtype=F64)
        joints = 1e-2 * end.joint_efforts + 1e-2 * end.joint_velocities + end.joint_positions
        motion = end.positions + 1e-2 * end.velocities
        return (weights * motion).sum() + (rows * joints).sum()

    given = [value.clone().requires_grad_() for value in inputs]
    gradients = torch.autograd.grad(loss(*given), given)
    for i, (value, gradient, direction) in enumerate(
        zip(inputs, gradients, directions, strict=True)
    ):
        assert gradient.norm() > 0

        def along(moved, i=i):
            with torch.no_grad():
                return float(loss(*inputs[:i], moved, *inputs[i + 1 :]))

        error = mismatch(along, value, gradient, direction, 1e-5, TOLERANCE)
        assert error < TOLERANCE, (i, error)


@pytest.mark.parametrize(("package", "name"), ROBOTS)
def test_gradients_through_the_load_of_a_robot_agree_with_differences(package, name):
    """Gradients by joint targets, base pose and friction, over four steps in contact."""
    path = robot_file(package, name)
    robot, span = inside_its_limits(path, base="kinematic", actuation="position")
    simulator = carrying(robot)
    start, given = simulator.initial_state(), simulator.default_parameters()
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(2, len(span), dtype=F64, generator=generator)
    contacts = []

    def run(targets, pose, friction):
        state = start
        for k in range(1, 5):
            control = dc.Control(
                joint_positions=torch.lerp(start.joint_positions, targets, k / 4),
                base_poses=torch.lerp(start.base_poses, pose, k / 4),
            )
            state = simulator.step(state, control, given.replace(friction=friction))
            contacts.append(state.report.contact_count)
        return state

    lift = torch.tensor([[0.001, 0.0, 0.002, 0.0, 0.0, 0.0, 0.0]], dtype=F64)
    turn = torch.randn(1, 7, dtype=F64, generator=generator)
    targets = start.joint_positions + 0.002 * span * noise[0]
    inputs = [targets, start.base_poses + lift, given.friction]
    directions = [span.sign() * noise[1], turn, torch.ones_like(given.friction)]
    check_gradients(run, inputs, directions, start)
    assert min(contacts) > 0


@pytest.mark.parametrize(("package", "name"), DRIVEN)
def test_gradients_through_drives_that_carry(package, name):
    """Gradients by targets, gains and feed-forward efforts of drives; forces move all joints."""
    robot, span = inside_its_limits(robot_file(package, name), stiffness=50.0, damping=5.0)
    simulator = carrying(robot)
    start, given = simulator.initial_state(), simulator.default_parameters()
    generator = torch.Generator().manual_seed(2)
    noise = torch.randn(5, len(span), dtype=F64, generator=generator)
    contacts = []

    def run(targets, efforts, stiffness):
        state = start
        for _ in range(4):
            control = dc.Control(joint_positions=targets, joint_efforts=efforts)
            state = simulator.step(state, control, given.replace(joint_stiffness=stiffness))
            contacts.append(state.report.contact_count)
        return state

    inputs = [start.joint_positions + 0.01 * noise[0], 0.1 * noise[1], given.joint_stiffness]
    check_gradients(run, inputs, list(noise[2:]), start)
    assert max(contacts) > 0
