"""Cost of a step of the baseline: a sheet slides off a sphere with dry friction at its nodes.

    python -m benchmarks.projective            # under a minute
    python -m benchmarks.projective --quick    # seconds, on a small mesh

25 x 25 vertices, 4.5 m wide, on a sphere of radius 2 m, in steps of 1/180 s: the scene of the
tests' reference trajectory. Each row is one elastic solver at one tolerance. Times are of the
fastest step in contact, in milliseconds and in EF: one factorization of the contact-free Hessian by
Eigen, the fastest of those between the steps. Backward is of a random loss of positions.
"""

from __future__ import annotations

import time

import click
import torch

import diffcloth_torch as dc
from diffcloth_torch.autograd.core_function import as_array

DT = 1 / 180  # [s]
ROWS = [(elastic, tolerance) for tolerance in (1e-3, 1e-6) for elastic in ("newton", "projective")]


def simulator(size: int, elastic: str, tolerance: float) -> dc.Simulator:
    """The sheet just above the sphere, both with the materials of the experiment."""
    material = dc.Material(stretch=150.0, bending=1e-5, density=0.3, damping=0.0, friction=0.3)
    sheet = dc.Cloth.grid(size, size, size=(4.5, 4.5), material=material, bending_model="hinge")
    ball = dc.RigidBody.sphere(2.0, pose=[0.6, 0.2, -2.1, 1, 0, 0, 0], friction=0.3, thickness=0.2)
    return dc.Simulator(
        dc.Scene([sheet], [ball]),
        DT,
        scheme="projective",
        contact=dc.ContactOptions(self_contact=False),
        solver=dc.SolverOptions(tolerance=tolerance, elastic=elastic),
    )


def reference(sim: dc.Simulator, state: dc.State) -> float:
    """Seconds of one factorization."""
    inputs, _ = sim._inputs(state, None, None)
    arrays = {name: as_array(tensor) for name, tensor in inputs.items()}
    return sim._core.reference_factorization_seconds(arrays, 3)


def measure(size: int, elastic: str, tolerance: float, first: int, steps: int) -> str:
    """One row of the table."""
    sim = simulator(size, elastic, tolerance)
    state = sim.initial_state()
    with torch.no_grad():
        for _ in range(first):
            state = sim.step(state)
    weights = torch.randn(state.positions.shape, dtype=torch.float64)
    forward, backward, factor, touching = [], [], [], []
    for _ in range(steps):
        x = state.positions.clone().requires_grad_()
        begin = time.perf_counter()
        after = sim.step(state.replace(positions=x))
        middle = time.perf_counter()
        (after.positions * weights).sum().backward()
        forward.append(middle - begin)
        backward.append(time.perf_counter() - middle)
        factor.append(reference(sim, state))
        touching.append(after.report.contact_count)
        state = after.detach()
    ef = min(factor)
    cells = [
        f"{elastic:11}",
        f"{tolerance:9.0e}",
        f"{max(touching):8d}",
        f"{1e3 * ef:6.2f}",
    ]
    for values in (forward, backward):
        cells += [f"{1e3 * min(values):8.2f}", f"{min(values) / ef:6.2f}"]
    return " ".join(cells)


@click.command(help=__doc__)
@click.option("--quick", is_flag=True, help="A small mesh and few steps.")
def main(quick: bool) -> None:
    torch.manual_seed(0)
    torch.set_num_threads(1)
    size, first, steps = (13, 20, 3) if quick else (25, 60, 40)
    print("elastic     tolerance touching  EF[ms]  fwd[ms] fwd[EF]  bwd[ms] bwd[EF]")
    for elastic, tolerance in ROWS:
        print(measure(size, elastic, tolerance, first, steps), flush=True)


if __name__ == "__main__":
    main()
