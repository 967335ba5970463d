"""Fit a cloth to a camera's recording of another simulator: a model that is only nearly right.

    python examples/fit_foreign.py

The recording comes from masses and springs, integrated explicitly: springs that stiffen with their
strain, springs over two edges, and air. A camera sees markers at 30 Hz with its own, late clock and
an error of 2 mm; 40 % of the markers are hidden. The fit has no model of the springs. The fitted
numbers are the stretch stiffness, the drag, the speed at the start, and the delay of the camera.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

import diffcloth_torch as dc

Array = NDArray[np.float64]

ROWS, SIDE, DENSITY = 7, 0.3, 0.2  # markers of a side; [m], [kg/m^2]
RATE, FRAMES, SEEN_FROM = 30.0, 14, 0.05  # the camera: [Hz], count, its first time [s]
DAMPING = 2e-3  # of each spring, along it [N s/m]
NOISE, HIDDEN = 2e-3, 0.4  # [m], share of the markers
LATEST = 0.03  # largest delay [s]
KEPT = 10  # frames that are fitted; the others are kept out, to compare a forecast with

clock = SEEN_FROM + np.arange(FRAMES) / RATE  # times on the clock of the camera, which is late


class Truth(NamedTuple):
    """True values of fitted numbers: [-], [rad/s], [s]."""

    normal_drag: float = 1.2
    speed: float = 2.0
    delay: float = 0.015


class Springs(NamedTuple):
    """Pairs of masses, the stiffness of each pair [N/m], and its increase with squared strain."""

    pairs: NDArray[np.int64]
    stiffness: Array
    stiffening: float


def sheet(rows: int) -> dc.Cloth:
    """A square sheet that is held along an edge."""
    material = dc.Material(density=DENSITY, bending=2e-5, damping=5e-3)
    return dc.Cloth.grid((rows, rows), SIDE, pins={"edge": range(rows)}, material=material)


def connect(rows: int) -> tuple[Springs, Springs]:
    """Springs of a square grid: against stretch and shear, and over two edges against bending."""
    index = np.arange(rows * rows).reshape(rows, rows)
    along = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:])]
    across = [(index[:-1, :-1], index[1:, 1:]), (index[:-1, 1:], index[1:, :-1])]
    over = [(index[:, :-2], index[:, 2:]), (index[:-2], index[2:])]

    def springs(groups: list, stiffness: list[float], stiffening: float) -> Springs:
        pairs = [np.stack([a.ravel(), b.ravel()], axis=1) for a, b in groups]
        each = [np.full(len(p), k) for p, k in zip(pairs, stiffness, strict=True)]
        return Springs(np.concatenate(pairs), np.concatenate(each), stiffening)

    return springs(along + across, [60.0, 60.0, 20.0, 20.0], 30.0), springs(over, [0.3, 0.3], 0.0)


def simulate_masses(cloth: dc.Cloth, true: Truth, moments: Array) -> Array:
    """Positions [T, n, 3] at moments [s], by symplectic Euler with steps of 0.1 ms."""
    held, step = len(cloth.pins["edge"]), 1e-4
    x, faces, groups = np.array(cloth.vertices), np.array(cloth.faces), connect(held)
    p, q, r = (x[corner] for corner in faces.T)
    areas = np.linalg.norm(np.cross(q - p, r - p), axis=1) / 2
    mass = np.bincount(faces.ravel(), np.repeat(DENSITY * areas / 3, 3), len(x))[:, None]
    v = true.speed * turning(cloth)
    lengths = [np.linalg.norm(x[g.pairs[:, 0]] - x[g.pairs[:, 1]], axis=1) for g in groups]
    found, time = [], 0.0
    for moment in moments:
        for _ in range(round((moment - time) / step)):
            force = mass * [0.0, 0.0, -9.81]
            for group, rest in zip(groups, lengths, strict=True):
                a, b = group.pairs.T
                d = x[b] - x[a]
                length = np.linalg.norm(d, axis=1)
                strain = length / rest - 1
                pull = group.stiffness * rest * strain * (1 + group.stiffening * strain**2)
                rate = ((v[b] - v[a]) * d).sum(axis=1) / length
                pull = ((pull + DAMPING * rate) / length)[:, None] * d
                for axis in range(3):
                    force[:, axis] += np.bincount(a, pull[:, axis], len(x))
                    force[:, axis] -= np.bincount(b, pull[:, axis], len(x))
            p, q, r = x[faces[:, 0]], x[faces[:, 1]], x[faces[:, 2]]
            normal = np.cross(q - p, r - p) / 2
            area = np.linalg.norm(normal, axis=1, keepdims=True)
            flow = (v[faces].mean(axis=1) * normal).sum(axis=1, keepdims=True) / area
            push = -0.5 * 1.2 * true.normal_drag * np.abs(flow) * flow * normal / 3
            for corner in faces.T:
                for axis in range(3):
                    force[:, axis] += np.bincount(corner, push[:, axis], len(x))
            v = v + step * force / mass
            v[:held] = 0.0
            x = x + step * v
        time = moment
        found.append(x)
    return np.stack(found)


def turning(cloth: dc.Cloth) -> Array:
    """Velocities of a turn of 1 rad/s about the held edge, free end down [m/s]."""
    vertices, held = np.array(cloth.vertices), cloth.pins["edge"]
    arm = np.linalg.norm(vertices - vertices[held[0]], axis=1)
    edge = vertices[held[-1]] - vertices[held[0]]
    edge = edge / np.linalg.norm(edge)
    along = (vertices - vertices[held[0]]) @ edge
    return np.sqrt(np.maximum(arm**2 - along**2, 0.0))[:, None] * [0.0, 0.0, -1.0]


def markers_of(finer: int) -> list[int]:
    """Vertices at the markers, of a sheet with `finer` edges between neighboring markers."""
    rows = finer * (ROWS - 1) + 1
    return np.arange(rows * rows).reshape(rows, rows)[::finer, ::finer].ravel().tolist()


def record(true: Truth, rng: np.random.Generator, frames: int = FRAMES, finer: int = 1) -> Array:
    """Markers [T, n, 3] that a camera sees of the masses, NaN where hidden.

    The masses have `finer` edges between neighboring markers.
    """
    masses = sheet(finer * (ROWS - 1) + 1)
    seen = simulate_masses(masses, true, clock[:frames] - true.delay)
    recorded = seen[:, markers_of(finer)]
    recorded = recorded + NOISE * rng.standard_normal(recorded.shape)
    recorded[rng.random(recorded.shape[:2]) < HIDDEN] = np.nan
    return recorded


def swing(
    dt: float, end: float, given: dc.Parameters, values: Mapping[str, torch.Tensor], finer: int = 1
) -> dc.Trajectory:
    """All states of the sheet from the start to the time `end` [s]."""
    cloth = sheet(finer * (ROWS - 1) + 1)
    contact = dc.ContactOptions(self_contact=False)
    simulator = dc.Simulator(dc.Scene([cloth]), dt, contact=contact, integrator="second_order")
    known = {n: v for n, v in vars(given).items() if isinstance(v, torch.Tensor)}
    parameters = simulator.default_parameters().replace(**known)
    speeds = values["speed"] * torch.from_numpy(turning(cloth))
    start = simulator.initial_state().replace(velocities=speeds)
    start = dc.at_half_step(start, parameters=parameters, simulator=simulator)
    steps = int(np.ceil(end / dt))
    return dc.Trajectory([start, *simulator.rollout(start, parameters=parameters, steps=steps)])


def compare(
    recorded: Array, dt: float, frames: slice, finer: int = 1
) -> Callable[..., torch.Tensor]:
    """Residuals of some frames, for `dc.fit`, with `finer` edges between neighboring markers."""
    times = clock[: len(recorded)][frames]

    def residuals(parameters, values):
        states = swing(dt, times[-1] + LATEST, parameters, values, finer)
        return dc.residuals.markers(
            states,
            recorded[frames],
            vertices=markers_of(finer),
            times=times,
            delay=values["delay"],
            noise=NOISE,
        )

    return residuals


def unknown() -> dict[str, dc.Variable]:
    """The fitted numbers, with first values."""
    return {
        "stretch": dc.Variable(100.0, bounds=(10.0, 1000.0)),
        "normal_drag": dc.Variable(0.6),
        "speed": dc.Variable(1.0),
        "delay": dc.Variable(0.0, bounds=(-LATEST, LATEST)),
    }


if __name__ == "__main__":
    truth = Truth()
    recorded = record(truth, np.random.default_rng(0))
    fitted = slice(0, KEPT)
    fit = dc.fit(
        unknown(),
        compare(recorded, 0.01, fitted),
        hold_out=compare(recorded, 0.01, slice(KEPT, FRAMES)),
    )
    print(fit)
    print(f"true: drag {truth.normal_drag}, speed {truth.speed}, delay {truth.delay}")
    print(f"the last {FRAMES - KEPT} frames, kept out: rms {fit.held_out[0]:.3g}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dc.StepBiasWarning)  # the numbers are printed below
        shift = fit.step_bias(compare(recorded, 0.005, fitted), order=2)
    limit = {name: float(fit.values[name] + moved) for name, moved in shift.items()}
    print("without the error of the time step:")
    for name, number in limit.items():
        print(f"  {name} {number:.4g}")
    low = fit.predict(lambda p, v: swing(0.01, clock[-1], p, v)[-1].positions[:, 2].min())
    print(f"lowest point at the end: {low.value:.4f} +- {low.half_width:.4f} m")
