"""Time a step forward and backward, by scene, size and batch.

    python -m benchmarks.step                                    # all scenes: long
    python -m benchmarks.step --scene sphere --size 24 --size 48
    python -m benchmarks.step --scene sphere --scene woven-sphere --size 24
    python -m benchmarks.step --quick                            # seconds
    python -m benchmarks.step --scene hanging --scene air --scene damped    # cost of a potential
    python -m benchmarks.step --scene gripper --scene limited-gripper

Times are medians with quartiles, in milliseconds per environment, and medians in EF: one numeric
factorization of the contact-free Hessian of the same state by `Eigen::SimplicialLDLT`, timed
between the steps. EF mostly removes the differences between machines. One core is used unless
`threads` is larger: `torch.set_num_threads(1)`, as set by `--threads`.

Each step is differentiated: backward maps cotangents of positions and velocities to positions and
velocities before the step and to the targets of the bodies. Solves use the default tolerance.
`touching` is the share of the cloth's vertices in a pair within the barrier distance, found by
ipctk (of the extra `test`). The core reports phases only for forward; backward is one number.
`tangent` and `x 8` are the times of one tangent and of eight at once over the time of a backward,
for the same inputs and outputs, all in the core for the last step.
"""

from __future__ import annotations

import json
import math
import platform
from pathlib import Path

import click
import torch
from tqdm import tqdm

import diffcloth_torch as dc
from benchmarks.measure import Spread, Timing, time_steps
from benchmarks.scenes import DT, FURTHER, SCENES

SIZES = (12, 24, 48, 96)
BATCH, BATCH_SIZE = 8, 24  # environments, and the size at which they are timed
SCALING_THREADS = 2

TIMED = {**SCENES, **FURTHER}
Row = tuple[str, int, int, int]  # scene, size, batch, threads


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.option("--scene", "scenes", multiple=True, type=click.Choice(list(TIMED)))
@click.option("--size", "sizes", multiple=True, type=click.IntRange(min=4), help="Vertices a side.")
@click.option("--steps", type=click.IntRange(min=1), help="Timed steps; by default fewer if large.")
@click.option("--threads", default=1, type=click.IntRange(min=1), help="Of torch.")
@click.option("--batch/--no-batch", default=True, help="Also time batches of 8 at 24 squared.")
@click.option("--quick", is_flag=True, help="Few steps of small sheets: shows that it runs.")
@click.option("--json", "out", type=click.Path(path_type=Path, dir_okay=False))
def main(
    scenes: tuple[str, ...],
    sizes: tuple[int, ...],
    steps: int | None,
    threads: int,
    batch: bool,
    quick: bool,
    out: Path | None,
) -> None:
    names = scenes or tuple(TIMED)
    given = tuple(sorted(sizes)) or ((6, 8) if quick else SIZES)
    batch_size = max(given) if quick else BATCH_SIZE
    rows: list[Row] = [(name, size, 0, threads) for name in names for size in given]
    if batch and batch_size in given:
        pools = sorted({threads, SCALING_THREADS})
        rows += [(name, batch_size, 2 if quick else BATCH, n) for name in names for n in pools]

    core = dc.build_info()
    print(f"{_processor()}; torch {torch.__version__}; {core['factorization']}")
    print(f"h = {DT:g} s, scheme coupled, tolerance {dc.SolverOptions().tolerance:g} m/s\n")
    print(_HEAD)
    timings = []
    for name, size, environments, count in tqdm(rows, disable=None, leave=False):
        timed = steps or (2 if quick else 20 if size <= 24 else 10 if size <= 48 else 5)
        timing = time_steps(name, size, environments, count, timed, TIMED[name](size))
        timings.append(timing)
        tqdm.write(_line(timing))
    print(f"\n{_phase_table(timings)}")
    exponents, scaling = exponents_in_vertices(timings), batch_scaling(timings)
    _print_summary(exponents, scaling)
    if out is not None:
        records = {
            "processor": _processor(),
            "torch": torch.__version__,
            "core": core,
            "timings": [timing.record() for timing in timings],
            "exponents": exponents,
            "batch_scaling": scaling,
        }
        out.write_text(json.dumps(records, indent=2) + "\n")


