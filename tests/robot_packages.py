"""Robot files of public packages, for tests of installed packages.

Only example-robot-data is in the extra `robots`. The other packages have requirements that are not
needed to read their files; to install them without requirements into a separate folder, run

    pip install --no-deps --target build/robots airo-models dexmate-urdf \\
        differentiable-robot-model example-robot-data hello-robot-stretch-urdf jvrc-description
    PYTHONPATH=build/robots pytest -m "" tests/model/test_public_robots.py
"""

from functools import cache
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

PACKAGES = (
    "airo-models",
    "dexmate-urdf",
    "differentiable-robot-model",
    "example-robot-data",
    "hello-robot-stretch-urdf",
    "jvrc-description",
)


@cache
def robot_files(package):
    """Paths of the URDF files of a package; empty if the package is not installed."""
    try:
        found = files(package) or []
    except PackageNotFoundError:
        found = []
    return sorted(Path(str(file.locate())).resolve() for file in found if file.suffix == ".urdf")


def robot_file(package, name):
    """The file of a package whose path ends in `name`; skips the test without the package."""
    found = robot_files(package)
    if not found:
        pytest.skip(f"needs the package {package}")
    (path,) = [path for path in found if path.as_posix().endswith(f"/{name}")]
    return path


def under_a_cloth(robot, cells=8, size=0.1, gap=0.002, **keywords):
    """A simulator of a sheet that falls on the highest point of a robot."""
    frames = robot.forward_kinematics(torch.from_numpy(robot.joint_positions.copy()))
    points = [torch.zeros(1, 3, dtype=torch.float64)]
    for name, surface in zip(robot.link_names, robot.surfaces, strict=True):
        if surface is not None:
            frame = frames[name]
            vertices = torch.from_numpy(surface.vertices.copy())
            points.append(vertices @ frame[:3, :3].T + frame[:3, 3])
    placed = torch.cat(points[1:] or points)
    x, y, z = placed[placed[:, 2].argmax()].tolist()
    cloth = dc.Cloth.grid(cells, cells, size, pose=[x, y, z + gap, 1, 0, 0, 0], name="cloth")
    return dc.Simulator(dc.Scene([cloth], robots=[robot]), 0.01, **keywords)


def inside_its_limits(path, **keywords):
    """A robot with joints at least a tenth of their range from limits, and the ranges [J]."""
    options = {"ignore_contact": "overlapping", "name": "robot"} | keywords
    mechanism = dc.Robot.load(path, **options).mechanism
    span = mechanism.upper - mechanism.lower
    span = np.where(np.isfinite(span), span, 2.0)
    start = np.clip(0.0, mechanism.lower + 0.1 * span, mechanism.upper - 0.1 * span)
    return dc.Robot.load(path, joint_positions=start, **options), torch.from_numpy(span)


def carrying(robot):
    """A simulator in which a robot catches a sheet in the first step."""
    solver = dc.SolverOptions(tolerance=1e-9)
    return under_a_cloth(robot, cells=6, size=0.08, gap=0.0006, solver=solver)
