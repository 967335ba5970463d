"""Objects in a grip stay in place, with the default slip velocity."""

import importlib
import math
from pathlib import Path

import pytest
import torch

import diffcloth_torch as dc

ROOT = Path(__file__).resolve().parents[2]
MINUTE = 60.0


@pytest.mark.quick("box")
@pytest.mark.parametrize("what", ["box", "cloth"])
def test_a_held_object_creeps_by_less_than_a_tenth_of_a_millimeter_in_a_minute(what, monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    sticking = importlib.import_module("benchmarks.sticking")
    _, sunk, law = sticking.held(what, dc.ContactOptions().slip_velocity, MINUTE)
    assert abs(sunk) < 1e-4
    assert law < 1e-4


def test_a_box_creeps_by_the_law_at_the_default_tolerance():
    """The tolerance is a third of the creep: a solve also iterates until slip forces converge."""
    slope, mu, gap = 0.25, 0.5, 5e-4
    turn = [math.cos(slope / 2), 0.0, math.sin(slope / 2), 0.0]
    up = 0.02 + gap
    plane = dc.RigidBody.plane(4.0, pose=[0, 0, 0, *turn], friction=mu)
    box = dc.RigidBody.box(
        [0.08, 0.08, 0.04],
        motion="dynamic",
        mass=0.2,
        friction=mu,
        pose=[up * math.sin(slope), 0, up * math.cos(slope), *turn],
    )
    sim = dc.Simulator(
        dc.Scene([], [plane, box]), 0.01, contact=dc.ContactOptions(barrier_distance=2 * gap)
    )
    with torch.no_grad():
        end = sim.rollout(sim.initial_state(), steps=300)[-1]
    down = torch.tensor([math.cos(slope), 0.0, -math.sin(slope)], dtype=torch.float64)
    speed = float(end.body_velocities[1, :3] @ down)
    law = dc.ContactOptions().slip_velocity * (1 - math.sqrt(1 - math.tan(slope) / mu))
    # A solve may end where a step changes friction by 1e-3 of the largest: 2.4e-3 of this speed.
    assert speed == pytest.approx(law, rel=1e-3)
