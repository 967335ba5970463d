"""Write the page of measurements, docs/performance.md, and its plots.

    python -m benchmarks.figures --against "the first version=../first"
    python -m benchmarks.figures --newton ../peer/bin/python ...    # see benchmarks.peers
    python -m benchmarks.figures --forward-peers NEWTON MUJOCO    # repeat only these peers
    python -m benchmarks.figures --environments "the first version=../first"    # repeat only these
    python -m benchmarks.figures --integrators    # repeat only these
    python -m benchmarks.figures --draw    # redraw only the page

`--against` names another checkout with a built package, and may be repeated: all scenes are timed
with it and this checkout side by side, as by `benchmarks.compare`. Then this checkout alone is
timed by phases, as by `benchmarks.step`, and with several losses in one backward. `--newton` is the
Python of an environment with Newton, which is timed beside this package as by `benchmarks.peers`.
Measurements are stored in docs/performance.json, from which page and plots are made; peers,
environments and integrators that a run does not measure keep their records.
`--forward-peers` repeats the measurements of `benchmarks.forward_peers`, with the Pythons of its
two environments, `--environments` those by `benchmarks.scripted`, and `--integrators` the part
`explicit` of `benchmarks.integrators`; all keep all other records.

`--cpu` counts processor time, for a shared machine; threads are then omitted, because processor
time does not show their benefit.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Iterable
from dataclasses import asdict
from datetime import date
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import click
import torch
from tqdm import tqdm

import diffcloth_torch as dc
from benchmarks import forward_peers, scripted
from benchmarks.compare import BATCH, POOLS, ROOT, Row, time_row
from benchmarks.integrators import INTEGRATORS, errors_and_times
from benchmarks.measure import time_steps
from benchmarks.pages import table
from benchmarks.peers import time_all
from benchmarks.scenes import BUCKLING, DT, SCENES, in_regime, kept_file
from benchmarks.step import _processor

RECORDS = "performance.json"
SIZES = (12, 24, 48)
PHASE_SIZES = (24, 48)
BUCKLING_SIZE = 24
STEPS = {12: 12, 24: 12, 48: 4}  # number of timed steps by size, after the warm-up
BATCH_SCENES = ("hanging", "sphere")
LOSSES = (1, 8, 64)
LOSS_SCENES = ("hanging", "sphere", "self-contact")
REPEATS = 5  # of a backward with several losses
SHARED = (
    ("hanging", 48),
    ("sphere", 48),
    ("self-contact", 48),
    ("hanging", 96),
    ("plane", 96),
)
SHARED_STEPS = 3

Records = dict[str, Any]


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.option("--against", "others", multiple=True, help="NAME=FOLDER with a built package.")
@click.option(
    "--newton",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Python of an environment that has Newton.",
)
@click.option(
    "--forward-peers",
    "forward",
    nargs=2,
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    metavar="NEWTON MUJOCO",
    help="Measure these alone: Pythons of environments that have Newton and MuJoCo.",
)
@click.option(
    "--environments", "environments", help="NAME=FOLDER with a built package; measure these alone."
)
@click.option("--integrators", "integrating", is_flag=True, help="Measure these alone.")
@click.option("--cpu", is_flag=True, help="Processor time instead of wall-clock time.")
@click.option("--quick", is_flag=True, help="Tiny sheets: shows that it runs.")
@click.option("--draw", is_flag=True, help="Measure nothing: draw what was measured before.")
@click.option("--docs", default=ROOT / "docs", type=click.Path(path_type=Path, file_okay=False))
def main(
    others: tuple[str, ...],
    newton: Path | None,
    forward: tuple[Path, Path] | None,
    environments: str | None,
    integrating: bool,
    cpu: bool,
    quick: bool,
    draw: bool,
    docs: Path,
) -> None:
    file = docs / RECORDS
    if draw or forward or environments or integrating:
        if not file.exists():
            alone = "--environments" if environments else "--integrators"
            option = "--draw" if draw else "--forward-peers" if forward else alone
            raise click.UsageError(f"{option} needs {file}, which a run without it writes")
        if forward and not draw:
            records = json.loads(file.read_text())
            records["forward_peers"] = measure_forward_peers(*forward)
            file.write_text(json.dumps(records, indent=1) + "\n")
        if environments and not draw:
            records = json.loads(file.read_text())
            ((release, folder),) = _folders([environments]).items()
            records["environments"] = measure_environments(release, folder, quick)
            file.write_text(json.dumps(records, indent=1) + "\n")
        if integrating and not draw:
            records = json.loads(file.read_text())
            records["integrators"] = measure_integrators(quick)
            file.write_text(json.dumps(records, indent=1) + "\n")
    else:
        earlier = json.loads(file.read_text()) if file.exists() else {}
        file.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory() as kept:
            measured = measure(_folders(others), cpu, quick, Path(kept))
        if newton is not None:
            measured["peers"] = measure_peers(newton, quick)
        for part in ("peers", "forward_peers", "environments", "integrators"):
            measured.setdefault(part, earlier.get(part))
        file.write_text(json.dumps(measured, indent=1) + "\n")
    records = json.loads(file.read_text())
    (docs / "images").mkdir(exist_ok=True)
    plots = draw_all(records, docs / "images")
    (docs / "performance.md").write_text(page(records, plots))
    print(docs / "performance.md")


def _folders(others: Iterable[str]) -> dict[str, Path]:
    folders = {}
    for text in others:
        name, equals, folder = text.partition("=")
        if not (name and equals and Path(folder).is_dir()):
            raise click.UsageError(f"--against must be NAME=FOLDER with a folder, got {text!r}")
        folders[name] = Path(folder)
    return folders


# ---- measuring ----


def measure(others: dict[str, Path], cpu: bool, quick: bool, kept: Path) -> Records:
    """All measurements of the page, as plain numbers.

    The folder `kept` stores each scene's regime, because the approach takes longer than the timing.
    """
    sizes, phase_sizes = ((6,), (6,)) if quick else (SIZES, PHASE_SIZES)
    names = BATCH_SCENES if quick else tuple(SCENES)
    rows = [Row(name, size, 0, 1) for size in sizes for name in names]
    if not quick:
        rows += [Row(name, BUCKLING_SIZE, 0, 1) for name in BUCKLING]
    steps = dict.fromkeys(sizes, 2) if quick else STEPS
    pools = POOLS[:1] if cpu else POOLS
    batched = sizes[0] if quick else 24
    batch_names = BATCH_SCENES[-1:] if quick else BATCH_SCENES
    rows += [Row(name, batched, BATCH, n) for name in batch_names for n in pools]
    start = time.perf_counter()
    records: Records = {
        "date": date.today().isoformat(),
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "load": [round(os.getloadavg()[0], 1)],
        "clock": "processor" if cpu else "wall",
        "torch": torch.__version__,
        "core": dc.build_info()["factorization"],
        "dt": DT,
        "steps": {str(size): steps[size] for size in sizes},
        "tolerance": dc.SolverOptions().tolerance,
        "releases": {},
    }
    for release, folder in others.items():
        records["releases"][release] = []
        for row in tqdm(rows, desc=release, disable=None, leave=False):
            ours, theirs = time_row(row, folder, kept, steps[row.size], cpu)
            records["releases"][release].append(
                {**asdict(row), "this": asdict(ours), "other": asdict(theirs)}
            )
    torch.set_num_threads(1)
    records["phases"] = [
        _phases(name, size, steps[size], kept)
        for size in phase_sizes
        for name in tqdm(SCENES, desc="phases", disable=None, leave=False)
    ]
    counts = (1, 3) if quick else LOSSES
    records["losses"] = [
        _time_losses(name, phase_sizes[0], count, cpu, kept)
        for name in LOSS_SCENES
        for count in counts
    ]
    shared = [(BATCH_SCENES[0], sizes[0])] if quick else SHARED
    records["shared"] = [_time_shared(name, size, kept) for name, size in shared]
    records["load"].append(round(os.getloadavg()[0], 1))
    records["minutes"] = round((time.perf_counter() - start) / 60, 1)
    return records


def _dated(rows: Iterable[Any], **more: Any) -> Records:
    """Measured rows with the date and the processor."""
    found = list(rows)
    return {"date": date.today().isoformat(), "processor": _processor(), **more, "rows": found}


def measure_peers(newton: Path, quick: bool) -> Records:
    """Return the times that `benchmarks.peers` measures, with date and processor."""
    torch.set_num_threads(1)
    return _dated(time_all(newton, 6 if quick else PHASE_SIZES[0]))


def measure_forward_peers(newton: Path, mujoco: Path) -> Records:
    """Measurements of `benchmarks.forward_peers`, with date and processor."""
    torch.set_num_threads(1)
    return _dated(forward_peers.time_all(newton, mujoco, PHASE_SIZES[0]))


def measure_environments(release: str, folder: Path, quick: bool) -> Records:
    """Return the times that `benchmarks.scripted` measures, with the date."""
    rows, steps, turns = ((("FoldCloth", 7, 1),), 2, 1) if quick else (scripted.ROWS, 40, 3)
    shown = tqdm(rows, desc="environments", disable=None, leave=False)
    return _dated((scripted.time_row(row, folder, steps, turns) for row in shown), release=release)


def measure_integrators(quick: bool) -> Records:
    """Return the errors and times of both integrators, with the date."""
    torch.set_num_threads(1)
    return _dated(errors_and_times(4, 0.1) if quick else errors_and_times(5, 0.5))


def _phases(name: str, size: int, steps: int, kept: Path) -> Records:
    file = kept_file(kept, name, size, 0)
    timing = time_steps(name, size, 0, 1, steps, SCENES[name](size), file)
    return {
        "scene": name,
        "size": size,
        "forward_in_ef": timing.forward_in_ef,
        "backward_in_ef": timing.backward_in_ef,
        "iterations": timing.iterations,
        "contacts": timing.contacts,
        "residual": timing.residual,
        "phases": timing.phases,
    }


def _time_losses(name: str, size: int, count: int, cpu: bool, kept: Path) -> Records:
    """Backward of several losses in a loop and in one call, in turn [ms]."""
    scene = SCENES[name](size)
    simulator = dc.Simulator(scene.scene, DT)
    before = in_regime(simulator, scene, 0, kept_file(kept, name, size, 0)).detach()
    leaves = [before.positions.requires_grad_(), before.velocities.requires_grad_()]
    after = simulator.step(before, scene.control(before))
    outputs = [after.positions, after.velocities]
    g = torch.Generator().manual_seed(1)
    losses = [torch.randn(count, *y.shape, generator=g, dtype=y.dtype) for y in outputs]
    clock = time.process_time if cpu else time.perf_counter

    def in_a_loop() -> None:
        for k in range(count):
            torch.autograd.grad(outputs, leaves, [c[k] for c in losses], retain_graph=True)

    def at_once() -> None:
        torch.autograd.grad(outputs, leaves, losses, retain_graph=True, is_grads_batched=True)

    seconds: dict[str, list[float]] = {"loop": [], "once": []}
    for _ in range(REPEATS):
        for key, run in (("loop", in_a_loop), ("once", at_once)):
            start = clock()
            run()
            seconds[key].append(clock() - start)
    times = {key: 1e3 * median(values) for key, values in seconds.items()}
    return {"scene": name, "size": size, "losses": count, **times}


def _time_shared(name: str, size: int, kept: Path) -> Records:
    """A step of one environment on one thread and on two, in turn [ms of wall-clock time]."""
    scene = SCENES[name](size)
    simulator = dc.Simulator(scene.scene, DT)
    state = in_regime(simulator, scene, 0, kept_file(kept, name, size, 0)).detach()
    seconds: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(SHARED_STEPS):
        for threads, taken in seconds.items():
            torch.set_num_threads(threads)
            start = time.perf_counter()
            after = simulator.step(state, scene.control(state))
            taken.append(time.perf_counter() - start)
        state = after
    torch.set_num_threads(1)
    one, two = (1e3 * median(taken) for taken in seconds.values())
    return {"scene": name, "size": size, "one": one, "two": two}


# ---- drawing ----


def draw_all(records: Records, folder: Path) -> list[tuple[str, str]]:
    """Draw the plots; return their files and captions."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams.update({"svg.hashsalt": "diffcloth_torch", "font.size": 9})
    plots = []
    if records["releases"]:
        _draw_ratios(records, folder / "performance_ratio.svg")
        _draw_sizes(records, folder / "performance_size.svg")
        plots += [
            ("performance_ratio.svg", "How many times faster this release is, by scene and size"),
            ("performance_size.svg", "Milliseconds a step over the number of vertices"),
        ]
    _draw_phases(records, folder / "performance_phases.svg")
    return [*plots, ("performance_phases.svg", "Shares of the phases in a step forward")]


