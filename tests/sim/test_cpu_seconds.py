"""Processor time in reports, beside the time on the wall."""

import os
import pickle
import subprocess
import sys
import textwrap
import time

import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch import Report


def hanging(n=12, **options):
    sheet = dc.Cloth.grid(n, n, 0.4, pins={"edge": range(n)})
    return dc.Simulator(dc.Scene([sheet]), 0.01, **options)


def test_a_step_reports_processor_time():
    sim = hanging()
    begin = time.process_time()
    report = sim.step(sim.initial_state()).report
    spent = time.process_time() - begin
    assert 0.0 < report.cpu_seconds <= spent
    # Wall and processor clocks are read in turn; one thread works.
    assert report.cpu_seconds <= sum(report.seconds.values()) + 1e-3


def test_threads_that_share_factorizations_are_counted():
    threads = torch.get_num_threads()
    sim = hanging(70)
    state = sim.step(sim.initial_state())
    try:
        torch.set_num_threads(2)
        begin = time.process_time()
        report = sim.step(state).report
        spent = time.process_time() - begin
    finally:
        torch.set_num_threads(threads)
    # The rest is time in Python and of threads that wait for each other.
    assert 0.7 * spent < report.cpu_seconds <= spent


def test_a_batch_has_one_number_an_environment():
    sim = hanging(6)
    report = sim.step(sim.initial_state(3)).report
    assert report.cpu_seconds.shape == (3,)
    assert report.cpu_seconds.dtype == torch.float64
    assert (report.cpu_seconds > 0).all()
    assert report.select(1).cpu_seconds == float(report.cpu_seconds[1])
    stacked = Report.stack([report.select(i) for i in range(3)])
    assert torch.equal(stacked.cpu_seconds, report.cpu_seconds)
    chosen = Report.where(torch.tensor([True, False, True]), report, stacked)
    assert torch.equal(chosen.cpu_seconds, report.cpu_seconds)


@pytest.mark.parametrize("coupling", ["rigid_to_cloth", "cloth_to_rigid"])
def test_solves_of_a_staggered_coupling_add_up(coupling):
    sheet = dc.Cloth.grid(6, 6, 0.2, pins={"edge": range(6)})
    ball = dc.RigidBody.sphere(0.03, motion="dynamic", mass=0.01, pose=[0, 0, 0.04, 1, 0, 0, 0])
    sim = dc.Simulator(dc.Scene([sheet], [ball]), 0.01, coupling=coupling)
    report = sim.step(sim.initial_state()).report
    assert 0 < report.cpu_seconds <= sum(report.seconds.values()) + 1e-3


def test_processor_time_is_saved_and_shown(tmp_path):
    sim = hanging(5)
    state = sim.step(sim.initial_state())
    torch.save(state, tmp_path / "state.pt")
    loaded = torch.load(tmp_path / "state.pt", weights_only=True)
    assert loaded.report.cpu_seconds == state.report.cpu_seconds
    assert "cpu_seconds=" in repr(state.report)


@pytest.mark.parametrize("batch", [None, 2])
def test_reports_of_earlier_versions_have_none(batch):
    sim = hanging(4)
    report = sim.step(sim.initial_state(batch)).report
    old = {name: value for name, value in report.__dict__.items() if name != "cpu_seconds"}
    loaded = Report.__new__(Report)
    loaded.__setstate__(old)
    unknown = torch.as_tensor(loaded.cpu_seconds)
    assert unknown.isnan().all()
    assert unknown.shape == torch.as_tensor(report.residual).shape
    assert pickle.loads(pickle.dumps(loaded)).converged is not None


LOADED = """
    import os, torch
    import diffcloth_torch as dc

    torch.set_num_threads(1)
    sheet = dc.Cloth.grid(30, 30, 0.4, pins={"edge": range(30)})
    sim = dc.Simulator(dc.Scene([sheet]), 0.01)
    state, wall, processor = sim.initial_state(), 0.0, 0.0
    while processor < 0.3:
        state = sim.step(state)
        wall += sum(state.report.seconds.values())
        processor += state.report.cpu_seconds
    print(wall / processor)
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no affinity of processes here")
@pytest.mark.slow
def test_processor_time_does_not_count_other_processes():
    """On one processor with two others that are busy, the wall counts three times as much."""
    processor = max(os.sched_getaffinity(0))

    def start(code, **options):
        return subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(code)],
            preexec_fn=lambda: os.sched_setaffinity(0, {processor}),
            **options,
        )

    busy = [start("while True: pass") for _ in range(2)]
    try:
        found, _ = start(LOADED, stdout=subprocess.PIPE, text=True).communicate(timeout=120)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    # Schedulers are fair within a third, over a third of a second.
    assert float(found) > 2.0
