"""Equal bits for any number of threads, forward and backward, on a busy machine.

Libraries with shared state between threads rarely corrupt small solves: therefore meshes are large
enough to reach their blocked kernels, and steps are repeated under load.
"""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from parallel_scenes import batch, differing, simulator, step
from processes import threads

SIZES = (12, 16, 24)
LARGE = 48
REPEATS = {12: 4, 16: 2, 24: 1}
SLOW = pytest.param(10, marks=pytest.mark.slow)  # times as often
ENVIRONMENTS = 4


@pytest.fixture(scope="module", autouse=True)
def busy():
    """Another process keeps a core busy, so that threads are interrupted at random points."""
    spin = "import sys; print('spins', flush=True)\nwhile True: pass"
    with subprocess.Popen([sys.executable, "-c", spin], stdout=subprocess.PIPE) as process:
        try:
            process.stdout.readline()
            yield
        finally:
            process.kill()


@pytest.fixture(scope="module")
def serial():
    """Map from (size, scheme) to a state and the values of its step on one thread; cached."""
    made = {}

    def of(n, scheme="coupled"):
        if (n, scheme) not in made:
            state = batch(n, ENVIRONMENTS, scheme=scheme)
            with threads(1):
                after, values = step(simulator(n, scheme), state)
            assert (after.report.contact_count > n * n // 2).all()
            made[n, scheme] = state, values
        return made[n, scheme]

    return of


@pytest.mark.quick("12-*", "16-4-*")
@pytest.mark.parametrize("often", [1, SLOW])
@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.parametrize("n", SIZES)
def test_a_batch_has_the_same_bits_on_any_number_of_threads(serial, n, count, often):
    state, expected = serial(n)
    sim = simulator(n)
    for _ in range(often * REPEATS[n]):
        with threads(count):
            _, values = step(sim, state)
        assert differing(values, expected) == []


@pytest.mark.quick("2")
@pytest.mark.parametrize("count", [2, 4])
def test_split_has_the_same_bits_on_any_number_of_threads(serial, count):
    state, expected = serial(16, "split")
    for _ in range(2):
        with threads(count):
            _, values = step(simulator(16, "split"), state)
        assert differing(values, expected) == []


@pytest.mark.quick("12")
@pytest.mark.parametrize("n", SIZES[:2])
def test_woven_cloth_has_the_same_bits_alone_and_on_any_number_of_threads(n):
    sim, state = simulator(n, woven=True), batch(n, ENVIRONMENTS, woven=True)
    with threads(1):
        after, expected = step(sim, state)
        alone = [step(sim, environment)[0] for environment in state]
    assert (after.report.contact_count > n * n // 2).all()
    for i, one in enumerate(alone):
        assert torch.equal(one.positions, expected[0][i])
    for count in (2, 4):
        with threads(count):
            _, values = step(sim, state)
        assert differing(values, expected) == []


@pytest.mark.parametrize("n", SIZES[:2])
def test_an_environment_has_the_same_bits_alone_and_in_a_batch(serial, n):
    state, expected = serial(n)
    with threads(1):
        alone = [step(simulator(n), environment)[0] for environment in state]
    for i, after in enumerate(alone):
        assert torch.equal(after.positions, expected[0][i])
        assert torch.equal(after.body_forces, expected[2][i])


@pytest.mark.quick("coupled")
@pytest.mark.parametrize("scheme", ["coupled", "split"])
def test_threads_that_share_one_environment_change_no_bit(scheme):
    # Large enough for shared work: see tests/linalg/test_shared_work.py.
    sim, state = simulator(LARGE, scheme, False), batch(LARGE, 1, scheme=scheme, folded=False)
    with threads(1):
        after, expected = step(sim, state)
    assert (after.report.contact_count > 100).all()
    for count in (2, 3, 2, 3):
        with threads(count):
            _, values = step(sim, state)
        assert differing(values, expected) == []


@pytest.mark.quick("12-*")
@pytest.mark.parametrize("often", [1, SLOW])
@pytest.mark.parametrize("n", SIZES)
def test_eight_python_threads_on_one_simulator(n, often):
    sim = simulator(n)
    states = list(batch(n, 4, seed=1))
    with threads(1):
        expected = 2 * [step(sim, state)[1] for state in states]
        for _ in range(often * max(1, REPEATS[n] // 2)):
            with ThreadPoolExecutor(8) as pool:
                results = list(pool.map(lambda state: step(sim, state)[1], 2 * states))
            assert [differing(a, b) for a, b in zip(results, expected, strict=True)] == [[]] * 8


@pytest.mark.slow
@pytest.mark.parametrize(("n", "steps"), [(10, 500), (16, 300), (24, 200)])
def test_a_thousand_batched_steps_have_the_bits_of_one_thread(n, steps):
    sim = simulator(n)
    starts = batch(n, ENVIRONMENTS, seed=2)
    state = starts
    for k in range(steps):
        results = []
        for count in (1, 2):
            with threads(count):
                results.append(step(sim, state))
        assert differing(results[1][1], results[0][1]) == []
        # Repeat a short trajectory: a scene at rest tests less.
        state = results[0][0] if k % 10 < 9 else starts