def _draw_ratios(records: Records, file: Path) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True, layout="constrained")
    for axis, part in zip(axes, ("forward", "backward"), strict=True):
        bars = [
            (f"{release}, {size}²", {r["scene"]: _ratio(r, part) for r in rows if _is(r, size)})
            for release, rows in records["releases"].items()
            for size in _sizes(rows)
        ]
        width = 0.8 / len(bars)
        for k, (label, ratios) in enumerate(bars):
            places = [i + (k - (len(bars) - 1) / 2) * width for i in range(len(ratios))]
            heights = [ratio if ratio else math.nan for ratio in ratios.values()]
            axis.bar(places, heights, width, label=label)
            axis.set_xticks(range(len(ratios)), ratios, rotation=30, ha="right")
        axis.axhline(1.0, color="black", linewidth=0.8)
        axis.set_title(part)
    axes[0].set_ylabel("times faster than")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=7, loc="outside lower center", ncols=3)  # beside no bar
    _save(figure, file)


def _draw_sizes(records: Records, file: Path) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for axis, part in zip(axes, ("forward", "backward"), strict=True):
        for k, name in enumerate(SCENES):
            for release, rows in records["releases"].items():
                chosen = [r for r in rows if r["scene"] == name and not r["batch"]]
                vertices = [r["size"] ** 2 for r in chosen]
                if release == next(iter(records["releases"])):
                    times = [r["this"][part] or math.nan for r in chosen]
                    axis.loglog(vertices, times, "o-", color=f"C{k}", label=name, markersize=3)
                times = [r["other"][part] or math.nan for r in chosen]
                axis.loglog(vertices, times, "--", color=f"C{k}", linewidth=0.8)
        axis.set_title(f"{part}, dashed: {', '.join(records['releases'])}")
        sides = sorted({r["size"] for rows in records["releases"].values() for r in rows})
        axis.set_xticks([n * n for n in sides], [f"{n} x {n}" for n in sides])
        axis.minorticks_off()
        axis.set_xlabel("vertices")
    axes[0].set_ylabel("ms a step")
    axes[0].legend(fontsize=7)
    _save(figure, file)


