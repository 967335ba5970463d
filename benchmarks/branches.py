"""Count steps that end in another minimum after a tiny change of their start.

    python -m benchmarks.branches                                       # minutes
    python -m benchmarks.branches --scene sphere --size 24 --starts 8
    python -m benchmarks.branches --scene crumple --least 1e-12 --most 1e-6
    python -m benchmarks.branches --keep FOLDER     # later runs count on the same trajectories
    python -m benchmarks.branches --quick                               # seconds

A step of buckling cloth has several minima. The choice of the minimum must not depend on the last
bits of the start: gradients, optimizers and differences rely on this. Therefore the states of a
trajectory are recorded, and each is stepped again from starts with random changes of all vertices.
The size of the change is drawn between `--least` and `--most` for each start. In `held-or-moved`
the starts are equal, and a body that is static in one run moves by that size in the other. A jump
is an end with a vertex more than 0.1 mm away from the end of the recorded start. Ordinary ends
differ by a few times the difference of their starts (`growth`, the median).

jumps       starts that end in another minimum, of all
failed      changed starts and recorded states whose step does not converge; none is a jump
iterations  mean over the steps of the recorded states, summed over their solves
time        mean time of the core for these steps, on one thread [ms]
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import mean, median

import click
import numpy as np
import torch
from tqdm import tqdm

import diffcloth_torch as dc
from benchmarks.scenes import BUCKLING, DT, SCENES, Scene, in_regime, sheet

JUMP = 1e-4  # [m]
FIELDS = ("positions", "velocities", "body_poses")


@dataclass(frozen=True)
class Trial:
    """A scene and the options of its steps.

    Attributes:
        scene: Function from the number of vertices per side to a scene.
        dt: Time step [s].
        tolerance: Tolerance of the solver [m/s].
        nudged: If true, the ends of the bodies' motions differ instead of the cloths' starts.
    """

    scene: Callable[[int], Scene]
    dt: float = DT
    tolerance: float = dc.SolverOptions().tolerance
    nudged: bool = False

    def simulator(self, scene: Scene) -> dc.Simulator:
        return dc.Simulator(
            scene.scene, self.dt, solver=dc.SolverOptions(tolerance=self.tolerance, throw=False)
        )


@dataclass(frozen=True)
class Count:
    """One row of the table; the module's docstring explains the columns."""

    scene: str
    size: int
    jumps: int
    starts: int
    failed: int
    growth: float
    iterations: float
    time: float


def thrown(n: int, stretch: float = dc.Material().stretch) -> Scene:
    """Throw a sheet of .6 m over a sphere of .25 m."""
    vertices, faces = sheet(n)
    placed = 0.6 * vertices + (0.05, 0.02, 0.03)
    cloth = dc.Cloth(placed, faces, material=dc.Material(stretch=stretch))
    ball = dc.RigidBody.sphere(0.25, pose=[0, 0, -0.25, 1, 0, 0, 0])
    return Scene(dc.Scene([cloth], [ball]), approach=6, speed=(0.5, 0.2, -1.0))


def draped(n: int) -> Scene:
    """Lay a damped sheet of .5 m over a dented ellipsoid, a kinematic body that is held still."""
    vertices, faces = sheet(n)
    ball = dc.RigidBody.sphere(0.12)
    shape = np.array(ball.vertices) * (1.0, 1.0, 1.6)
    shape += np.random.default_rng(0).uniform(-0.002, 0.002, shape.shape)
    placed = 0.5 * vertices + (0.0, 0.0, shape[:, 2].max() + 0.02)
    cloth = dc.Cloth(placed, faces, material=dc.Material(damping=0.01))
    body = dc.RigidBody(shape, np.array(ball.faces), motion="kinematic")
    return Scene(dc.Scene([cloth], [body]), approach=0)


TRIALS: dict[str, Trial] = {
    "thrown": Trial(thrown, 1 / 60),
    "thrown-1e-9": Trial(thrown, 1 / 60, 1e-9),
    "thrown-stiff": Trial(lambda n: thrown(n, 1e4), 1 / 60),
    "held-or-moved": Trial(draped, nudged=True, tolerance=1e-10),
    **{name: Trial(SCENES[name]) for name in ("sphere", "self-contact", "two-sheets")},
    **{name: Trial(scene) for name, scene in BUCKLING.items()},
}


