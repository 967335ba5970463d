"""Priors of fits: against the formula of linear regression, and refused priors."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

RNG = np.random.default_rng(3)
DESIGN = RNG.standard_normal((12, 2))
SEEN = DESIGN @ [1.3, -0.4] + 0.2 * RNG.standard_normal(12)


def linear(parameters, values):
    theta = torch.stack([values["slope"], values["shift"]])
    return (torch.from_numpy(DESIGN) @ theta - torch.from_numpy(SEEN)) / 0.2


def test_a_linear_fit_is_that_of_bayes():
    """Mean and covariance in closed form, with the noise that the residuals show."""
    free = {"slope": dc.Variable(0.0, prior=(1.0, 0.05)), "shift": dc.Variable(0.0)}
    found = dc.fit(free, linear)
    rows = DESIGN / 0.2
    precision = np.diag([1 / 0.05**2, 0.0])
    mean = np.linalg.solve(rows.T @ rows + precision, rows.T @ (SEEN / 0.2) + precision @ [1, 0])
    np.testing.assert_allclose([float(v) for v in found.values.values()], mean, rtol=1e-7)
    assert len(found.residuals) == 12
    noise = float(found.residuals @ found.residuals) / 10
    expected = np.linalg.inv(rows.T @ rows / noise + precision)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-6)
    priors = ((float(found.values["slope"]) - 1) / 0.05) ** 2
    assert found.cost == pytest.approx(
        0.5 * float(found.residuals @ found.residuals) + 0.5 * priors
    )


def product(parameters, values):
    return ((values["a"] * values["b"] - 6.0) / 0.1).reshape(1)


def test_a_prior_decides_where_observations_do_not():
    """One observation determines a b = 6; the prior of a, on the scale "log", determines a."""
    free = {
        "a": dc.Variable(1.0, scale="log", prior=(2.0, 0.1)),
        "b": dc.Variable(1.0, scale="log"),
    }
    found = dc.fit(free, product)
    assert float(found.values["a"]) == pytest.approx(2.0, rel=1e-6)
    assert float(found.values["b"]) == pytest.approx(3.0, rel=1e-6)
    low, high = found.intervals["a"]
    assert low == pytest.approx(2 * np.exp(-0.196), rel=1e-3)
    assert high == pytest.approx(2 * np.exp(0.196), rel=1e-3)
    assert len(found.unidentifiable) == 1, "what the observations do not tell, is said all the same"


def test_starts_are_drawn_from_priors():
    free = {
        "slope": dc.Variable(0.0, prior=(5.0, 0.5), bounds=(-10, 5.5)),
        "shift": dc.Variable(2.0, scale="log", prior=(3.0, 0.2)),
    }
    found = dc.fit(free, linear, starts=200, max_evaluations=1)
    slopes, shifts = (
        np.array([float(s.first[name]) for s in found.starts[1:]]) for name in ("slope", "shift")
    )
    assert abs(np.median(slopes) - 5.0) < 0.15
    assert slopes.max() <= 5.5
    assert abs(np.log(shifts / 3).mean()) < 0.06
    assert abs(np.log(shifts / 3).std() - 0.2) < 0.04


def test_other_priors_are_another_fit(tmp_path):
    free = {"slope": dc.Variable(0.0, prior=(1.0, 0.1)), "shift": dc.Variable(0.0)}
    dc.fit(free, linear, resume=tmp_path)
    free["slope"] = dc.Variable(0.0, prior=(1.0, 0.2))
    with pytest.raises(dc.InvalidInput, match="belongs to other variables or options"):
        dc.fit(free, linear, resume=tmp_path)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: dc.Variable(1.0, prior=1.0), dc.InvalidInput, r"must be \(mean, deviation\)"),
        (lambda: dc.Variable(1.0, prior=(1.0, 0.0)), dc.InvalidInput, "deviation of `prior` must"),
        (lambda: dc.Variable(1.0, prior=(np.nan, 1.0)), dc.InvalidInput, "mean of `prior` must"),
        (
            lambda: dc.Variable([1.0, 2.0], prior=([1.0, 2.0, 3.0], 1.0)),
            dc.InvalidInput,
            r"mean of `prior` must have shape \[\] or \[2\]",
        ),
        (
            lambda: dc.Variable(1.0, bounds=(0, 2), prior=(3.0, 1.0)),
            dc.InvalidInput,
            "mean of `prior` must be between its bounds 0 and 2, got 3",
        ),
        (
            lambda: dc.fit({"stretch": dc.Variable(1.0, prior=(-1.0, 1.0))}, lambda p: p.stretch),
            dc.InvalidInput,
            r"variables\['stretch'\], the mean of `prior`, must be positive",
        ),
    ],
)
def test_bad_priors(call, error, message):
    with pytest.raises(error, match=message):
        call()
