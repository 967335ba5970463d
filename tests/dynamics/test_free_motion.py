"""Velocities that the core finds, put into the equation as torch states it."""

import re

import numpy as np
import pytest
import torch
from mechanisms import TREES, frame_of, inertia_of, make, random_configuration

from diffcloth_torch import _core
from diffcloth_torch.dynamics.free_motion import robot_motion, solve_motion
from diffcloth_torch.dynamics.inertia import Motion, momentum, slope
from diffcloth_torch.dynamics.jacobians import DifferentialKinematics, root_frame
from diffcloth_torch.geometry.rotation import quaternion_matrix, rotation_exp

H = 0.01


CASES = [
    (name, base)
    for name in TREES
    for base in ("fixed", "kinematic", "floating")
    if name != "body" or base == "floating"
]


@pytest.mark.parametrize("speed", [1.0, 20.0])  # [rad/s], of each joint
@pytest.mark.parametrize(("name", "base"), CASES)
def test_the_velocities_solve_the_equation(name, base, speed):
    kinds, parents = TREES[name]
    mimic = {5: (4, -0.7, 0.3)} if name == "branched" else None
    rng = np.random.default_rng(list(TREES).index(name))
    mechanism = make(kinds, parents, base=base, rng=rng, mimic=mimic)
    pose, joints, nu = (
        torch.cat(parts)
        for parts in zip(
            *(random_configuration(mechanism, np.random.default_rng(s)) for s in range(3)),
            strict=True,
        )
    )
    tree, inertia = DifferentialKinematics(mechanism), inertia_of(mechanism)
    inertia = inertia._replace(armature=inertia.armature + 0.1)
    local = inertia.center[..., tree.root, :]
    rotation = quaternion_matrix(pose[:, 3:])
    center = pose[:, :3] + (rotation @ local[..., None])[..., 0]
    first = 6 if base != "floating" else 0
    # Every other joint is prescribed, where there are enough.
    prescribed = [6 + j for j in range(1, mechanism.joint_count, 2)]
    solved = torch.tensor([i for i in range(first, nu.shape[-1]) if i not in prescribed])
    nu = speed * nu
    known = nu.clone()
    known[:, solved] = 0.0
    if base == "fixed":
        known[:, :6] = 0.0
    given = momentum(Motion.at(tree, inertia, frame_of(pose), joints), inertia, nu)

    found, good = solve_motion(
        robot_motion(mechanism, solved, H), inertia, (center, rotation, joints), known, given
    )

    assert good.all()
    velocity = known.index_copy(-1, solved, found)
    middle_rotation, middle = rotation, center
    if base != "fixed":
        middle_rotation = rotation_exp(H / 2 * velocity[:, 3:6]) @ rotation
        middle = center + H / 2 * velocity[:, :3]
    motion = Motion.at(
        tree,
        inertia,
        root_frame(middle, middle_rotation, local),
        joints + H / 2 * velocity[:, 6:],
    )
    left = momentum(motion, inertia, velocity) - H / 2 * slope(tree, motion, velocity)
    assert found.abs().min() > 1e-3  # all of them are asked for something
    torch.testing.assert_close(
        left[:, solved], given[:, solved], rtol=0, atol=1e-11 * float(given.abs().max())
    )


def free_motion(**changes):
    options = {
        "parent": [-1, 0],
        "order": [0, 1],
        "kind": [0, 1],
        "offset": np.stack([np.eye(4)] * 2),
        "axis": np.array([[0.0, 0, 0], [0, 0, 1]]),
        "dof": [-1, 0],
        "multiplier": np.ones(2),
        "constant": np.zeros(2),
        "joint_count": 1,
        "solved": [6],
        "root_moves": False,
        "dt": H,
    }
    return _core.FreeMotion(**{**options, **changes})


@pytest.mark.boundary
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"axis": np.zeros(3)}, "one entry a link"),
        ({"order": [1, 0]}, "parents before their children"),
        ({"order": [0, 0]}, "every link once"),
        ({"parent": [-1, 7]}, "parents before their children"),
        ({"kind": [0, 3]}, "in range"),
        ({"dof": [-1, 1]}, "in range"),
        ({"dof": [-1, -1]}, "in range"),
        ({"solved": [7]}, "rows of the velocities"),
    ],
)
def test_the_core_refuses_trees_that_it_would_read_beyond(changes, message):
    free_motion()
    with pytest.raises(ValueError, match=re.escape(message)):
        free_motion(**changes)


@pytest.mark.boundary
def test_the_core_refuses_arrays_of_other_sizes():
    sizes = {
        "mass": 2, "center": 6, "inertia": 18, "armature": 1, "root_center": 3,
        "root_rotation": 9, "joints": 1, "known": 7, "momentum": 7,
    }  # fmt: skip
    arrays = {name: np.ones((1, size)) for name, size in sizes.items()}
    free_motion().solve(**arrays)
    for name, size in sizes.items():
        with pytest.raises(ValueError, match=f"`{name}` must have {size} numbers"):
            free_motion().solve(**{**arrays, name: np.ones((1, size + 1))})


@pytest.mark.boundary
def test_the_core_refuses_bodies_without_an_inertia():
    with pytest.raises(ValueError, match="`inertia` must have 9 numbers a body"):
        _core.free_turns(np.ones((1, 3, 3)), np.ones((2, 3)), H, False)
    with pytest.raises(ValueError, match="`momentum` must have 3 numbers a body"):
        _core.free_turns(np.ones((1, 3, 3)), np.ones(4), H, False)
