"""Solvers of fits agree with least squares, on a problem without simulation."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch
from test_fit_features import VARIABLES, bits, residuals

import diffcloth_torch as dc

METHODS = {
    "L-BFGS-B": {"method": "L-BFGS-B", "max_evaluations": 200, "tolerance": 1e-12},
    "Adam": {"method": partial(torch.optim.Adam, lr=0.05), "max_evaluations": 500},
}


@pytest.mark.parametrize("name", METHODS)
def test_other_methods_end_at_the_same_place(name):
    expected = dc.fit(VARIABLES, residuals)
    found = dc.fit(VARIABLES, residuals, **METHODS[name])
    for key, value in expected.values.items():
        assert float(found.values[key]) == pytest.approx(float(value), rel=5e-3, abs=1e-3)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=5e-2, atol=1e-8)
    assert found.cost == pytest.approx(expected.cost, rel=1e-2)
    assert found.success
    assert ("500 steps of Adam" in found.message) == (name == "Adam")
    short = dc.fit(VARIABLES, residuals, **(METHODS[name] | {"max_evaluations": 3}))
    assert not short.success


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.ModelErrorWarning")
@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.CorrelatedResidualsWarning")
def test_methods_stay_within_bounds(name):
    """The best offset is near -.3."""
    free = VARIABLES | {"offset": dc.Variable(0.0, bounds=(-0.1, 1))}
    found = dc.fit(free, residuals, **METHODS[name])
    assert float(found.values["offset"]) == pytest.approx(-0.1)
    assert all(float(trial.values["offset"]) >= -0.1 for trial in found.history)


@pytest.mark.parametrize("name", METHODS)
def test_methods_resume_with_the_same_bits(name, tmp_path):
    options = METHODS[name] | {"max_evaluations": 12, "resume": tmp_path}
    count = 0

    def progress(trial):
        nonlocal count
        count += 1
        if count > 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        dc.fit(VARIABLES, residuals, progress=progress, **options)
    calls = []

    def counted(parameters, values):
        calls.append(1)
        return residuals(parameters, values)

    again = dc.fit(VARIABLES, counted, **options)
    assert calls
    whole = dc.fit(VARIABLES, residuals, **(options | {"resume": None}))
    assert bits(again) == bits(whole)


def fails_beyond(limit):
    def failing(parameters, values):
        if float(values["rate"].detach()) > limit:
            raise dc.NotConverged("step: of a test")
        return residuals(parameters, values)

    return failing


@pytest.mark.parametrize("name", METHODS)
def test_a_failure_is_a_rejected_trial_and_counted(name):
    """The best rate is 2; trial points beyond 2.05 fail."""
    quick = {"Adam": {"method": partial(torch.optim.Adam, lr=0.1), "max_evaluations": 40}}
    found = dc.fit(VARIABLES, fails_beyond(2.05), **(METHODS | quick)[name])
    assert found.failures > 0
    assert all(np.isinf(t.cost) == bool(t.failure) for t in found.history)
    assert np.isfinite(found.cost)
    assert found.cost < found.history[0].cost


def woven(twill):
    """Residuals of a twill stiffness that is valid for a material from 1.92e-4 on."""
    material = dc.Material(
        bending=4e-4, bending_weft=2e-4, bending_twill=twill, poisson=0.3, density=0.2
    )
    cloth = dc.Cloth.grid(6, 3, (0.1, 0.2), pins={"edge": range(6)}, material=material)
    sim = dc.Simulator(dc.Scene([cloth]), 0.02, contact=dc.ContactOptions(self_contact=False))
    start = sim.initial_state()

    def residuals(parameters):
        given = sim.default_parameters().replace(bending_twill=parameters.bending_twill)
        state = sim.step(start, parameters=given)
        return 10 * (parameters.bending_twill / 1.5e-4).log().reshape(1) + 0 * state.positions[0, 0]

    return residuals


@pytest.mark.parametrize("method", ["least_squares", "L-BFGS-B", partial(torch.optim.Adam, lr=0.2)])
def test_a_trial_step_beyond_all_materials_is_rejected(method):
    """Without bounds a trial may leave the valid range; the fit continues."""
    variables = {"bending_twill": dc.Variable(5e-4)}
    found = dc.fit(variables, woven(5e-4), method=method, max_evaluations=40)
    assert found.failures > 0
    failures = [trial.failure for trial in found.history if trial.failure]
    assert all("`bending_twill` must be at least" in failure for failure in failures)
    assert 1.92e-4 < float(found.values["bending_twill"]) < 2.5e-4


def test_first_values_of_no_material_are_refused():
    with pytest.raises(dc.InvalidInput, match="`bending_twill` must be at least"):
        dc.fit({"bending_twill": dc.Variable(1e-4)}, woven(5e-4))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"method": "adam"},
            dc.InvalidInput,
            "`method` must be one of 'least_squares'",
        ),
        ({"method": 3}, TypeError, "`method` must be a name or make an optimizer of torch"),
        ({"method": "L-BFGS-B", "loss": "huber"}, dc.InvalidInput, '`loss` must be "linear"'),
        ({"method": len}, TypeError, "must be an optimizer of torch or make one, got int"),
        ({"tolerance": 0.0}, dc.InvalidInput, "`tolerance` must be finite and > 0"),
        ({"loss_scale": -1.0}, dc.InvalidInput, "`loss_scale` must be finite and > 0"),
        ({"seed": -1}, dc.InvalidInput, "`seed` must be at least 0"),
    ],
)
def test_bad_arguments_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        dc.fit(VARIABLES, residuals, **options)