def _draw_phases(records: Records, file: Path) -> None:
    import matplotlib.pyplot as plt

    sizes = list(dict.fromkeys(r["size"] for r in records["phases"]))
    phases = list(records["phases"][0]["phases"])
    figure, axes = plt.subplots(
        1, len(sizes), figsize=(9, 3.4), sharey=True, layout="constrained", squeeze=False
    )
    for axis, size in zip(axes[0], sizes, strict=True):
        rows = [r for r in records["phases"] if r["size"] == size]
        below = [0.0] * len(rows)
        for phase in phases:
            shares = [r["phases"][phase] / sum(r["phases"].values()) for r in rows]
            axis.bar([r["scene"] for r in rows], shares, bottom=below, label=phase)
            below = [a + b for a, b in zip(below, shares, strict=True)]
        axis.set_title(f"{size} x {size}")
        axis.tick_params(axis="x", rotation=30)
    axes[0][0].set_ylabel("share of forward")
    axes[0][-1].legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    _save(figure, file)


def _save(figure: Any, file: Path) -> None:
    import matplotlib.pyplot as plt

    figure.savefig(file, metadata={"Date": None})
    plt.close(figure)
    # Remove trailing blanks, as some editors and hooks do.
    lines = file.read_text().splitlines()
    file.write_text("\n".join(line.rstrip() for line in lines) + "\n")


