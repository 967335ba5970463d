"""Long rollouts, many environment steps, large sheets, loaders: cost and memory stay bounded."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
import torch
from processes import run_python
from torch.utils.data import DataLoader, Dataset

import diffcloth_torch as dc

ROOT = Path(__file__).parents[1]
F64 = torch.float64


def hanging(cells=4):
    sheet = dc.Cloth.grid(cells, cells, size=0.3, pins={"edge": range(cells)})
    return dc.Simulator(dc.Scene([sheet]), 0.01)


def pulled(sim, steps, every):
    """Gradient of a rollout by a force that acts in all steps, and its processor time."""
    force = torch.full((16, 3), 1e-3, dtype=F64, requires_grad=True)
    begin = time.process_time()
    states = sim.rollout(
        sim.initial_state(), [dc.Control(forces=force)] * steps, checkpoint_every=every
    )
    states[-1].positions.sum().backward()
    return force.grad, time.process_time() - begin


@pytest.mark.slow
def test_a_step_of_a_long_rollout_costs_as_much_as_one_of_a_short_one():
    sim = hanging()
    pulled(sim, 20, 10)
    times = {steps: min(pulled(sim, steps, 50)[1] for _ in range(2)) for steps in (250, 2000)}
    # Measured 1.0; a cost proportional to the steps would be 8.
    assert times[2000] / 2000 < 2 * times[250] / 250
    torch.testing.assert_close(pulled(sim, 100, 7)[0], pulled(sim, 100, None)[0], rtol=0, atol=0)


class Rolls(Dataset):
    """Ends of rollouts and their gradients, computed in workers."""

    def __init__(self, sim):
        self.sim = sim

    def __len__(self):
        return 4

    def __getitem__(self, index):
        start = self.sim.initial_state()
        x = start.positions.clone().requires_grad_()
        end = self.sim.rollout(start.replace(positions=x), steps=index + 1)[-1]
        end.positions.square().sum().backward()
        return end.positions.detach(), x.grad


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.parametrize("count", [1, 2])
def test_workers_of_a_loader_return_the_bits_of_this_process(method, count):
    rolls = Rolls(hanging())
    expected = [rolls[k] for k in range(len(rolls))]
    loader = DataLoader(rolls, batch_size=None, num_workers=count, multiprocessing_context=method)
    for found, wanted in zip(loader, expected, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(found, wanted, strict=True))


def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.slow
def test_10000_environment_steps_with_gradients_leave_no_memory():
    env = dc.envs.make("HitCloth", num_envs=10, size=4, horizon=20, seed=0)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    actions = torch.zeros(env.action_space.shape, requires_grad=True)
    sizes, total = [], 0.0
    for k in range(1000):
        noise = 0.1 * torch.randn(actions.shape, generator=generator)
        _, reward, *_ = env.step(actions + noise)
        total = total + reward.sum()
        if k % 5 == 4:
            total.backward()
            env.clear_grad()
            total = 0.0
        if k in (499, 999):
            sizes.append(resident_bytes())
    assert torch.isfinite(actions.grad).all()
    # The cache of factors fills at first.
    assert sizes[1] - sizes[0] < 10e6


SHEET = """
    import re
    from pathlib import Path
    import torch
    from benchmarks.scenes import hanging
    import diffcloth_torch as dc

    torch.set_num_threads(1)
    sim = dc.Simulator(hanging(100).scene, 0.01)
    start = sim.initial_state()
    x = start.positions.clone().requires_grad_()
    states = sim.rollout(start.replace(positions=x), steps=5)
    states[-1].positions.square().sum().backward()
    assert x.grad.abs().max() > 0
    status = Path("/proc/self/status").read_text()
    print(int(re.search(r"VmHWM:\\s+(\\d+) kB", status)[1]) / 1024)
"""


@pytest.mark.slow
def test_a_sheet_of_100_by_100_with_gradients_has_a_stated_peak():
    peak = float(run_python(SHEET, cwd=ROOT))  # [MiB]
    assert peak < 1000
