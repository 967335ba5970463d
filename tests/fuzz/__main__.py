"""Step random scenes and judge every state, path, report and some gradients.

    python tests/fuzz --minutes 5             # as many scenes as five minutes allow
    python tests/fuzz --scenes 100 --seed 3   # always the same hundred
    python tests/fuzz --seed 3 --only 17      # one of these scenes again

A scene is a function of the seed, its index and `--draw`: scenes of odd indices throw cloths at
bodies with prescribed motion; even indices draw bodies, robots, couplings and schemes. ipctk
judges every state and the polyline of every step, also of failed steps. An error is one line of
JSON with the scene and the failed check. Steps that do not converge or that are refused (an
infeasible motion, a rotation too fast for the time step) are counted, and listed with `--list`. The
exit status is 1 if there was an error. ipctk does not judge the scheme `projective`, whose surfaces
may cross.

A gradient is compared with differences along a random direction. Buckling cloth has several minima,
and the smallest change of an input may switch the minimum of a step: therefore gradients are
computed at several points, and the two points that agree best with the difference between them
count, on any branch of minima. Suspects are listed, not judged: with very many minima, no two
points may share a branch.
"""

from __future__ import annotations

import collections
import json
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "physics"))

from differences import slope_error
from physics_scenes import Judge, free_links, joined_links
from random_scenes import RandomScene, draw_cloth_scene
from random_towers import draw_tower

import diffcloth_torch as dc

DRAWINGS = {
    "all": lambda seed, index: (draw_cloth_scene if index % 2 else draw_tower)(seed, index),
    "cloths": draw_cloth_scene,
    "towers": draw_tower,
}
WRONG = ("intersection", "path", "report", "momentum", "not finite", "error", "start")
GRADIENT_SHARE = 0.1  # of the scenes
MOVING = ("body_velocities", "joint_velocities", "base_velocities")  # fields of a state
OUTPUTS = ("positions", "body_poses", "joint_positions", "base_poses")
ROUNDING = 1e-10  # of momentum, a thousandth of which is seen
ERROR = 1e-3  # of momentum, relative: a contact's stiffness may exceed M/h^2 greatly
SUSPECT = 1e-3  # relative error of a gradient; right ones are below 2e-4


class Tally:
    """Counts, and one line for each failure."""

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


class SchemeJudge:
    """Judge of states and paths; silent for schemes whose surfaces may cross."""

    def __init__(self, scene: RandomScene) -> None:
        sim = scene.simulator
        self.silent = sim.scheme == "projective"
        self._judge = Judge(sim, free_links(sim.scene), joined_links(sim.scene))

    def is_free(self, state: dc.State) -> bool:
        return self.silent or self._judge.is_free(state)

    def is_free_path(self, path: np.ndarray) -> bool:
        return self.silent or self._judge.is_free_path(path)

    def placed(self, path: np.ndarray) -> np.ndarray:
        """A path with the meshes of smooth bodies, or of all bodies if meshes are in contact."""
        return path if self.silent else self._judge.placed(path)

    def points(self, state: dc.State) -> np.ndarray:
        """Points of all surfaces, in the order of a path."""
        return self._judge.points(state)


def run_scene(seed: int, index: int, tally: Tally, drawing: str) -> None:
    where: dict[str, Any] = {"seed": seed, "scene": index}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        _run_scene(seed, index, tally, drawing, where)
    for kind in {warning.category.__name__ for warning in caught}:
        tally.counts[f"warned: {kind}"] += 1


def _run_scene(seed: int, index: int, tally: Tally, drawing: str, where: dict[str, Any]) -> None:
    try:
        scene = DRAWINGS[drawing](seed, index)
    except dc.SimulationError as error:
        tally.line("start", where, str(error))
        return
    where["drawn"] = scene.description
    rng = np.random.default_rng([seed, index, 1])
    check_gradient = rng.random() < GRADIENT_SHARE
    judge = SchemeJudge(scene)
    state = scene.start
    tally.counts["scenes"] += 1
    tally.counts[f"scenes: {_kind(scene)}"] += 1
    for k in range(scene.steps):
        where["step"] = k
        control = scene.control(state, k)
        path = _path(scene, state, control)
        path = None if path is None else judge.placed(path)
        if path is not None and not judge.is_free_path(path):
            tally.line("path", where, "a segment of the path is not free")
        before, state = state, _step(scene, state, control, rng, tally, where)
        if state is None:
            return
        _judge(scene, judge, before, state, path, tally, where)
        if check_gradient and k == 1:
            _check_gradient(scene, before, control, rng, tally, where)