# ---- the page ----


def page(records: Records, plots: list[tuple[str, str]]) -> str:
    """The Markdown of the page."""
    parts = ["# Performance", _preface(records)]
    parts += [f"![{text}](images/{file})" for file, text in plots]
    if records.get("environments"):
        found = records["environments"]
        parts += ["## Environments", _environment_text(found), _environment_table(found["rows"])]
        parts += [_environment_phases(found["rows"])]
    for release, rows in records["releases"].items():
        parts += [f"## Compared with {release}", _release_text(rows, release), _release_table(rows)]
    parts += ["## By phase", _PHASE_TEXT, _phase_table(records["phases"])]
    if records.get("integrators"):
        found = records["integrators"]
        parts += ["## Error against time", _integrator_text(found)]
        parts += [_integrator_table(found["rows"])]
    losses = _pair_table(
        records["losses"], ["scene", "size", "losses"], {"loop": "loop", "once": "one call"}
    )
    parts += ["## Many losses", _LOSS_TEXT, losses]
    shared = _pair_table(records["shared"], ["scene", "size"], {"one": "one thread", "two": "two"})
    parts += ["## One environment on two threads", _SHARED_TEXT, shared]
    if records.get("peers"):
        found = records["peers"]
        parts += ["## Compared with Newton", _PEER_TEXT.format(**found)]
        parts += [_peer_table(found["rows"])]
    if records.get("forward_peers"):
        parts += ["## Compared with VBD and MuJoCo", _forward_peer_text(records["forward_peers"])]
        parts += [_forward_peer_table(records["forward_peers"]["rows"])]
    return "\n\n".join(parts) + "\n"


