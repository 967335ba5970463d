"""Intervals of fits: sizes of residuals beside their noise, correlated noise, collinear numbers."""

from __future__ import annotations

import warnings
from collections import Counter

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.optimize.compared import Comparison
from diffcloth_torch.optimize.series import autocorrelation, layout_of, walk

F64 = torch.float64
COUNT, NOISE = 60, 0.05
TIMES = torch.linspace(0.0, 1.0, COUNT, dtype=F64)
TRUTH = {"a": 2.0, "b": 3.0}
CLEAN = 2.0 * torch.exp(-3.0 * TIMES)


def variables():
    return {"a": dc.Variable(1.5), "b": dc.Variable(2.0)}


def fit_to(noise, scale=NOISE, shape=(COUNT,), **options):
    """Fit a decay to observations with errors `noise`, in standard deviations of .05."""
    seen = CLEAN.reshape(-1, *[1] * (len(shape) - 1)) + NOISE * torch.as_tensor(noise)

    def residuals(parameters, values):
        decay = values["a"] * torch.exp(-values["b"] * TIMES)
        return (decay.reshape(-1, *[1] * (len(shape) - 1)) - seen) / scale

    return dc.fit(variables(), residuals, **options)


def white(seed, shape=(COUNT,)):
    return np.random.default_rng(seed).standard_normal(shape)


def walking(seed, shape=(COUNT,)):
    return 0.5 * white(seed, shape).cumsum(axis=0)


@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.ModelErrorWarning")
@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.CorrelatedResidualsWarning")
def test_a_block_without_successive_moments_counts_as_white_noise_beside_walks():
    """A measurement of one number at one moment narrows its interval."""

    def fitted(**others):
        def residuals(parameters, values):
            decay = values["a"] * torch.exp(-values["b"] * TIMES)
            blocks = {"decay": (decay - CLEAN - NOISE * torch.as_tensor(walking(1))) / NOISE}
            single = {
                n: (values["a"] - TRUTH["a"] + e).reshape(1, -1) / NOISE for n, e in others.items()
            }
            return blocks | single

        return dc.fit(variables(), residuals, covariance="robust")

    alone = fitted()
    both = fitted(single=1e-3 * torch.tensor([1.0, -2.0, 1.0]))
    assert alone.noise_model == both.noise_model == "random walks"
    for low, high in both.intervals.values():
        assert np.isfinite([low, high]).all()
    widths = [np.ptp(found.intervals["a"]) for found in (both, alone)]
    assert 0 < widths[0] < widths[1]


def inside(found):
    ends = found.intervals
    return {name: ends[name][0] < true < ends[name][1] for name, true in TRUTH.items()}


def test_sizes_of_residuals_beside_their_noise():
    from scipy.stats import chi2

    found = fit_to(white(0))
    (block,) = found.blocks.values()
    square = float(found.residuals @ found.residuals)
    assert found.rms == pytest.approx((square / COUNT) ** 0.5)
    assert found.chi2 == {"residuals": pytest.approx(square)}
    assert block.count == COUNT
    assert block.freedom == pytest.approx(COUNT - 2)
    assert block.p_value == pytest.approx(chi2.sf(square, COUNT - 2))
    assert found.noise_model == "white noise"


@pytest.mark.parametrize(
    ("scale", "category", "message"),
    [
        (NOISE / 2, dc.ModelErrorWarning, "'residuals' have a root mean square of 1.8.*wrong"),
        (NOISE * 2, dc.NoiseWarning, "the noise is smaller than given"),
    ],
)
def test_residuals_of_another_size_than_their_noise_are_told(scale, category, message):
    with pytest.warns(category, match=message):
        fit_to(white(0), scale)


def test_blocks_have_names_and_warnings_name_them():
    seen = 2.0 + NOISE * torch.from_numpy(white(1, (30, 2)))

    def residuals(parameters, values):
        return {
            "good": (values["a"] - seen[:, 0]) / NOISE,
            "bad": 3 * (values["a"] - seen[:, 1]) / NOISE,
        }

    with pytest.warns(dc.ModelErrorWarning, match="of 'bad' have"):
        found = dc.fit({"a": dc.Variable(1.0)}, residuals)
    assert list(found.blocks) == ["good", "bad"]
    assert found.blocks["good"].p_value > 0.01
    assert found.chi2["bad"] == pytest.approx(float(found.residuals[30:] @ found.residuals[30:]))


def test_nothing_is_said_of_noise_that_was_not_given():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = fit_to(white(0), scale=10.0)
        robust = fit_to(white(0), loss="huber")
    assert np.isnan(found.blocks["residuals"].p_value)
    assert np.isnan(robust.blocks["residuals"].p_value)


