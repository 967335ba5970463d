"""Scenes with bodies and robots of every kind, small and far enough apart not to touch."""

import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.model.assembly import assemble
from diffcloth_torch.robots import GRIPPER
from diffcloth_torch.sim.inputs.layout import Layout

F64 = torch.float64

# Three joints in a row, each of another type, and a fourth that follows the first.
ARM = """<robot name="arm">
  <link name="base"><inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01"
    ixy="0" ixz="0" iyz="0"/></inertial></link>
  {links}
  <joint name="slide" type="prismatic"><parent link="base"/><child link="a"/>
    <origin xyz="0 0 0.1"/><axis xyz="1 0 0"/><limit lower="-0.2" upper="0.3" effort="0"
    velocity="0"/></joint>
  <joint name="turn" type="revolute"><parent link="a"/><child link="b"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 1 0"/><limit lower="-1" upper="2" effort="0"
    velocity="0"/></joint>
  <joint name="spin" type="continuous"><parent link="b"/><child link="c"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 0 1"/></joint>
  <joint name="follow" type="revolute"><parent link="c"/><child link="d"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="0"
    velocity="0"/><mimic joint="turn" multiplier="0.5" offset="0.1"/></joint>
</robot>"""
_LINK = """<link name="{name}"><inertial><origin xyz="0.01 0 0.05"/><mass value="0.2"/>
  <inertia ixx="0.002" iyy="0.003" izz="0.002" ixy="0.0001" ixz="0" iyz="0"/></inertial>
  {collision}</link>"""
_BOX = """<collision><origin xyz="0 0 0.05"/><geometry><box size="0.02 0.02 0.04"/></geometry>
  </collision>"""


def load_arm(folder, **options):
    """An arm of four links, of which the last has a box; slide, turn and spin are its joints."""
    links = [_LINK.format(name=name, collision=_BOX if name == "d" else "") for name in "abcd"]
    path = folder / "arm.urdf"
    path.write_text(ARM.format(links="\n".join(links)))
    return dc.Robot.load(path, **options)


def make_scene(folder, **arm):
    """A static, a kinematic and a dynamic body; an arm and a gripper on a floating base."""
    cloth = dc.Cloth.grid(3, 3, 0.2, pins={"edge": [0, 1]}, pose=[0, 0, 3, 1, 0, 0.1, 0.2])
    bodies = [
        dc.RigidBody.plane(4.0, name="floor"),
        dc.RigidBody.box(0.2, motion="kinematic", pose=[0, 1, 1, 1, 0, 0, 0], name="hand"),
        dc.RigidBody.box(
            [0.1, 0.2, 0.3], motion="dynamic", mass=0.5, pose=[0, -1, 1, 1, 0, 0, 0], name="brick"
        ),
    ]
    arm = {
        "actuation": {"slide": "position", "turn": "pd", "spin": "torque"},
        "stiffness": 5.0,
    } | arm
    robots = [
        load_arm(folder, pose=[1, 0, 0.5, 1, 0, 0, 0], name="arm", **arm),
        dc.Robot.load(
            GRIPPER, base="floating", pose=[-1, 0, 1, 1, 0, 0, 0], actuation="velocity", name="hold"
        ),
    ]
    return dc.Scene([cloth], bodies, robots)


@pytest.fixture(scope="module")
def layout(tmp_path_factory):
    return Layout(assemble(make_scene(tmp_path_factory.mktemp("robots"))))
