"""After a fit: predictions with bands, information of a next recording, and the repr."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

RNG = np.random.default_rng(7)
DESIGN = RNG.standard_normal((40, 2))
SEEN = torch.from_numpy(DESIGN @ [1.5, 0.7] + 0.1 * RNG.standard_normal(40))
FREE = {"x": dc.Variable([1.0, 1.0])}


def linear(parameters, values):
    return (torch.from_numpy(DESIGN) @ values["x"] - SEEN) / 0.1


@pytest.fixture(scope="module")
def found():
    return dc.fit(FREE, linear)


def test_a_prediction_has_the_band_of_linear_regression(found):
    rows = torch.tensor([[1.0, 2.0], [0.0, 1.0], [3.0, -1.0]], dtype=torch.float64)
    predicted = found.predict(lambda p, v: (rows @ v["x"]).reshape(3, 1))
    expected = (rows @ found.values["x"]).reshape(3, 1)
    torch.testing.assert_close(predicted.value, expected)
    reach = (found.intervals["x[1]"][1] - float(found.values["x"][1])) / found.covariance[
        1, 1
    ] ** 0.5
    errors = np.sqrt(np.diag(rows.numpy() @ found.covariance @ rows.numpy().T))
    np.testing.assert_allclose(predicted.half_width[:, 0], reach * errors, rtol=1e-6)
    torch.testing.assert_close(predicted.high - predicted.low, 2 * predicted.half_width)


def test_bands_are_those_of_numbers_on_a_logarithmic_scale():
    free = {"a": dc.Variable(1.0, scale="log")}
    noise = torch.from_numpy(0.01 * RNG.standard_normal(30))
    found = dc.fit(free, lambda p, v: (v["a"] - 2.0 - noise) / 0.01)
    predicted = found.predict(lambda p, v: v["a"] ** 2)
    low, high = found.intervals["a"]
    assert float(predicted.low) == pytest.approx(low**2, rel=1e-3)
    assert float(predicted.high) == pytest.approx(high**2, rel=1e-3)


def test_information_is_the_width_of_the_fit_with_the_recording(found):
    more = torch.from_numpy(RNG.standard_normal((15, 2)))
    expected = found.information(lambda p, v: more @ v["x"] / 0.1)
    noise = float(found.residuals @ found.residuals) / 38
    rows = DESIGN / 0.1
    covariance = np.linalg.inv(rows.T @ rows / noise + 100 * (more.T @ more).numpy())
    now = [(high - low) / 2 for low, high in found.intervals.values()]
    reach = now / np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(
        list(expected.values()), reach * np.sqrt(np.diag(covariance)), rtol=1e-6
    )
    assert all(width < before for width, before in zip(expected.values(), now, strict=True))


def test_a_recording_determines_unknown_variables():
    found = dc.fit({"x": dc.Variable([1.0, 2.0])}, lambda p, v: v["x"].sum()[None] - 3 + SEEN[:9])
    assert len(found.unidentifiable) == 1
    expected = found.information(lambda p, v: (v["x"][0] - v["x"][1])[None] / 0.2)
    assert all(width < 1.0 for width in expected.values())
    with pytest.raises(dc.InvalidInput, match="must determine every number"):
        dc.fit(
            {"stretch": dc.Variable(1.0), "bending": dc.Variable(1.0)},
            lambda p: torch.stack([p.stretch - 1.0, p.stretch - 1.1, p.stretch - 0.9]),
        ).predict(lambda p: p.bending)


def test_a_fit_without_noise_predicts_without_a_band():
    free = {"x": dc.Variable(1.0)}
    found = dc.fit(free, lambda p, v: (v["x"] - 2.0) * torch.ones(3, dtype=torch.float64))
    assert float(found.predict(lambda p, v: 3 * v["x"]).half_width) < 1e-9
    assert found.information(lambda p, v: v["x"][None])["x"] < 1e-9


def test_a_fit_prints_its_numbers_and_no_residuals(found):
    text = repr(found)
    assert text.startswith("Fit: rms ")
    assert "x[1] 0.68957, between" in text
    assert len(text.splitlines()) == 3
    many = dc.fit(
        {"x": dc.Variable(np.ones(50))},
        lambda p, v: torch.cat([v["x"], v["x"] - 1.0]) / 10,
        covariance="white",
    )
    assert "and 30 more" in repr(many)
    assert len(repr(many).splitlines()) == 22


@pytest.mark.parametrize("name", ["predict", "information"])
def test_objects_that_are_no_functions_are_refused(found, name):
    with pytest.raises(TypeError, match=f"Fit.{name}: `.*` must be a function, got float"):
        getattr(found, name)(1.0)
    with pytest.raises(TypeError, match="must return a tensor"):
        getattr(found, name)(lambda p, v: 1.0)
