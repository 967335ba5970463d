"""Robots with lead screws, the example of docs/extending.md; runs in the extended copy."""

import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scenes
import torch
from differences import difference

import diffcloth_torch as dc

F64 = torch.float64
PITCH = 0.1 / (2 * math.pi)  # [m/rad]
LINK = """<link name="{name}"><inertial><origin xyz="{center}"/><mass value="{mass}"/>
  <inertia ixx="0.002" iyy="0.003" izz="0.002" ixy="0.0001" ixz="0" iyz="0"/></inertial>
  {collision}</link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
  <origin {place}/><axis xyz="{axis}"/>
  <limit lower="-3" upper="3" effort="0" velocity="0"/></joint>"""
BOX = '<collision><geometry><box size="0.06 0.06 0.06"/></geometry></collision>'


def link(name, center, mass, collision=""):
    return LINK.format(name=name, center=center, mass=mass, collision=collision)


def joint(name, kind, parent, child, place, axis):
    return JOINT.format(name=name, kind=kind, parent=parent, child=child, place=place, axis=axis)


ARM = "\n".join(
    [
        '<robot name="arm">',
        link("base", "0 0 0", 1),
        link("post", "0.01 0.02 0", 0.1),
        link("head", "0 0.01 0.02", 0.1),
        link("tip", "0 0 0", 0.5, BOX),
        joint("lift", "screw", "base", "post", 'xyz="0.02 0 0"', "0 0 1"),
        joint("tilt", "revolute", "post", "head", 'xyz="0 0.01 0.02" rpy="0.2 0 0.1"', "0 1 0"),
        joint("drive", "screw", "head", "tip", 'xyz="-0.02 -0.01 -0.02"', "0.6 0 0.8"),
        "</robot>",
    ]
)


def load(folder, **options):
    path = folder / "arm.urdf"
    path.write_text(ARM)
    return dc.Robot.load(path, name="arm", **{"actuation": "torque", **options})


def judge(pin, mechanism):
    """The same robot in Pinocchio."""
    model, joint = pin.Model(), {}
    for link in mechanism.order:
        parent, place = 0, pin.SE3(mechanism.offset[link])
        if mechanism.parent[link] >= 0:
            parent = joint[int(mechanism.parent[link])]
        joint[link] = parent
        if mechanism.kind[link] != "fixed":
            axis = mechanism.axis[link]
            made = (
                pin.JointModelHelicalUnaligned(axis, PITCH)
                if mechanism.kind[link] == "screw"
                else pin.JointModelRevoluteUnaligned(axis)
            )
            joint[link] = model.addJoint(parent, made, place, mechanism.link_names[link])
            place = pin.SE3.Identity()
        inertia = (mechanism.mass[link], mechanism.center[link], mechanism.inertia[link])
        model.appendBodyToJoint(joint[link], pin.Inertia(*inertia), place)
    return model, joint


def test_the_tested_package_is_the_copy(tmp_path):
    assert Path(dc.__file__).is_relative_to(Path(__file__).parents[2])
    assert load(tmp_path).mechanism.kind == ("fixed", "screw", "revolute", "screw")


def test_frames_energies_and_accelerations_are_those_of_pinocchio(tmp_path):
    pin = pytest.importorskip("pinocchio", reason="Pinocchio is in the extra `test`")
    robot = load(tmp_path)
    model, joint = judge(pin, robot.mechanism)
    data = model.createData()
    q, v = np.array([0.7, -0.4, 1.1]), np.array([1.0, -2.0, 3.0])

    frames = robot.forward_kinematics(torch.tensor(q))
    pin.forwardKinematics(model, data, q)
    for link, name in enumerate(robot.link_names):
        expected = data.oMi[joint[link]].homogeneous
        np.testing.assert_allclose(frames[name].numpy(), expected, rtol=0, atol=1e-14)

    h = 1e-6
    sim = dc.Simulator(dc.Scene([], robots=[robot]), h)
    state = sim.initial_state().replace(
        joint_positions=torch.tensor(q), joint_velocities=torch.tensor(v)
    )
    kinetic = pin.computeKineticEnergy(model, data, q, v)
    assert float(sim.kinetic_energy(state)) == pytest.approx(kinetic, rel=1e-12)
    # The weight of the base, at the origin, has no energy.
    potential = pin.computePotentialEnergy(model, data, q)
    assert float(sim.energy(state, parts=True)["gravity"]) == pytest.approx(potential, rel=1e-12)
    velocities = sim.link_velocities(state)["arm/tip"].numpy()
    pin.forwardKinematics(model, data, q, v)
    tip = joint[robot.link_names.index("tip")]
    found = pin.getVelocity(model, data, tip, pin.LOCAL_WORLD_ALIGNED).vector
    np.testing.assert_allclose(velocities, found, rtol=0, atol=1e-13)
    rates = sim.step(state).joint_velocities.numpy()
    expected = pin.aba(model, data, q, v, np.zeros(3))
    # A step of 1e-6 s changes the acceleration by that share, and the difference of rates rounds.
    np.testing.assert_allclose((rates - v) / h, expected, rtol=1e-4)


