"""Fits to data of a fine time step: effect of the time step of the fit on the numbers.

    python -m benchmarks.step_bias                 # all scenes: about ten minutes
    python -m benchmarks.step_bias swing slide --data second_order
    python -m benchmarks.step_bias --quick swing   # a small form: shows that it runs

Data at h = .00125 s, one frame in .03 s, 40 % of the markers missing, are fitted at h = .01 s. The
data come from implicit Euler, with an eighth of the bias of the fit, or, with
`--data second_order`, from the second-order step. Rows:

euler          implicit Euler
its shift      implicit Euler with the shift of `Fit.step_bias`, from h = .005 s
extrapolated   a fit of `residuals.extrapolated`, h = .01 and .005 s, from the shifted numbers
in stages      a fit of `residuals.extrapolated` after a rough fit, as with `extrapolate: true`
second_order   `integrator="second_order"`, and below it with its shift

Columns: processor time relative to the first row, root mean square of the residuals in units of
the noise, and each number with the half width of its interval ("white noise").
"""

from __future__ import annotations

import functools
import math
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import click
import numpy as np
import torch
from torch import Tensor

import diffcloth_torch as dc

F64 = torch.float64
FRAME = 0.03  # [s]
STEP, HALF, FINE = 0.01, 0.005, 0.00125  # [s]
# Tolerance of the fit after the shift: a last step of at most .3 standard errors, with a thousand
# residuals. The error behind a last step of Gauss-Newton is smaller than the step.
ROUGH = 1e-4
MISSING = 0.4  # share of the markers that are not seen
INTEGRATORS = ("implicit_euler", "second_order")

Values = Mapping[str, Tensor]
Motion = Callable[[Values, int], Sequence[dc.State]]
"""Function from values of all variables, and a number of steps, to the states."""


@dataclass(frozen=True)
class Study:
    """A motion with known numbers.

    Attributes:
        make: Function from the time step and the integrator to the motion.
        truth: Name of each number -> its true value.
        first: First values of the fit.
        frames: Number of frames.
        noise: Standard deviation of a coordinate [m].
        bounds: Name of a number -> its bounds; default bounds for all others.
    """

    make: Callable[[float, str], Motion]
    truth: dict[str, float]
    first: dict[str, float]
    frames: int
    noise: float = 1e-3
    bounds: dict[str, tuple[float, float]] | None = None


def swing(h: float, integrator: str, rows: int = 9) -> Motion:
    """A sheet that is released from the horizontal and turns about its pinned edge, in air."""
    material = dc.Material(stretch=100.0, bending=3e-5, density=0.15, damping=2e-3, normal_drag=1.1)
    cloth = dc.Cloth.grid(rows, rows, 0.4, pins={"edge": range(rows)}, material=material)
    sim = simulator(dc.Scene([cloth]), h, integrator)
    corners = torch.from_numpy(np.array(cloth.vertices))
    axis = corners[rows - 1] - corners[0]
    axis = axis / axis.norm()
    arm = corners - corners[0]
    turning = torch.linalg.cross(axis.expand_as(arm), arm - (arm @ axis)[:, None] * axis)
    return lambda values, steps: rollout(sim, values, values["speed"] * turning, steps)


def slide(h: float, integrator: str) -> Motion:
    """A sheet that slides over a floor."""
    material = dc.Material(stretch=300.0, bending=1e-4, density=0.2, damping=0.01)
    cloth = dc.Cloth.grid(5, 5, 0.2, pose=[0, 0, 0.00199, 1, 0, 0, 0], material=material)
    return _on_floor(cloth, h, integrator)


def drop(h: float, integrator: str) -> Motion:
    """A tilted sheet that falls on a floor and slides."""
    material = dc.Material(stretch=300.0, bending=1e-3, density=0.2, damping=0.02)
    pose = [0, 0, 0.08, math.cos(0.15), 0, math.sin(0.15), 0]
    return _on_floor(dc.Cloth.grid(5, 5, 0.2, pose=pose, material=material), h, integrator)


def _on_floor(cloth: dc.Cloth, h: float, integrator: str) -> Motion:
    scene = dc.Scene([cloth], [dc.RigidBody.plane(4.0)])
    sim = simulator(scene, h, integrator, barrier_distance=0.002)
    along = torch.zeros_like(sim.initial_state().velocities)
    along[:, 0] = 1.0
    return lambda values, steps: rollout(sim, values, values["speed"] * along, steps)


