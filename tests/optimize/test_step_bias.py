"""Bias of the time step: extrapolated residuals, and the resulting shift of a fit."""

from __future__ import annotations

import pickle
import warnings

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.optimize.compared import noting

F64 = torch.float64
NOISE = 0.01
TRUTH = {"a": 2.0, "b": 3.0}


class Decay:
    """x' = -b x from x(0) = a by implicit Euler, seen at 20 moments of a second."""

    def __init__(self, step, seed=0, weight=1.0):
        self.step, self.weight = step, weight
        self.times = torch.linspace(0.05, 1.0, 20, dtype=F64)
        exact = TRUTH["a"] * torch.exp(-TRUTH["b"] * self.times)
        rng = np.random.default_rng(seed)
        self.seen = exact + NOISE * torch.from_numpy(rng.standard_normal(20))

    def __call__(self, parameters, values):
        steps = torch.round(self.times / self.step)
        return (values["a"] * (1 + values["b"] * self.step) ** -steps - self.seen) / NOISE


def variables(**options):
    return {"a": dc.Variable(1.5, **options), "b": dc.Variable(2.0, scale="log")}


def shifted(found, shift):
    return {name: float(found.values[name] + shift[name]) for name in shift}


def polynomial(h):
    def residuals(parameters):
        return [torch.tensor([1.0, 2.0], dtype=F64) + 3 * h - 5 * h**2 + 7 * h**3]

    return residuals


@pytest.mark.parametrize("ratio", [2.0, 3.0])
def test_extrapolation_removes_a_power_of_the_time_step_with_each_level(ratio):
    levels = [polynomial(0.1 * ratio**-k) for k in range(3)]
    limit = torch.tensor([1.0, 2.0], dtype=F64)
    two = dc.residuals.extrapolated(*levels[:2], ratio=ratio)(None)["trajectory 0"] - limit
    three = dc.residuals.extrapolated(*levels, ratio=ratio)(None)["trajectory 0"] - limit
    # The remainders of the interpolating polynomials at h = 0.
    h = 0.1 * ratio ** -torch.arange(3, dtype=F64)
    cubic = 7 * h[0] * h[1] * (h[0] + h[1])
    torch.testing.assert_close(two, (5 * h[0] * h[1] - cubic).expand(2), atol=1e-14, rtol=0)
    torch.testing.assert_close(three, (7 * h.prod()).expand(2), atol=1e-14, rtol=0)


def test_extrapolation_of_a_second_order_step():
    def at(h):
        return lambda parameters: torch.tensor([2 + 3 * h**2 + 4 * h**3], dtype=F64)

    levels = [at(0.1), at(0.05), at(0.025)]
    two = dc.residuals.extrapolated(*levels[:2], order=2)(None)["residuals"]
    three = dc.residuals.extrapolated(*levels, order=2)(None)["residuals"]
    assert float(two) == pytest.approx(2 - 4 * 0.1**3 / 6, abs=1e-14)
    assert float(three) == pytest.approx(2, abs=1e-14)


def test_the_shift_of_a_second_order_step():
    def at(h):
        return lambda parameters, values: values["x"] - 2 - 3 * h**2 + 0 * torch.ones(4)

    found = dc.fit({"x": dc.Variable(1.0)}, at(0.1), covariance="white")
    with pytest.warns(dc.StepBiasWarning):
        shift = found.step_bias(at(0.05), order=2)
    assert float(found.values["x"] + shift["x"]) == pytest.approx(2, abs=1e-6)


def test_the_interval_misses_the_truth_and_a_warning_tells_the_shift():
    found = dc.fit(variables(), Decay(0.05))
    low, high = found.intervals["b"]
    assert not low < TRUTH["b"] < high
    with pytest.warns(dc.StepBiasWarning, match=r"b 3\.0\d+ instead of 3\.2\d+, .* half widths"):
        shift = found.step_bias(Decay(0.025))
    limit = dc.fit(variables(), dc.residuals.extrapolated(Decay(0.05), Decay(0.025)))
    for name, value in shifted(found, shift).items():
        width = np.subtract(*limit.intervals[name][::-1]) / 2
        assert abs(value - float(limit.values[name])) < 0.1 * width, "the extrapolated fit"
        assert abs(value - TRUTH[name]) < 1.5 * width
    assert set(shift) == {"a", "b"}
    assert shift["a"].shape == ()


def test_one_evaluation_is_exact_for_linear_residuals_with_priors():
    rng = np.random.default_rng(5)
    design = torch.from_numpy(rng.standard_normal((12, 2)))
    seen, error = (torch.from_numpy(rng.standard_normal(12)) for _ in range(2))
    calls = []

    def at(h):
        def residuals(parameters, values):
            calls.append(h)
            return design @ values["x"] - seen + h * error

        return residuals

    free = {"x": dc.Variable([0.0, 0.0], prior=([1.0, 0.0], [0.5, 2.0]))}
    found = dc.fit(free, at(0.3))
    calls.clear()
    shift = found.step_bias(at(0.1), ratio=3.0, max_evaluations=1)
    assert calls == [0.1]
    limit = dc.fit(free, at(0.0))
    torch.testing.assert_close(found.values["x"] + shift["x"], limit.values["x"], atol=1e-7, rtol=0)