def _kind(scene: RandomScene) -> str:
    """Label of the scheme, with the coupling if forces also move bodies or robots."""
    sim = scene.simulator
    if sim._layout.is_dynamic:
        return f"{sim.scheme} {sim.coupling}" if sim.scene.cloths else "no cloths"
    return f"{sim.scheme} cloths"


def _path(scene: RandomScene, state: dc.State, control: dc.Control) -> np.ndarray | None:
    """Path of a step; None if refused (the step itself then reports the refusal)."""
    try:
        return scene.simulator.path(state, control).numpy()
    except dc.SimulationError:
        return None


def _step(
    scene: RandomScene,
    state: dc.State,
    control: dc.Control,
    rng: np.random.Generator,
    tally: Tally,
    where: dict[str, Any],
) -> dc.State | None:
    """State after a step, of which some run backward; None if the step failed."""
    tally.counts["steps"] += 1
    names = ("positions", *(n for n in MOVING if getattr(state, n).numel()))
    wanted = rng.random() < 0.3
    starts = {name: getattr(state, name).clone().requires_grad_(wanted) for name in names}
    try:
        after = scene.simulator.step(state.replace(**starts), control)
    except dc.InfeasibleMotion as error:
        tally.failed_step("InfeasibleMotion", where, str(error))
        return None
    except dc.NotConverged as error:
        reason = _reason(scene, error.report)
        if reason.startswith("residual"):
            tally.line("report", where, str(error))
        tally.counts["NotConverged"] += 1
        tally.counts[f"NotConverged in: {_kind(scene)}"] += 1
        tally.failed_step(f"NotConverged: {reason}", where, str(error))
        return None
    except dc.TurnedTooFar as error:
        tally.failed_step("TooFast", where, str(error))
        return None
    except Exception as error:
        tally.line("error", where, f"{type(error).__name__}: {error}")
        return None
    tally.counts["converged"] += 1
    tally.counts["iterations"] += after.report.iterations
    if wanted:
        tally.counts["backward"] += 1
        loss = sum((getattr(after, name) ** 2).sum() for name in OUTPUTS)
        try:
            gradients = torch.autograd.grad(loss, list(starts.values()), allow_unused=True)
        except Exception as error:
            tally.line("error", where, f"backward: {type(error).__name__}: {error}")
        else:
            for name, gradient in zip(names, gradients, strict=True):
                if gradient is not None and not gradient.isfinite().all():
                    tally.line("not finite", where, f"gradient of {name}")
    return after.detach()


def _reason(scene: RandomScene, report: Any) -> str:
    if report.residual <= scene.simulator.solver.tolerance:
        return "residual below tolerance"
    if report.iterations >= scene.simulator.solver.max_iterations:
        return "iterations"
    return "gave up near" if report.residual < 1e-3 else "gave up far"


def _judge(
    scene: RandomScene,
    judge: SchemeJudge,
    before: dc.State,
    after: dc.State,
    path: np.ndarray | None,
    tally: Tally,
    where: dict[str, Any],
) -> None:
    fields = ("positions", "velocities", "body_poses", "body_forces", "joint_positions", *MOVING)
    infinite = [name for name in fields if not getattr(after, name).isfinite().all()]
    if infinite:
        tally.line("not finite", where, f"state: {', '.join(infinite)}")
        return
    if not judge.is_free(after):
        tally.line("intersection", where, "state")
    if path is None:
        tally.line("path", where, "refused, while the step is not")
    elif not judge.silent:
        size = np.abs(path).max()
        for end, state in ((path[0], before), (path[-1], after)):
            if np.abs(end - judge.points(state)).max() > 1e-9 * size:
                tally.line("path", where, "does not go from state to state")
    report = after.report
    solver = scene.simulator.solver
    local = report.counts.get("local_global", 0)  # which has 50 times as many
    sane = report.converged and 0 <= report.residual <= solver.tolerance
    sane = sane and report.status == "converged" and report.iterations + local >= 1
    sane = sane and report.iterations <= solver.max_iterations >= local / 50
    if not (sane and report.motion_fraction == 1):
        tally.line("report", where, repr(report))
    _check_joints(scene, after, tally, where)
    if len(scene.simulator._assembly.pins) == 0 and solver.metric != "identity":
        _check_momentum(scene, before, after, tally, where)
    _check_bodies(scene, before, after, tally, where)


