"""Stages, hold-out, processes, resumption, outlines and the page of fits."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.optimize.compared import noting
from diffcloth_torch.optimize.outlines import _radii

F64 = torch.float64
TRUTH = torch.tensor([2.0, 0.5, -0.3], dtype=F64)
TIMES = torch.linspace(0.0, 2.0, 40, dtype=F64)


def curve(values, times=TIMES):
    """Residuals of a decaying oscillation, without a simulation."""
    return (
        torch.exp(-values["decay"] * times) * torch.cos(values["rate"] * times) + values["offset"]
    )


NOISE = 0.01
SEEN = curve({"rate": TRUTH[0], "decay": TRUTH[1], "offset": TRUTH[2]}) + NOISE * torch.from_numpy(
    np.random.default_rng(0).standard_normal(40)
)


def residuals(parameters, values):
    return [((curve(values) - SEEN) / NOISE)[::2]]


def other_residuals(parameters, values):
    return [residuals(parameters, values)[0] + 1.0]


def kept_out(parameters, values):
    return [((curve(values) - SEEN) / NOISE)[1::2]]


VARIABLES = {
    "rate": dc.Variable(1.5, scale="log", spread=4.0),
    "decay": dc.Variable(0.3, bounds=(0, 5)),
    "offset": dc.Variable(0.0, bounds=(-1, 1)),
}


def bits(found):
    return (
        {n: v.tolist() for n, v in found.values.items()},
        [trial.cost for trial in found.history],
        [start.cost for start in found.starts],
        found.covariance.tolist(),
    )


def test_no_point_is_evaluated_twice_in_a_row():
    calls = []

    def counted(parameters, values):
        if not torch._C._are_functorch_transforms_active():
            calls.append(tuple(float(v) for v in values.values()))
        return residuals(parameters, values)

    found = dc.fit(VARIABLES, counted, starts=2)
    assert len(calls) == len(found.history)
    assert len(set(calls)) == len(calls)


@pytest.mark.slow
def test_any_number_of_workers_finds_the_same_bits():
    alone = dc.fit(VARIABLES, residuals, starts=4, seed=3)
    assert bits(dc.fit(VARIABLES, residuals, starts=4, seed=3, workers=2)) == bits(alone)


def test_residuals_that_cannot_be_pickled_are_refused():
    with pytest.raises(dc.InvalidInput, match="`residuals` must be a function of a module"):
        dc.fit(VARIABLES, lambda p, v: residuals(p, v), workers=1)


def valleys(parameters, values):
    """Two minima: near 1, and a worse one near -1."""
    x = values["x"]
    return torch.stack([10 * (x * x - 1), 0.5 * (x - 1), 0.1 + 0 * x])


def test_starts_that_end_elsewhere_say_why():
    found = dc.fit({"x": dc.Variable(0.8, bounds=(-2, 2))}, valleys, starts=8, seed=1)
    assert float(found.values["x"]) == pytest.approx(1.0)
    other = [start for start in found.starts if float(start.values["x"]) < 0]
    assert 0 < len(other) < 8
    assert all(start.apart.startswith("another minimum: cost 0.5") for start in other)
    assert all(not start.apart for start in found.starts if float(start.values["x"]) > 0)
    short = dc.fit(VARIABLES, residuals, starts=2, max_evaluations=2)
    assert any("had not converged after 2 evaluations" in start.apart for start in short.starts)


def failing(parameters, values):
    if float(values["rate"].detach()) > 2.5:
        raise dc.NotConverged("step: of a test")
    return residuals(parameters, values)


def test_a_start_that_fails_says_so():
    found = dc.fit(VARIABLES, failing, starts=4, seed=1)
    failed = [start for start in found.starts if not np.isfinite(start.cost)]
    assert failed
    assert all("failed at its first values: step: of a test" in start.apart for start in failed)


def test_a_stage_ends_at_its_own_tolerance():
    exact = dc.fit(VARIABLES, residuals)
    stages = [dc.Stage(residuals, tolerance=0.5), dc.Stage(residuals)]
    found = dc.fit(VARIABLES, stages)
    evaluations = [sum(trial.stage == k for trial in found.history) for k in range(2)]
    assert 1 < evaluations[0] < len(exact.history) - 2
    assert found.cost == pytest.approx(exact.cost, rel=1e-8)
    with pytest.raises(dc.InvalidInput, match=r"`residuals\[1\].tolerance` must be"):
        dc.fit(VARIABLES, [stages[1], dc.Stage(residuals, tolerance=0.0)])


def test_a_stage_keeps_fixed_variables_and_the_next_begins_there():
    seen = []

    def quiet(parameters, values):
        seen.append(float(values["decay"].detach()))
        return residuals(parameters, values)

    found = dc.fit(VARIABLES, [dc.Stage(quiet, free=["rate", "offset"]), dc.Stage(residuals)])
    assert set(seen) == {0.3}
    stages = [trial.stage for trial in found.history]
    assert stages == sorted(stages)
    change = stages.index(1)
    best = min(found.history[:change], key=lambda trial: trial.cost)
    assert found.history[change].values == best.values
    alone = dc.fit(VARIABLES, residuals)
    for name, value in alone.values.items():
        assert float(found.values[name]) == pytest.approx(float(value), rel=1e-5)


@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.ModelErrorWarning")
@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.CorrelatedResidualsWarning")
def test_held_out_data_are_not_fitted_and_their_error_is_the_noise():
    found = dc.fit(VARIABLES, residuals, hold_out=kept_out)
    assert len(found.residuals) == 20
    (error,) = found.held_out
    assert 0.6 < error < 1.5  # one, within three standard errors of 20 numbers
    wrong = dc.fit(
        VARIABLES | {"decay": dc.Variable(0.3, free=False)}, residuals, hold_out=kept_out
    )
    assert wrong.held_out[0] > 2.0


def test_an_interrupted_fit_goes_on_with_the_same_bits(tmp_path):
    whole = dc.fit(VARIABLES, residuals, starts=2)

    def until(count):
        def progress(trial):
            nonlocal count
            count -= 1
            if count < 0:
                raise KeyboardInterrupt

        return progress

    with pytest.raises(KeyboardInterrupt):
        dc.fit(VARIABLES, residuals, starts=2, resume=tmp_path, progress=until(4))
    calls = []

    def counted(parameters, values):
        calls.append(1)
        return residuals(parameters, values)

    again = dc.fit(VARIABLES, counted, starts=2, resume=tmp_path)
    assert bits(again) == bits(whole)
    before = len(calls)
    dc.fit(VARIABLES, counted, starts=2, resume=tmp_path)
    assert len(calls) == before + 2, "all is remembered, and tried once for each start"
    with pytest.raises(dc.InvalidInput, match="residuals` are not what they were"):
        dc.fit(VARIABLES, other_residuals, starts=2, resume=tmp_path)
    with pytest.raises(dc.InvalidInput, match="belongs to other variables or options"):
        dc.fit(VARIABLES, residuals, loss="huber", resume=tmp_path)
    (tmp_path / "start_0.pt").write_bytes(b"something else")
    with pytest.raises(dc.InvalidInput, match="is no complete checkpoint"):
        dc.fit(VARIABLES, residuals, resume=tmp_path)


def test_a_late_and_biased_sensor_is_found():
    """Delay and bias are variables like others: the model shifts its own time and values."""
    true = torch.from_numpy(np.random.default_rng(1).standard_normal(40)) * NOISE
    seen = curve({"rate": TRUTH[0], "decay": TRUTH[1], "offset": TRUTH[2]}, TIMES - 0.05) + true

    def late(parameters, values):
        moved = TIMES - values["delay"]
        given = {"rate": TRUTH[0], "decay": values["decay"], "offset": TRUTH[2] + values["bias"]}
        return (curve(given, moved) - seen) / NOISE

    free = {"decay": dc.Variable(0.3), "delay": dc.Variable(0.0), "bias": dc.Variable(0.1)}
    found = dc.fit(free, late)
    for name, value in {"decay": 0.5, "delay": 0.05, "bias": 0.0}.items():
        low, high = found.intervals[name]
        assert low < value < high


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: dc.fit(VARIABLES, []), TypeError, "one or more Stage"),
        (
            lambda: dc.fit(VARIABLES, [dc.Stage(residuals, free=["speed"])]),
            dc.InvalidInput,
            r"residuals\[0\]\.free` may name rate, decay, offset; got 'speed'",
        ),
        (
            lambda: dc.fit(VARIABLES, [dc.Stage(residuals, free=["rate"])]),
            dc.InvalidInput,
            "it leaves out decay, offset",
        ),
        (lambda: dc.fit(VARIABLES, residuals, resume=__file__), dc.InvalidInput, "a folder"),
        (lambda: dc.fit(VARIABLES, residuals, workers=-1), dc.InvalidInput, "`workers`"),
        (lambda: dc.Variable(1.0, spread=1.0), dc.InvalidInput, "`spread` must be finite and > 1"),
    ],
)
def test_bad_arguments_are_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_residuals_that_change_their_length_while_they_are_differentiated_are_refused():
    def growing(parameters, values):
        found = residuals(parameters, values)
        return found if not torch.is_grad_enabled() else [*found, found[0][:1]]

    with pytest.raises(dc.InvalidInput, match="as many numbers in every call"):
        dc.fit(VARIABLES, growing, method="L-BFGS-B")


class TestOutline:
    RAYS = np.stack([np.cos(a := 2 * np.pi / 24 * np.arange(24)), np.sin(a)], axis=1)

    @staticmethod
    def sheet():
        cloth = dc.Cloth.grid(5, 5, (0.2, 0.2), pins={"all": range(25)})
        return cloth, dc.Simulator(dc.Scene([cloth]), 0.01).initial_state()

    def test_a_square_has_its_radii(self):
        cloth, state = self.sheet()
        middle = cloth.vertices.mean(axis=0)[:2]
        square = middle + 0.1 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        call = {"faces": cloth.faces, "center": middle, "directions": 24}
        same = dc.residuals.outline([state], [square], **call)
        assert same.shape == (24,)
        assert float(same.abs().max()) < 1e-12
        larger = dc.residuals.outline(
            [state], [middle + 1.1 * (square - middle)], noise=0.01, **call
        )
        expected = -0.1 * 0.1 / np.abs(self.RAYS).max(axis=1) / 0.01
        np.testing.assert_allclose(larger.numpy(), expected, atol=1e-12)

    @pytest.mark.parametrize("seed", range(10))
    def test_rays_through_corners_meet_the_outline(self, seed):
        turns = 2 * np.pi / 97 * np.arange(97)
        rays = np.stack([np.cos(turns), np.sin(turns)], axis=1)
        radii = 0.1 + 0.01 * np.random.default_rng(seed).standard_normal(97)
        ring = np.stack([np.arange(97), np.roll(np.arange(97), -1)], axis=1)
        found = _radii("", torch.from_numpy(radii[:, None] * rays), ring, torch.from_numpy(rays))
        np.testing.assert_allclose(found.numpy(), radii, atol=1e-9)

    def test_a_radius_is_the_last_crossing_and_its_derivative_matches_differences(self):
        points = torch.from_numpy(np.random.default_rng(2).normal(size=(30, 2)))
        pairs = np.array([(i, j) for i in range(30) for j in range(i)])
        found = _radii("", points, pairs, torch.from_numpy(self.RAYS))
        along = points @ torch.from_numpy(self.RAYS).T
        assert (found <= along.max(dim=0).values + 1e-12).all()
        tangent = torch.from_numpy(np.random.default_rng(3).normal(size=(30, 2)))
        h = 1e-6
        rays = torch.from_numpy(self.RAYS)
        ends = [_radii("", points + s * h * tangent, pairs, rays) for s in (1, -1)]
        _, exact = torch.func.jvp(lambda p: _radii("", p, pairs, rays), (points,), (tangent,))
        torch.testing.assert_close(exact, (ends[0] - ends[1]) / (2 * h), rtol=1e-5, atol=1e-7)

    @staticmethod
    def wavy(phase, sizes, count=180):
        """A wheel whose radius has waves, as a cloth with edges from its hub to its rim."""
        angles = 2 * np.pi / count * (np.arange(count) + 0.3)  # no ray meets a corner
        radii = np.full(count, 0.1)
        for k, size in sizes.items():
            radii += size * np.cos(k * (angles - phase) + 0.3 * k)
        rim = radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        vertices = np.concatenate([rim, np.zeros((1, 2))])
        k = np.arange(count)
        faces = np.stack([k, np.roll(k, -1), np.full(count, count)], axis=1)
        cloth = dc.Cloth(np.pad(vertices, ((0, 0), (0, 1))), faces)
        contact = dc.ContactOptions(self_contact=False)
        return cloth, dc.Simulator(dc.Scene([cloth]), 0.01, contact=contact).initial_state(), rim

    @pytest.mark.parametrize("phase", [0.0, 0.4, 1.7, 3.0, 5.0])
    def test_a_turned_outline_is_turned_back(self, phase):
        """Three rotations fit the largest wave; the other waves determine the right rotation."""
        sizes = {1: 0.002, 3: 0.01, 4: 0.004}
        cloth, state, _ = self.wavy(0.0, sizes)
        *_, seen = self.wavy(phase, sizes)
        call = {"faces": cloth.faces, "directions": 48}
        with noting() as notes:
            found = dc.residuals.outline([state], [seen], turned=True, **call)
        assert float(found.abs().max()) < 5e-5
        # The placed observation is in the scene of the state, on the rim of its wheel.
        rim = dc.residuals.outline([state], notes[0].placed, **call)
        assert float(rim.abs().max()) < 5e-4
        plain = dc.residuals.outline([state], notes[0].observed, **call)
        assert phase == 0.0 or float(plain.abs().max()) > 2e-3
        larger = dc.residuals.outline([state], [1.02 * seen], turned=True, **call)
        assert float(larger.mean()) == pytest.approx(-0.02 * 0.1, rel=1e-2)

    def test_derivatives_know_of_the_turn(self):
        cloth, state, _ = self.wavy(0.0, {1: 0.002, 3: 0.01, 4: 0.004})
        *_, seen = self.wavy(1.7, {1: 0.001, 3: 0.012, 4: 0.006})

        def call(positions):
            moved = state.replace(positions=positions)
            return dc.residuals.outline(
                [moved], [seen], cloth.faces, directions=25, turned=True, noise=0.01
            )

        tangent = torch.from_numpy(np.random.default_rng(3).normal(size=state.positions.shape))
        h = 1e-8
        ends = [call(state.positions + s * h * tangent) for s in (1, -1)]
        _, exact = torch.func.jvp(call, (state.positions,), (tangent,))
        torch.testing.assert_close(exact, (ends[0] - ends[1]) / (2 * h), rtol=1e-4, atol=1e-4)
        positions = state.positions.clone().requires_grad_()
        weights = torch.from_numpy(np.random.default_rng(4).normal(size=25))
        (gradient,) = torch.autograd.grad(call(positions) @ weights, positions)
        assert float((gradient * tangent).sum()) == pytest.approx(float(exact @ weights), rel=1e-9)

    def test_a_circle_has_no_direction(self):
        cloth, state, _ = self.wavy(0.0, {})
        *_, seen = self.wavy(0.0, {3: 0.01})
        call = {"faces": cloth.faces, "directions": 30}
        found = dc.residuals.outline([state], [seen], turned=True, **call)
        torch.testing.assert_close(found, dc.residuals.outline([state], [seen], **call))
        with pytest.raises(dc.InvalidInput, match="at least 12 for an outline with 3 folds, got 8"):
            dc.residuals.outline([state], [seen], cloth.faces, directions=8, turned=True)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"outlines": []}, "one for each of 1 states"),
            ({"outlines": [np.zeros((2, 2))]}, r"`outlines`\[0\] must have shape \[n, 2\]"),
            ({"center": (1.0, 0.0)}, "must lie around `center`"),
            ({"center": (1.0, 0.0, 0.0)}, r"`center` must have shape \[2\]"),
            ({"faces": [[0, 1, 25]]}, "indices between 0 and 24"),
            ({"directions": 2}, "`directions` must be at least 3"),
            ({"noise": 0.0}, "`noise` must be finite and > 0"),
            ({"outlines": [np.full((3, 2), np.nan)]}, r"`outlines`\[0\] must be finite"),
            ({"faces": np.zeros((0, 3), int)}, r"`faces` must have shape \[F, 3\] with F >= 1"),
        ],
    )
    def test_bad_arguments_are_refused(self, change, message):
        cloth, state = self.sheet()
        square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        given = {"outlines": [square], "faces": cloth.faces, "center": (0.0, 0.0), "noise": 1.0}
        with pytest.raises(dc.InvalidInput, match=message):
            dc.residuals.outline([state], **(given | change))


class _Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.sources, self.open = [], []

    def handle_starttag(self, tag, attrs):
        self.sources += [value for name, value in attrs if name in ("src", "href")]


def test_the_page_of_a_fit_is_one_file_that_loads_nothing(tmp_path):
    cloth = dc.Cloth.grid(4, 4, (0.2, 0.2), pins={"edge": range(4)}, name="sheet")
    simulator = dc.Simulator(dc.Scene([cloth]), 0.02)

    def simulate(stretch, bending):
        given = simulator.default_parameters().replace(stretch=stretch, bending=bending)
        return simulator.rollout(simulator.initial_state(), parameters=given, steps=4)

    with torch.no_grad():
        seen = simulate(torch.tensor(60.0), torch.tensor(1e-4)).positions.numpy().copy()
    seen += 1e-3 * np.random.default_rng(0).standard_normal(seen.shape)
    seen[2:, 13] += 0.02  # a marker that has slipped
    seen[1, 5] = np.nan

    def compare(parameters):
        states = simulate(parameters.stretch, parameters.bending)
        return dc.residuals.markers(states, seen, noise=1e-3)

    free = {"stretch": dc.Variable(30.0), "bending": dc.Variable(2e-4)}
    found = dc.fit(free, compare, hold_out=compare, max_evaluations=4)
    page = tmp_path / "fit.html"
    found.report(page)
    text = page.read_text()
    tags = _Tags()
    tags.feed(text)
    assert len(tags.sources) == 5  # twice two pictures, and the costs
    assert all(source.startswith("data:image/png;base64,") for source in tags.sources)
    assert "http" not in re.sub(r"base64,[^\"]*", "", text)
    assert text.count("The worst is vertex 13:") == 2
    assert "interval of 95 %" in text
    assert "Kept out of the fit" in text
    with pytest.raises(dc.InvalidInput, match=r'must end in "\.html"'):
        found.report(tmp_path / "fit.pdf")