def _integrator_text(found: Records) -> str:
    return f"""\
A sheet of 5 x 5 vertices swings from one edge for half a second, without drag and contact. An error
is the root mean square difference of coordinates from the motion that DOP853 of SciPy finds for the
same energies, at tolerances of 1e-8. Times are processor times of a simulated second, medians of
three rollouts in turn, by `python -m benchmarks.integrators --part explicit`. Measured on
{found["date"]} ({found["processor"]}). The [guide](guide.md#integrator) says when to take which."""


def _integrator_table(rows: list[Records]) -> str:
    head = ["time step [s]"]
    for name in ("implicit Euler", "second order"):
        head += [f"{name}: error [mm]", "time [ms/s]"]
    lines = []
    for row in rows:
        line = [f"{row['h']:g}"]
        for name in INTEGRATORS:
            line += [_number(row[name]["error"]), _number(row[name]["milliseconds"])]
        ratio = row["second_order"]["milliseconds"] / row["implicit_euler"]["milliseconds"]
        lines.append([*line, _number(ratio)])
    return table([*head, "times, ratio"], lines)


def _preface(records: Records) -> str:
    clock = "processor time" if records["clock"] == "processor" else "wall-clock time"
    before, after = records["load"]
    steps = ", ".join(f"{n} steps at {k} x {k}" for k, n in records["steps"].items())
    return f"""\
This page is for users who estimate the time of a simulation.
`python -m benchmarks.figures` writes it from `docs/{RECORDS}`: do not edit it.

Measured on {records["date"]} in {records["minutes"]:g} minutes of {clock}, on {records["cores"]}
cores ({records["processor"]}), with one thread unless a table says otherwise.
The load of the machine was {before:g} before the first measurement and {after:g} after the last.
The benchmark runs one process at a time, so a load above 1 comes from other jobs. Then ratios,
whose two sides run in turn, are more reliable than milliseconds, and a second thread finds no free
core.
torch {records["torch"]}; {records["core"]}.

A step is {records["dt"]:g} s long and uses the scheme `coupled` at a tolerance of
{records["tolerance"]:g} m/s. Scenes are those of `benchmarks.scenes`: sheets of `size` x `size`
vertices that have reached their regime. Times are medians of {steps}."""


