"""Fits: results from synthetic data, confidence intervals and refused input."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import diffcloth_torch as dc

F64 = torch.float64
NOISE = 1e-3  # [m]


def hanging(rows=8, columns=3, dt=0.02):
    """A strip held at its upper end, horizontal at first."""
    cloth = dc.Cloth.grid(
        rows,
        columns,
        (0.06, 0.3),
        material=dc.Material(stretch=40.0, bending=2e-4, density=0.2, damping=0.01),
        pins={"clamp": range(2 * columns)},
        name="strip",
    )
    return dc.Simulator(dc.Scene([cloth]), dt, contact=dc.ContactOptions(self_contact=False))


@pytest.fixture(scope="module")
def strip():
    return hanging()


def rollout(sim, parameters, steps=12):
    return sim.rollout(sim.initial_state(), parameters=parameters, steps=steps)[1::2]


def complete(sim, parameters):
    """Parameters of the scene, with the parameters of a fit replaced."""
    given = {n: v for n, v in vars(parameters).items() if isinstance(v, torch.Tensor)}
    return sim.default_parameters().replace(**given)


def observe(sim, seed, noise=NOISE, **truth):
    numbers = {name: torch.tensor(value, dtype=F64) for name, value in truth.items()}
    with torch.no_grad():
        states = rollout(sim, sim.default_parameters().replace(**numbers))
    positions = torch.stack([state.positions for state in states]).numpy()
    return positions + noise * np.random.default_rng(seed).standard_normal(positions.shape)


def residuals_of(sim, observed):
    def residuals(parameters):
        states = rollout(sim, complete(sim, parameters))
        return dc.residuals.markers(states, observed, noise=NOISE)

    return residuals


TRUTH = {"stretch": 60.0, "bending": 4e-4}
START = {"stretch": dc.Variable(30.0), "bending": dc.Variable(2e-4)}


@pytest.mark.slow
@pytest.mark.rounding
def test_the_true_values_are_in_their_intervals(strip):
    """The intervals hold for nearly all of ten seeds; the fit equals SciPy's with differences."""
    hits = dict.fromkeys(TRUTH, 0)
    for seed in range(10):
        found = dc.fit(START, residuals_of(strip, observe(strip, seed, **TRUTH)))
        assert found.success
        assert not found.unidentifiable
        assert found.failures == 0
        for name, true in TRUTH.items():
            low, high = found.intervals[name]
            hits[name] += low <= true <= high
            assert low < float(found.values[name]) < high < 3 * low
    assert all(count >= 8 for count in hits.values()), hits  # 95 % of ten, less chance


@pytest.mark.rounding
def test_without_noise_the_truth_is_found(strip):
    residuals = residuals_of(strip, observe(strip, 0, noise=0.0, **TRUTH))
    found = dc.fit(START, residuals)
    for name, true in TRUTH.items():
        assert float(found.values[name]) == pytest.approx(true, rel=1e-5)
        torch.testing.assert_close(getattr(found.parameters, name), found.values[name])
    assert found.parameters.friction is None
    assert found.cost < 1e-8
    assert found.history[0].cost > 1.0


def test_the_jacobian_is_that_of_differences(strip):
    """Covariances too: the same solver with differences ends at the same place."""
    from scipy.optimize import least_squares

    residuals = residuals_of(strip, observe(strip, 3, **TRUTH))
    found = dc.fit(START, residuals)

    def plain(theta):
        stretch, bending = torch.tensor(np.exp(theta))
        with torch.no_grad():
            return residuals(dc.Parameters(stretch=stretch, bending=bending)).numpy()

    first = np.log([30.0, 2e-4])
    other = least_squares(plain, first, jac="3-point", x_scale="jac", xtol=1e-10, ftol=1e-10)
    values = np.array([float(found.values["stretch"]), float(found.values["bending"])])
    np.testing.assert_allclose(values, np.exp(other.x), rtol=1e-4)
    s2 = 2 * other.cost / (len(other.fun) - 2)
    expected = s2 * np.linalg.inv(other.jac.T @ other.jac) * np.outer(values, values)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-2)
    assert found.correlation[0, 0] == pytest.approx(1.0)
    assert abs(found.correlation[0, 1]) < 1.0


