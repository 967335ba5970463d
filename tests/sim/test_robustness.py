"""Failures around a step: bad scenes and states, threads, workers, interrupts, memory.

Tests of meshes, scenes and the contract cover bad values of single arguments.
"""

import os
import signal
import subprocess
import sys
import textwrap
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from processes import threads
from torch.utils.data import DataLoader, Dataset

import diffcloth_torch as dc

F64 = torch.float64
DT = 0.01


def tent(cells=6, **keywords):
    """A sheet slightly above a ball, in contact within a few steps; generic coordinates."""
    cloth = dc.Cloth.grid(
        cells,
        cells,
        size=0.4,
        pose=[0.013, 0.007, 0.115, 0.99, 0.01, 0.02, 0.1],
        pins={"corner": [0]},
        material=dc.Material(stretch=100.0),
    )
    ball = dc.RigidBody.sphere(0.1, subdivisions=1, motion="kinematic")
    return dc.Simulator(dc.Scene([cloth], [ball]), DT, **keywords)


@pytest.fixture(scope="module")
def sim():
    return tent()


@pytest.fixture(scope="module")
def contact(sim):
    """A state in contact."""
    state = sim.initial_state()
    for _ in range(10):
        state = sim.step(state)
    assert state.report.contact_count > 1
    return state


def still_works(sim):
    return sim.step(sim.initial_state()).report.converged


def values(state):
    return state.positions, state.velocities, state.body_forces


def same(a, b):
    return all(torch.equal(x, y) for x, y in zip(values(a), values(b), strict=True))


# --- Bad scenes and states -----------------------------------------------------------------------


def test_a_cloth_that_intersects_itself_is_refused():
    cloth = dc.Cloth.grid(3, 3, name="a")
    x = np.array(cloth.vertices)
    x[8] = x[0] + [0.1, 0.12, -0.05]  # folded through the opposite corner
    x[5] = x[1] + [0.03, 0.1, 0.3]
    with pytest.raises(
        dc.IntersectingState, match=r"cloth 'cloth0' edge .* intersects cloth 'cloth0' face"
    ):
        dc.Simulator(dc.Scene([dc.Cloth(x, cloth.faces, rest_positions=cloth.vertices)]), DT)


def test_surfaces_closer_than_their_thickness_are_refused():
    def make(height):
        cloth = dc.Cloth.grid(
            3, 3, pose=[0, 0, height, 1, 0, 0, 0], material=dc.Material(thickness=0.02)
        )
        return dc.Simulator(dc.Scene([cloth], [dc.RigidBody.plane(3, thickness=0.04)]), DT)

    with pytest.raises(dc.IntersectingState, match=r"0\.029.* m apart, .* thickness 0\.03"):
        make(0.029)
    assert still_works(make(0.031))


def test_touching_surfaces_are_refused():
    cloth = dc.Cloth.grid(3, 3, pose=[0, 0, 0, 1, 0, 0, 0])
    with pytest.raises(dc.IntersectingState):
        dc.Simulator(dc.Scene([cloth], [dc.RigidBody.plane(3)]), DT)


def test_a_barrier_too_wide_for_the_mesh_is_refused_with_the_limit():
    cloth = dc.Cloth.grid(3, 3, size=0.2)  # elements that are no neighbors are 0.07 m apart
    with pytest.raises(dc.InvalidInput, match=r"`barrier_distance` .* below half .* 0\.0353553 m"):
        dc.Simulator(dc.Scene([cloth]), DT, contact=dc.ContactOptions(barrier_distance=0.04))


@pytest.mark.parametrize("dt", [-0.01, float("nan"), float("inf")])
def test_a_bad_time_step_is_refused(dt):
    with pytest.raises(dc.InvalidInput, match="`dt` must be finite and > 0"):
        dc.Simulator(dc.Scene([dc.Cloth.grid(2, 2)]), dt)


@pytest.mark.parametrize("dt", ["1e-2", None, True])
def test_a_time_step_of_another_type_is_refused(dt):
    with pytest.raises(TypeError, match="`dt`"):
        dc.Simulator(dc.Scene([dc.Cloth.grid(2, 2)]), dt)


def test_a_collapsed_rest_shape_is_refused(sim):
    parameters = sim.default_parameters()
    rest = parameters.rest_positions.clone()
    rest[1] = rest[0]
    with pytest.raises(dc.InvalidInput, match=r"area > 0 in `rest_positions`.* \[0\]"):
        sim.step(sim.initial_state(), None, parameters.replace(rest_positions=rest))
    assert still_works(sim)


@pytest.mark.parametrize("speed", [1e6, 1e150, 1e300])
def test_absurd_velocities_end_in_a_result_or_an_error(sim, speed):
    state = sim.initial_state()
    fast = state.replace(velocities=state.velocities + speed * torch.randn(36, 3, dtype=F64))
    try:
        after = sim.step(fast)
    except (dc.SimulationError, dc.InvalidInput):
        pass
    else:
        assert after.report.converged
        assert torch.isfinite(after.positions).all()
    assert still_works(sim)


