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
def test_bad_priors_are_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_a_prior_of_two_variables_is_that_of_bayes():
    """Mean and covariance in closed form; one of the numbers is searched on the scale "log"."""
    covariance = np.array([[0.04, 0.018], [0.018, 0.01]])
    free = {"slope": dc.Variable(0.0), "shift": dc.Variable(0.0)}
    prior = dc.Prior({"shift": -0.5, "slope": 1.0}, covariance)
    found = dc.fit(free, linear, priors=[prior])
    rows = DESIGN / 0.2
    precision = np.linalg.inv(covariance[::-1, ::-1])
    normal = rows.T @ rows + precision
    mean = np.linalg.solve(normal, rows.T @ (SEEN / 0.2) + precision @ [1.0, -0.5])
    np.testing.assert_allclose([float(v) for v in found.values.values()], mean, rtol=1e-7)
    assert len(found.residuals) == 12
    noise = float(found.residuals @ found.residuals) / 10
    expected = np.linalg.inv(rows.T @ rows / noise + precision)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-6)
    apart = [float(found.values["slope"]) - 1.0, float(found.values["shift"]) + 0.5]
    square = float(found.residuals @ found.residuals) + apart @ precision @ apart
    assert found.cost == pytest.approx(0.5 * square)


def test_starts_are_drawn_from_a_prior_of_two_variables():
    covariance = np.array([[0.09, 0.05], [0.05, 0.04]])
    free = {"slope": dc.Variable(1.0, scale="log"), "shift": dc.Variable(0.0)}
    prior = dc.Prior({"slope": 2.0, "shift": 1.0}, covariance)
    found = dc.fit(free, linear, priors=[prior], starts=300, max_evaluations=1)
    drawn = [[np.log(float(s.first["slope"])), float(s.first["shift"])] for s in found.starts[1:]]
    np.testing.assert_allclose(np.mean(drawn, axis=0), [np.log(2.0), 1.0], atol=0.05)
    np.testing.assert_allclose(np.cov(np.transpose(drawn)), covariance, atol=0.015)


def test_a_tie_follows_its_variable():
    """A line through the origin, whose shift is a multiple of its slope."""
    tied = {"slope": dc.Variable(0.0), "shift": dc.Tie("slope", -0.3)}
    found = dc.fit(tied, linear)
    assert found.names == ["slope"]
    assert float(found.values["shift"]) == pytest.approx(-0.3 * float(found.values["slope"]))
    line = DESIGN @ [1.0, -0.3]
    assert float(found.values["slope"]) == pytest.approx(line @ SEEN / (line @ line))
    curved = dc.fit(tied | {"shift": dc.Tie("slope", lambda x: -0.45 * torch.tanh(x))}, linear)
    expected = -0.45 * np.tanh(float(curved.values["slope"]))
    assert float(curved.values["shift"]) == pytest.approx(expected)


TWO = {"slope": dc.Variable(0.0, prior=(1.0, 0.1)), "shift": dc.Variable(0.0)}


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: dc.Prior({}, np.eye(1)), TypeError, "`means` must be a dict"),
        (lambda: dc.Prior({"a": 1.0}, np.eye(2)), dc.InvalidInput, r"must have shape \[1, 1\]"),
        (
            lambda: dc.Prior({"a": [1.0, 2.0]}, [[1.0, 0.5], [0.2, 1.0]]),
            dc.InvalidInput,
            "must be symmetric",
        ),
        (
            lambda: dc.Prior({"a": [1.0, 2.0]}, [[1.0, 2.0], [2.0, 1.0]]),
            dc.InvalidInput,
            "must be positive definite",
        ),
        (
            lambda: dc.fit(TWO, linear, priors=[dc.Prior({"drag": 1.0}, [[1.0]])]),
            dc.InvalidInput,
            r"priors\[0\] may name slope, shift, which are free; got 'drag'",
        ),
        (
            lambda: dc.fit(TWO, linear, priors=[dc.Prior({"slope": 1.0}, [[1.0]])]),
            dc.InvalidInput,
            r"priors\[0\] names 'slope', which has a prior already",
        ),
        (lambda: dc.fit(TWO, linear, priors=3), TypeError, "`priors` must be a list"),
        (lambda: dc.fit(TWO, linear, priors=[3]), TypeError, r"priors\[0\] must be a Prior"),
        (lambda: dc.Tie(3), TypeError, "`of` must be a name"),
        (lambda: dc.Tie("slope", np.inf), dc.InvalidInput, "`by` must be finite"),
        (
            lambda: dc.fit({"slope": dc.Variable(1.0), "shift": dc.Tie("drag")}, linear),
            dc.InvalidInput,
            r"variables\['shift'\].of may name slope; got 'drag'",
        ),
    ],
)
def test_bad_priors_and_ties_are_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()