@cache
def scene(folder, actuation):
    """A sheet on which the arm presses a box."""
    vertices, faces = scenes.grid(5, 5, edge=0.06, seed=3)
    cloth = dc.Cloth(
        vertices - vertices.mean(axis=0),
        faces,
        material=scenes.material(faces, stretch=200.0),
        pins={"corners": [0, 4, 20, 24]},
    )
    robot = load(folder, actuation=actuation, stiffness=0.05, damping=0.01, pose=AT)
    sim = dc.Simulator(
        dc.Scene([cloth], robots=[robot], gravity=(0.04, -0.03, -0.98)),
        0.01,
        contact=dc.ContactOptions(
            barrier_distance=0.01, barrier_stiffness=60.0, slip_velocity=0.02
        ),
        solver=dc.SolverOptions(tolerance=1e-11),
    )
    start = sim.initial_state()
    start = start.replace(joint_velocities=torch.tensor([-2.0, 0.3, 0.5], dtype=F64))
    with torch.no_grad():
        for _ in range(2):
            start = sim.step(start)
    assert start.body_forces.abs().max() > 0  # they touch
    return sim, start


AT = [0.01, 0.0, 0.047, 1.0, 0.02, 0.02, 0.2]
SIZES = {
    "joint_positions": 1e-5,
    "joint_velocities": 1e-3,
    "positions": 1e-6,
    "base_poses": 1e-6,
    "link_mass": 1e-3,
    "link_center": 1e-5,
    "link_inertia": 1e-5,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("screws")


@pytest.mark.parametrize("actuation", ["torque", "pd"])
@pytest.mark.parametrize("name", SIZES)
def test_gradients_of_steps_in_contact(folder, actuation, name):
    sim, start = scene(folder, actuation)
    of_state = name not in ("link_mass", "link_center", "link_inertia")
    given = getattr(start if of_state else sim.default_parameters(), name).detach()
    weights = torch.Generator().manual_seed(1)
    weights = [
        torch.randn(getattr(start, field).shape, dtype=F64, generator=weights)
        for field in ("positions", "joint_positions", "joint_velocities")
    ]

    def loss(value):
        state, parameters = start, sim.default_parameters()
        if of_state:
            state = state.replace(**{name: value})
        else:
            parameters = parameters.replace(**{name: value})
        for _ in range(2):
            state = sim.step(state, None, parameters)
        ends = (state.positions, state.joint_positions, state.joint_velocities)
        return sum((w * end).sum() for w, end in zip(weights, ends, strict=True))

    leaf = given.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(leaf), leaf)
    direction = torch.as_tensor(scenes.noise(tuple(given.shape), 1.0, 4))
    if name == "link_inertia":
        direction = direction + direction.mT
    with torch.no_grad():
        expected = difference(lambda x: float(loss(x)), given, direction, SIZES[name])
    assert abs(expected) > 1e-6
    # Solves end at 1e-11, and differences divide that by their steps.
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-6)


def test_an_equilibrium_carries_the_weight(folder):
    """The drives of an arm at rest have the efforts that Pinocchio computes."""
    pin = pytest.importorskip("pinocchio", reason="Pinocchio is in the extra `test`")
    robot = load(folder, actuation="pd", stiffness=2.0)
    sim = dc.Simulator(dc.Scene([], robots=[robot]), 0.01)
    found = sim.equilibrium(sim.initial_state())
    q = found.joint_positions.numpy()
    model, _ = judge(pin, robot.mechanism)
    weight = pin.computeGeneralizedGravity(model, model.createData(), q)
    np.testing.assert_allclose(-2.0 * q, weight, rtol=0, atol=1e-7)
