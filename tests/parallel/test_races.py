"""Threads share one simulator, in scenes small enough for sanitizers, which detect rare races.

Without repetition and without load; test_threads.py compares the bits of larger meshes.
"""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from parallel_scenes import batch, differing, simulator, step
from processes import threads

N = 6


@pytest.fixture(autouse=True)
def one_thread():
    with threads(1):
        yield


@pytest.mark.parametrize("scheme", ["coupled", "split"])
def test_a_batch_on_two_threads(scheme):
    sim, state = simulator(N, scheme), batch(N, 3, scheme=scheme)
    after, expected = step(sim, state)
    assert (after.report.contact_count > 0).all()
    torch.set_num_threads(2)
    _, values = step(sim, state)
    assert differing(values, expected) == []


def test_eight_python_threads_on_one_simulator():
    sim = simulator(N)
    states = list(batch(N, 8, seed=1))
    expected = [step(sim, state)[1] for state in states]
    with ThreadPoolExecutor(8) as pool:
        results = list(pool.map(lambda state: step(sim, state)[1], states))
    assert [differing(a, b) for a, b in zip(results, expected, strict=True)] == [[]] * 8


def test_python_threads_step_batches_of_one_state_on_threads_of_their_own():
    sim, state = simulator(N), batch(N, 2)
    _, expected = step(sim, state)

    def work(_):
        torch.set_num_threads(2)
        return step(sim, state)[1]

    with ThreadPoolExecutor(3) as pool:
        results = list(pool.map(work, range(3)))
    assert [differing(values, expected) for values in results] == [[]] * 3


def test_factors_are_forgotten_while_others_go_backward():
    sim = simulator(N)
    states = list(batch(N, 3, seed=2))
    expected = [step(sim, state)[1] for state in states]
    with ThreadPoolExecutor(4) as pool:
        steps = [pool.submit(step, sim, state) for state in states]
        while not all(future.done() for future in steps):
            sim._core.forget_factors()
            assert sim._core.factor_bytes <= sim._core.largest_factor_bytes
    results = [future.result()[1] for future in steps]
    assert [differing(a, b) for a, b in zip(results, expected, strict=True)] == [[]] * 3