def counted(draw, seeds, **options):
    """Intervals that hold the truth, and warnings, over fits to other noise."""
    hits, said = Counter(), Counter()
    for seed in seeds:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            hits.update(inside(fit_to(draw(seed), **options)))
        said.update(w.category for w in caught)
    return hits, said


@pytest.mark.slow
def test_white_noise_leaves_the_truth_inside_as_often_as_said():
    """95 % within 3 points, of 200 fits; their share has a standard error of 1.5 points."""
    hits, said = counted(white, range(200))
    assert all(0.92 <= hits[name] / 200 <= 0.98 for name in TRUTH), hits
    assert said[dc.CorrelatedResidualsWarning] <= 5
    assert said[dc.ModelErrorWarning] + said[dc.NoiseWarning] <= 2


@pytest.mark.slow
def test_a_random_walk_leaves_the_truth_inside():
    """White intervals hold the truth in a third of the fits; measured over 200: 93 and 87 %."""
    hits, said = counted(walking, range(200))
    assert all(hits[name] / 200 >= 0.85 for name in TRUTH), hits
    assert said[dc.CorrelatedResidualsWarning] == 200
    with_white, _ = counted(walking, range(40), covariance="white")
    assert all(with_white[name] / 40 < 0.6 for name in TRUTH), with_white


@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.ModelErrorWarning")
def test_a_random_walk_is_found_and_told():
    with pytest.warns(dc.CorrelatedResidualsWarning, match="that of random walks"):
        found = fit_to(0.4 * walking(3))
    plain = fit_to(0.4 * walking(3), covariance="white")
    assert found.noise_model == "random walks"
    assert plain.noise_model == "white noise"
    assert (np.diag(found.covariance) > 2 * np.diag(plain.covariance)).all()
    assert float(found.values["a"]) == float(plain.values["a"])


