"""Coverage of intervals by fits to recordings of another simulator, with other true numbers.

`python -m benchmarks.identification --foreign` prints the tables. The recordings come from the
masses and springs of `examples/fit_foreign.py`, and have no counterpart of the fitted stretch
stiffness. Each seed draws the true drag, speed and delay, the noise and the hidden markers.
"""

from __future__ import annotations

import functools
import importlib.util
import statistics
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
from torch import Tensor

import diffcloth_torch as dc
from diffcloth_torch.learn.evaluation import wilson
from diffcloth_torch.optimize.uncertainty import noise_of, uncertainty_of

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "fit_foreign.py"
NUMBERS = ("normal_drag", "speed", "delay")  # those that both simulators have
DRAG, SPEED, DELAY = (0.8, 1.6), (1.5, 2.5), (0.005, 0.02)  # ranges: [-], [rad/s], [s]
WARNINGS = (
    dc.ModelErrorWarning,
    dc.CorrelatedResidualsWarning,
    dc.StepBiasWarning,
    dc.MeshBiasWarning,
)

Intervals = dict[str, tuple[float, float]]


class Case(NamedTuple):
    """A kind of recording and its fit.

    Attributes:
        name: Description for the table.
        finer: Edges between masses for each edge of the fitted mesh.
        dt: Time step of the fit [s].
    """

    name: str
    finer: int
    dt: float


CASES = (
    Case("masses at the vertices, h = .02", 1, 0.02),
    Case("masses at the vertices, h = .01", 1, 0.01),
    Case("edges of the masses half as long, h = .01", 2, 0.01),
)


class Outcome(NamedTuple):
    """A fit with its intervals, by assumed noise and shift, and the warnings that it issued."""

    true: dict[str, float]
    intervals: dict[str, Intervals]
    warned: frozenset[type[Warning]]
    rms: float
    seconds: float

    def inside(self, way: str, name: str) -> bool:
        """Return whether an interval holds the true value."""
        low, high = self.intervals[way][name]
        return low <= self.true[name] <= high


@functools.cache
def example() -> ModuleType:
    """The example as a module, without its fit."""
    spec = importlib.util.spec_from_file_location("fit_foreign", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def outcome(case: Case, seed: int, frames: int | None = None) -> Outcome:
    """Record and fit with one seed.

    Args:
        case: The kind of recording.
        seed: Seed of the true numbers, the noise and the hidden markers.
        frames: Number of frames; None uses as many as the example fits.
    """
    masses, rng = example(), np.random.default_rng(seed)
    frames = masses.KEPT if frames is None else frames
    true = masses.Truth(*(float(rng.uniform(*ends)) for ends in (DRAG, SPEED, DELAY)))
    recorded = masses.record(true, rng, frames, case.finer)
    start, fitted = time.process_time(), slice(0, frames)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = dc.fit(
            masses.unknown(), masses.compare(recorded, case.dt, fitted), covariance="robust"
        )
        step = found.step_bias(masses.compare(recorded, case.dt / 2, fitted), order=2)
        shifts = {"step": step}
        if case.finer > 1:
            mesh = found.mesh_bias(masses.compare(recorded, case.dt, fitted, finer=2))
            shifts["step, mesh"] = {name: step[name] + mesh[name] for name in step}
    intervals = {}
    for noise, ends in (("white", white(found)), ("robust", found.intervals)):
        intervals[noise] = ends
        intervals |= {f"{noise}, {what}": moved(ends, by) for what, by in shifts.items()}
    return Outcome(
        true=true._asdict(),
        intervals=intervals,
        warned=frozenset(w.category for w in caught if w.category in WARNINGS),
        rms=found.rms,
        seconds=time.process_time() - start,
    )


def white(found: dc.Fit) -> Intervals:
    """Intervals of a fit under white noise: the covariance changes no fitted number."""
    model = found.linearized
    noise = noise_of(model.residuals, len(model.space), "linear", 1.0)
    return uncertainty_of(model.space, model.theta, model.jacobian, noise, None).intervals


def moved(intervals: Intervals, shift: dict[str, Tensor]) -> Intervals:
    """Move intervals as a whole."""
    return {
        n: (low + float(shift[n]), high + float(shift[n])) for n, (low, high) in intervals.items()
    }


def table(case: Case, outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Rows of the counts, with Wilson's intervals of 95 % for the underlying probability."""
    count, ways = len(outcomes), list(outcomes[0].intervals)
    rms = statistics.median(found.rms for found in outcomes)
    seconds = statistics.median(found.seconds for found in outcomes)
    yield f"\n{case.name}: residuals {rms:.2f} of the noise, {seconds:.1f} s"
    warned = Counter(category for found in outcomes for category in found.warned)
    yield ", ".join(f"{c.__name__} {warned[c]} of {count}" for c in WARNINGS)
    yield _line("", ways)
    for name in NUMBERS:
        yield _line(name, [_share(sum(f.inside(w, name) for f in outcomes), count) for w in ways])
    silent = [found for found in outcomes if dc.ModelErrorWarning not in found.warned]
    for title, fits in (("all", outcomes), ("not warned", silent)):
        counts = [sum(found.inside(way, n) for found in fits for n in NUMBERS) for way in ways]
        yield _line(title, [f"{inside} of {len(fits) * len(NUMBERS)}" for inside in counts])


def _line(title: str, cells: Sequence[str]) -> str:
    return f"{title:12}" + "".join(f"{cell:>21}" for cell in cells)


def _share(inside: int, count: int) -> str:
    low, high = wilson(inside, count)
    return f"{inside} of {count} ({100 * low:.0f}-{high:.0%})"
