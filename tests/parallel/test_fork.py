"""Forked processes step batches on new threads after the parent has used threads."""

import multiprocessing
import os
import signal
import time
import traceback

import pytest
import torch
from parallel_scenes import batch, differing, simulator, step
from processes import threads
from torch.utils.data import DataLoader, Dataset

import diffcloth_torch as dc
from diffcloth_torch.robots import GRIPPER

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "fork"), reason="forks"),
    # Python 3.12 warns of every fork of a process with threads; these tests show that forks work.
    pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning"),
]

SIZES = (6, 12, 16)


@pytest.fixture(params=SIZES)
def after_a_parallel_region(request):
    """Size, state, values of a step on two threads of this process, and a time to wait."""
    n = request.param
    state = batch(n, 4)
    with threads(2):
        torch.randn(500, 500) @ torch.randn(500, 500)
        begin = time.monotonic()
        expected = step(simulator(n), state)[1]
        # A child that hangs must not hang the tests; a busy machine may be slow.
        patience = 30 + 20 * (time.monotonic() - begin)
        yield n, state, expected, patience


def in_child(function, patience):
    """Run a function in a forked child; its exit status, negative for a signal."""
    pid = os.fork()
    if pid == 0:
        signal.alarm(int(patience))
        try:
            status = 0 if function() else 1
        except BaseException:
            traceback.print_exc()
            status = 2
        os._exit(status)
    _, status = os.waitpid(pid, 0)
    return os.waitstatus_to_exitcode(status)


@pytest.mark.quick("6-1", "12-2")
@pytest.mark.parametrize("count", [1, 2])
def test_a_forked_child_steps_batches(after_a_parallel_region, count):
    n, state, expected, patience = after_a_parallel_region

    def repeat():
        torch.set_num_threads(count)
        sim = simulator(n)
        return all(differing(step(sim, state)[1], expected) == [] for _ in range(2))

    assert in_child(repeat, patience) == 0
    # The parent continues as before.
    assert differing(step(simulator(n), state)[1], expected) == []


def test_a_forked_child_shares_the_work_on_one_environment():
    sim, state = simulator(48, folded=False), batch(48, 1, folded=False)
    with threads(2):
        begin = time.monotonic()
        expected = step(sim, state)[1]
        patience = 30 + 20 * (time.monotonic() - begin)
        assert in_child(lambda: differing(step(sim, state)[1], expected) == [], patience) == 0
        assert differing(step(sim, state)[1], expected) == []


def robots(environments):
    """A state of a gripper and a box in the air, and a function that returns a step's values."""
    hand = dc.Robot.load(GRIPPER, base="floating", actuation="pd", stiffness=50.0, damping=1.0)
    box = dc.RigidBody.box(0.1, motion="dynamic", mass=0.5, pose=[2, 0, 0, 1, 0.1, 0.2, 0.3])
    contact = dc.ContactOptions(barrier_distance=1e-3)
    sim = dc.Simulator(dc.Scene([], [box], [hand]), 0.01, contact=contact)

    def take():
        generator = torch.Generator().manual_seed(0)
        state = sim.initial_state(environments)
        spin = torch.randn(environments, 1, 6, generator=generator, dtype=torch.float64)
        spin.requires_grad_()
        state = state.replace(base_velocities=spin, body_velocities=2 * spin)
        states = sim.rollout(state, steps=2)
        loss = states[-1].joint_velocities.sum() + states[-1].body_poses.square().sum()
        loss.backward()
        return [states[-1].base_poses, states[-1].body_velocities, spin.grad]

    return take


@pytest.mark.parametrize("environments", [1, 3, 17])
@pytest.mark.parametrize("count", [None, 2])
def test_a_forked_child_steps_bodies_and_robots(environments, count):
    take = robots(environments)
    with threads(2):
        torch.randn(500, 500) @ torch.randn(500, 500)
        begin = time.monotonic()
        expected = take()
        patience = 30 + 20 * (time.monotonic() - begin)

        def repeat():
            if count is not None:
                torch.set_num_threads(count)
            return all(torch.equal(*pair) for pair in zip(take(), expected, strict=True))

        assert in_child(repeat, patience) == 0


def work(queue, n, state):
    torch.set_num_threads(2)
    _, values = step(simulator(n), state)
    queue.put([value.numpy() for value in values])


def test_a_process_of_multiprocessing_steps_batches(after_a_parallel_region):
    n, state, expected, patience = after_a_parallel_region
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    process = context.Process(target=work, args=(queue, n, state))
    process.start()
    answered = wait(process, queue, patience)
    values = queue.get() if answered else []
    process.join()
    assert answered
    assert process.exitcode == 0
    assert differing([torch.from_numpy(value) for value in values], expected) == []


def wait(process, queue, patience):
    """Return whether an answer arrives before the process ends or the patience is exhausted."""
    deadline = time.monotonic() + patience
    while queue.empty():
        process.join(0.05)
        if process.exitcode is not None or time.monotonic() > deadline:
            process.kill()
            return not queue.empty()
    return True


class Steps(Dataset):
    def __init__(self, n, state):
        self.n, self.state = n, state

    def __len__(self):
        return 2

    def __getitem__(self, index):
        torch.set_num_threads(2)  # a worker starts with one
        return step(simulator(self.n), self.state)[1]


def test_a_worker_of_a_data_loader_steps_batches(after_a_parallel_region):
    n, state, expected, patience = after_a_parallel_region
    loader = DataLoader(
        Steps(n, state),
        batch_size=None,
        num_workers=1,
        multiprocessing_context="fork",
        timeout=patience,
    )
    rows = list(loader)
    assert len(rows) == 2
    for values in rows:
        assert differing(values, expected) == []
