"""Factors are kept for backward up to a number of bytes, and recomputed if evicted."""

import gc
import weakref

import pytest
import torch
from parallel_scenes import batch, simulator

import diffcloth_torch as dc
from diffcloth_torch import _core
from diffcloth_torch.autograd.core_function import as_array


def test_factors_are_kept_up_to_a_number_of_bytes():
    sim = dc.Simulator(dc.Scene([dc.Cloth.grid(30, 30)], gravity=(0, 0, 0)), 0.01)
    core, largest = sim._core, _core.Simulator.largest_factor_bytes
    state = sim.initial_state().replace(positions=sim.initial_state().positions.requires_grad_())
    kept, sizes = [], []
    while len(sizes) < 2 or sizes[-1] > sizes[-2]:
        kept.append(sim.step(state))
        sizes.append(core.factor_bytes)
        assert 0 < sizes[-1] <= largest
        assert len(sizes) < 1000
    # The cache was full and held as many factors as fit.
    assert sizes[-1] > largest - sizes[0] - 1
    core.forget_factors()
    assert core.factor_bytes == 0


def test_factors_go_with_the_graph_that_may_ask_for_them():
    sim, state = simulator(12), batch(12, 2)
    x = state.positions.clone().requires_grad_()
    for _ in range(3):
        after = sim.step(state.replace(positions=x))
        (after.positions**2).sum().backward()
        of_one_step = sim._core.factor_bytes
    assert of_one_step > 0
    kept = [sim.step(state.replace(positions=x)) for _ in range(2)]
    assert sim._core.factor_bytes == 3 * of_one_step
    del after, kept
    assert sim._core.factor_bytes == 0


def test_a_graph_may_outlive_its_simulator():
    sim = dc.Simulator(dc.Scene([dc.Cloth.grid(5, 5)]), 0.01)
    state = sim.initial_state()
    after = sim.step(state.replace(velocities=state.velocities.clone().requires_grad_()))
    assert sim._core.factor_bytes > 0
    del sim
    gc.collect()
    after.positions.sum().backward()


def test_kept_factors_may_outlive_the_core():
    sim = dc.Simulator(dc.Scene([dc.Cloth.grid(5, 5)]), 0.01)
    inputs, _ = sim._inputs(sim.initial_state(), None, None)
    arrays = {name: as_array(tensor) for name, tensor in inputs.items()}
    kept = sim._core.forward(arrays, True, 1)["kept"]
    assert sim._core.factor_bytes > 0
    simulator = weakref.ref(sim)  # the only one to hold the core
    del sim
    gc.collect()
    assert simulator() is None
    del kept  # returns its bytes to a cache that no longer exists


@pytest.mark.parametrize("scheme", ["coupled", "split"])
def test_factors_that_are_gone_change_no_bit(scheme):
    sim, state = simulator(12, scheme), batch(12, 2, scheme=scheme)
    x = state.positions.clone().requires_grad_()
    after = sim.step(state.replace(positions=x))
    loss = (after.positions**2).sum() + after.body_forces.sum()
    (kept,) = torch.autograd.grad(loss, x, retain_graph=True)
    sim._core.forget_factors()
    (made_again,) = torch.autograd.grad(loss, x)
    assert torch.equal(kept, made_again)


def test_contacts_that_come_and_go_seldom_cost_an_analysis():
    sim, state = simulator(16), batch(16, 2)
    counts = []
    for _ in range(3):
        state = sim.step(state)
        counts.append(state.report.counts)
    analyses, factorizations = (
        sum(int(c[name].sum()) for c in counts) for name in ("analyses", "factorizations")
    )
    assert factorizations > 100
    # 6 if patterns combine trial point and start; 63 for patterns of the trial point alone.
    assert analyses < 12
