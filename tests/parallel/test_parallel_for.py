"""Threads that cannot be started, fail or are interrupted."""

import os
import resource
import signal
import sys
import threading
import time

import pytest
from processes import run_python

from diffcloth_torch import _kernels

run = _kernels.run_environments


@pytest.mark.parametrize("threads", [-1, 0, 1, 2, 3, 8])
@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_every_environment_runs_once(count, threads):
    taken = run(count, threads, 0.0)
    assert sum(taken) == count
    assert len(taken) <= max(1, min(threads, count))


def test_threads_share_the_environments():
    taken = run(4, 4, 0.2)
    assert len(taken) > 1
    assert sum(taken) == 4


@pytest.mark.parametrize("threads", [1, 3])
def test_the_first_failure_by_index_is_raised_once_all_have_ended(threads):
    with pytest.raises(ValueError, match="environment 2"):
        run(6, threads, 0.0, [5, 2, 4])
    assert sum(run(6, threads, 0.0)) == 6


def test_the_most_expensive_begin():
    order = _kernels.order_of_environments
    assert order(5, 1, [1.0, 3.0, 0.0, 3.0, 2.0]) == [1, 3, 4, 0, 2]
    assert order(4, 1, []) == [0, 1, 2, 3]
    assert order(4, 1, [0.0, 1.0]) == [0, 1, 2, 3]  # of another batch
    assert sorted(order(5, 3, [1.0, 3.0, 0.0, 3.0, 2.0])) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("threads", [1, 3])
def test_the_first_failure_by_index_is_raised_in_any_order(threads):
    with pytest.raises(ValueError, match="environment 1"):
        _kernels.order_of_environments(6, threads, [0.0, 1.0, 5.0, 3.0, 4.0, 2.0], [2, 4, 1])


WITHOUT_THREADS = """
    import threading
    import torch
    import diffcloth_torch as dc
    from diffcloth_torch import _kernels
    from diffcloth_torch.sim.solve import step

    try:
        threading.Thread(target=int).start()
    except RuntimeError:
        print("no threads")

    print(_kernels.run_environments(5, 4, 0.0))
    try:
        _kernels.run_environments(5, 4, 0.0, [3, 1])
    except ValueError as error:
        print(error)

    print(_kernels.run_team([[], [], [0, 1]], 4, 0.0, 3))

    step.torch.get_num_threads = lambda: 4  # torch's own pool needs threads, too
    floor = dc.RigidBody.plane(2, pose=[0, 0, -0.01, 1, 0, 0, 0])
    sim = dc.Simulator(dc.Scene([dc.Cloth.grid(4, 4)], [floor]), 0.01)
    x = sim.initial_state(5).positions.requires_grad_()
    after = sim.step(sim.initial_state(5).replace(positions=x))
    after.positions.sum().backward()
    print(all(torch.equal(row, after.positions[0]) for row in after.positions), bool(x.grad.any()))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits as Linux has them")
def test_a_batch_runs_on_the_threads_that_there_are():
    # Stacks exceed the remaining address space: no thread can start, all else works.
    def limit():
        resource.setrlimit(resource.RLIMIT_STACK, (1 << 38, resource.RLIM_INFINITY))
        resource.setrlimit(resource.RLIMIT_AS, (1 << 37, resource.RLIM_INFINITY))

    if resource.getrlimit(resource.RLIMIT_STACK)[1] != resource.RLIM_INFINITY:
        pytest.skip("may not raise the limit of the stack")
    printed = run_python(
        WITHOUT_THREADS,
        preexec_fn=limit,
        timeout=120,
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    assert printed.splitlines() == [
        "no threads",
        "[5]",
        "environment 1",
        "[(0, 0), (0, 1), (0, 2)]",
        "True True",
    ]


class PressedError(Exception):
    pass


@pytest.fixture
def interrupting():
    """Raise in the main thread, as Ctrl-C does, after some seconds."""

    def handler(number, frame):
        raise PressedError

    before = signal.signal(signal.SIGINT, handler)
    timers = []

    def after(seconds):
        timers.append(threading.Timer(seconds, signal.raise_signal, [signal.SIGINT]))
        timers[-1].start()

    yield after
    for timer in timers:
        timer.join()
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("threads", [2, 3])
def test_an_interrupt_reaches_others_while_the_caller_waits_for_them(interrupting, threads):
    # The caller's tasks end as soon as other threads have begun theirs, which would take longer.
    interrupting(0.5)
    start = time.monotonic()
    with pytest.raises(PressedError):
        run(threads, threads, 15.0)
    assert time.monotonic() - start < 5.0
    assert sum(run(4, 2, 0.0)) == 4


def test_an_interrupt_reaches_a_single_thread(interrupting):
    interrupting(0.5)
    start = time.monotonic()
    with pytest.raises(PressedError):
        run(2, 1, 15.0)
    assert time.monotonic() - start < 5.0


def test_an_interrupt_is_raised_in_place_of_a_failure(interrupting):
    interrupting(0.5)
    with pytest.raises(PressedError):
        run(3, 2, 15.0, [0, 1, 2])