def _check_joints(scene: RandomScene, after: dc.State, tally: Tally, where: dict[str, Any]) -> None:
    """Check that prescribed joints reach their targets, and others are within limits up to 1 %."""
    if scene.drives is None:
        return
    mechanism = scene.simulator.scene.robots[0].mechanism
    done = (where["step"] + 1) / scene.steps
    wanted = scene.drives.start + done * (scene.drives.ends - scene.drives.start)
    zone = 0.01 * (mechanism.upper - mechanism.lower)
    for j, mode in enumerate(mechanism.actuation):
        found = float(after.joint_positions[j])
        right = abs(found - wanted[j]) < 1e-12
        if mode in ("pd", "torque"):
            right = mechanism.lower[j] - zone[j] < found < mechanism.upper[j] + zone[j]
        if not right:
            tally.line("report", where, f"joint {j} ({mode}) at {found}, wanted {wanted[j]}")


def _check_momentum(
    scene: RandomScene,
    before: dc.State,
    after: dc.State,
    tally: Tally,
    where: dict[str, Any],
) -> None:
    """Internal forces cancel: momentum changes by gravity, air and contact of bodies."""
    if not len(scene.masses):
        return
    m = scene.masses[:, None]
    had, has = (m * state.velocities.numpy() / scene.simulator.dt for state in (before, after))
    weight = m * np.array([0.0, 0.0, -scene.description["gravity"]])
    forces = [weight, -after.body_forces.numpy()]
    x, dt = after.positions.numpy(), scene.simulator.dt
    forces += [pull.force(x, where["step"], dt)[None] for pull in scene.pulls]
    faces, start = scene.simulator._assembly.faces, before.positions.numpy()
    forces.append(scene.air.force(faces, start, x, where["step"], dt)[None])
    left = m.sum() * scene.simulator.solver.tolerance / scene.simulator.dt
    _compare(had, has, forces, left, "cloths", tally, where)


def _check_bodies(
    scene: RandomScene,
    before: dc.State,
    after: dc.State,
    tally: Tally,
    where: dict[str, Any],
) -> None:
    """The momentum of each body that forces move changes by gravity and the forces on it."""
    sim = scene.simulator
    gravity = np.array([[0.0, 0.0, -scene.description["gravity"]]])
    for row, (name, body) in enumerate(zip(sim.scene.body_names, sim.scene.bodies, strict=True)):
        if body.motion == "dynamic":
            states = (before, after)
            had, has = (
                body.mass * state.body_velocities[[row], :3].numpy() / sim.dt for state in states
            )
            forces = after.body_forces.numpy()[sim.slices[name]]
            left = body.mass * sim.solver.tolerance / sim.dt
            _compare(had, has, [body.mass * gravity, forces], left, name, tally, where)


def _compare(
    had: np.ndarray,
    has: np.ndarray,
    forces: list[np.ndarray],
    left: float,
    what: str,
    tally: Tally,
    where: dict[str, Any],
) -> None:
    """Compare momentum before and after, divided by the time step, with forces.

    The error is relative to all forces, including the residual force of the solver's tolerance.
    """
    gain = has - had
    size = sum(np.abs(part).sum() for part in (gain, *forces))
    size += ROUNDING * (np.abs(had) + np.abs(has)).sum()  # rounding of constant momentum
    size += left / ERROR
    rest = gain.sum(axis=0) - sum(part.sum(axis=0) for part in forces)
    error = np.abs(rest).max() / max(size, 1e-300)
    if error > ERROR:
        tally.line("momentum", where, f"{what}: relative error {error:.3g}")