def test_stretches_widen_intervals_and_are_the_spread_of_white_noise():
    """Noise that repeats in pairs doubles the variances (20 series of 60 moments)."""
    noise = np.repeat(white(5, (COUNT // 2, 20)), 2, axis=0)
    with pytest.warns(dc.CorrelatedResidualsWarning, match="that of correlated stretches"):
        found = fit_to(noise, shape=noise.shape)
    plain = fit_to(noise, shape=noise.shape, covariance="white")
    ratio = np.diag(found.covariance) / np.diag(plain.covariance)
    np.testing.assert_allclose(ratio, 1.9, rtol=0.3)
    same = fit_to(white(6, noise.shape), shape=noise.shape, covariance="robust")
    independent = fit_to(white(6, noise.shape), shape=noise.shape, covariance="white")
    assert same.noise_model == "correlated stretches"
    ratio = np.diag(same.covariance) / np.diag(independent.covariance)
    np.testing.assert_allclose(ratio, 1.0, rtol=0.2)


def test_a_walk_has_the_covariance_of_its_increments():
    """U^T C U against the matrix C = w min(s, t) + n, with a gap in one of the series."""
    rng = np.random.default_rng(2)
    layout = layout_of({"x": torch.zeros(400, 30)}, [])
    noise = 0.3 * rng.standard_normal((400, 30)).cumsum(0) + 0.2 * rng.standard_normal((400, 30))
    seen = rng.random(noise.size) > 0.2
    part = type(layout)(layout.names, layout.block[seen], layout.series[seen], layout.time[seen])
    directions = np.linalg.qr(rng.standard_normal((int(seen.sum()), 2)))[0]
    found = walk(noise.reshape(-1)[seen], part, directions)
    expected = np.zeros((2, 2))
    for series in range(30):
        rows = np.flatnonzero(part.series == series)
        t = part.time[rows] + 1.0
        C = 0.09 * np.minimum(t[:, None], t) + 0.04 * np.eye(len(rows))
        expected += directions[rows].T @ C @ directions[rows]
    np.testing.assert_allclose(found, expected, rtol=0.1, atol=0.05 * expected.max())


def test_series_of_markers_are_those_of_their_coordinates():
    """Series of 5 moments, 2 markers and 3 coordinates, with a marker that is missing twice."""
    used = np.ones((5, 2, 3), dtype=bool)
    used[1:3, 0] = False
    points = list(np.zeros((5, 2, 3)))
    compared = Comparison("markers", np.arange(5.0), points, points, points, [], 1.0, used)
    layout = layout_of({"x": torch.zeros(24)}, [compared])
    steady = np.broadcast_to(np.arange(6.0), (5, 6)).reshape(5, 2, 3)[used]
    np.testing.assert_array_equal(layout.series, steady)
    assert len(layout.pairs(1)[0]) == 3 * 4 + 3 * 1
    assert autocorrelation(steady + 1, layout)[0] == pytest.approx(1.0)
    flat = layout_of({"x": torch.zeros(24)}, [])
    assert set(flat.series) == {0}


def test_nearly_collinear_numbers_are_named():
    """Slip of a grip determines friction times squeeze; other data determine each weakly."""
    rng = np.random.default_rng(4)
    slip = torch.from_numpy(0.01 * rng.standard_normal(20))
    free = {"friction": dc.Variable(0.3), "squeeze": dc.Variable(2.0, scale="log")}

    def residuals(parameters, values):
        product = parameters.friction * values["squeeze"]
        each = torch.stack([parameters.friction / 0.4, values["squeeze"] / 2.5]) - 1
        return torch.cat([(product - 1.0 + slip) / 0.01, each / 0.3])

    found = dc.fit(free, residuals)
    assert found.unidentifiable == []
    assert {pair.name: pair.other for pair in found.collinear} == {
        "friction": "squeeze",
        "squeeze": "friction",
    }
    pair = found.collinear[0]
    assert pair.correlation < -0.99
    assert pair.standard_error == pytest.approx(0.3 / 2**0.5, rel=0.3)
    assert pair.error_if_known < 0.01
    text = f"if all other numbers were known; its largest correlation is -1.000, with {pair.other}"
    assert text in str(pair)
    known = dc.fit(free | {"squeeze": dc.Variable(2.5, free=False)}, residuals)
    assert known.collinear == []


@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.ModelErrorWarning")
@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.CorrelatedResidualsWarning")
def test_correlated_noise_makes_no_number_collinear():
    """The error with known others has the covariance of the fit: one number has no others."""
    noise = torch.from_numpy(np.random.default_rng(5).standard_normal(400).cumsum())
    found = dc.fit({"a": dc.Variable(1.0)}, lambda p, v: v["a"] - noise, covariance="robust")
    plain = dc.fit({"a": dc.Variable(1.0)}, lambda p, v: v["a"] - noise, covariance="white")
    assert found.noise_model == "random walks"
    assert found.covariance[0, 0] > 100 * plain.covariance[0, 0]
    assert found.collinear == []


def test_another_covariance_is_refused():
    with pytest.raises(dc.InvalidInput, match="`covariance` must be"):
        fit_to(white(0), covariance="blocks")


def test_the_profile_of_a_linear_model_is_its_interval():
    rng = np.random.default_rng(8)
    design = torch.from_numpy(rng.standard_normal((30, 3)))
    noise = torch.from_numpy(rng.standard_normal(30))
    free = {"x": dc.Variable([0.0, 0.0, 0.0])}
    found = dc.fit(free, lambda p, v: design @ (v["x"] - 1.0) - noise)
    profile = found.profile("x[1]")
    assert profile.interval == pytest.approx(found.intervals["x[1]"], rel=1e-6)
    assert profile.rises.min() == 0.0
    assert (np.diff(profile.values) > 0).all()
    alone = dc.fit({"y": dc.Variable(0.0)}, lambda p, v: v["y"] - noise)
    assert alone.profile("y").interval == pytest.approx(alone.intervals["y"], rel=1e-6)


def test_a_profile_knows_a_model_that_is_not_linear():
    """x^2 = 1 + noise, near zero: the rise of the cost against its formula on both sides."""
    noise = torch.tensor([-0.8, 0.9, -0.1, 0.2], dtype=F64)
    free = {"x": dc.Variable(0.5, bounds=(0.0, 10.0))}
    found = dc.fit(free, lambda p, v: v["x"] ** 2 - 0.3 - noise)
    low, high = found.profile("x").interval
    x2 = float(found.values["x"]) ** 2
    reach = (found.intervals["x"][1] - float(found.values["x"])) * 2 * x2**0.5
    assert high == pytest.approx((x2 + reach) ** 0.5, rel=0.02)
    assert low == 0.0, "the bound is reached before the cost has risen"
    assert found.intervals["x"][0] < 0.0


def test_profiles_refuse_other_numbers_and_robust_losses():
    with pytest.raises(dc.InvalidInput, match="`name` may be a, b; got 'c'"):
        fit_to(white(0)).profile("c")
    with pytest.raises(dc.InvalidInput, match="must be \"linear\", got 'huber'"):
        fit_to(white(0), loss="huber").profile("a")


def test_a_wrong_model_is_told():
    """An exponential fitted to a hyperbola, whose residuals are twice their noise."""
    seen = 2.0 / (1.0 + TIMES) ** 4 + 0.01 * torch.from_numpy(white(2))

    def residuals(parameters, values):
        return (values["a"] * torch.exp(-values["b"] * TIMES) - seen) / 0.01

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        dc.fit(variables(), residuals)
    assert {w.category for w in caught} >= {dc.ModelErrorWarning, dc.CorrelatedResidualsWarning}
