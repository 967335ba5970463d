"""Mechanisms for tests: random trees, a pendulum, and their models in Pinocchio."""

import numpy as np
import torch
from tree_in_torch import DifferentialKinematics, root_frame

from diffcloth_torch.dynamics.inertia import Inertia
from diffcloth_torch.geometry.rotation import quaternion_matrix
from diffcloth_torch.model.mechanism import Mechanism

F64 = torch.float64


def tensor(values):
    return torch.as_tensor(np.asarray(values), dtype=F64)


def random_rotation(rng):
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.linalg.det(q)


def random_inertia(rng, size=0.1):
    """Inertia of a box with random sides, in random axes."""
    sides = rng.uniform(0.3, 1.0, 3) * size
    moments = (sides @ sides - sides**2) / 12
    turn = random_rotation(rng)
    return turn @ np.diag(moments) @ turn.T


def make(kinds, parents, *, base="fixed", rng, mimic=None, actuation="torque", limit=np.inf):
    """A mechanism with random offsets, axes and masses; `mimic`: link -> (its leader, a, b)."""
    count = len(kinds)
    mimic = mimic or {}
    offset = np.tile(np.eye(4), (count, 1, 1))
    axis = np.zeros((count, 3))
    dof = np.full(count, -1, dtype=np.int32)
    multiplier, constant = np.ones(count), np.zeros(count)
    joints = 0
    for l in range(count):
        if parents[l] >= 0:
            offset[l, :3, :3], offset[l, :3, 3] = random_rotation(rng), rng.uniform(-0.4, 0.4, 3)
        if kinds[l] != "fixed":
            axis[l] = rng.normal(size=3)
            axis[l] /= np.linalg.norm(axis[l])
            if l not in mimic:
                dof[l] = joints
                joints += 1
    for l, (leader, a, b) in mimic.items():
        dof[l], multiplier[l], constant[l] = dof[leader], a, b
    mass = rng.uniform(0.2, 2.0, count)
    modes = (actuation,) * joints if isinstance(actuation, str) else tuple(actuation)
    return Mechanism(
        name="tree",
        base=base,
        link_names=tuple(f"link{l}" for l in range(count)),
        parent=np.array(parents, dtype=np.int32),
        kind=tuple(kinds),
        offset=offset,
        axis=axis,
        dof=dof,
        multiplier=multiplier,
        constant=constant,
        joint_names=tuple(f"joint{j}" for j in range(joints)),
        lower=np.full(joints, -limit),
        upper=np.full(joints, limit),
        actuation=modes,
        mass=mass,
        center=rng.uniform(-0.2, 0.2, (count, 3)),
        inertia=np.stack([m * random_inertia(rng, 0.4) for m in mass]),
    )


TREES = {
    "chain": (("fixed", "revolute", "revolute", "revolute"), (-1, 0, 1, 2)),
    "sliding": (("fixed", "prismatic", "revolute", "prismatic"), (-1, 0, 1, 2)),
    # Parents after their children, joints that do not move, branches.
    "branched": (
        ("revolute", "fixed", "fixed", "prismatic", "revolute", "revolute"),
        (1, -1, 0, 2, 1, 4),
    ),
    "body": (("fixed",), (-1,)),
}


def pendulum(lengths=(1.0, 1.0), masses=(1.0, 1.0), base="fixed"):
    """A chain of bobs on massless rods in the x-z plane that hang down at zero angles."""
    count = len(lengths) + 1
    offset = np.tile(np.eye(4), (count, 1, 1))
    center = np.zeros((count, 3))
    for l in range(2, count):
        offset[l, 2, 3] = -lengths[l - 2]
    for l in range(1, count):
        center[l, 2] = -lengths[l - 1]
    axis = np.zeros((count, 3))
    axis[1:, 1] = 1.0
    joints = count - 1
    return Mechanism(
        name="pendulum",
        base=base,
        link_names=tuple(f"link{l}" for l in range(count)),
        parent=np.arange(count, dtype=np.int32) - 1,
        kind=("fixed", *("revolute",) * joints),
        offset=offset,
        axis=axis,
        dof=np.arange(count, dtype=np.int32) - 1,
        multiplier=np.ones(count),
        constant=np.zeros(count),
        joint_names=tuple(f"joint{j}" for j in range(joints)),
        lower=np.full(joints, -np.inf),
        upper=np.full(joints, np.inf),
        actuation=("torque",) * joints,
        mass=np.array([1.0, *masses]),
        center=center,
        inertia=np.tile(1e-4 * np.eye(3), (count, 1, 1)),
    )


