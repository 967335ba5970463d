"""Time this checkout and another one side by side, on the same scenes.

    python -m benchmarks.compare --against ../other
    python -m benchmarks.compare --against ../other --scene sphere --size 24 --size 48

`--against` is a folder with a built package `diffcloth_torch`: another checkout, or the
site-packages of another environment. The two run in separate processes, pinned to one core, and
step alternately, so that other load of the machine slows both. Both start at the end of this
checkout's approach; then each follows its own trajectory, because models of contact may differ
between versions.

Times are medians in milliseconds per environment, the ratio is other over this: above 1, this
checkout is faster. `--cpu` counts processor time instead of wall-clock time. The batch (8
environments, at size 24 or the largest below) is timed on 1 and 2 threads and as many cores;
`scaling` is how many times faster 2 threads are than 1.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import click
from tqdm import tqdm

from benchmarks.scenes import BUCKLING, FURTHER, SCENES, kept_file

ALL = SCENES | BUCKLING
ROOT = Path(__file__).resolve().parents[1]
SIZES = (12, 24, 48)
BATCH = 8
LARGEST_BATCHED = 24
POOLS = (1, 2)  # threads of the batch
WARM_UP = 2  # steps whose times are dropped: caches fill


@dataclass(frozen=True)
class Row:
    """One timed configuration."""

    scene: str
    size: int
    batch: int  # 0 for a state without a batch axis
    threads: int


@dataclass(frozen=True)
class Medians:
    """Medians of one side.

    Attributes:
        forward: Time of a step per environment [ms].
        backward: Time of backward for converged steps, per environment [ms]; None without any.
        iterations: Newton iterations of a step.
        unconverged: Number of timed environment steps that did not converge.
    """

    forward: float
    backward: float | None
    iterations: float
    unconverged: int

    @staticmethod
    def of(samples: list[dict[str, Any]]) -> Medians:
        backward = [1e3 * s["backward"] for s in samples if s["backward"] is not None]
        return Medians(
            forward=median(1e3 * s["forward"] for s in samples),
            backward=median(backward) if backward else None,
            iterations=median(s["iterations"] for s in samples),
            unconverged=sum(s["unconverged"] for s in samples),
        )


class Side:
    """A process that steps one package."""

    def __init__(
        self,
        package: Path,
        row: Row,
        kept: Path,
        processor_time: bool,
        slip_velocity: float | None,
    ) -> None:
        cores = sorted(os.sched_getaffinity(0))[-row.threads :]
        worker = Path(__file__).with_name("worker.py")
        self._process = subprocess.Popen(
            [sys.executable, str(worker)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )
        self._name = package
        given: dict[str, Any] = {"package": str(package), "cores": cores}
        given |= {"processor_time": processor_time, "slip_velocity": slip_velocity}
        given["kept"] = str(kept_file(kept, row.scene, row.size, row.batch))
        self._send(json.dumps({**asdict(row), **given}))
        self.ready = self._receive()

    def step(self) -> dict[str, Any]:
        self._send("step")
        return self._receive()

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()

    def _send(self, line: str) -> None:
        # A side that has failed reports its reason when its answer is read.
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()

    def _receive(self) -> dict[str, Any]:
        line = self._process.stdout.readline()
        if not line:
            raise click.ClickException(f"the process of {self._name} ended; see above")
        return json.loads(line)


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.option(
    "--against",
    required=True,
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder with the other package.",
)
@click.option("--scene", "scenes", multiple=True, type=click.Choice(list(ALL | FURTHER)))
@click.option("--size", "sizes", multiple=True, type=click.IntRange(min=4), help="Vertices a side.")
@click.option("--steps", type=click.IntRange(min=1), help="Timed steps; by default fewer if large.")
@click.option("--batch/--no-batch", default=True, help="Also time batches of 8.")
@click.option("--cpu", is_flag=True, help="Processor time, for a machine that others use too.")
@click.option(
    "--slip-velocity",
    type=click.FloatRange(min=0, min_open=True),
    help="Of both [m/s]; by default that of each version, which was 1e-3, then 1e-4, now 1e-5.",
)
@click.option("--json", "out", type=click.Path(path_type=Path, dir_okay=False))
def main(
    against: Path,
    scenes: tuple[str, ...],
    sizes: tuple[int, ...],
    steps: int | None,
    batch: bool,
    cpu: bool,
    slip_velocity: float | None,
    out: Path | None,
) -> None:
    names, given = scenes or tuple(ALL), sorted(sizes or SIZES)
    rows = [Row(name, size, 0, 1) for name in names for size in given]
    batched = [size for size in given if size <= LARGEST_BATCHED]
    if batch and batched:
        rows += [Row(name, max(batched), BATCH, n) for name in names for n in POOLS]
    print(f"this: {ROOT}\nother: {against.resolve()}\n\n{_HEAD}")
    results = []
    for row in tqdm(rows, disable=None, leave=False):
        timed = steps or (20 if row.size <= 24 else 10 if row.size <= 48 else 5)
        with TemporaryDirectory() as kept:
            ours, theirs = time_row(row, against, Path(kept), timed, cpu, slip_velocity)
        results.append((row, ours, theirs))
        tqdm.write(_line(row, ours, theirs))
    if not cpu:
        _print_scaling(results)
    if out is not None:
        records = [
            {**asdict(row), "this": asdict(ours), "other": asdict(theirs)}
            for row, ours, theirs in results
        ]
        out.write_text(json.dumps(records, indent=2) + "\n")


def time_row(
    row: Row,
    against: Path,
    kept: Path,
    steps: int,
    processor_time: bool,
    slip_velocity: float | None = None,
) -> tuple[Medians, Medians]:
    """Medians of this checkout and of the other, which step alternately.

    Both start at the end of this checkout's approach, which the folder `kept` stores.
    """
    with contextlib.ExitStack() as stack:
        sides = []
        for package in (ROOT, against):
            sides.append(Side(package, row, kept, processor_time, slip_velocity))
            stack.callback(sides[-1].close)
        samples: tuple[list[dict[str, Any]], ...] = ([], [])
        for k in range(WARM_UP + steps):
            # Alternate the first side, which runs with the caches of the second.
            for i in (0, 1) if k % 2 == 0 else (1, 0):
                sample = sides[i].step()
                if k >= WARM_UP:
                    samples[i].append(sample)
    return Medians.of(samples[0]), Medians.of(samples[1])


_HEAD = (
    f"{'scene':<13}{'size':>6}{'batch':>6}{'threads':>8}"
    f"{'forward [ms]':>14}{'other':>9}{'ratio':>7}{'backward [ms]':>15}{'other':>9}{'ratio':>7}"
    f"{'Newton':>8}{'other':>7}{'unconverged':>13}{'other':>7}"
)


def _line(row: Row, ours: Medians, theirs: Medians) -> str:
    text = f"{row.scene:<13}{row.size:>4}^2{row.batch or 1:>6}{row.threads:>8}"
    for name, width in (("forward", 14), ("backward", 15)):
        a, b = getattr(ours, name), getattr(theirs, name)
        text += f"{_number(a):>{width}}{_number(b):>9}"
        text += f"{b / a:>7.2f}" if a and b else f"{'-':>7}"
    return (
        f"{text}{ours.iterations:>8.1f}{theirs.iterations:>7.1f}"
        f"{ours.unconverged:>13}{theirs.unconverged:>7}"
    )


def _number(value: float | None) -> str:
    """A number with three significant digits, or all digits before the point."""
    if value is None:
        return "-"
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _print_scaling(results: list[tuple[Row, Medians, Medians]]) -> None:
    batches = {(r.scene, r.threads): (a, b) for r, a, b in results if r.batch}
    if batches:
        print("\nScaling of a batch from 1 thread to 2, this and other:")
    for scene in dict.fromkeys(scene for scene, _ in batches):
        one, two = batches[scene, POOLS[0]], batches[scene, POOLS[1]]
        forward = [a.forward / b.forward for a, b in zip(one, two, strict=True)]
        backward = [
            a.backward / b.backward if a.backward and b.backward else float("nan")
            for a, b in zip(one, two, strict=True)
        ]
        print(
            f"{scene:<13} forward {forward[0]:.2f}, {forward[1]:.2f};"
            f"  backward {backward[0]:.2f}, {backward[1]:.2f}"
        )


if __name__ == "__main__":
    main()