def _release_text(rows: list[Records], release: str) -> str:
    parts = []
    for size in _sizes(rows):
        text = []
        for part in ("forward", "backward"):
            ratios = [ratio for r in rows if _is(r, size) and (ratio := _ratio(r, part))]
            mean = math.exp(sum(map(math.log, ratios)) / len(ratios))
            text.append(f"{part} {mean:.1f} ({min(ratios):.1f} to {max(ratios):.1f})")
        parts.append(f"{size} x {size}: {', '.join(text)}")
    return (
        "Both take steps in turn, each on its own trajectory from the same start. A ratio is the "
        f"time of {release} over the time of this release. The geometric means of the ratios over "
        f"the scenes, and their ranges, are {'; '.join(parts)}."
    )


def _release_table(rows: list[Records]) -> str:
    head = ["scene", "size", "batch", "threads"]
    for part in ("forward [ms]", "backward [ms]"):
        head += [part, "other", "ratio"]
    head += ["iterations", "other", "unconverged", "other"]
    lines = []
    for r in rows:
        line = [r["scene"], r["size"], r["batch"] or 1, r["threads"]]
        for part in ("forward", "backward"):
            line += [_number(r[side][part]) for side in ("this", "other")]
            line.append(_number(_ratio(r, part)))
        line += [f"{r[side]['iterations']:.1f}" for side in ("this", "other")]
        line += [r[side]["unconverged"] for side in ("this", "other")]
        lines.append(line)
    return table(head, lines)


def _environment_text(found: Records) -> str:
    return f"""\
Small, damped, frictional sheets that tools move by the scripts of their tasks, the default solver
options. {found["release"].capitalize()} and this release take the same recorded steps in turn:
`python -m benchmarks.scripted` describes how. Measured on {found["date"]} ({found["processor"]}).
Times are processor times of a time step, per environment, with the step's backward in
`with gradients`; `python` is the part of `env.step` outside of the core. A ratio is the time of
{found["release"]} over the time of this release."""


def _environment_table(rows: list[Records]) -> str:
    head = ["task", "size", "batch"]
    for part in ("forward [ms]", "with gradients [ms]", "python [ms]"):
        head += [part, "other", "ratio"]
    lines = []
    for r in rows:
        line = [r["task"], r["size"], r["batch"]]
        for part in ("forward", "with_gradients", "python"):
            line += [_number(r[side][part]) for side in ("this", "other")]
            line.append(_number(_ratio(r, part)))
        lines.append([*line, *(f"{r[side]['iterations']:.1f}" for side in ("this", "other"))])
    return table([*head, "iterations", "other"], lines)


def _environment_phases(rows: list[Records]) -> str:
    """Phases of forward [ms] and counts a step, of this release."""
    phases = list(rows[0]["this"]["phases"])
    counts = ["exact", "chord", "projected", "factorizations"]
    return table(
        ["task", "size", "batch", *phases, "contacts", *counts],
        [
            [r["task"], r["size"], r["batch"]]
            + [_number(r["this"]["phases"][phase]) for phase in phases]
            + [_number(r["this"]["contacts"])]
            + [_number(r["this"]["counts"][name]) for name in counts]
            for r in rows
        ],
    )


_PHASE_TEXT = """\
This table shows forward and backward of this release in EF, and the phases of forward in
milliseconds of wall-clock time. One EF is the time in which `Eigen::SimplicialLDLT` factors the
contact-free Hessian of the same state. Times in EF vary less from machine to machine."""


def _phase_table(rows: list[Records]) -> str:
    phases = list(rows[0]["phases"])
    return table(
        ["scene", "size", "forward [EF]", "backward [EF]", "iterations", "contacts", *phases],
        [
            [r["scene"], r["size"], f"{r['forward_in_ef']:.2f}", f"{r['backward_in_ef']:.2f}"]
            + [f"{r['iterations']:g}", f"{r['contacts']:g}"]
            + [_number(r["phases"][phase]) for phase in phases]
            for r in rows
        ],
    )


