"""Compare the integrators: momentum, bias of fits by the time step, energy in contact, and cost.

    python -m benchmarks.integrators              # all parts: about half an hour
    python -m benchmarks.integrators --part momentum --part drag
    python -m benchmarks.integrators --quick      # small forms of each part

Parts:

momentum   Share of its angular momentum that a free sheet keeps in a second, by its spin and by the
           time step, and the change of its linear momentum.
drag       A sheet swings from one edge in air. Error of its positions by the time step against the
           second-order step with h / 16, and the drag that a fit to these positions finds.
explicit   The same sheet against an explicit solver of SciPy (DOP853) for the same energies: error
           and processor time by the time step.
damping    A sheet oscillates about its hanging shape; damping that a fit to data of h / 16 finds,
           by the time step.
drops      Random sheets fall on bodies and on themselves: the largest energy after contact over the
           energy at the start, speeds at the end, and steps that did not converge.
damped     The same with damping of the material.
cost       Processor time of a step on scenes of `benchmarks.scenes`, second order over Euler: in
           its own rollout, and from the same states.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any

import click
import numpy as np
import torch
from torch import Tensor

import diffcloth_torch as dc
from benchmarks.scenes import DT, SCENES, in_regime

INTEGRATORS = ("implicit_euler", "second_order")
PARTS = ("momentum", "drag", "explicit", "damping", "drops", "damped", "cost")
TRUE_DRAG = 1.5
TRUE_DAMPING = 0.005  # [s]
FINE = 16  # time steps of the reference in one of 0.01 s


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    ").replace("\n\nmom", "\n\n\b\nmom"))
@click.option("--part", "parts", multiple=True, type=click.Choice(PARTS))
@click.option("--scenes", default=200, show_default=True, type=click.IntRange(1), help="Of drops.")
@click.option("--quick", is_flag=True, help="Small forms: shows that it runs.")
def main(parts: Sequence[str], scenes: int, quick: bool) -> None:
    torch.set_num_threads(1)
    runs: dict[str, Callable[[], None]] = {
        "momentum": lambda: print_momentum(5 if quick else 8, 0.2 if quick else 1.0),
        "drag": lambda: print_drag(4 if quick else 6, 0.2 if quick else 1.2, quick=quick),
        "explicit": lambda: print_explicit(4 if quick else 5, 0.1 if quick else 0.5),
        "damping": lambda: print_damping(
            4 if quick else 6, 0.2 if quick else 1.0, (0.01,) if quick else (0.01, 0.005, 0.0025)
        ),
        "drops": lambda: print_drops(2 if quick else scenes, 0.2 if quick else 1.0),
        "damped": lambda: print_drops(2 if quick else scenes, 0.2 if quick else 1.0, damped=True),
        "cost": lambda: print_cost((6,) if quick else (12, 24), 2 if quick else 12),
    }
    for part in parts or PARTS:
        print(f"\n== {part}")
        start = time.process_time()
        runs[part]()
        print(f"   {time.process_time() - start:.0f} s of processor time")
        sys.stdout.flush()


def sheet(n: int, side: float = 0.5, **material: float) -> dc.Cloth:
    """A sheet on a jittered grid."""
    grid = dc.Cloth.grid(n, n, side)
    vertices = np.array(grid.vertices)
    vertices[:, :2] += np.random.default_rng(0).uniform(-0.01, 0.01, (n * n, 2)) * side
    return dc.Cloth(vertices, grid.faces, material=dc.Material(**material))


def simulator(
    cloth: dc.Cloth, h: float, integrator: str, gravity: float = 9.81, tolerance: float = 1e-8
) -> dc.Simulator:
    return dc.Simulator(
        dc.Scene([cloth], gravity=(0.0, 0.0, -gravity)),
        h,
        integrator=integrator,
        contact=dc.ContactOptions(self_contact=False),
        solver=dc.SolverOptions(tolerance=tolerance),
    )


def print_momentum(n: int, seconds: float) -> None:
    """Print the remaining angular momentum, and the change of linear momentum."""
    print(f"{'spin [rad/s]':<18}{'h [s]':>8}" + "".join(f"{name:>34}" for name in INTEGRATORS))
    rows: list[tuple[tuple[float, float, float], float]] = [
        ((0.0, 0.0, 5.0), 0.01),
        ((5.0, 0.0, 0.0), 0.01),
        ((3.0, 1.0, 4.0), 0.01),
        ((0.0, 0.0, 12.0), 0.01),
        *(((3.0, 1.0, 4.0), h) for h in (0.02, 0.005, 0.0025)),
    ]
    for spin, h in rows:
        texts = []
        for integrator in INTEGRATORS:
            sim = simulator(sheet(n), h, integrator, gravity=0.0)
            start = sim.initial_state()
            x = start.positions - start.positions.mean(dim=0)
            omega = torch.tensor(spin, dtype=torch.float64)
            velocities = torch.linalg.cross(omega.expand_as(x), x) + 0.3
            state = start.replace(velocities=velocities)
            before = sim.momentum(state)
            with torch.no_grad():
                for _ in range(round(seconds / h)):
                    state = sim.step(state)
            after = sim.momentum(state)
            # About the center, which moves on a straight line.
            masses = sim.vertex_masses()[:, None]
            turn = [
                momentum[3:]
                - torch.linalg.cross((masses * s.positions).sum(dim=0) / masses.sum(), momentum[:3])
                for momentum, s in ((before, start), (after, state))
            ]
            change = ((after - before)[:3].norm() / before[:3].norm()).item()
            share = (turn[1].norm() / turn[0].norm()).item()
            texts.append(f"{share:>18.4f}, linear {change:.0e}")
        print(f"{spin!s:<18}{h:>8g}" + "".join(f"{text:>34}" for text in texts))


def swing(n: int, h: float, integrator: str, drag: float, seconds: float) -> Tensor:
    """Positions of a sheet that swings from one edge, every 0.02 s."""
    cloth = sheet(n, 0.6, bending=1e-3, normal_drag=drag, tangential_drag=0.03)
    edge = range(n * (n - 1), n * n)
    held = dc.Cloth(cloth.vertices, cloth.faces, pins={"edge": edge}, material=cloth.material)
    return rolled(simulator(held, h, integrator), seconds)


def rolled(sim: dc.Simulator, seconds: float, state: dc.State | None = None) -> Tensor:
    state = sim.initial_state() if state is None else state
    every, frames = round(0.02 / sim.dt), []
    with torch.no_grad():
        for k in range(round(seconds / sim.dt)):
            state = sim.step(state)
            if (k + 1) % every == 0:
                frames.append(state.positions)
    return torch.stack(frames)


def rms(a: Tensor, b: Tensor) -> float:
    return float((a - b).pow(2).mean().sqrt())


def found(residual: Callable[[float], float], low: float, high: float) -> float:
    """Argument of the smallest residual."""
    from scipy.optimize import minimize_scalar

    options = {"maxiter": 12, "xatol": 1e-3 * (high - low)}
    best = minimize_scalar(residual, bounds=(low, high), method="bounded", options=options)
    return float(best.x)


def print_drag(n: int, seconds: float, *, quick: bool) -> None:
    """Errors and biases of the drag, by the time step."""
    fine, finer = (
        swing(n, 0.01 / k, "second_order", TRUE_DRAG, seconds) for k in (FINE // 2, FINE)
    )
    print(f"reference: h = 0.01 / {FINE}; it differs from twice that h by {rms(fine, finer):.1e} m")
    print(f"{'integrator':<16}{'h [s]':>7}{'rms [mm]':>10}{'drag found':>12}{'bias':>8}")
    for integrator in INTEGRATORS:
        for h in (0.02, 0.01) if quick else (0.02, 0.01, 0.005, 0.0025):
            error = rms(swing(n, h, integrator, TRUE_DRAG, seconds), finer)
            line = f"{integrator:<16}{h:>7g}{1e3 * error:>10.3f}"
            if h >= 0.01:

                def residual(drag: float, h: float = h, integrator: str = integrator) -> float:
                    return rms(swing(n, h, integrator, drag, seconds), finer) ** 2

                drag = found(residual, 0.7 * TRUE_DRAG, 1.3 * TRUE_DRAG)
                line += f"{drag:>12.4f}{100 * (drag / TRUE_DRAG - 1):>+7.1f}%"
            print(line)
            sys.stdout.flush()


def print_explicit(n: int, seconds: float) -> None:
    """Errors against an explicit solver for the same energies, and the time that they cost."""
    rows = errors_and_times(n, seconds)
    heads = [f"h = {row['h']:g}" for row in rows]
    print(f"{'':<16}" + "".join(f"{head:>12}" for head in heads))
    for integrator in INTEGRATORS:
        found = [row[integrator] for row in rows]
        print(f"{integrator:<16}" + "".join(f"{each['error']:>9.3f} mm" for each in found))
        print(f"{'':<16}" + "".join(f"{each['milliseconds']:>7.0f} ms/s" for each in found))


def errors_and_times(n: int, seconds: float, turns: int = 3) -> list[dict[str, Any]]:
    """Errors of a sheet that swings without drag, and processor time, by the time step.

    Both integrators roll out in turn.

    Args:
        n: Vertices along a side.
        seconds: Length of the motion [s].
        turns: Rollouts of each, of which the median counts.

    Returns:
        For each time step "h" [s], and for each integrator the "error", root mean square over
        coordinates and times [mm], and the "milliseconds" of processor time in a simulated second.
    """
    from scipy.integrate import solve_ivp

    cloth = sheet(n, 0.6, stretch=100.0, bending=1e-3)
    edge = list(range(n * (n - 1), n * n))
    held = dc.Cloth(cloth.vertices, cloth.faces, pins={"edge": edge}, material=cloth.material)
    sim = simulator(held, 0.01, "implicit_euler")
    masses = sim.vertex_masses().numpy()[:, None]
    free = np.ones((n * n, 1))
    free[edge] = 0.0
    state = sim.initial_state()

    def motion(_: float, y: np.ndarray) -> np.ndarray:
        x, v = y.reshape(2, n * n, 3)
        positions = torch.tensor(x, requires_grad=True)
        energy = sim.energy(state.replace(positions=positions))  # gravity included
        (gradient,) = torch.autograd.grad(energy, positions)
        acceleration = -free * gradient.numpy() / masses
        return np.concatenate([v.ravel(), acceleration.ravel()])

    start = np.concatenate([state.positions.numpy().ravel(), np.zeros(3 * n * n)])
    at = 0.02 * np.arange(1, round(seconds / 0.02) + 1)
    solved = solve_ivp(motion, (0.0, at[-1]), start, "DOP853", at, rtol=1e-8, atol=1e-10)
    exact = torch.tensor(solved.y.T[:, : 3 * n * n].reshape(len(at), n * n, 3))
    rows = []
    for h in (0.02, 0.01, 0.005, 0.0025):
        sims = {name: simulator(held, h, name) for name in INTEGRATORS}
        times: dict[str, list[float]] = {name: [] for name in INTEGRATORS}
        row: dict[str, Any] = {"h": h}
        for _ in range(turns):
            for name, sim_of in sims.items():
                begin = time.process_time()
                positions = rolled(sim_of, seconds)
                times[name].append(time.process_time() - begin)
                row[name] = {"error": 1e3 * rms(positions[: len(exact)], exact)}
        for name in INTEGRATORS:
            row[name]["milliseconds"] = 1e3 * median(times[name]) / seconds
        rows.append(row)
    return rows


def print_damping(n: int, seconds: float, steps: Sequence[float]) -> None:
    """Damping that a fit finds in the oscillation of a hanging sheet, at some 11 rad/s."""

    def oscillation(h: float, integrator: str, damping: float) -> Tensor:
        cloth = sheet(n, 0.5, stretch=2.0, bending=1e-3, damping=damping)
        upright = np.stack(
            [cloth.vertices[:, 0], 0 * cloth.vertices[:, 0], cloth.vertices[:, 1]], axis=-1
        )
        edge = range(n * (n - 1), n * n)
        held = dc.Cloth(
            upright,
            cloth.faces,
            rest_positions=cloth.vertices,
            pins={"edge": edge},
            material=cloth.material,
        )
        return rolled(simulator(held, h, integrator), seconds)

    finer = oscillation(0.01 / FINE, "second_order", TRUE_DAMPING)
    for integrator in INTEGRATORS:
        for h in steps:

            def residual(damping: float, h: float = h, integrator: str = integrator) -> float:
                return rms(oscillation(h, integrator, damping), finer) ** 2

            damping = found(residual, 0.0, 2.0 * TRUE_DAMPING)
            bias = 100 * (damping / TRUE_DAMPING - 1)
            print(
                f"{integrator:<16} h {h:<7g} damping {1e3 * damping:.3f} ms of "
                f"{1e3 * TRUE_DAMPING:g}, {bias:+.1f} %"
            )


def random_drop(seed: int, damped: bool = False) -> tuple[dc.Scene, float, Tensor]:
    """A scene, a time step, and velocities of the sheet, whose damping is 1 to 50 ms or zero."""
    g = np.random.default_rng(seed)
    n = int(g.integers(4, 9))
    side = float(g.uniform(0.2, 0.6))
    material = {
        "stretch": float(10 ** g.uniform(1.5, 4)),
        "bending": float(10 ** g.uniform(-6, -3)),
        "friction": float(g.uniform(0.0, 0.8)),
        "density": float(g.uniform(0.08, 0.4)),
    }
    if damped:
        material["damping"] = float(10 ** np.random.default_rng(1000 + seed).uniform(-3, -1.3))
    cloth = sheet(n, side, **material)
    axis = g.normal(size=3)
    turn = torch.linalg.matrix_exp(
        torch.linalg.cross(
            torch.eye(3, dtype=torch.float64), torch.tensor(axis).expand(3, 3), dim=1
        )
    ).numpy()
    placed = cloth.vertices @ turn.T
    placed[:, 2] += 0.05 - placed[:, 2].min()
    body = [
        dc.RigidBody.plane(4.0),
        dc.RigidBody.sphere(0.15, pose=[0, 0, -0.16, 1, 0, 0, 0]),
        dc.RigidBody.box((0.2, 0.2, 0.2), pose=[0.03, 0.02, -0.11, 1, 0, 0, 0]),
    ][seed % 3]
    floor = [] if seed % 3 == 0 else [dc.RigidBody.plane(4.0, pose=[0, 0, -0.5, 1, 0, 0, 0])]
    scene = dc.Scene(
        [dc.Cloth(placed, cloth.faces, rest_positions=cloth.vertices, material=cloth.material)],
        [body, *floor],
    )
    velocities = torch.tensor(g.normal(size=3) * [1, 1, 0.5] + [0, 0, -1.0])
    return scene, float(g.choice([0.003, 0.005, 0.01, 0.02])), velocities


def print_drops(count: int, seconds: float, damped: bool = False) -> None:
    """Largest energies after contact by the time step, and speeds at the end."""
    print(
        f"{'integrator':<16}{'h [s]':>8}{'scenes':>8}{'largest E / E0':>16}{'kinetic alone':>15}"
        f"{'gains above 1 %':>17}{'median end speed':>18}{'not converged':>15}"
    )
    for integrator in INTEGRATORS:
        found: dict[float, list[tuple[float, float, float, int, int]]] = {}
        for seed in range(count):
            h, *numbers = drop(seed, integrator, seconds, damped)
            found.setdefault(h, []).append(tuple(numbers))
        for h in sorted(found):
            gains, kinetic, speeds, failed, steps = zip(*found[h], strict=True)
            print(
                f"{integrator:<16}{h:>8g}{len(gains):>8}{max(gains):>16.4f}{max(kinetic):>15.4f}"
                f"{sum(g > 1.01 for g in gains):>17}{median(speeds):>14.4f} m/s"
                f"{sum(failed):>8} of {sum(steps)}"
            )
        sys.stdout.flush()


def drop(
    seed: int, integrator: str, seconds: float, damped: bool = False
) -> tuple[float, float, float, float, int, int]:
    """One scene: time step, largest energy, largest without elasticity, speed, failures, steps."""
    scene, h, velocities = random_drop(seed, damped)
    sim = dc.Simulator(scene, h, integrator=integrator, solver=dc.SolverOptions(throw=False))
    state = sim.initial_state()
    state = state.replace(velocities=state.velocities + velocities)
    # Heights count from the lowest point of the scene.
    lowest = -9.81 * float(sim.vertex_masses().sum()) * 0.8
    energies: list[tuple[float, float]] = []
    touched, steps = False, 0
    with torch.no_grad():
        for steps in range(1, round(seconds / h) + 1):  # counted
            after = sim.step(state)
            if not after.report.converged:
                return (h, *largest(energies), 0.0, 1, steps)
            touched = touched or after.report.contact_count > 0
            middle = state.replace(velocities=0.5 * (state.velocities + after.velocities))
            there = middle if integrator == "second_order" else state
            kinetic = sim.kinetic_energy(there)
            gravity = sim.energy(there, parts=True)["gravity"]
            total = sim.energy(there) + kinetic
            if touched or not energies:
                energies.append((float(total) - lowest, float(gravity + kinetic) - lowest))
            state = after
    return (h, *largest(energies), float(state.velocities.norm(dim=1).max()), 0, steps)


def largest(energies: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """The largest of each after the first, over the first."""
    first = energies[0][0]
    later = energies[1:] or energies
    return max(e for e, _ in later) / first, max(e for _, e in later) / first


def print_cost(sizes: Sequence[int], steps: int) -> None:
    """Processor time of a step, in turn: of each rollout, and of Euler steps along the other's.

    The rollouts differ: less damped cloth is in other states, whose steps may take more iterations.
    The last columns compare steps from the same states.
    """
    columns = ("Euler [ms]", "second order", "ratio", "Euler there", "ratio", "iterations")
    print(f"{'scene':<16}{'size':>6}" + "".join(f"{name:>14}" for name in columns))
    for name in ("hanging", "plane", "sphere", "self-contact", "two-sheets", "moving-body"):
        for size in sizes:
            scene = SCENES[name](size)
            euler, second = (
                dc.Simulator(scene.scene, DT, integrator=name_of) for name_of in INTEGRATORS
            )
            states = [in_regime(sim, scene, 0) for sim in (euler, second)]
            times: list[list[float]] = [[], [], []]
            iterations: list[list[float]] = [[], [], []]
            with torch.no_grad():
                for _ in range(steps):
                    starts = [*states, states[1]]
                    ends = [
                        sim.step(start, scene.control(start))
                        for sim, start in zip((euler, second, euler), starts, strict=True)
                    ]
                    states = ends[:2]
                    for k, end in enumerate(ends):
                        times[k].append(1e3 * float(end.report.cpu_seconds))
                        iterations[k].append(float(end.report.iterations))
            own, other, there = (median(each) for each in times)
            counts = " ".join(f"{median(each):.0f}" for each in iterations)
            print(
                f"{name:<16}{size:>6}{own:>14.3g}{other:>14.3g}{other / own:>14.2f}"
                f"{there:>14.3g}{other / there:>14.2f}{counts:>14}"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main()
