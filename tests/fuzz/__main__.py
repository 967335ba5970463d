"""Step random scenes and judge every state, path, report and some gradients.

    python tests/fuzz --minutes 5             # as many scenes as five minutes allow
    python tests/fuzz --scenes 100 --seed 3   # always the same hundred
    python tests/fuzz --seed 3 --only 17      # one of them again

A scene is a function of the seed and its index. ipctk judges every state and the polyline of every
step, also of steps that fail. What is wrong is one line of JSON, which names the scene and what
failed in it; steps that do not converge, or whose motion is refused, are counted, and listed with
`--list`. The exit status is 1 if anything was wrong.

A gradient is compared with differences along a random direction. What buckles has several minima,
and the least change of an input may let a step end in another: so gradients are taken at several
points, and the two of them that agree best with the difference between them count, on whatever
branch of minima they are. Suspects are listed, not judged: where there are very many minima, no two
points may share a branch.
"""

from __future__ import annotations

import collections
import json
import sys
import time
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "physics"))

from differences import slope_error
from physics_scenes import Judge
from random_scenes import RandomScene, draw

import diffcloth_torch as dc

WRONG = ("intersection", "path", "report", "momentum", "not finite", "error", "start")
GRADIENT_SHARE = 0.1  # of the scenes
SUSPECT = 1e-3  # relative error of a gradient; right ones are below 2e-4


class Tally:
    """Counts, and the lines of what failed."""

    def __init__(self, show_failures: bool) -> None:
        self.counts: collections.Counter[str] = collections.Counter()
        self.gradient_errors: list[float] = []
        self._show_failures = show_failures

    def line(self, kind: str, where: dict[str, Any], text: str, *, show: bool = True) -> None:
        self.counts[kind] += 1
        if show:
            print(json.dumps({"kind": kind, **where, "text": text}, default=str), flush=True)

    def failed_step(self, kind: str, where: dict[str, Any], text: str) -> None:
        self.line(kind, where, text, show=self._show_failures)


def run_scene(seed: int, index: int, tally: Tally) -> None:
    where: dict[str, Any] = {"seed": seed, "scene": index}
    try:
        scene = draw(seed, index)
    except dc.SimulationError as error:
        tally.line("start", where, str(error))
        return
    where["drawn"] = scene.description
    rng = np.random.default_rng([seed, index, 1])
    check_gradient = rng.random() < GRADIENT_SHARE
    judge = Judge(scene.simulator)
    state = scene.start
    tally.counts["scenes"] += 1
    for k in range(scene.steps):
        where["step"] = k
        control = scene.control(state)
        if not judge.is_free_path(scene.simulator.path(state, control).numpy()):
            tally.line("path", where, "a segment of the path is not free")
        before, state = state, _step(scene, state, control, rng, tally, where)
        if state is None:
            return
        _judge(scene, judge, before, state, tally, where)
        if check_gradient and k == 1:
            _check_gradient(scene, before, control, rng, tally, where)


def _step(
    scene: RandomScene,
    state: dc.State,
    control: dc.Control,
    rng: np.random.Generator,
    tally: Tally,
    where: dict[str, Any],
) -> dc.State | None:
    """The state after a step, with a backward through some; None where it failed."""
    tally.counts["steps"] += 1
    start = state.positions.clone().requires_grad_(rng.random() < 0.3)
    try:
        after = scene.simulator.step(state.replace(positions=start), control)
    except dc.InfeasibleMotion as error:
        tally.failed_step("InfeasibleMotion", where, str(error))
        return None
    except dc.NotConverged as error:
        reason = _reason(scene, error.report)
        if reason.startswith("residual"):
            tally.line("report", where, str(error))
        tally.counts["NotConverged"] += 1
        tally.failed_step(f"NotConverged: {reason}", where, str(error))
        return None
    except Exception as error:
        tally.line("error", where, f"{type(error).__name__}: {error}")
        return None
    tally.counts["converged"] += 1
    tally.counts["iterations"] += after.report.iterations
    if start.requires_grad:
        tally.counts["backward"] += 1
        try:
            (gradient,) = torch.autograd.grad((after.positions**2).sum(), start)
        except Exception as error:
            tally.line("error", where, f"backward: {type(error).__name__}: {error}")
        else:
            if not gradient.isfinite().all():
                tally.line("not finite", where, "gradient")
    return after.detach()


def _reason(scene: RandomScene, report: Any) -> str:
    if report.residual <= scene.simulator.solver.tolerance:
        return "residual below tolerance"
    if report.iterations >= scene.simulator.solver.max_iterations:
        return "iterations"
    return "gave up near" if report.residual < 1e-3 else "gave up far"


def _judge(
    scene: RandomScene,
    judge: Judge,
    before: dc.State,
    after: dc.State,
    tally: Tally,
    where: dict[str, Any],
) -> None:
    if not (after.positions.isfinite().all() and after.velocities.isfinite().all()):
        tally.line("not finite", where, "state")
        return
    if not judge.is_free(after):
        tally.line("intersection", where, "state")
    report = after.report
    solver = scene.simulator.solver
    sane = report.converged and 0 <= report.residual <= solver.tolerance
    sane = sane and 1 <= report.iterations <= solver.max_iterations
    if not (sane and report.motion_fraction == 1):
        tally.line("report", where, repr(report))
    if len(scene.simulator._assembly.pins) == 0:
        _check_momentum(scene, before, after, tally, where)


