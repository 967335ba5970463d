"""A camera with a clock, a delay, a frame and a noise of its own."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

import diffcloth_torch as dc

F64 = torch.float64
CLOTH = dc.Cloth.grid(3, 3, 0.2, pins={"edge": range(3)})
SIM = dc.Simulator(dc.Scene([CLOTH]), 0.01, contact=dc.ContactOptions(self_contact=False))
START = SIM.initial_state()
STATES = dc.Trajectory([START, *SIM.rollout(START, steps=20)])
TIMES = np.arange(0.02, 0.18, 1 / 60)


def test_positions_between_states_are_hermite_cubics():
    t, v = STATES.time.numpy(), STATES.velocities.numpy().copy()
    v[:-1] = (v[:-1] + v[1:]) / 2  # at the times of the states
    expected = CubicHermiteSpline(t, STATES.positions.numpy(), v)(TIMES)
    np.testing.assert_allclose(STATES.at(TIMES).numpy(), expected, atol=1e-14)
    torch.testing.assert_close(STATES.at(STATES.time), STATES.positions, atol=1e-14, rtol=0)


def test_states_that_are_several_steps_apart_have_their_own_velocities():
    few = STATES[::4]
    spline = CubicHermiteSpline(few.time.numpy(), few.positions.numpy(), few.velocities.numpy())
    np.testing.assert_allclose(few.at(TIMES).numpy(), spline(TIMES), atol=1e-14)


def test_free_fall_by_the_second_order_step_is_a_parabola_between_states():
    cloth = dc.Cloth.grid(2, 2, 0.1)
    sim = dc.Simulator(dc.Scene([cloth]), 0.02, integrator="second_order")
    start = sim.initial_state()
    states = dc.Trajectory([start, *sim.rollout(start, steps=5)])
    times = np.array([0.003, 0.01, 0.05, 0.071])
    fallen = (states.at(times) - start.positions)[:, 0, 2].numpy()
    np.testing.assert_allclose(fallen, -9.81 * times**2 / 2, atol=1e-9)


def test_positions_are_differentiable_in_times_and_states():
    times = torch.tensor([0.013, 0.05, 0.2], dtype=F64, requires_grad=True)
    weights = torch.linspace(-1, 1, 27, dtype=F64).reshape(9, 3)
    (slope,) = torch.autograd.grad((STATES.at(times) * weights).sum(), times)
    ends = [((STATES.at(times.detach() - e) * weights).sum((1, 2))) for e in (0.0, 1e-7)]
    torch.testing.assert_close(slope, (ends[0] - ends[1]) / 1e-7, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: STATES.at([0.1, 0.3]), r"between 0 and 0.2 s.* got 0.3 at \[1\]"),
        (lambda: STATES.at([-1e-3]), "got -0.001"),
        (lambda: STATES.at(0.1), r"must have shape \[K\]"),
        (lambda: STATES[:1].at([0.0]), "needs two or more states, got 1"),
        (lambda: dc.Trajectory([STATES[1], STATES[0]]).at([0.0]), r"must increase, that of \[1\]"),
    ],
)
def test_times_that_are_refused(call, message):
    with pytest.raises(dc.InvalidInput, match=f"Trajectory.at: .*{message}"):
        call()


def test_delay_frame_and_bias_of_a_camera_are_found():
    turn, shift, delay = np.array([0.3, -0.2, 0.5]), np.array([0.1, 2.0, -1.0]), 0.012
    exact = STATES.at(TIMES - delay).numpy() @ Rotation.from_rotvec(turn).as_matrix().T + shift
    rng = np.random.default_rng(0)
    seen = exact + 1e-3 * rng.standard_normal(exact.shape)
    seen[rng.random(seen.shape[:2]) < 0.4] = np.nan

    def residuals(parameters, values):
        frame = values["rotation"], values["translation"]
        return dc.residuals.markers(
            STATES, seen, times=TIMES, delay=values["delay"], frame=frame, noise=1e-3
        )

    free = {
        "rotation": dc.Variable([0.2, -0.1, 0.4]),
        "translation": dc.Variable([0.0, 1.9, -0.9]),
        "delay": dc.Variable(0.0, bounds=(-0.02, 0.02)),
    }
    found = dc.fit(free, residuals)
    truth = [*turn, *shift, delay]
    for name, true in zip(found.names, truth, strict=True):
        low, high = found.intervals[name]
        middle, half = (low + high) / 2, (high - low) / 2
        assert abs(middle - true) < 2 * half, name  # four standard errors
        assert half < 0.02, name


def test_noise_of_axes_markers_and_frames():
    seen = STATES.positions.numpy() + 0.01
    plain = dc.residuals.markers(STATES, seen, noise=1.0).reshape(21, 9, 3)
    rng = np.random.default_rng(1)
    for shape in ((), (3,), (9, 1), (21, 1, 1), (21, 9, 3)):
        noise = rng.uniform(0.5, 2.0, shape)
        found = dc.residuals.markers(STATES, seen, noise=noise).reshape(21, 9, 3)
        torch.testing.assert_close(
            found, plain / torch.from_numpy(np.broadcast_to(noise, (21, 9, 3)).copy())
        )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noise": np.ones(9)}, "`noise` must have shape"),
        ({"noise": [1.0, 0.0, 1.0]}, "`noise` must be"),
        ({"delay": 0.1}, "`delay` needs `times`"),
        ({"times": STATES.time.numpy(), "delay": [1.0, 2.0]}, "`delay` must have shape"),
        ({"times": STATES.time.numpy() + 1.0}, "Trajectory.at: `times` must be between"),
        ({"frame": 3.0}, r"`frame` must be \(rotation, translation\)"),
        ({"frame": (np.zeros(4), np.zeros(3))}, r"rotation of `frame` must have shape \[3\]"),
    ],
)
def test_cameras_that_are_refused(options, message):
    with pytest.raises(dc.InvalidInput, match=message):
        dc.residuals.markers(STATES, STATES.positions.numpy(), **options)