def test_a_small_bias_takes_one_evaluation_and_no_warning():
    found = dc.fit(variables(), Decay(1e-4))
    calls = []

    def finer(parameters, values):
        calls.append(1)
        return Decay(5e-5)(parameters, values)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found.step_bias(finer)
    assert len(calls) == 1


def test_a_shift_that_does_not_settle_is_told():
    """The finer residuals depend on the number with the opposite sign: no Jacobian fits both."""
    free = {"x": dc.Variable(0.0)}
    spread = torch.tensor([-1e-3, 1e-3], dtype=F64)
    found = dc.fit(free, lambda p, v: v["x"] - 1 + spread)
    with pytest.warns(dc.StepBiasWarning, match="the last of 4 steps to the limit moved a number"):
        found.step_bias(lambda p, v: 0.9 - v["x"] + spread)


@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.ModelErrorWarning")
def test_numbers_at_a_bound_stay_and_are_named():
    free = {"a": dc.Variable(1.5, bounds=(0.0, 1.9)), "b": dc.Variable(2.0, scale="log")}
    found = dc.fit(free, Decay(0.05), covariance="white")
    assert found.at_bounds == ["a"]
    with pytest.warns(dc.StepBiasWarning, match="at bounds, and not moved: a"):
        shift = found.step_bias(Decay(0.025))
    assert float(shift["a"]) == 0.0
    assert float(shift["b"]) != 0.0


def test_weights_of_a_robust_loss_count_in_the_shift():
    """Without weights an outlier of 30 deviations would turn the least-squares direction."""

    def at(h):
        clean = Decay(h)

        def residuals(parameters, values):
            return clean(parameters, values) + 30.0 * (torch.arange(20) == 1)

        return residuals

    found = dc.fit(variables(), at(0.05), loss="cauchy")
    limit = dc.fit(variables(), dc.residuals.extrapolated(at(0.05), at(0.025)), loss="cauchy")
    with pytest.warns(dc.StepBiasWarning):
        shift = found.step_bias(at(0.025), max_evaluations=10)
    for name, value in shifted(found, shift).items():
        width = np.subtract(*limit.intervals[name][::-1]) / 2
        assert abs(value - float(limit.values[name])) < 0.3 * width


@pytest.mark.parametrize(("order", "factor"), [(2.0, 4 / 3), (1.0, 2.0)])
def test_a_mesh_converges_with_its_own_order(order, factor):
    free = {"x": dc.Variable(0.0)}

    def at(edge):
        return lambda p, v: v["x"] - 1 + edge**order + torch.tensor([-1e-4, 1e-4], dtype=F64)

    found = dc.fit(free, at(0.2))
    with pytest.warns(dc.MeshBiasWarning, match="without the error of the mesh"):
        shift = found.mesh_bias(at(0.1), order=order)
    assert float(shift["x"]) == pytest.approx(factor * (0.2**order - 0.1**order))
    assert float(found.values["x"] + shift["x"]) == pytest.approx(1.0)


def test_extrapolated_residuals_can_be_sent_to_a_process():
    given = dc.residuals.extrapolated(Decay(0.05), Decay(0.025))
    values = {name: torch.tensor(value) for name, value in TRUTH.items()}
    copied = pickle.loads(pickle.dumps(given))(None, values)
    assert torch.equal(copied["residuals"], given(None, values)["residuals"])


SHEET = dc.Cloth.grid(3, 3, 0.2)
AT_REST = dc.Simulator(dc.Scene([SHEET]), 0.01).initial_state()
SEEN = AT_REST.positions.numpy()


def moved(by, kind="markers"):
    """Residuals of a sheet that stands `by` above its rest."""

    def residuals(parameters, values):
        states = [AT_REST.replace(positions=AT_REST.positions * values["scale"] + by)]
        if kind == "markers":
            return dc.residuals.markers(states, SEEN[None], noise=0.01)
        return dc.residuals.point_cloud(states, [SEEN], noise=0.01)

    return residuals


def test_a_page_compares_extrapolated_positions():
    given = dc.residuals.extrapolated(moved(0.2), moved(0.1))
    with noting() as notes:
        given(None, {"scale": torch.ones((), dtype=F64)})
    assert len(notes) == 1
    np.testing.assert_allclose(notes[0].simulated[0], SEEN, atol=1e-15)


