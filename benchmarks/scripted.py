"""Time the steps of environments under their scripts, beside another checkout or alone.

    python -m benchmarks.scripted                        # this checkout, by phase
    python -m benchmarks.scripted --against ../other     # side by side
    python -m benchmarks.scripted --task LiftCloth --size 10 --certify gradients

Environments simulate small, damped, frictional sheets in batches, unlike the sheets of
`benchmarks.step`. States and controls of `--steps` time steps are recorded once, with the other
checkout if there is one. Both simulators are loaded from the same file with the same options, and
repeat these recorded steps alternately, in processes pinned to one core: a difference between
versions does not accumulate over steps. Times are processor times per environment, medians over the
steps; a ratio is other over this. `ends` is the largest distance between the vertices of both after
a step. `core` is the sum of the phases of forward. `python` is the time of `env.step` outside of
the core, per time step and environment, measured in separate transitions of each version; both are
medians of wall-clock time.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import click

ROOT = Path(__file__).resolve().parents[1]
WORKER = Path(__file__).with_name("scripted_worker.py")

# Task, vertices a side, environments.
ROWS = (
    ("FoldCloth", 12, 8),
    ("GraspCloth", 10, 8),
    ("LiftCloth", 10, 8),
    ("HangCloth", 10, 8),
    ("PushCube", 9, 8),
    ("FoldCloth", 8, 1),
    ("LiftCloth", 9, 1),
)
Row = tuple[str, int, int]


class Side:
    """A process with one package."""

    def __init__(self, package: Path, job: dict[str, Any]) -> None:
        cores = sorted(os.sched_getaffinity(0))[-1:]
        self._process = subprocess.Popen(
            [sys.executable, str(WORKER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )
        self._package = package
        self._send(json.dumps({**job, "package": str(package), "cores": cores}))
        self.answer = self._receive()

    def step(self) -> dict[str, Any]:
        self._send("step")
        return self._receive()

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def _send(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def _receive(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise click.ClickException(f"the process of {self._package} ended; see above")
        answer: dict[str, Any] = json.loads(line)
        return answer


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.option("--against", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--task", "tasks", multiple=True, help="By default the listed rows.")
@click.option("--size", type=click.IntRange(min=4), help="Vertices a side, for --task.")
@click.option("--batch", default=8, show_default=True, help="Environments, for --task.")
@click.option("--steps", default=40, show_default=True, type=click.IntRange(1))
@click.option("--turns", default=3, show_default=True, type=click.IntRange(1))
@click.option("--certify", default="always", type=click.Choice(["always", "gradients"]))
@click.option("--json", "out", type=click.Path(path_type=Path, dir_okay=False))
def main(
    against: Path | None,
    tasks: Sequence[str],
    size: int | None,
    batch: int,
    steps: int,
    turns: int,
    certify: str,
    out: Path | None,
) -> None:
    rows = [(task, size or 12, batch) for task in tasks] or list(ROWS)
    print(_HEAD if against else _HEAD_ALONE)
    records = []
    for row in rows:
        record = time_row(row, against, steps, turns, certify)
        records.append(record)
        print(_line(record))
        sys.stdout.flush()
    print("\nThis checkout by phase [ms], and counts a step:")
    for record in records:
        print(_phases(record))
    if out is not None:
        out.write_text(json.dumps(records, indent=2) + "\n")


def time_row(
    row: Row, against: Path | None, steps: int, turns: int, certify: str = "always"
) -> dict[str, Any]:
    """Numbers of one row for this checkout, and for the other if there is one."""
    task, size, batch = row
    packages = [ROOT] if against is None else [ROOT, against]
    with TemporaryDirectory() as folder:
        job = {"task": task, "size": size, "batch": batch, "steps": steps}
        job |= {"file": f"{folder}/steps.pt", "certify": certify}
        Side(packages[-1], {**job, "does": "record"}).close()
        sides = [Side(package, {**job, "does": "time"}) for package in packages]
        samples: list[list[dict[str, Any]]] = [[] for _ in sides]
        for k in range(turns * steps):
            # The first one finds the caches of the second: they change places.
            for i in range(len(sides)) if k % 2 == 0 else reversed(range(len(sides))):
                samples[i].append(sides[i].step())
        for side in sides:
            side.close()
        transitions = []
        for package in packages:
            side = Side(package, {**job, "does": "transitions"})
            transitions.append(side.answer)
            side.close()
    result: dict[str, Any] = {"task": task, "size": size, "batch": batch}
    for name, own, answer in zip(("this", "other"), samples, transitions, strict=False):
        per_step = [own[k::steps] for k in range(steps)]
        result[name] = {
            key: 1e3 * sum(median(s[key] for s in each) for each in per_step) / steps
            for key in ("forward", "with_gradients", "core")
        }
        result[name] |= {
            "python": 1e3 * answer["outside"] / answer["steps"] / batch,
            "transition": 1e3 * answer["transition"] / batch,
        }
        for key in ("iterations", "contacts"):
            result[name][key] = sum(s[key] for s in own) / len(own)
        for table in ("phases", "counts"):
            scale = 1e3 if table == "phases" else 1.0
            result[name][table] = {
                entry: scale * sum(s[table][entry] for s in own) / len(own)
                for entry in own[0][table]
            }
    if against is not None:
        result["ends"] = max(
            abs(a - b)
            for ours, theirs in zip(*(s[:steps] for s in samples), strict=True)
            for a, b in zip(ours["end"], theirs["end"], strict=True)
        )
    return result


_TIMES = ("forward", "with_gradients", "core", "python")
_HEAD = f"{'task':<14}{'size':>5}{'batch':>6}" + "".join(
    f"{name + ' [ms]':>20}{'other':>8}{'ratio':>7}" for name in _TIMES
)
_HEAD += f"{'iterations':>12}{'other':>7}{'ends [m]':>10}"
_HEAD_ALONE = f"{'task':<14}{'size':>5}{'batch':>6}" + "".join(
    f"{name + ' [ms]':>20}" for name in _TIMES
)
_HEAD_ALONE += f"{'iterations':>12}"


def _line(record: dict[str, Any]) -> str:
    text = f"{record['task']:<14}{record['size']:>5}{record['batch']:>6}"
    ours, theirs = record["this"], record.get("other")
    for name in _TIMES:
        text += f"{ours[name]:>20.3g}"
        if theirs is not None:
            text += f"{theirs[name]:>8.3g}{theirs[name] / ours[name]:>7.2f}"
    text += f"{ours['iterations']:>12.1f}"
    if theirs is not None:
        text += f"{theirs['iterations']:>7.1f}{record['ends']:>10.1e}"
    return text


def _phases(record: dict[str, Any]) -> str:
    ours = record["this"]
    phases = ", ".join(f"{name} {value:.3g}" for name, value in ours["phases"].items())
    counts = ", ".join(f"{n} {value:.3g}" for n, value in ours["counts"].items() if value)
    head = f"{record['task']} {record['size']} x {record['batch']}"
    return f"{head}: {phases}; contacts {ours['contacts']:.3g}; {counts}"


if __name__ == "__main__":
    main()
