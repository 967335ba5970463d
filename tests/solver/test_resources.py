"""Reported times of a step, and its memory."""

import platform
import sys
import time
from pathlib import Path

import pytest
import torch
from processes import run_python

import diffcloth_torch as dc

ROOT = Path(__file__).resolve().parents[2]


def test_the_seconds_of_a_report_are_those_of_the_step():
    ball = dc.RigidBody.sphere(0.2, pose=[0.01, 0.02, -0.205, 1, 0, 0, 0])
    sim = dc.Simulator(dc.Scene([dc.Cloth.grid(32, 32)], [ball]), 0.01)
    state = sim.initial_state()
    untold = []
    with torch.no_grad():
        for _ in range(8):
            begin = time.perf_counter()
            state = sim.step(state)
            wall = time.perf_counter() - begin
            told = sum(state.report.seconds.values())
            assert told <= wall
            untold.append((wall - told) / wall)
    # The rest is Python around the core: about 1.5 of 50 ms and more.
    # The minimum over steps excludes other load of the machine.
    assert min(untold) < 0.06, untold


LARGE_ARRAYS = """
    import resource
    import torch
    from benchmarks.scenes import hanging
    import diffcloth_torch as dc

    def faults():
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

    torch.set_num_threads(1)
    scene = hanging(96)
    sim = dc.Simulator(scene.scene, 0.01)
    state = sim.initial_state()
    with torch.no_grad():
        state = sim.step(state)
        before = faults()
        state = sim.step(state)
    print(faults() - before)
"""


def _lends_huge_pages() -> bool:
    path = Path("/sys/kernel/mm/transparent_hugepage/enabled")
    return path.exists() and "[never]" not in path.read_text()


@pytest.mark.slow
@pytest.mark.skipif(not _lends_huge_pages(), reason="asks the system for huge pages")
def test_large_arrays_are_asked_of_the_system_in_huge_pages():
    # 1,000 faults; 28,000 with pages of 4 KiB, of which each matrix has 2,600.
    assert float(run_python(LARGE_ARRAYS, cwd=ROOT)) < 8000


SELF_CONTACT = """
    import ctypes
    import os
    import torch
    from benchmarks.scenes import self_contact
    import diffcloth_torch as dc

    def resident():
        # What is free in the heap is not left behind, though the C library may hold on to it.
        ctypes.CDLL(None).malloc_trim(0)
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    torch.set_num_threads(1)
    scene = self_contact(40)
    sim = dc.Simulator(scene.scene, 0.01)
    state = sim.initial_state()
    sizes = []
    with torch.no_grad():
        for _ in range(14):
            state = sim.step(state)
            sizes.append(resident())
    assert state.report.contact_count > 100
    print(max(sizes) - sizes[0])
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="asks glibc to give memory back")
def test_contacts_that_come_and_go_leave_little_in_memory():
    # Each new set of contacts is a new matrix pattern, whose analysis may be kept.
    assert float(run_python(SELF_CONTACT, cwd=ROOT)) < 60  # [MB]


# The peak of this process alone: `ru_maxrss` would include the peak of the parent process.
LARGE_SHEET = """
    import re
    from pathlib import Path
    import torch
    from benchmarks.scenes import hanging
    import diffcloth_torch as dc

    torch.set_num_threads(1)
    scene = hanging(200)
    sim = dc.Simulator(scene.scene, 0.01)
    state = sim.initial_state()
    with torch.no_grad():
        for _ in range(2):
            state = sim.step(state)
    assert state.report.counts["factorizations"] > 1
    status = Path("/proc/self/status").read_text()
    print(int(re.search(r"VmHWM:\\s+(\\d+) kB", status)[1]) / 1024)
"""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks /proc for the peak")
def test_a_large_sheet_takes_little_memory():
    # 284 of one factor, and 230 of torch.
    assert float(run_python(LARGE_SHEET, cwd=ROOT)) < 900  # [MiB]