def test_parameters_that_act_as_a_ratio_cannot_be_separated(strip):
    """A stretched strip at rest depends only on the ratio of stiffness to weight."""
    sim = hanging()
    with torch.no_grad():
        target = sim.equilibrium(sim.initial_state()).positions.numpy()[None]
    target = target + NOISE * np.random.default_rng(0).standard_normal(target.shape)

    def residuals(parameters):
        rest = sim.equilibrium(sim.initial_state(), None, complete(sim, parameters))
        return dc.residuals.markers([rest], target, noise=NOISE)

    free = {
        "stretch": dc.Variable(40.0),
        "bending": dc.Variable(2e-4),
        "density": dc.Variable(0.2),
    }
    found = dc.fit(free, residuals, max_evaluations=10)
    assert len(found.unidentifiable) == 1
    shares = found.unidentifiable[0].shares
    assert set(shares) == {"stretch", "bending", "density"}
    np.testing.assert_allclose(list(shares.values()), np.full(3, 3**-0.5), atol=1e-3)
    assert "stretch" in str(found.unidentifiable[0])


def test_nothing_is_known_of_variables_that_residuals_do_not_use():
    found = dc.fit(START, lambda p: torch.stack([p.stretch / 50 - 1, p.stretch / 52 - 1]))
    assert 50 < float(found.values["stretch"]) < 52
    assert found.intervals["bending"] == (0.0, np.inf)
    np.testing.assert_array_equal(found.correlation, np.eye(2))
    assert [set(direction.shares) for direction in found.unidentifiable] == [{"bending"}]


def test_values_of_starts_and_several_trajectories(strip):
    """A velocity that is no parameter, with a frozen stiffness, in two trajectories."""
    true = np.array([0.3, -0.2, 0.1])
    sim = strip

    def run(velocity, bending, sign):
        start = sim.initial_state()
        moving = torch.ones_like(start.velocities)
        moving[:6] = 0.0
        start = start.replace(velocities=sign * moving * velocity)
        given = sim.default_parameters().replace(bending=bending)
        return sim.rollout(start, parameters=given, steps=4)

    bending = torch.tensor(3e-4, dtype=F64)
    with torch.no_grad():
        observed = [
            torch.stack([s.positions for s in run(torch.tensor(true), bending, sign)]).numpy()
            for sign in (1.0, -1.0)
        ]

    def residuals(parameters, values):
        return [
            dc.residuals.markers(run(values["velocity"], parameters.bending, sign), seen)
            for sign, seen in zip((1.0, -1.0), observed, strict=True)
        ]

    variables = {
        "velocity": dc.Variable([0.0, 0.0, 0.0]),
        "bending": dc.Variable(3e-4, free=False),
    }
    found = dc.fit(variables, residuals)
    assert found.names == ["velocity[0]", "velocity[1]", "velocity[2]"]
    np.testing.assert_allclose(found.values["velocity"].numpy(), true, atol=1e-6)
    assert float(found.parameters.bending) == 3e-4


@pytest.mark.slow
@pytest.mark.rounding
def test_starts_end_at_one_place_and_repeat(strip):
    residuals = residuals_of(strip, observe(strip, 1, **TRUTH))
    found = dc.fit(START, residuals, starts=3, seed=4)
    again = dc.fit(START, residuals, starts=3, seed=4)
    assert len(found.starts) == 3
    costs = [start.cost for start in found.starts]
    np.testing.assert_allclose(costs, costs[0], rtol=1e-5)
    assert [start.apart for start in found.starts] == ["", "", ""]
    assert [trial.cost for trial in found.history] == [trial.cost for trial in again.history]
    assert {trial.start for trial in found.history} == {0, 1, 2}
    firsts = [next(t for t in found.history if t.start == k).values["stretch"] for k in range(3)]
    assert len({float(first) for first in firsts}) == 3