def exponents_in_vertices(timings: list[Timing]) -> dict[str, dict[str, float]]:
    """Exponent p of time ~ vertices^p between the smallest size from 24 on and the largest.

    If fewer than two sizes from 24 on were timed, between the smallest and the largest of all.
    """
    result = {}
    for name in dict.fromkeys(timing.scene for timing in timings):
        single = [t for t in timings if t.scene == name and t.batch == 0]
        large = [t for t in single if t.size >= 24]
        ends = sorted(large if len(large) > 1 else single, key=lambda t: t.size)
        a, b = ends[0], ends[-1]
        if a.size == b.size:
            continue  # one size determines no exponent
        growth = 2.0 * math.log(b.size / a.size)
        result[name] = {
            "from": a.size,
            "to": b.size,
            "forward": math.log(b.forward.median / a.forward.median) / growth,
            "backward": math.log(b.backward.median / a.backward.median) / growth,
        }
    return result


def batch_scaling(timings: list[Timing]) -> dict[str, dict[str, float]]:
    """Speedup of a batch on several threads over one thread."""
    result = {}
    for name in dict.fromkeys(timing.scene for timing in timings):
        batches = {t.threads: t for t in timings if t.scene == name and t.batch > 0}
        many = max(batches, default=1)
        if 1 not in batches or many == 1:
            continue
        one, all_threads = batches[1], batches[many]
        result[name] = {
            "threads": many,
            "forward": one.forward.median / all_threads.forward.median,
            "backward": one.backward.median / all_threads.backward.median,
        }
    return result


_HEAD = (
    f"{'scene':<16}{'size':>6}{'batch':>6}{'threads':>8}  {'forward [ms]':>22}{'[EF]':>7}"
    f"  {'backward [ms]':>20}{'[EF]':>7}{'tangent':>9}{'x 8':>6}"
    f"  {'EF [ms]':>8}{'Newton':>8}{'residual':>10}{'contacts':>9}{'touching':>9}"
)


def _line(t: Timing) -> str:
    return (
        f"{t.scene:<16}{t.size:>4}^2{t.batch or 1:>6}{t.threads:>8}  {_spread(t.forward):>22}"
        f"{t.forward_in_ef:>7.2f}  {_spread(t.backward):>20}{t.backward_in_ef:>7.2f}"
        f"{t.tangent:>9.2f}{t.many_tangents:>6.2f}"
        f"  {_number(t.reference.median):>8}{t.iterations:>8.1f}{t.residual:>10.1e}"
        f"{t.contacts:>9.0f}{t.contact_share:>9.1%}"
    )


def _spread(s: Spread) -> str:
    return f"{_number(s.median)} ({_number(s.lower)} .. {_number(s.upper)})"


def _number(value: float) -> str:
    """A number with three significant digits, or all digits before the point."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _phase_table(timings: list[Timing]) -> str:
    """Medians of the phases of forward [ms]."""
    phases = list(timings[0].phases)
    lines = ["Phases of forward, medians [ms per environment]:"]
    lines.append(f"{'scene':<16}{'size':>6}{'batch':>6}{'threads':>8}" + _cells(phases))
    for t in timings:
        cells = [_number(t.phases[phase]) for phase in phases]
        lines.append(f"{t.scene:<16}{t.size:>4}^2{t.batch or 1:>6}{t.threads:>8}" + _cells(cells))
    return "\n".join(lines)


def _cells(texts: list[str]) -> str:
    return "".join(f"{text:>15}" for text in texts)


def _print_summary(
    exponents: dict[str, dict[str, float]], scaling: dict[str, dict[str, float]]
) -> None:
    if exponents:
        print("\nExponent of the time in the number of vertices:")
    for name, e in exponents.items():
        sizes = f"{e['from']}^2 to {e['to']}^2"
        print(f"{name:<16} {sizes}: forward {e['forward']:.2f}, backward {e['backward']:.2f}")
    if scaling:
        print("\nSpeed of a batch over threads, relative to one thread:")
    for name, s in scaling.items():
        print(
            f"{name:<16} {s['threads']} threads: forward {s['forward']:.2f}, "
            f"backward {s['backward']:.2f}"
        )


def _processor() -> str:
    """Name of the processor, if Linux reports one."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()


if __name__ == "__main__":
    main()