def _check_momentum(
    scene: RandomScene,
    before: dc.State,
    after: dc.State,
    tally: Tally,
    where: dict[str, Any],
) -> None:
    """Internal forces cancel: momentum changes by gravity and what the bodies push back."""
    m = scene.masses[:, None]
    change = (m * (after.velocities - before.velocities).numpy()).sum(axis=0) / scene.simulator.dt
    weight = np.array([0.0, 0.0, -scene.description["gravity"]]) * m.sum()
    push = -after.body_forces.numpy().sum(axis=0)
    size = (
        np.abs(m * (after.velocities - before.velocities).numpy()).sum() / scene.simulator.dt
        + after.body_forces.abs().sum().item()
        + np.abs(weight).sum()
    )
    # Solves end within the tolerance of 1e-6 m/s; a contact's stiffness may exceed M/h^2 greatly.
    error = np.abs(change - weight - push).max() / max(size, 1e-300)
    if error > 1e-3:
        tally.line("momentum", where, f"relative error {error:.3g}")


def _check_gradient(
    scene: RandomScene,
    state: dc.State,
    control: dc.Control,
    rng: np.random.Generator,
    tally: Tally,
    where: dict[str, Any],
) -> None:
    """Adjoints against differences along a direction in positions, velocities and materials."""
    sim = scene.simulator
    # A share of the speed of a fall: what a solve leaves must vanish beside small differences.
    tight = dc.Simulator(
        sim.scene,
        sim.dt,
        scheme=sim.scheme,
        contact=sim.contact,
        solver=dc.SolverOptions(tolerance=1e-10 * np.sqrt(scene.description["size"])),
    )
    edge = scene.description["size"] / 10
    shape = state.positions.shape
    weights = torch.from_numpy(rng.normal(size=shape))
    free = torch.ones(shape[0], 1, dtype=torch.float64)
    free[torch.from_numpy(sim._assembly.pins.astype(np.int64))] = 0.0
    # Changes of comparable size: an edge, an edge a step, a factor e of the stiffness.
    directions = [
        free * edge * torch.from_numpy(rng.normal(size=shape)),
        edge / sim.dt * torch.from_numpy(rng.normal(size=shape)),
        torch.from_numpy(rng.normal(size=())),
    ]
    stretch = tight.parameters().stretch

    def point(at: float) -> tuple[float, float, float]:
        """Where, the loss there and its derivative."""
        t = torch.tensor(at, dtype=torch.float64, requires_grad=True)
        after = tight.step(
            state.replace(
                positions=state.positions + t * directions[0],
                velocities=state.velocities + t * directions[1],
            ),
            control,
            tight.parameters().replace(stretch=stretch * (t * directions[2]).exp()),
        )
        loss = (weights * after.positions).sum() / edge
        (slope,) = torch.autograd.grad(loss, t)
        return t.item(), loss.item(), slope.item()

    steps = 10.0 ** np.arange(-8, -3)
    try:
        points = [point(at) for at in (0.0, *steps, *-steps)]
    except dc.SimulationError as error:
        tally.failed_step("gradient not checked", where, str(error))
        return
    error = slope_error(points)
    tally.gradient_errors.append(error)
    if not error <= SUSPECT:  # not a number, too
        text = f"relative error {error:.3g} of (t, loss, derivative) {points}"
        tally.line("suspect gradient", where, text)


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.option("--minutes", type=click.FloatRange(min=0), help="No scene begins later than this.")
@click.option("--scenes", "count", type=click.IntRange(min=1), help="How many at most.")
@click.option("--seed", default=0, type=click.IntRange(min=0))
@click.option("--only", type=click.IntRange(min=0), help="Index of the only scene.")
@click.option("--list", "show_failures", is_flag=True, help="A line for each step that failed.")
def main(
    minutes: float | None, count: int | None, seed: int, only: int | None, show_failures: bool
) -> None:
    if minutes is None and count is None and only is None:
        raise click.UsageError("give --minutes, --scenes or --only")
    torch.set_num_threads(1)
    tally = Tally(show_failures or only is not None)
    begin = time.monotonic()
    index = only or 0
    while True:
        run_scene(seed, index, tally)
        index += 1
        late = minutes is not None and time.monotonic() - begin > 60 * minutes
        if only is not None or late or (count is not None and index >= count):
            break
    _summarize(tally, time.monotonic() - begin)
    raise SystemExit(any(tally.counts[kind] for kind in WRONG))


def _summarize(tally: Tally, seconds: float) -> None:
    c = tally.counts
    steps, converged = max(c["steps"], 1), max(c["converged"], 1)
    share = c["NotConverged"] / max(c["scenes"], 1)
    print(f"{c['scenes']} scenes, {c['steps']} steps in {seconds:.0f} s")
    print(f"converged {c['converged']}, {c['iterations'] / converged:.1f} iterations each")
    print(
        f"NotConverged {c['NotConverged']}: {share:.1%} of scenes, {c['NotConverged'] / steps:.1%}"
    )
    for kind in sorted(kind for kind in c if kind.startswith("NotConverged: ")):
        print(f"  {kind.removeprefix('NotConverged: ')} {c[kind]}")
    print(f"InfeasibleMotion {c['InfeasibleMotion']}")
    print(", ".join(f"{kind} {c[kind]}" for kind in WRONG))
    print(f"backward {c['backward']}, suspect gradients {c['suspect gradient']}", end="")
    if tally.gradient_errors:
        low, middle, high = np.quantile(tally.gradient_errors, [0.25, 0.5, 1.0])
        print(
            f" of {len(tally.gradient_errors)} checked: "
            f"relative errors {low:.1e} .. {middle:.1e} .. {high:.1e}",
            end="",
        )
    print()


if __name__ == "__main__":
    main()
