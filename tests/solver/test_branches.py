"""Continuity of a step: starts with tiny differences end in the same minimum.

A step of a sheet that buckles on a sphere has several minima. Each of these scenes has states from
which half of the starts once ended in another minimum; one in twenty still may.
"""

import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NEAR = (1e-9, 1e-7)  # [m]

pytestmark = pytest.mark.rounding


@pytest.fixture
def branches(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    return importlib.import_module("benchmarks.branches")


@pytest.mark.quick("thrown-16-3")
@pytest.mark.parametrize(
    ("scene", "size", "states"), [("thrown", 15, 8), ("thrown-1e-9", 16, 3), ("thrown", 16, 3)]
)
def test_starts_beside_each_other_end_beside_each_other(branches, scene, size, states):
    count = branches.count_jumps(scene, size, states, 8, NEAR)
    assert count.failed == 0
    assert count.jumps <= count.starts // 20
    assert count.growth < 20
