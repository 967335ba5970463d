"""Meshes, scenes and judges shared by the tests of the laws of physics."""

import numpy as np
import torch

import diffcloth_torch as dc

F64 = torch.float64
WEIGHTLESS = (0.0, 0.0, 0.0)


def tensor(values):
    return torch.as_tensor(np.asarray(values), dtype=F64)


def strip(cells, rows, length, width):
    """Flat strip along x from 0 to `length`, centered in y; vertex [i, j] is i * rows + j.

    All diagonals run one way: where they alternate, the six-point patches are too soft.
    """
    x, y = np.linspace(0, length, cells + 1), np.linspace(-width / 2, width / 2, rows)
    vertices = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((cells + 1, rows))], axis=-1)
    faces = []
    for i in range(cells):
        for j in range(rows - 1):
            a, b = i * rows + j, (i + 1) * rows + j
            faces += [[a, b, b + 1], [a, b + 1, a + 1]]
    return vertices.reshape(-1, 3), np.array(faces)


def jittered_sheet(cells, size, seed=0, share=0.2):
    """Flat square sheet whose inner vertices are moved in the plane, in general position."""
    vertices, faces = strip(cells, cells + 1, size, size)
    inside = (np.abs(vertices[:, 0] - size / 2) < 0.499 * size) & (
        np.abs(vertices[:, 1]) < 0.499 * size
    )
    noise = np.random.default_rng(seed).uniform(-share, share, (len(vertices), 2)) * size / cells
    vertices[inside, :2] += noise[inside]
    return vertices, faces


def lumped_masses(vertices, faces, density):
    """A third of the mass of each adjacent face [kg]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    masses = np.zeros(len(vertices))
    for k in range(3):
        np.add.at(masses, faces[:, k], density * area / 3)
    return masses


def settle(sim, state, control=None, *, steps=60, speed=1e-9):
    """Step until nothing moves; a large dt of implicit Euler is a damped search for rest."""
    for _ in range(steps):
        state = sim.step(state, control)
        if state.velocities.abs().max() < speed:
            return state
    raise AssertionError(f"still moving at {state.velocities.abs().max():.3g} m/s")


def rotation(axis, angle):
    """Rotation matrix about an axis by an angle [rad]."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def quaternion(axis, angle):
    axis = np.asarray(axis) / np.linalg.norm(axis)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])