def _check_gradient(
    scene: RandomScene,
    state: dc.State,
    control: dc.Control,
    rng: np.random.Generator,
    tally: Tally,
    where: dict[str, Any],
) -> None:
    """Adjoints against differences along a direction in places, velocities and materials."""
    sim = scene.simulator
    # Relative to the speed of a fall: a solve's error must be small against small differences.
    tolerance = 1e-10 * np.sqrt(scene.description["size"])
    tight = dc.Simulator(
        sim.scene,
        sim.dt,
        scheme=sim.scheme,
        coupling=sim.coupling,
        contact=sim.contact,
        solver=replace(sim.solver, tolerance=tolerance),
    )
    edge = scene.description["size"] / 10
    shape = state.positions.shape
    weights = torch.from_numpy(rng.normal(size=shape))
    free = torch.ones(shape[0], 1, dtype=torch.float64)
    free[torch.from_numpy(sim._assembly.pins.astype(np.int64))] = 0.0
    # Changes of comparable size: an edge, an edge a step, a factor e of the stiffness.
    changes = {
        "positions": free * edge * torch.from_numpy(rng.normal(size=shape)),
        "velocities": edge / sim.dt * torch.from_numpy(rng.normal(size=shape)),
    }
    factor = torch.from_numpy(rng.normal(size=()))
    given = tight.default_parameters()
    stretch, mass = given.stretch, given.body_mass
    bodies = torch.zeros_like(state.body_poses)
    moves = [body.motion == "dynamic" for body in sim.scene.bodies]
    if any(moves):
        # Changes also include a tenth of a radian per step, and a factor e of the masses.
        turn = torch.tensor([edge] * 3 + [0.1] * 3, dtype=torch.float64) / sim.dt
        noise = torch.from_numpy(rng.normal(size=(len(moves), 6)))
        changes["body_velocities"] = turn * noise * torch.tensor(moves)[:, None]
        bodies = torch.from_numpy(rng.normal(size=bodies.shape))
        bodies[:, 3:] *= edge

    def point(at: float) -> tuple[float, float, float]:
        """The point `at`, the loss at this point and its derivative."""
        t = torch.tensor(at, dtype=torch.float64, requires_grad=True)
        moved = {name: getattr(state, name) + t * change for name, change in changes.items()}
        physical = {}
        if len(shape) and shape[0]:
            physical["stretch"] = stretch * (t * factor).exp()
        if any(moves):
            physical["body_mass"] = mass * (t * factor).exp()
        after = tight.step(state.replace(**moved), control, given.replace(**physical))
        loss = ((weights * after.positions).sum() + (bodies * after.body_poses).sum()) / edge
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
@click.option("--draw", "drawing", type=click.Choice(list(DRAWINGS)), default="all")
@click.option("--list", "show_failures", is_flag=True, help="A line for each step that failed.")
def main(
    minutes: float | None,
    count: int | None,
    seed: int,
    only: int | None,
    drawing: str,
    show_failures: bool,
) -> None:
    if minutes is None and count is None and only is None:
        raise click.UsageError("give --minutes, --scenes or --only")
    torch.set_num_threads(1)
    tally = Tally(show_failures or only is not None)
    begin = time.monotonic()
    index = only or 0
    while True:
        run_scene(seed, index, tally, drawing)
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
        f"NotConverged {c['NotConverged']}: {share:.2%} of scenes, "
        f"{c['NotConverged'] / steps:.3%} of steps"
    )
    for kind in sorted(kind for kind in c if kind.startswith("NotConverged: ")):
        print(f"  {kind.removeprefix('NotConverged: ')} {c[kind]}")
    for kind in sorted(kind for kind in c if kind.startswith("scenes: ")):
        name = kind.removeprefix("scenes: ")
        print(f"  {name}: {c[f'NotConverged in: {name}']} of {c[kind]} scenes")
    print(f"InfeasibleMotion {c['InfeasibleMotion']}, turns too fast {c['TooFast']}", end="")
    for kind in sorted(kind for kind in c if kind.startswith("warned: ")):
        print(f", {kind.removeprefix('warned: ')} {c[kind]}", end="")
    print()
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
