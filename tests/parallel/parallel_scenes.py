"""Folded sheets on a plate, in contact with the plate and themselves from the first step on."""

from functools import cache

import numpy as np
import torch

import diffcloth_torch as dc

F64 = torch.float64


@cache
def simulator(n, scheme="coupled", folded=True, woven=False):
    """n x n vertices; the lower half rests on a plate, the upper half on the lower one, or on
    the plate too."""
    sheet = dc.Cloth.grid(n, n)
    edge = 1.0 / (n - 1)
    flat = np.array(sheet.vertices)
    flat[:, :2] += np.random.default_rng(n).uniform(-0.1, 0.1, (n * n, 2)) * edge
    s = flat[:, 1]  # across the fold, which occupies one row of cells
    reach = 0.1 * edge
    # Deeper in the barrier this step needs 90 iterations instead of 50.
    gap, below = 0.95 * reach, s < (0.0 if folded else 1.0)
    placed = np.stack([flat[:, 0], np.where(below, s, -s), np.where(below, 0, gap)], axis=-1)
    material = dc.fabrics.material("blanket") if woven else dc.Material(friction=0.3)
    cloth = dc.Cloth(
        placed, sheet.faces, rest_positions=flat, material=material, directions=[1.0, 0.5, 0.0]
    )
    plate = dc.RigidBody.plane(3.0, pose=[0.01, 0.02, -gap, 1, 0, 0, 0])
    contact = dc.ContactOptions(barrier_distance=reach)
    return dc.Simulator(dc.Scene([cloth], [plate]), 0.01, scheme=scheme, contact=contact)


def batch(n, environments, seed=0, scheme="coupled", folded=True, woven=False):
    """A batched state with different velocities in each environment."""
    state = simulator(n, scheme, folded, woven).initial_state(environments)
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(state.velocities.shape, generator=generator, dtype=F64)
    speed = torch.tensor([0.3, 0.1, -0.05], dtype=F64)
    return state.replace(velocities=speed + 0.02 * noise)


def step(sim, state):
    """One step: its values, and the gradients by the state, body poses and friction."""
    before = state.detach()
    leaves = [before.positions.clone(), before.velocities.clone(), before.body_poses.clone()]
    x, v, poses = (leaf.requires_grad_() for leaf in leaves)
    parameters = sim.default_parameters()
    friction = parameters.friction.clone().requires_grad_()
    after = sim.step(
        before.replace(positions=x, velocities=v, body_poses=poses),
        None,
        parameters.replace(friction=friction),
    )
    outputs = [after.positions, after.velocities, after.body_forces]
    cotangents = [torch.linspace(-1, 2, o.numel(), dtype=F64).reshape(o.shape) for o in outputs]
    torch.autograd.backward(outputs, cotangents)
    values = [o.detach() for o in outputs] + [x.grad, v.grad, poses.grad, friction.grad]
    return after.detach(), values


def differing(a, b):
    """Names of values with different bits."""
    names = ("positions", "velocities", "body_forces", "x_bar", "v_bar", "poses_bar", "mu_bar")
    return [name for name, p, q in zip(names, a, b, strict=True) if not torch.equal(p, q)]
