"""Jacobians of steps with a dynamic robot, forward and in reverse, against differences."""

import pytest
import torch
from bodies.coupled_scenes import COUPLINGS, control, in_contact, parameters

# Steps of the differences; the last is larger because fingers at their velocity limit hardly
# depend on their viscosity.
STEPS = [1e-5] * 4 + [1e-3]


@pytest.mark.quick("monolithic-fixed", "rigid_to_cloth-fixed", "cloth_to_rigid-fixed")
@pytest.mark.parametrize("base", ["fixed", "floating"])
@pytest.mark.parametrize("coupling", COUPLINGS)
def test_both_modes_find_the_jacobian(coupling, base):
    sim, start = in_contact(coupling, base)
    given, drive = parameters(sim), control(sim)

    def end(theta):
        changed = given.replace(
            gravity=theta[:3],
            friction=given.friction + theta[3],
            joint_viscosity=given.joint_viscosity + theta[4],
        )
        state = sim.rollout(start, [drive, drive], changed)[-1]
        parts = (state.positions, state.body_velocities, state.joint_positions)
        return torch.cat([part.flatten() for part in parts])

    theta = torch.cat([given.gravity, torch.zeros(2, dtype=torch.float64)])
    forward = torch.func.jacfwd(end)(theta)
    reverse = torch.func.jacrev(end)(theta)
    for k, direction in enumerate(torch.eye(len(theta), dtype=torch.float64)):
        column = forward[:, k]
        assert (reverse[:, k] - column).norm() <= 1e-9 * column.norm()
        with torch.no_grad():
            step = STEPS[k] * direction
            change = end(theta + step) - end(theta - step)
        assert (change / (2 * STEPS[k]) - column).norm() <= 2e-5 * column.norm()


def test_a_gradient_by_torch_func():
    sim, start = in_contact(COUPLINGS[0], "fixed")
    given, drive = parameters(sim), control(sim)

    def height(gravity):
        return sim.step(start, drive, given.replace(gravity=gravity)).positions[..., 2].sum()

    leaf = given.gravity.clone().requires_grad_()
    (expected,) = torch.autograd.grad(height(leaf), leaf)
    torch.testing.assert_close(torch.func.grad(height)(given.gravity), expected)
