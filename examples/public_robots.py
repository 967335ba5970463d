"""A cloth falls on public robots, which then move under it.

    python examples/public_robots.py panda tiago     (needs the extras `robots` and `viewer`)

The robots' files come from example-robot-data, unchanged. The picture of a robot is robot_NAME.png;
without names, all robots are drawn.
"""

from __future__ import annotations

import sys
from importlib.metadata import files
from pathlib import Path
from typing import NamedTuple

import torch

import diffcloth_torch as dc

DT, FALLING, MOVING = 0.02, 30, 30  # [s], and steps


class Pose(NamedTuple):
    """A robot of example-robot-data, and its motion.

    Attributes:
        file: End of the path of the robot's file.
        size: Side of the sheet [m].
        start: Joint -> start position [rad or m]; other joints are as near to zero as possible.
        move: Joint -> distance of the motion under the sheet [rad or m].
        azimuth: Viewing direction [degrees].
    """

    file: str
    size: float
    start: dict[str, float]
    move: dict[str, float]
    azimuth: float = -60.0


ROBOTS = {
    "panda": Pose(
        "panda_description/urdf/panda.urdf",
        0.4,
        {"panda_joint4": -1.5, "panda_joint6": 1.5, "panda_finger_joint1": 0.02},
        {"panda_joint1": 0.6},
    ),
    "allegro": Pose(
        "allegro_left_hand.urdf", 0.16, {}, {f"joint_{k}.0": 0.7 for k in (1, 5, 9)}, 30.0
    ),
    "ur5": Pose("ur5_robot.urdf", 0.4, {"shoulder_lift_joint": -0.6}, {"shoulder_pan_joint": 0.6}),
    "tiago": Pose("tiago_no_hand.urdf", 0.5, {}, {"torso_lift_joint": 0.2, "head_1_joint": 0.7}),
    "talos": Pose("talos_reduced.urdf", 0.7, {}, {"arm_left_2_joint": 0.6, "torso_1_joint": 0.4}),
}


def find(end: str) -> Path:
    """Path of a URDF file of the package."""
    (found,) = [file for file in files("example-robot-data") or [] if f"{file}".endswith(f"/{end}")]
    return Path(str(found.locate()))


def top_of(robot: dc.Robot) -> list[float]:
    """Highest point of a robot's links [m]."""
    frames = robot.forward_kinematics(torch.tensor(robot.joint_positions))
    points = [
        torch.tensor(surface.vertices) @ frames[name][:3, :3].T + frames[name][:3, 3]
        for name, surface in zip(robot.link_names, robot.surfaces, strict=True)
        if surface is not None
    ]
    return max(torch.cat(points).tolist(), key=lambda point: point[2])


def simulate(pose: Pose, cells: int = 24) -> tuple[dc.Scene, list[dc.State]]:
    """Drop a sheet of `cells` rows onto a robot, which then moves."""
    robot = dc.Robot.load(
        find(pose.file), joint_positions=pose.start, actuation="position", name="robot"
    )
    x, y, z = top_of(robot)
    cloth = dc.Cloth.grid(
        cells,
        cells,
        pose.size,
        pose=[x, y, z + 0.02, 1, 0, 0, 0],
        material=dc.Material(stretch=200, bending=2e-5, density=0.15, friction=0.6, damping=0.01),
    )
    scene = dc.Scene([cloth], robots=[robot])
    simulator = dc.Simulator(scene, DT)
    start = simulator.initial_state()
    way = torch.tensor([pose.move.get(name, 0.0) for name in robot.joint_names])
    shares = [0.0] * FALLING + [k / MOVING for k in range(1, MOVING + 1)]
    controls = [dc.Control(joint_positions=start.joint_positions + s * way) for s in shares]
    return scene, [start, *simulator.rollout(start, controls)]


if __name__ == "__main__":
    for name in sys.argv[1:] or ROBOTS:
        scene, states = simulate(ROBOTS[name])
        path, camera = f"robot_{name}.png", dc.Camera(azimuth=ROBOTS[name].azimuth)
        dc.render(scene, states, path, moments=4, camera=camera)
        print(f"{path}: {states[-1].report.contact_count} contacts at the end")
