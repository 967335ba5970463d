"""Reported uncertainties of fits, and failures that end a trial but not the fit."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.errors import InadmissibleMaterial

F64 = torch.float64
TIMES = torch.linspace(0.0, 1.0, 60, dtype=F64)
NOISE = 0.05


def decay(values, times=TIMES):
    return values["a"] * torch.exp(-values["b"] * times)


TRUTH = decay({"a": torch.tensor(2.0, dtype=F64), "b": torch.tensor(3.0, dtype=F64)})


def variables():
    return {"a": dc.Variable(1.5), "b": dc.Variable(2.0)}


def fit_to(seen, chosen=slice(None), **options):
    def residuals(parameters, values):
        return (decay(values) - seen)[chosen] / NOISE

    return dc.fit(variables(), residuals, **options)


@pytest.mark.quick("linear")
@pytest.mark.parametrize("loss", ["linear", "soft_l1", "huber", "cauchy", "arctan"])
def test_standard_errors_are_the_spread_of_fits_to_other_noise(loss):
    outliers = 0.0 if loss == "linear" else 0.1
    values, errors = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        noise = NOISE * rng.standard_normal(60)
        noise = np.where(rng.random(60) < outliers, 20 * noise, noise)
        found = fit_to(TRUTH + torch.from_numpy(noise), loss=loss, covariance="white")
        values.append([float(v) for v in found.values.values()])
        errors.append(np.sqrt(np.diag(found.covariance)))
    # The spread of 60 fits is known to a tenth.
    np.testing.assert_allclose(np.median(errors, axis=0), np.std(values, axis=0), rtol=0.3)


def test_residuals_that_show_no_noise_have_that_which_was_given():
    seen = TRUTH + NOISE * torch.from_numpy(np.random.default_rng(0).standard_normal(60))
    found = fit_to(seen, [0, 20])
    assert found.cost < 1e-10
    rows = torch.func.jacfwd(lambda x: decay({"a": x[0], "b": x[1]})[[0, 20]] / NOISE)
    J = rows(torch.stack([found.values["a"], found.values["b"]])).numpy()
    np.testing.assert_allclose(found.covariance, np.linalg.inv(J.T @ J), rtol=1e-4)
    fewer = fit_to(seen, [20])
    assert [len(d.shares) for d in fewer.unidentifiable] == [2]
    assert all(not math.isfinite(high - low) for low, high in fewer.intervals.values())


SHEET = dc.Cloth.grid(5, 5, 0.2)
AT_REST = dc.Simulator(dc.Scene([SHEET]), 0.01).initial_state()


def scaled(values):
    return [AT_REST.replace(positions=values["scale"] * AT_REST.positions)]


def test_a_marker_of_no_weight_was_not_seen():
    rng = np.random.default_rng(1)
    observed = 1.3 * AT_REST.positions.numpy() + 0.01 * rng.standard_normal((25, 3))
    kept = np.arange(25) % 8 == 0
    unseen = np.where(kept[:, None], observed, np.nan)

    def found(observed, weights):
        def residuals(parameters, values):
            return dc.residuals.markers(scaled(values), observed[None], weights, noise=0.01)

        return dc.fit({"scale": dc.Variable(1.0)}, residuals)

    some, others = found(observed, kept.astype(float)), found(unseen, None)
    assert len(some.residuals) == len(others.residuals) == 12
    assert some.intervals == others.intervals


def test_observations_may_be_tensors():
    observed = 1.3 * AT_REST.positions[None]

    def residuals(parameters, values):
        states, rows = scaled(values), torch.arange(25)
        one, noise = torch.ones(25), torch.tensor(0.01)
        seen = dc.residuals.markers(states, observed, one, vertices=rows, noise=noise)
        return [seen, dc.residuals.point_cloud(states, list(observed))]

    for method in ("least_squares", "L-BFGS-B"):
        found = dc.fit({"scale": dc.Variable(1.0)}, residuals, method=method)
        assert float(found.values["scale"]) == pytest.approx(1.3, abs=1e-6)

    def differentiated(parameters, values):
        return dc.residuals.markers(scaled(values), values["scale"] * observed)

    with pytest.raises(dc.InvalidInput, match="`observed` must not require a gradient"):
        dc.fit({"scale": dc.Variable(1.0)}, differentiated)


def test_a_torch_optimizer_goes_back_from_any_failure_and_resumes_with_the_same_bits(tmp_path):
    rates = []

    def too_large(parameters, values):
        rates.append(float(values["b"].detach()))
        if rates[-1] > 3.1:
            raise InadmissibleMaterial("b belongs to no material")
        return (decay(values) - TRUTH) / NOISE

    adam = partial(torch.optim.Adam, lr=0.2)
    options = {"method": adam, "max_evaluations": 20, "resume": tmp_path}
    first = dc.fit(variables(), too_large, **options)
    assert max(rates) > 3.1
    assert first.failures > 0
    assert float(first.values["b"]) == pytest.approx(3.0, abs=0.15)
    count = len(rates)
    again = dc.fit(variables(), too_large, **options)
    assert len(rates) == count + 1  # the kept point is tried once
    assert again.message == first.message
    assert [t.cost for t in again.history] == [t.cost for t in first.history]
    assert {n: v.tolist() for n, v in again.values.items()} == {
        n: v.tolist() for n, v in first.values.items()
    }


def test_a_trajectory_that_is_kept_out_and_fails_is_infinitely_wrong():
    def fails(parameters, values):
        raise dc.NotConverged("never")

    def empty(parameters, values):
        return [decay(values)[:0]]

    residuals = fit_to(TRUTH).compared[0]
    assert dc.fit(variables(), residuals, hold_out=fails).held_out == [math.inf]
    with pytest.raises(dc.InvalidInput, match=r"`hold_out` must return numbers, trajectory 0 has"):
        dc.fit(variables(), residuals, hold_out=empty)


def test_a_report_begins_at_the_first_start_that_could_be_simulated(tmp_path):
    def fails_at_first(parameters, values):
        if float(values["b"].detach()) == pytest.approx(2.0):
            raise dc.NotConverged("only there")
        return (decay(values) - TRUTH) / NOISE

    found = dc.fit(variables(), fails_at_first, starts=3)
    assert not math.isfinite(found.starts[0].cost)
    found.report(tmp_path / "fit.html")
    assert (tmp_path / "fit.html").stat().st_size > 0


@pytest.mark.parametrize("first", [1e-4, 1e-3])
@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.ModelErrorWarning")
@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.CorrelatedResidualsWarning")
def test_a_number_that_ends_at_a_bound_is_named(first):
    residuals = fit_to(TRUTH).compared[0]
    given = {"a": dc.Variable(2.0, bounds=(2.0, 9.0)), "b": dc.Variable(first, scale="log")}
    with pytest.warns(UserWarning, match="b ended a factor of 1000 from where it began"):
        found = dc.fit(given, residuals)
    assert float(found.values["b"]) == pytest.approx(1000 * first)
    assert "b" in found.at_bounds
    assert "b is at its bound" in found.message


def test_nothing_is_said_of_numbers_between_their_bounds(recwarn):
    found = fit_to(TRUTH)
    assert found.at_bounds == []
    assert not [w for w in recwarn if "factor of 1000" in str(w.message)]


def test_random_starts_lie_between_the_bounds():
    given = {
        "a": dc.Variable(1.0, bounds=(0.9, 1.05), scale="log", spread=100.0),
        "b": dc.Variable(2.0, bounds=(1.5, 2.5)),
    }
    found = dc.fit(given, fit_to(TRUTH).compared[0], starts=20, max_evaluations=1)
    for name, (low, high) in (("a", (0.9, 1.05)), ("b", (1.5, 2.5))):
        firsts = [float(start.first[name]) for start in found.starts[1:]]
        assert low < min(firsts) < max(firsts) < high
        assert max(firsts) - min(firsts) > 0.5 * (high - low)


@pytest.mark.parametrize(("bounds", "is_known"), [((-1e3, 1e3), True), ((-1.0, 1.0), False)])
def test_a_number_is_unknown_whose_error_is_half_its_range(bounds, is_known):
    """A single observation of the number 0 with a standard error of 2."""
    given = {"shift": dc.Variable(0.0, bounds=bounds)}
    found = dc.fit(given, lambda parameters, values: values["shift"].reshape(1) / 2)
    assert found.covariance[0, 0] == pytest.approx(4.0)
    assert bool(found.unidentifiable) is not is_known


def test_threads_and_priors_outside_a_range_are_refused():
    residuals = fit_to(TRUTH).compared[0]
    with (
        ThreadPoolExecutor(2) as threads,
        pytest.raises(dc.InvalidInput, match="`workers` must be processes"),
    ):
        dc.fit(variables(), residuals, workers=threads)
    negative = {"friction": dc.Variable(0.4, scale="linear", prior=(-3.0, 0.1))}
    with pytest.raises(dc.InvalidInput, match="the mean of `prior` must be"):
        dc.fit(negative, lambda p: p.friction.reshape(1))