@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.ModelErrorWarning")
@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.CorrelatedResidualsWarning")
def test_outliers_count_less_with_a_robust_loss(strip):
    observed = observe(strip, 2, **TRUTH)
    mistaken = np.random.default_rng(5).choice(observed.shape[0] * 18, 12, replace=False)
    observed[mistaken // 18, 6 + mistaken % 18] += 0.05
    errors = []
    for loss in ("linear", "soft_l1"):
        found = dc.fit(START, residuals_of(strip, observed), loss=loss)
        errors.append(abs(np.log(float(found.values["bending"]) / TRUTH["bending"])))
    assert errors[1] < 0.5 * errors[0]


def test_a_failed_trial_step_is_rejected_and_counted(strip):
    base = residuals_of(strip, observe(strip, 0, noise=0.0, **TRUTH))
    calls = []

    def residuals(parameters):
        calls.append(1)
        if float(torch.as_tensor(parameters.stretch).detach()) > 31.0 and len(calls) < 6:
            raise dc.NotConverged("step: of a test")
        return base(parameters)

    found = dc.fit({"stretch": dc.Variable(30.0), "bending": dc.Variable(4e-4)}, residuals)
    assert found.failures >= 1
    assert any(trial.cost == np.inf and "of a test" in trial.failure for trial in found.history)
    assert float(found.values["stretch"]) == pytest.approx(TRUTH["stretch"], rel=1e-4)


def test_a_failure_at_every_start_is_raised(strip):
    def residuals(parameters):
        raise dc.NotConverged("step: of a test")

    with pytest.raises(dc.NotConverged, match="of a test"):
        dc.fit(START, residuals, starts=2)


class TestResiduals:
    def test_markers_that_were_not_seen_do_not_count(self, strip):
        states = rollout(strip, strip.default_parameters())
        seen = torch.stack([s.positions for s in states]).detach().numpy()[:, [5, 9]] + 0.002
        seen[1, 0] = np.nan
        found = dc.residuals.markers(states, seen, vertices=[5, 9], noise=0.001)
        assert found.shape == (3 * (2 * len(states) - 1),)
        np.testing.assert_allclose(found.numpy(), -2.0, atol=1e-9)
        weighted = dc.residuals.markers(states, seen, vertices=[5, 9], weights=[0.0, 0.5])
        assert float(weighted.abs().max()) == pytest.approx(0.001)

    def test_points_look_for_the_nearest_vertex(self, strip):
        states = rollout(strip, strip.default_parameters())[:2]
        clouds = [s.positions.detach().numpy()[[7, 3, 11]] + 1e-4 for s in states]
        found = dc.residuals.point_cloud(states, clouds, noise=1e-4)
        np.testing.assert_allclose(found.numpy(), -np.ones(18), atol=1e-9)

    @pytest.mark.parametrize(
        ("call", "message"),
        [
            (lambda s: dc.residuals.markers(s, np.zeros((2, 4, 3))), "`observed` must have shape"),
            (lambda s: dc.residuals.markers([], np.zeros((0, 4, 3))), "must be one or more"),
            (
                lambda s: dc.residuals.markers(s, np.zeros((6, 24, 3)), noise=0.0),
                "`noise` must be finite and > 0, got 0",
            ),
            (
                lambda s: dc.residuals.markers(s, np.zeros((6, 24, 3)), weights=[-1.0] * 24),
                "`weights` must be finite and >= 0, got -1 at",
            ),
            (
                lambda s: dc.residuals.markers(s, np.full((6, 24, 3), np.inf)),
                r"`observed`, where it is not NaN, must be finite, got inf at \[0, 0, 0\]",
            ),
            (
                lambda s: dc.residuals.markers(s, np.zeros((6, 24, 3)), [np.nan] * 24),
                r"`weights` must be finite and >= 0, got nan at \[0\]",
            ),
            (lambda s: dc.residuals.point_cloud(s, [np.zeros((3, 3))]), "one for each of 6 states"),
            (
                lambda s: dc.residuals.point_cloud(s[:1], [np.full((3, 3), np.nan)]),
                r"`clouds`\[0\] must be finite",
            ),
        ],
    )
    def test_bad_arguments_are_refused(self, strip, call, message):
        states = rollout(strip, strip.default_parameters())
        with pytest.raises(dc.InvalidInput, match=message):
            call(states)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: dc.Variable(1.0, bounds=(2, 3)), dc.InvalidInput, "between its bounds 2 and 3"),
        (lambda: dc.Variable(1.0, bounds=(3, 2)), dc.InvalidInput, "low < high"),
        (lambda: dc.Variable(-1.0, scale="log"), dc.InvalidInput, "must be positive"),
        (lambda: dc.Variable(1.0, scale="cubic"), dc.InvalidInput, "`scale`"),
        (lambda: dc.Variable([1.0, np.nan]), dc.InvalidInput, "finite"),
        (lambda: dc.fit({"stretch": 300.0}, len), TypeError, r"variables\['stretch'\] must be a"),
        (
            lambda: dc.fit({"stretch": dc.Variable(1.0, free=False)}, len),
            dc.InvalidInput,
            "at least one that is free",
        ),
        (lambda: dc.fit(START, len, method="adam"), dc.InvalidInput, "least_squares"),
        (lambda: dc.fit(START, len, loss="cubic"), dc.InvalidInput, "soft_l1"),
        (lambda: dc.fit(START, len, starts=0), dc.InvalidInput, "`starts` must be at least 1"),
        (
            lambda: dc.fit(START, lambda p: [1.0]),
            TypeError,
            "a tensor, a list of tensors, or a dict",
        ),
        (lambda: dc.fit(START, lambda p: 1.0), TypeError, "a list of tensors, or a dict"),
        (lambda: dc.Variable(1.0, bounds=(0, 1, 2)), dc.InvalidInput, "low < high"),
        (lambda: dc.Variable([]), dc.InvalidInput, "one or more numbers, got none"),
        (lambda: dc.Variable("1"), TypeError, "must hold real numbers"),
        (lambda: dc.fit([dc.Variable(1.0)], len), TypeError, "must be a dict of name -> Variable"),
        (lambda: dc.fit({3: dc.Variable(1.0)}, len), TypeError, "must have names as keys, got 3"),
        (
            lambda: dc.fit({"strech": dc.Variable(1.0)}, lambda p: p.stretch),
            dc.InvalidInput,
            r"'strech', which is no field of Parameters.*\(parameters, values\).*'stretch' meant",
        ),
        (
            lambda: dc.fit(START, lambda p, v: p.stretch),
            dc.InvalidInput,
            r"must take \(parameters\)",
        ),
        (
            lambda: dc.fit({"friction": dc.Variable(0.3, bounds=(-1, 2))}, len),
            dc.InvalidInput,
            r"variables\['friction'\], `bounds` must be between 0 and inf, got -1 and 2",
        ),
        (
            lambda: dc.fit({"poisson": dc.Variable(0.9)}, len),
            dc.InvalidInput,
            r"variables\['poisson'\], `value` must be between -1 and 0.5",
        ),
        (lambda: dc.fit(START, lambda p: []), dc.InvalidInput, "at least one number, got none"),
        (
            lambda: dc.fit(START, lambda p: (p.stretch - p.stretch).abs().sqrt().reshape(1)),
            dc.InvalidInput,
            "must have finite derivatives",
        ),
        (
            lambda: dc.fit(
                START, lambda p: torch.stack([p.stretch] * (1 + (float(p.stretch.detach()) < 29)))
            ),
            dc.InvalidInput,
            "as many numbers in every call, got 2 after 1",
        ),
        (lambda: dc.fit(START, len, hold_out="a"), TypeError, "`hold_out` must be a function"),
        (lambda: dc.fit(START, len, progress=None), TypeError, "`progress` must be a function"),
        (
            lambda: dc.fit(START, lambda p: p.stretch.reshape(1) * np.nan),
            dc.InvalidInput,
            r"finite numbers, got nan at \[0\]",
        ),
    ],
)
def test_bad_arguments_are_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()