def test_residuals_that_are_not_linear_in_positions_are_refused():
    ones = {"scale": torch.ones((), dtype=F64)}
    with pytest.raises(dc.InvalidInput, match=r"residuals.extrapolated: .* `point_cloud` choose"):
        dc.residuals.extrapolated(moved(0.0, "cloud"), moved(0.0, "cloud"))(None, ones)
    found = dc.fit({"scale": dc.Variable(1.1)}, moved(0.01), max_evaluations=1)
    with pytest.raises(dc.InvalidInput, match=r"Fit.step_bias: .* `point_cloud` choose"):
        found.step_bias(moved(0.0, "cloud"))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda f: f.step_bias(Decay(0.1), 1.0), dc.InvalidInput, "`ratio` must be"),
        (lambda f: f.step_bias(Decay(0.1), max_evaluations=0), dc.InvalidInput, "max_evaluations"),
        (lambda f: f.step_bias(3.0), TypeError, "`finer` must be a function, got float"),
        (
            lambda f: f.step_bias(lambda p, v: v["a"].reshape(1)),
            dc.InvalidInput,
            "`finer` must return 20 residuals, as in the fit, got 1",
        ),
        (
            lambda f: f.step_bias(lambda p, v: v["a"] * torch.full((20,), torch.nan)),
            dc.InvalidInput,
            r"`finer` must return finite numbers, got nan at \[0\]",
        ),
        (lambda f: f.mesh_bias(Decay(0.1), order=0.0), dc.InvalidInput, "`order` must be"),
        (
            lambda f: dc.residuals.extrapolated(Decay(0.1), Decay(0.05), ratio=0.5),
            dc.InvalidInput,
            "`ratio` must be",
        ),
        (lambda f: dc.residuals.extrapolated(Decay(0.1), 1), TypeError, "`fine` must be a func"),
        (
            lambda f: dc.residuals.extrapolated(Decay(0.1), lambda p, v: v["a"])(None, f.values),
            dc.InvalidInput,
            "every level must return residuals of the same shapes, level 1 has",
        ),
        (
            lambda f: dc.residuals.extrapolated(lambda p, v: 1.0, Decay(0.1))(None, f.values),
            TypeError,
            "every level must return a tensor, a list of tensors, or a dict",
        ),
    ],
)
def test_bad_arguments_are_refused(call, error, message):
    found = dc.fit(variables(), Decay(0.05))
    with pytest.raises(error, match=message):
        call(found)


@pytest.mark.slow
@pytest.mark.rounding
@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.ModelErrorWarning")
def test_a_swinging_sheet_is_found_without_the_bias_of_its_time_step():
    """Drag and speed of a sheet that swings in air, against the same simulator with h / 8."""
    rows = 7
    material = dc.Material(stretch=100.0, bending=3e-5, density=0.15, damping=2e-3, normal_drag=1.1)
    cloth = dc.Cloth.grid(rows, rows, 0.4, pins={"edge": range(rows)}, material=material)
    corners = torch.from_numpy(np.array(cloth.vertices))
    axis = corners[rows - 1] - corners[0]
    axis = axis / axis.norm()

    def simulate(step, parameters, speed):
        sim = dc.Simulator(dc.Scene([cloth]), step, contact=dc.ContactOptions(self_contact=False))
        given = {n: v for n, v in vars(parameters).items() if isinstance(v, torch.Tensor)}
        arm = corners - corners[0]
        start = sim.initial_state()
        turning = torch.linalg.cross(axis.expand_as(arm), arm - (arm @ axis)[:, None] * axis)
        every = round(0.03 / step)
        return sim.rollout(
            start.replace(velocities=speed * turning),
            parameters=sim.default_parameters().replace(**given),
            steps=20 * every,
        )[every - 1 :: every]

    with torch.no_grad():
        states = simulate(0.00125, dc.Parameters(), torch.tensor(1.5, dtype=F64))
    rng = np.random.default_rng(0)
    seen = states.positions.numpy()
    seen = seen + 2e-3 * rng.standard_normal(seen.shape)
    seen[rng.random(seen.shape[:2]) < 0.4] = np.nan

    def at(step):
        def residuals(parameters, values):
            states = simulate(step, parameters, values["speed"])
            return dc.residuals.markers(states, seen, noise=2e-3)

        return residuals

    free = {"normal_drag": dc.Variable(0.7), "speed": dc.Variable(1.0)}
    found = dc.fit(free, at(0.01), covariance="white")
    assert abs(float(found.values["normal_drag"]) / 1.1 - 1) > 0.15
    with pytest.warns(dc.StepBiasWarning, match="normal_drag"):
        limit = shifted(found, found.step_bias(at(0.005)))
    # The error of second order that is left: 2 % of both at h = 0.01.
    assert limit["normal_drag"] == pytest.approx(1.1, rel=0.03)
    assert limit["speed"] == pytest.approx(1.5, rel=0.02)
