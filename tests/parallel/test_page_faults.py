"""Memory freed by the threads of one step is reused by the threads of the next."""

import sys

import pytest
import torch
from processes import threads

import diffcloth_torch as dc


@pytest.mark.skipif(sys.platform != "linux", reason="counts pages as Linux does")
def test_threads_ask_the_system_for_no_more_pages():
    from resource import RUSAGE_SELF, getrusage

    cloth = dc.Cloth.grid(24, 24, pins={"corners": [0, 23]})
    sim = dc.Simulator(dc.Scene([cloth]), 0.01)
    state = sim.initial_state(8)
    with threads(2):
        for _ in range(3):
            state = sim.step(state)
        faults = getrusage(RUSAGE_SELF).ru_minflt
        for _ in range(5):
            state = sim.step(state)
        faults = getrusage(RUSAGE_SELF).ru_minflt - faults
    # A factor and its matrix alone need 700 pages, in each of 8 environments and 5 steps.
    assert faults < 8 * 5 * 100


@pytest.mark.skipif(sys.platform != "linux", reason="counts pages as Linux does")
def test_factors_of_a_step_share_their_pages():
    from resource import RUSAGE_SELF, getrusage

    n = 100
    cloth = dc.Cloth.grid(n, n, pins={"corners": [0, n - 1]})
    sim = dc.Simulator(dc.Scene([cloth]), 0.01)
    with threads(1), torch.no_grad():
        state = sim.step(sim.initial_state())
        faults = getrusage(RUSAGE_SELF).ru_minflt
        state = sim.step(state)
        faults = getrusage(RUSAGE_SELF).ru_minflt - faults
    of_one = 50e6 / 4096  # a factor of this mesh is larger
    assert state.report.counts["factorizations"] >= 3
    assert faults < 2.4 * of_one
