"""A step's report is made when it is read, with the fields of one that is made at once."""

from __future__ import annotations

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, fields, replace
from functools import partial

import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.sim.records.report import Report
from diffcloth_torch.sim.solve import outcome

SCENE = dc.Scene(
    [dc.Cloth.grid((4, 4), 0.3)], [dc.RigidBody.plane(2.0, pose=[0, 0, -0.004, 1, 0, 0, 0])]
)


def step(batch):
    sim = dc.Simulator(SCENE, 0.01)
    return sim.step(sim.initial_state(batch_size=batch))


def same(a, b):
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[name], b[name]) for name in a)
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


@pytest.mark.parametrize("batch", [None, 3])
def test_a_report_that_is_read_late_has_all_fields(batch, monkeypatch):
    made = []
    real = outcome.make_report

    def counting(*args, **keywords):
        made.append(real(*args, **keywords))
        return made[-1]

    monkeypatch.setattr(outcome, "make_report", counting)
    report = step(batch).report
    assert report.status == ("converged" if batch is None else ("converged",) * 3)
    assert not made
    for entry in fields(Report):
        assert same(getattr(report, entry.name), getattr(made[0], entry.name)), entry.name
    assert len(made) == 1
    assert "_make" not in vars(report)


@pytest.mark.parametrize(
    "use",
    [
        lambda report: pickle.loads(pickle.dumps(report)),
        copy.copy,
        copy.deepcopy,
        replace,
        lambda report: report.select(1),
    ],
)
def test_a_report_can_be_copied_before_it_is_read(use):
    report, again = step(2).report, step(2).report
    copied = use(report)
    assert type(copied) is Report
    assert int(torch.as_tensor(copied.contact_count).sum()) > 0
    assert repr(replace(again, seconds={}, cpu_seconds=None)).startswith("Report(")
    assert copied.counts.keys() == again.counts.keys() == asdict(again)["counts"].keys()


def test_the_first_reads_may_come_from_several_threads():
    for _ in range(20):
        report = step(None).report
        with ThreadPoolExecutor(4) as threads:
            found = list(threads.map(partial(getattr, report), ["iterations"] * 8))
        assert len(set(found)) == 1


def test_a_report_has_no_other_attributes():
    report = step(None).report
    with pytest.raises(AttributeError, match="'Report' object has no attribute 'iteration'"):
        report.iteration  # noqa: B018
    assert not hasattr(report, "__length_hint__")


def test_the_dictionary_of_a_report_is_complete():
    report = step(2).report
    assert vars(report).keys() == {entry.name for entry in fields(Report)}
    assert report.__dict__ is vars(report)