def grip(h: float, integrator: str) -> Motion:
    """A gripper that holds a sheet by friction and swings it."""
    root = math.sqrt(0.5)
    material = dc.Material(
        stretch=200.0, bending=1e-4, density=0.15, damping=3e-3, normal_drag=1.1, friction=0.8
    )
    cloth = dc.Cloth.grid(7, 7, 0.18, pose=[0, 0, 0.135, root, root, 0, 0], material=material)
    hand = dc.Robot.load(
        dc.robots.GRIPPER,
        base="kinematic",
        pose=[0, 0, 0.3, 0, 1, 0, 0],
        actuation="torque",
        joint_positions=0.0388,
        friction=0.8,
        name="hand",
    )
    sim = simulator(dc.Scene([cloth], robots=[hand]), h, integrator, barrier_distance=0.0015)
    still = torch.tensor([[0, 0, 0.3, 0, 1, 0, 0]], dtype=F64)
    sideways = torch.tensor([[0, 1.0, 0, 0, 0, 0, 0]], dtype=F64)
    squeeze = torch.tensor([4.0, 4.0], dtype=F64)

    def move(values: Values, steps: int) -> Sequence[dc.State]:
        def controller(k: int, _: dc.State) -> dc.Control:
            swung = values["amplitude"] * (1 - math.cos(2 * math.pi * 1.5 * (k + 1) * h)) / 2
            return dc.Control(joint_efforts=squeeze, base_poses=still + swung * sideways)

        return sim.rollout(
            sim.initial_state(), controller, parameters=given(sim, values), steps=steps
        )

    return move


def buckle(h: float, integrator: str) -> Motion:
    """A strip whose ends are pushed together until it buckles."""
    ends = [*range(6), *range(33, 39)]
    material = dc.Material(stretch=200.0, bending=2e-4, density=0.2, damping=0.01)
    cloth = dc.Cloth.grid((3, 13), (0.04, 0.2), pins={"ends": ends}, material=material)
    sim = simulator(dc.Scene([cloth], gravity=(0, 0, -0.05)), h, integrator)
    positions = sim.initial_state().positions
    pins, middle = positions[ends], positions.mean(0)
    long = int((positions.amax(0) - positions.amin(0)).argmax())

    def controller(k: int, _: dc.State) -> dc.Control:
        move = torch.zeros_like(pins)
        move[:, long] = -torch.sign(pins[:, long] - middle[long]) * 0.05 * min((k + 1) * h, 0.3)
        return dc.Control(pins=pins + move)

    return lambda values, steps: sim.rollout(
        sim.initial_state(), controller, parameters=given(sim, values), steps=steps
    )


STUDIES = {
    "swing": Study(
        swing,
        truth={"normal_drag": 1.1, "bending": 3e-5, "damping": 2e-3, "speed": 1.5},
        first={"normal_drag": 0.7, "bending": 1e-5, "damping": 4e-3, "speed": 1.0},
        frames=20,
        noise=2e-3,
        bounds={"bending": (1e-6, 1e-3), "damping": (1e-4, 0.1)},
    ),
    "slide": Study(slide, {"friction": 0.3, "speed": 1.0}, {"friction": 0.2, "speed": 0.8}, 9),
    "stick": Study(slide, {"friction": 0.3, "speed": 1.0}, {"friction": 0.2, "speed": 0.8}, 16),
    "drop": Study(drop, {"friction": 0.3, "speed": 1.0}, {"friction": 0.2, "speed": 0.8}, 12),
    "grip": Study(
        grip,
        truth={"normal_drag": 1.1, "amplitude": 0.06},
        first={"normal_drag": 0.7, "amplitude": 0.05},
        frames=20,
    ),
    "buckle": Study(
        buckle, {"bending": 2e-4, "damping": 0.01}, {"bending": 1e-4, "damping": 5e-3}, 16
    ),
}


def simulator(scene: dc.Scene, h: float, integrator: str, **contact: float) -> dc.Simulator:
    options: Any = contact
    return dc.Simulator(
        scene,
        h,
        integrator=integrator,
        contact=dc.ContactOptions(self_contact=False, **options),
    )


def given(sim: dc.Simulator, values: Values) -> dc.Parameters:
    """Default parameters of a simulator, replaced by the values named like fields."""
    fields: Any = {n: v for n, v in values.items() if n in dc.Parameters.__dataclass_fields__}
    return sim.default_parameters().replace(**fields)


def rollout(
    sim: dc.Simulator, values: Values, velocities: Tensor, steps: int
) -> Sequence[dc.State]:
    """A motion from velocities at the time 0."""
    parameters = given(sim, values)
    start = sim.initial_state().replace(velocities=velocities)
    if sim.integrator == "second_order":
        start = dc.at_half_step(start, parameters=parameters, simulator=sim)
    return sim.rollout(start, parameters=parameters, steps=steps)


@dataclass(frozen=True)
class Row:
    """Result of one way: values, half widths, root mean square and processor time [s].

    A shift is settled if its last step was small.
    """

    way: str
    values: dict[str, float]
    half_widths: dict[str, float]
    rms: float
    seconds: float
    settled: bool = True