@click.command(
    help=__doc__.replace("\n\n    ", "\n\n\b\n    ").replace("\n\njumps", "\n\n\b\njumps")
)
@click.option("--scene", "scenes", multiple=True, type=click.Choice(list(TRIALS)))
@click.option("--size", "sizes", multiple=True, type=click.IntRange(min=4), help="Vertices a side.")
@click.option("--steps", type=click.IntRange(min=1), help="States of a trajectory; 20.")
@click.option("--starts", type=click.IntRange(min=1), help="Beside each state; 4.")
@click.option("--least", default=1e-9, show_default=True, help="Difference of a start [m].")
@click.option("--most", default=1e-7, show_default=True, help="Likewise.")
@click.option("--keep", type=click.Path(path_type=Path, file_okay=False))
@click.option("--quick", is_flag=True, help="Two small scenes: shows that it runs.")
@click.option("--json", "out", type=click.Path(path_type=Path, dir_okay=False))
def main(
    scenes: tuple[str, ...],
    sizes: tuple[int, ...],
    steps: int | None,
    starts: int | None,
    least: float,
    most: float,
    keep: Path | None,
    quick: bool,
    out: Path | None,
) -> None:
    if not 0 < least <= most:
        raise click.BadParameter(f"--least {least:g} must be positive, and at most --most {most:g}")
    torch.set_num_threads(1)
    names = scenes or (("thrown", "crumple") if quick else tuple(TRIALS))
    sizes = sizes or ((8,) if quick else (16, 24))
    steps = steps or (3 if quick else 20)
    starts = starts or (2 if quick else 4)
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
    print(
        f"{'scene':<14}{'size':>5}{'jumps':>7}{'of':>5}{'failed':>8}{'growth':>8}"
        f"{'iterations':>12}{'time [ms]':>11}"
    )
    counts = []
    for name, size in tqdm([(n, s) for s in sizes for n in names], disable=None, leave=False):
        kept = None if keep is None else keep / f"{name}-{size}-{steps}.pt"
        count = count_jumps(name, size, steps, starts, (least, most), kept)
        counts.append(count)
        tqdm.write(
            f"{name:<14}{size:>3}^2{count.jumps:>7}{count.starts:>5}{count.failed:>8}"
            f"{count.growth:>8.1f}{count.iterations:>12.1f}{count.time:>11.1f}"
        )
    if out is not None:
        out.write_text(json.dumps([asdict(count) for count in counts], indent=2) + "\n")


def record(simulator: dc.Simulator, scene: Scene, steps: int, kept: Path | None) -> list[dc.State]:
    """The states of a trajectory in its regime, read from the file `kept` or written to it."""
    start = simulator.initial_state()
    if kept is not None and kept.exists():
        return [start.replace(**fields) for fields in torch.load(kept, weights_only=True)]
    states = [in_regime(simulator, scene, 0)]
    while len(states) < steps:
        states.append(simulator.step(states[-1], scene.control(states[-1])))
    if kept is not None:
        torch.save([{name: getattr(state, name) for name in FIELDS} for state in states], kept)
    return states


def nudged(state: dc.State, shift: torch.Tensor) -> dc.Control:
    """A control that moves the bodies by a tiny shift [m]."""
    poses = state.body_poses.clone()
    poses[:, :3] += shift
    return dc.Control(body_poses=poses)


def count_jumps(
    name: str,
    size: int,
    steps: int,
    starts: int,
    range_of_sizes: tuple[float, float],
    kept: Path | None = None,
) -> Count:
    """Step the states of a trajectory again, from starts at distances in `range_of_sizes` [m]."""
    trial = TRIALS[name]
    scene = trial.scene(size)
    simulator = trial.simulator(scene)
    random = np.random.default_rng(0)
    jumps, failed = 0, 0
    iterations, seconds, growths = [], [], []
    with torch.no_grad():
        for state in record(simulator, scene, steps, kept):
            control = scene.control(state)
            end = simulator.step(state, control)
            iterations.append(float(end.report.iterations))
            seconds.append(float(sum(end.report.seconds.values())))
            failed += not end.report.converged
            for _ in range(starts):
                # Every start draws equally many numbers, so other starts do not depend on its end.
                distance = np.exp(random.uniform(*np.log(range_of_sizes)))
                noise = torch.from_numpy(random.uniform(-1, 1, tuple(state.positions.shape)))
                if trial.nudged:
                    other = simulator.step(state, nudged(state, distance * noise[0]))
                else:
                    beside = state.replace(positions=state.positions + distance * noise)
                    other = simulator.step(beside, control)
                failed += not other.report.converged
                if not (end.report.converged and other.report.converged):
                    continue
                apart = (other.positions - end.positions).norm(dim=-1).max().item()
                jumps += apart > JUMP
                growths.append(apart / distance)
    return Count(
        scene=name,
        size=size,
        jumps=jumps,
        starts=starts * steps,
        failed=failed,
        growth=float(median(growths)) if growths else float("nan"),
        iterations=mean(iterations),
        time=1e3 * mean(seconds),
    )


if __name__ == "__main__":
    main()