@pytest.mark.parametrize("method", ["least_squares", "L-BFGS-B", torch.optim.SGD])
@pytest.mark.parametrize("count", [1, 3])  # fewer residuals than variables are derived backward
@pytest.mark.parametrize(
    ("leave", "message"),
    [
        (lambda x: x.numpy(), "must compute with torch .* not with NumPy"),
        (lambda x: np.asarray(x), "must compute with torch .* not with NumPy"),
        (lambda x: x.detach(), "must depend on the variables"),
        (lambda x: x.tolist(), "must depend on the variables"),
        (lambda x: [y.item() for y in x], "must depend on the variables"),
    ],
)
def test_residuals_that_leave_torch_are_refused(strip, method, count, leave, message):
    """The error has torch's error as its cause; a derivative of zero never results."""

    def residuals(parameters):
        state = rollout(strip, complete(strip, parameters), steps=2)[-1]
        return torch.as_tensor(leave(state.positions[-1]))[:count]

    with pytest.raises(dc.InvalidInput, match=message):
        dc.fit(START, residuals, method=method, max_evaluations=2)


def test_other_errors_of_residuals_are_raised_unchanged():
    def residuals(parameters):
        if torch._C._are_functorch_transforms_active():
            raise RuntimeError("my own")
        return parameters.stretch.reshape(1)

    with pytest.raises(RuntimeError, match=r"^my own$"):
        dc.fit(START, residuals)