def inertia_of(mechanism, armature=None):
    if armature is None:
        armature = np.zeros(mechanism.joint_count)
    arrays = (mechanism.mass, mechanism.center, mechanism.inertia, armature)
    return Inertia(*(tensor(a)[None] for a in arrays))


def random_configuration(mechanism, rng):
    """Root pose [1, 7], joints [1, J] and velocities nu [1, 6 + J]; a fixed root is at rest."""
    quaternion = rng.normal(size=4)
    pose = np.concatenate([rng.uniform(-1, 1, 3), quaternion / np.linalg.norm(quaternion)])
    velocity = rng.uniform(-3, 3, 6 + mechanism.joint_count)
    if mechanism.base == "fixed":
        velocity[:6] = 0
    joints = rng.uniform(-1.5, 1.5, mechanism.joint_count)
    return tensor(pose)[None], tensor(joints)[None], tensor(velocity)[None]


def frame_of(pose):
    """Frame [B, 4, 4] of poses [B, 7]."""
    rotation = quaternion_matrix(pose[..., 3:])
    return root_frame(pose[..., :3], rotation, torch.zeros(1, 3, dtype=F64))


class Judge:
    """A mechanism in Pinocchio, with velocities converted to our convention."""

    def __init__(self, pin, mechanism):
        self.pin, self.mechanism = pin, mechanism
        self.tree = DifferentialKinematics(mechanism)
        self.model = model = pin.Model()
        joint = {}  # link -> its joint in Pinocchio, and its pose in the joint's frame
        self.rows = []  # moving links in the order of their joints
        for l in depth_first(mechanism, mechanism.root):  # as Pinocchio's mass matrix needs
            inertia = pin.Inertia(mechanism.mass[l], mechanism.center[l], mechanism.inertia[l])
            if l == mechanism.root:
                parent, place = 0, pin.SE3.Identity()
                if mechanism.base == "floating":
                    parent = model.addJoint(0, pin.JointModelFreeFlyer(), place, "root")
            else:
                parent, place = joint[int(mechanism.parent[l])]
                place = place * pin.SE3(mechanism.offset[l])
            if mechanism.kind[l] != "fixed":
                kind = mechanism.kind[l]
                made = {
                    "revolute": pin.JointModelRevoluteUnaligned,
                    "prismatic": pin.JointModelPrismaticUnaligned,
                }[kind](mechanism.axis[l])
                parent, place = model.addJoint(parent, made, place, f"j{l}"), pin.SE3.Identity()
                self.rows.append(l)
            model.appendBodyToJoint(parent, inertia, place)
            joint[l] = (parent, place)
        self.place = joint
        self.data = model.createData()
        self.free = 6 if mechanism.base == "floating" else 0

    def configuration(self, pose, joints):
        m = self.mechanism
        own = [m.multiplier[l] * joints[m.dof[l]] + m.constant[l] for l in self.rows]
        if not self.free:
            return np.array(own)
        return np.concatenate([pose[:3], pose[4:], pose[3:4], own])

    def to_ours(self, rotation):
        """Matrix C: our velocities are C times Pinocchio's root velocity and our joint rates."""
        center = self.mechanism.center[self.mechanism.root]
        C = np.eye(self.free + self.mechanism.joint_count)
        if self.free:
            C[:3, :3] = C[3:6, 3:6] = rotation
            C[:3, 3:6] = rotation @ -cross_matrix(center)
        return C

    def from_joints(self):
        """S: Pinocchio's velocities are S times (its root's, our joints')."""
        m = self.mechanism
        S = np.zeros((self.model.nv, self.free + m.joint_count))
        S[: self.free, : self.free] = np.eye(self.free)
        for l in self.rows:
            v = self.model.joints[self.place[l][0]].idx_v
            S[v, self.free + m.dof[l]] = m.multiplier[l]
        return S


def depth_first(mechanism, link):
    children = np.flatnonzero(mechanism.parent == link).tolist()
    return [link, *(l for child in children for l in depth_first(mechanism, child))]


def cross_matrix(a):
    x, y, z = a
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
