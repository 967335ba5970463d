"""Contact through the public interface: no intersections, weight, momentum, energy, reaction."""

import numpy as np
import pytest
import torch
from physics_scenes import (
    WEIGHTLESS,
    Judge,
    jittered_sheet,
    lumped_masses,
    quaternion,
    strip,
    tensor,
)

import diffcloth_torch as dc

G = 9.81
SCHEMES = ["coupled", "split"]


def sheet(cells, size, height, *, seed=0, turn=0.3, center=(0.0, 0.0), **keywords):
    """Jittered square sheet, turned in its plane, so that nothing lines up with a body's edges."""
    vertices, faces = jittered_sheet(cells, size, seed)
    vertices = vertices - [size / 2, 0, 0]
    pose = [*center, height, *quaternion([0, 0, 1], turn)]
    posed = vertices @ rotation_of(pose).T + pose[:3]
    return dc.Cloth(posed, faces, rest_vertices=vertices, **keywords)


def rotation_of(pose):
    from physics_scenes import matrix

    return matrix(np.array(pose[3:]))


def masses_of(sim):
    parts = []
    for cloth in sim.scene.cloths:
        parts.append(lumped_masses(cloth.rest_vertices, cloth.faces, cloth.material.density))
    return tensor(np.concatenate(parts))[:, None]


# --- No intersections ----------------------------------------------------------------------------


def drape(scheme, thickness=0.0):
    material = dc.Material(stretch=300.0, bending=1e-5, thickness=thickness)
    cloth = sheet(10, 0.6, 0.16, material=material, center=(0.03, 0.02))
    ball = dc.RigidBody.sphere(0.12, subdivisions=2, friction=0.3)
    floor = dc.RigidBody.plane(3.0, pose=[0, 0, -0.15, 1, 0, 0, 0], thickness=thickness)
    return dc.Simulator(dc.Scene([cloth], [ball, floor]), 0.02, scheme=scheme)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("thickness", [0.0, 4e-3])
def test_a_cloth_drapes_over_a_ball_without_intersections(scheme, thickness):
    sim = drape(scheme, thickness)
    judge = Judge(sim)
    state = sim.initial_state()
    contacts = 0
    for _ in range(25):
        state = sim.step(state)
        assert judge.is_free(state)
        assert state.report.minimum_distance > 0
        contacts = max(contacts, state.report.contact_count)
    assert contacts > 20
    assert state.positions[:, 2].min() < 0.1  # it hangs around the ball
