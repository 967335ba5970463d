"""URDF files for tests, written from a few words or random; and their frames by Pinocchio."""

import math

import numpy as np
import pytest
from public_data import public

import diffcloth_torch as dc

INERTIAL = (
    '<inertial><origin xyz="0.01 0.02 0.03" rpy="0.4 0.5 0.6"/><mass value="2"/>'
    '<inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.03" iyz="0.002" izz="0.04"/></inertial>'
)


def data(name):
    return public(f"robots/{name}")


def panda():
    try:
        return dc.robots.panda()
    except ImportError:
        pytest.skip("the Panda is in the extra `robots`")


def link(name, content=INERTIAL):
    return f'<link name="{name}">{content}</link>'


def joint(name, parent, child, kind="revolute", content="", limit='lower="-2" upper="2"'):
    limits = f"<limit {limit} effort='0' velocity='0'/>" if limit and kind != "fixed" else ""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f"{content}{limits}</joint>"
    )


def robot(*parts):
    return f'<robot name="test">{"".join(parts)}</robot>'


def save(folder, text, name="robot.urdf"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def load(folder, *parts, **keywords):
    return dc.Robot.load(save(folder, robot(*parts)), **keywords)


def two_links(content="", kind="revolute", **keywords):
    """A base and one link on a joint."""
    return link("base"), link("arm"), joint("hinge", "base", "arm", kind, content, **keywords)


def random_robot(rng, links=8, content=INERTIAL):
    """A random tree; links are not in the order of its branches, so parents may follow children."""

    def three(scale=1.0):
        return " ".join(repr(float(x)) for x in scale * rng.standard_normal(3))

    order = rng.permutation(links)
    kinds = ["fixed", "revolute", "continuous", "prismatic"]
    parts = [link(f"l{i}", content) for i in order]
    leaders = []
    for i in rng.permutation(np.arange(1, links)):
        kind = kinds[rng.integers(4)]
        content = f'<origin xyz="{three(0.3)}" rpy="{three(2.0)}"/><axis xyz="{three()}"/>'
        if kind != "fixed" and leaders and rng.random() < 0.3:
            leader = leaders[rng.integers(len(leaders))]
            content += f'<mimic joint="{leader}" multiplier="{rng.normal()!r}" offset="0.1"/>'
        elif kind != "fixed":
            leaders.append(f"j{i}")
        limit = 'lower="-100" upper="100"'
        parts.append(joint(f"j{i}", f"l{rng.integers(i)}", f"l{i}", kind, content, limit))
    return robot(*parts)


def values_of_all_joints(robot, q):
    """Name of every joint's child link -> value, mimicking joints included."""
    m = robot.mechanism
    moving = [i for i in range(m.link_count) if m.kind[i] != "fixed"]
    return {m.link_names[i]: m.multiplier[i] * q[m.dof[i]] + m.constant[i] for i in moving}


def pinocchio_frames(path, values):
    """Frames of all links, from the values of the joints that carry the links."""
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    q = pin.neutral(model)
    carried = {model.frames[i].parentJoint: model.frames[i].name for i in _bodies(pin, model)[::-1]}
    for index, joint in enumerate(model.joints):
        if index == 0:
            continue
        value = values[carried[index]]
        at = joint.idx_q
        q[at : at + joint.nq] = [math.cos(value), math.sin(value)] if joint.nq == 2 else [value]
    pin.framesForwardKinematics(model, data, q)
    bodies = {model.frames[i].name: data.oMf[i].homogeneous for i in _bodies(pin, model)}
    return bodies, pin.centerOfMass(model, data, q), model


def _bodies(pin, model):
    return [i for i, f in enumerate(model.frames) if f.type == pin.FrameType.BODY]
