"""With bodies and robots in contact too: the same bits alone, in a batch and on every thread."""

import coupled_scenes
import pytest
import torch
from coupled_scenes import BASES, COUPLINGS

import diffcloth_torch as dc
from diffcloth_torch.robots import GRIPPER

pytestmark = pytest.mark.filterwarnings("ignore::diffcloth_torch.AddedMassWarning")

CASES = pytest.mark.parametrize(
    ("coupling", "base"), [(coupling, base) for coupling in COUPLINGS for base in BASES]
)
MOVED = ("positions", "velocities", "body_poses", "body_velocities", "joint_positions")
MOVED += ("joint_velocities", "base_poses", "base_velocities")
FIELDS = (*MOVED, "soft_pin_targets", "body_forces", "joint_targets", "joint_efforts", "time")


@pytest.fixture
def threads():
    """A function that sets the number of threads; the fixture restores the number afterwards."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def starts(coupling, base, count=3):
    """A simulator, and states in contact at several times."""
    sim, state = coupled_scenes.in_contact(coupling, base)
    controls = [coupled_scenes.control(sim)] * (count - 1)
    with torch.no_grad():
        later = sim.rollout(state, controls, coupled_scenes.parameters(sim))
    return sim, [state, *later]


def same(a, b):
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in FIELDS)


def pull(sim, state, steps=2):
    """States after `steps` steps, and the gradients of a loss on the last state by the start."""
    leaves = {name: getattr(state, name).clone().requires_grad_() for name in MOVED}
    masses = coupled_scenes.parameters(sim)
    controls = [coupled_scenes.control(sim)] * steps
    states = sim.rollout(state.replace(**leaves), controls, masses)
    end = states[-1]
    loss = sum((getattr(end, name) ** 2).sum() for name in (*MOVED, "body_forces"))
    if sim.scene.robots[0].mechanism.base == "fixed":
        del leaves["base_velocities"]  # nothing depends on them
    return states, torch.autograd.grad(loss, list(leaves.values()))


@pytest.mark.quick("monolithic-fixed", "rigid_to_cloth-fixed", "cloth_to_rigid-fixed")
@CASES
def test_a_batch_has_the_bits_of_its_environments_on_any_threads(coupling, base, threads):
    sim, singles = starts(coupling, base)
    threads(1)
    alone = [pull(sim, state) for state in singles]
    for count in (1, 2, 4):
        threads(count)
        states, gradients = pull(sim, dc.stack(singles))
        for i, (own_states, own_gradients) in enumerate(alone):
            assert all(same(a[i], b) for a, b in zip(states, own_states, strict=True))
            pairs = zip(gradients, own_gradients, strict=True)
            assert all(torch.equal(a[i], b) for a, b in pairs)


@CASES
def test_a_step_repeats_to_the_bit_whatever_went_before(coupling, base):
    """No cache may show: neither another step in between, nor another simulator of the scene."""
    sim, singles = starts(coupling, base)
    first, gradients = pull(sim, singles[0])
    pull(sim, singles[2])
    for again in (sim, coupled_scenes.simulator(coupling, base)):
        states, others = pull(again, singles[0])
        assert all(map(same, states, first))
        assert all(map(torch.equal, gradients, others))


@CASES
def test_environments_that_are_reset_go_on_as_if_alone(coupling, base):
    """`where` replaces some environments by the start, which ends their gradients there."""
    sim, singles = starts(coupling, base)
    given = (coupled_scenes.control(sim), coupled_scenes.parameters(sim))
    batch = dc.stack(singles)
    velocities = batch.velocities.clone().requires_grad_()
    after = sim.step(batch.replace(velocities=velocities), *given)
    fresh = dc.stack([sim.initial_state()] * 3)
    mixed = dc.where(torch.tensor([False, True, False]), fresh, after)
    end = sim.step(mixed, *given)
    assert same(end[1], sim.step(sim.initial_state(), *given))
    for i in (0, 2):
        assert same(end[i], sim.step(sim.step(singles[i], *given), *given))
    (gradient,) = torch.autograd.grad(end.body_poses.sum() + end.joint_positions.sum(), velocities)
    assert not gradient[1].any()
    assert gradient[0].any()
    assert gradient[2].any()


@pytest.mark.quick("monolithic-fixed", "rigid_to_cloth-fixed", "cloth_to_rigid-fixed")
@CASES
def test_a_checkpointed_rollout_has_the_same_gradients(coupling, base):
    sim, (start, *_) = starts(coupling, base)
    found = []
    for every in (None, 1, 3):
        x = start.body_velocities.clone().requires_grad_()
        masses = coupled_scenes.parameters(sim)
        mass = masses.body_mass.clone().requires_grad_()
        gains = masses.joint_stiffness.clone().requires_grad_()
        given = masses.replace(body_mass=mass, joint_stiffness=gains)
        control = coupled_scenes.control(sim)
        targets = control.joint_positions.clone().requires_grad_()
        states = sim.rollout(
            start.replace(body_velocities=x),
            [control.replace(joint_positions=targets)] * 5,
            given,
            checkpoint_every=every,
        )
        end = states[-1]
        loss = end.positions.sum() + end.joint_positions.sum() + end.body_poses[0, :3].sum()
        found.append((end, torch.autograd.grad(loss, (x, mass, gains, targets))))
    for end, gradients in found[1:]:
        assert same(end, found[0][0])
        assert all(map(torch.equal, gradients, found[0][1]))
    assert all(gradient.any() for gradient in found[0][1])


@pytest.mark.parametrize("names", [("gravity",), ("link_mass", "link_inertia")])
def test_a_robot_in_the_air_has_the_same_bits_with_any_gradient(names):
    """In every batch, and without a graph."""
    hand = dc.Robot.load(GRIPPER, base="floating", actuation="torque")
    contact = dc.ContactOptions(barrier_distance=1e-3)
    sim = dc.Simulator(dc.Scene([], robots=[hand]), 0.01, contact=contact)
    batch = sim.initial_state(4)
    spin = torch.linspace(-2, 3, 24, dtype=torch.float64).reshape(4, 1, 6)
    batch = batch.replace(base_velocities=spin)
    parameters = sim.default_parameters()
    leaves = {name: getattr(parameters, name).clone().requires_grad_() for name in names}
    for given in (parameters, parameters.replace(**leaves)):
        alone = [sim.step(batch[i], None, given) for i in range(4)]
        for count in (2, 3, 4):
            together = sim.step(dc.stack([batch[i] for i in range(count)]), None, given)
            assert all(same(together[i], alone[i]) for i in range(count))
    assert all(same(sim.step(batch[i]), alone[i]) for i in range(4))