def test_a_collapsed_state_is_refused(sim):
    state = sim.initial_state()
    with pytest.raises(dc.IntersectingState):
        sim.step(state.replace(positions=torch.zeros_like(state.positions)))
    assert still_works(sim)


# --- Threads and processes -----------------------------------------------------------------------


def gradient(sim, state):
    x = state.positions.clone().requires_grad_()
    after = sim.step(state.replace(positions=x))
    loss = (after.positions**2).sum() + 1e-3 * (after.velocities**2).sum()
    return after, torch.autograd.grad(loss, x)[0]


@pytest.mark.parametrize("scheme", ["coupled", "split"])
def test_the_number_of_threads_changes_no_bit_in_contact(contact, scheme):
    sim = tent(scheme=scheme)
    noise = torch.randn(5, 36, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    batch = dc.stack([contact.detach().replace(velocities=0.1 * row) for row in noise])
    results = []
    for count in (1, 2, 4):
        with threads(count):
            results.append(gradient(sim, batch))
    for after, x_bar in results[1:]:
        assert same(after, results[0][0])
        assert torch.equal(x_bar, results[0][1])


def test_eight_threads_at_once_in_contact(sim, contact):
    noise = torch.randn(8, 36, 3, dtype=F64, generator=torch.Generator().manual_seed(1))
    states = [contact.replace(velocities=0.1 * row) for row in noise]
    expected = [gradient(sim, state) for state in states]
    with ThreadPoolExecutor(8) as pool:
        results = list(pool.map(lambda state: gradient(sim, state), states))
    for (after, x_bar), (again, x_bar_again) in zip(expected, results, strict=True):
        assert same(after, again)
        assert torch.equal(x_bar, x_bar_again)


class Rolls(Dataset):
    def __init__(self, sim, state):
        self.sim, self.state = sim, state

    def __len__(self):
        return 2

    def __getitem__(self, index):
        after, x_bar = gradient(self.sim, dc.stack([self.state] * (index + 1)))
        return after.positions[index].detach(), x_bar[index]


def test_a_forked_worker_steps_after_a_parallel_region(sim, contact):
    state = contact.detach()
    with threads(2):
        expected, x_bar = gradient(sim, dc.stack([state, state]))  # threads have run here
        torch.randn(500, 500) @ torch.randn(500, 500)
        loader = DataLoader(Rolls(sim, state), num_workers=1, multiprocessing_context="fork")
        rows = list(loader)
    assert len(rows) == 2
    for positions, gradient_row in rows:
        assert torch.equal(positions[0], expected.positions[0])
        assert torch.equal(gradient_row[0], x_bar[0])


INTERRUPTED = """
    import signal
    import torch
    import diffcloth_torch as dc

    # A test run in the background of a shell ignores SIGINT, and so would its children.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sheet = dc.Cloth.grid(24, 24, size=1.0, material=dc.Material(stretch=1e4))
    sim = dc.Simulator(dc.Scene([sheet]), 0.01, solver=dc.SolverOptions(throw=False))
    noise = torch.randn(
        64, 576, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    state = sim.initial_state(64).replace(velocities=5 * noise)
    kept = state.positions.clone(), state.velocities.clone()
    torch.set_num_threads({threads})
    print("ready", flush=True)
    try:
        sim.step(state)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
    else:
        print("finished", flush=True)
    assert torch.equal(state.positions, kept[0]) and torch.equal(state.velocities, kept[1])
    assert sim.step(sim.initial_state()).report.converged
    print("works", flush=True)
"""


@pytest.mark.quick("2")
@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
@pytest.mark.parametrize("threads", [1, 2])
def test_ctrl_c_ends_a_long_step_within_a_second(threads):
    code = textwrap.dedent(INTERRUPTED.replace("{threads}", str(threads)))
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout.readline() == "ready\n"
            time.sleep(0.3)
            sent = time.monotonic()
            process.send_signal(signal.SIGINT)
            assert process.stdout.readline() == "interrupted\n"
            assert time.monotonic() - sent < 1.0
            assert process.stdout.readline() == "works\n"
            assert process.wait(timeout=60) == 0
        finally:
            process.kill()


# --- Memory --------------------------------------------------------------------------------------


def resident_bytes():
    with open("/proc/self/statm") as file:  # noqa: PTH123
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="reads /proc")  # noqa: PTH110
def test_memory_does_not_grow_over_many_steps_with_backward(contact):
    sim = tent()
    state = contact.detach()
    # The bounded cache of factors fills at first; afterwards 2,000 steps must leave nothing.
    sizes = []
    for k in range(5000):
        gradient(sim, state)
        if k in (2999, 4999):
            sizes.append(resident_bytes())
    assert sizes[1] - sizes[0] < 5e6