_LOSS_TEXT = """\
Backward of several losses, to positions and velocities: a loop over `torch.autograd.grad`, and one
call with `is_grads_batched=True`, in milliseconds."""


_SHARED_TEXT = """\
Forward, in milliseconds of wall-clock time. Threads without an environment share large
factorizations and solves; the bits are the same."""


def _pair_table(rows: list[Records], labels: list[str], pair: dict[str, str]) -> str:
    """Two times and their ratio.

    Args:
        rows: Records with the labels and the two times.
        labels: Keys of the first columns, and their headings.
        pair: Keys of the two times, and their headings.
    """
    lines = []
    for r in rows:
        one, other = (r[key] for key in pair)
        times = [_number(value) for value in (one, other, one / other)]
        lines.append([*(r[label] for label in labels), *times])
    return table([*labels, *pair.values(), "ratio"], lines)


_PEER_TEXT = """\
The differentiable cloth of Newton (`pip install newton`) uses explicit substeps in single
precision, with penalties where a vertex meets a body. Both simulate 15 frames at 60 Hz from the
same start; `python -m benchmarks.peers` describes how. Measured on {date} ({processor}). Times are
processor times of a frame. `gradient` is the error of each gradient against differences of its own
loss; where vertices bounce, differences of Newton's loss depend on their step. Those of ours are
the gradient as long as they do not cross to another minimum of a step
([Branches](notes/branches.md)), which on the sphere may be as near as 1e-7 m/s. `depth` is the
largest depth of the sheet inside the body."""


def _peer_table(rows: list[Records]) -> str:
    head = ["scene", "size", "by", "substeps", "forward [ms]", "backward [ms]", "gradient"]
    lines = []
    for r in rows:
        line = [r["scene"], r["size"], r["by"], r["substeps"]]
        line += [_number(r["forward"]), _number(r["backward"])]
        lines.append([*line, f"{r['gradient_error']:.1e}", f"{r['depth']:.2g}"])
    return table([*head, "depth [mm]"], lines)


def _forward_peer_text(found: Records) -> str:
    return f"""\
Newton's Vertex Block Descent and MuJoCo's flex have no gradients. Forward alone, the same 15 frames
at 60 Hz, and a sheet whose upper half falls on the lower one; `python -m benchmarks.forward_peers`
says how, with which settings, and what differs. Measured on {found["date"]} ({found["processor"]});
times are processor times of a frame. `crossings` are pairs of triangles of the sheet that intersect
and `inside` are vertices within the body, both the most of any frame; `depth` is the largest depth
of the sheet inside the body, and `stretch` the longest edge over its length at rest."""


def _forward_peer_table(rows: list[Records]) -> str:
    head = ["scene", "size", "by", "substeps", "forward [ms]", "crossings", "inside"]
    lines = []
    for r in rows:
        line = [r["scene"], r["size"], r["by"], r["substeps"], _number(r["forward"])]
        line += [r["crossings"], r["inside"]]
        lines.append([*line, f"{r['depth']:.2g}", f"{r['stretch']:.2f}"])
    return table([*head, "depth [mm]", "stretch"], lines)


def _is(row: Records, size: int) -> bool:
    """Return whether a row is of one environment in an ordinary scene of this size."""
    return row["size"] == size and not row["batch"] and row["scene"] in SCENES


def _sizes(rows: list[Records]) -> list[int]:
    return list(dict.fromkeys(r["size"] for r in rows))


def _ratio(row: Records, part: str) -> float | None:
    """Time of the other side divided by this side's; None if a side has no time."""
    ours, theirs = row["this"][part], row["other"][part]
    return theirs / ours if ours and theirs else None


def _number(value: float | None) -> str:
    """A number with three significant digits, or all digits before the point."""
    if value is None:
        return "-"
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


if __name__ == "__main__":
    main()