def run(study: Study, data: str = INTEGRATORS[0], *, quick: bool = False) -> list[Row]:
    """Fit one study in all ways."""
    make = functools.cache(study.make)
    frames = 4 if quick else study.frames

    def seen_at(h: float, integrator: str, values: Values) -> Sequence[dc.State]:
        every = round(FRAME / h)
        return make(h, integrator)(values, every * frames)[every - 1 :: every]

    truth = {name: torch.tensor(value, dtype=F64) for name, value in study.truth.items()}
    with torch.no_grad():
        states = seen_at(HALF if quick else FINE, data, truth)
    generator = np.random.default_rng(0)
    seen = torch.stack([state.positions for state in states]).numpy()
    seen = seen + study.noise * generator.standard_normal(seen.shape)
    seen[generator.random(seen.shape[:2]) < MISSING] = np.nan

    def compared(h: float, integrator: str) -> Callable[..., Tensor]:
        def residuals(parameters: dc.Parameters, values: Values | None = None) -> Tensor:
            known = {n: v for n, v in vars(parameters).items() if isinstance(v, Tensor)}
            found = seen_at(h, integrator, {**known, **(values or {})})
            return dc.residuals.markers(found, seen, noise=study.noise)

        return residuals

    coarse, fine = compared(STEP, INTEGRATORS[0]), compared(HALF, INTEGRATORS[0])
    second = compared(STEP, INTEGRATORS[1])
    for residuals in (coarse, fine, second):  # excludes one-time compilation from the times
        _fit(study, study.first, residuals, max_evaluations=1)
    found, seconds = _fit(study, study.first, coarse)
    rows = [_row("euler", found, seconds)]
    shifted = _shifted("its shift", found, seconds, fine, order=1.0)
    rows.append(shifted)
    extrapolated = dc.residuals.extrapolated(coarse, fine)
    both, more = _fit(study, shifted.values, extrapolated, tolerance=ROUGH)
    rows.append(_row("extrapolated", both, shifted.seconds + more))
    stages = [dc.Stage(level, tolerance=ROUGH) for level in (coarse, extrapolated)]
    rows.append(_row("in stages", *_fit(study, study.first, stages)))
    other, seconds = _fit(study, study.first, second)
    rows.append(_row("second_order", other, seconds))
    rows.append(_shifted("its shift", other, seconds, compared(HALF, INTEGRATORS[1]), order=2.0))
    return rows


def _shifted(
    way: str, found: dc.Fit, seconds: float, finer: Callable[..., Tensor], order: float
) -> Row:
    """A fit with the shift of its time step."""
    begin = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        shift = found.step_bias(finer, order=order)
    seconds += time.process_time() - begin
    values = {name: float(found.values[name] + move) for name, move in shift.items()}
    unsettled = any("steps to the limit" in str(warning.message) for warning in caught)
    return Row(way, values, {}, math.nan, seconds, not unsettled)


def _fit(
    study: Study,
    first: Mapping[str, float],
    residuals: Callable[..., Any] | list[dc.Stage],
    **options: Any,
) -> tuple[dc.Fit, float]:
    bounds = study.bounds or {}
    free = {n: dc.Variable(value, bounds=bounds.get(n)) for n, value in first.items()}
    begin = time.process_time()
    found = dc.fit(free, residuals, covariance="white", **options)
    return found, time.process_time() - begin


def _row(way: str, found: dc.Fit, seconds: float) -> Row:
    widths = {name: (high - low) / 2 for name, (low, high) in found.intervals.items()}
    values = {name: float(value) for name, value in found.values.items()}
    return Row(way, values, widths, found.rms, seconds)


@click.command(
    help=(__doc__ or "").replace("\n\n    ", "\n\n\b\n    ").replace("\n\neul", "\n\n\b\neul")
)
@click.argument("scenes", nargs=-1, type=click.Choice([*STUDIES]))
@click.option("--data", default=INTEGRATORS[0], type=click.Choice(INTEGRATORS), show_default=True)
@click.option("--quick", is_flag=True, help="Few frames: shows that it runs.")
def main(scenes: tuple[str, ...], data: str, quick: bool) -> None:
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", dc.ModelErrorWarning)
    for name in scenes or STUDIES:
        study = STUDIES[name]
        rows = run(study, data, quick=quick)
        print(f"\n{name}: true {', '.join(f'{n} {v:g}' for n, v in study.truth.items())}")
        for row in rows:
            numbers = [
                f"{n} {value:.4g}" + (f" +- {row.half_widths[n]:.2g}" if row.half_widths else "")
                for n, value in row.values.items()
            ]
            times = row.seconds / rows[0].seconds
            numbers += [] if row.settled else ["not settled"]
            print(f"{row.way:13} {times:5.2f} {row.rms:6.2f}  {'  '.join(numbers)}")
        print(f"{'':13} the first took {rows[0].seconds:.1f} s")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
