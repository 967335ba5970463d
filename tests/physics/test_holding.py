"""What a grip holds stays there, with the default slip velocity."""

import importlib
from pathlib import Path

import pytest

import diffcloth_torch as dc

ROOT = Path(__file__).resolve().parents[2]
MINUTE = 60.0


@pytest.mark.parametrize("what", ["box", "cloth"])
def test_it_moves_by_less_than_a_tenth_of_a_millimeter_in_a_minute(what, monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    sticking = importlib.import_module("benchmarks.sticking")
    _, sunk, law = sticking.held(what, dc.ContactOptions().slip_velocity, MINUTE)
    assert abs(sunk) < 1e-4
    assert law < 1e-4
