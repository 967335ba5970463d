"""Digests of steps and gradients: equal lines of two versions mean equal bits.

    python -m benchmarks.bits > before.txt       # ten seconds; in another checkout > after.txt
    diff before.txt after.txt

Every scene of `benchmarks/scenes.py`, a free body and a gripper, in each scheme and coupling that
supports them, alone and in a batch. A line has digests of all tensors of the state after some
steps, and of the gradients by the start and by every parameter.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import click
import numpy as np
import torch
from torch import Tensor

import diffcloth_torch as dc
from benchmarks import coupling
from benchmarks.scenes import BUCKLING, DT, FURTHER, SCENES, in_regime

START = ("positions", "velocities", "body_poses", "body_velocities", "joint_positions")
END = (*START, "body_forces", "joint_velocities", "joint_efforts", "base_poses", "base_velocities")
STEPS = 2  # with a graph
FREE = ("gripper", "limited-gripper")  # which one minimization moves together with cloth
PROJECTIVE = ("hanging", "stiff", "plane", "sphere", "air")


@dataclass(frozen=True)
class Case:
    """A regime, and a function that makes its simulator, start and control."""

    name: str
    start: Callable[[], tuple[dc.Simulator, dc.State, Callable[[dc.State], dc.Control]]]


def cases(size: int) -> Iterator[Case]:
    """All regimes."""
    for name, make in {**SCENES, **BUCKLING, **FURTHER}.items():
        for scheme in ("coupled", "split", "projective"):
            if scheme == "projective" and name not in PROJECTIVE:
                continue
            if scheme == "split" and name in FREE:
                continue
            for batch in (0, 3) if scheme == "coupled" else (0,):

                def start(make=make, scheme=scheme, batch=batch):  # type: ignore[no-untyped-def]
                    scene = make(size)
                    options = dc.SolverOptions(throw=False)
                    simulator = dc.Simulator(scene.scene, DT, scheme=scheme, solver=options)
                    return simulator, in_regime(simulator, scene, batch), scene.control

                yield Case(f"{name} {scheme}" + (f" x{batch}" if batch else ""), start)
    pairs = {**coupling.PAIRS, "limited gripper": coupling.limited_gripper}
    for name, make_pair in pairs.items():
        for how in ("monolithic", "rigid_to_cloth", "cloth_to_rigid"):

            def start_pair(make_pair=make_pair, how=how):  # type: ignore[no-untyped-def]
                pair = make_pair(size)
                simulator = dc.Simulator(pair.free.scene, DT, coupling=how)
                state = simulator.initial_state(2)
                with torch.no_grad():
                    for _ in range(8):
                        state = simulator.step(state, pair.control)
                return simulator, state, lambda state: pair.control

            yield Case(f"{name} {how} x2", start_pair)


def digest(tensors: list[Tensor]) -> str:
    """Digest of the shapes and bits of tensors."""
    sha = hashlib.sha256()
    for tensor in tensors:
        sha.update(str(tuple(tensor.shape)).encode())
        sha.update(np.ascontiguousarray(tensor.detach().numpy()).tobytes())
    return sha.hexdigest()[:16]


def measure(case: Case) -> tuple[str, str]:
    """Digests of the end, and of the gradients."""
    simulator, state, control = case.start()
    # Parameters that the scene does not use are None.
    fields = {
        name: value.clone().requires_grad_()
        for name in dc.Parameters.__dataclass_fields__
        if not name.startswith("_")
        and (value := getattr(simulator.default_parameters(), name)) is not None
    }
    parameters = simulator.default_parameters().replace(**fields)
    start = {name: getattr(state, name).detach().clone().requires_grad_() for name in START}
    state = state.replace(**start)
    for _ in range(STEPS):
        state = simulator.step(state, control(state), parameters)
    end = [getattr(state, name) for name in END]
    generator = torch.Generator().manual_seed(0)
    loss = sum(
        ((x * torch.randn(x.shape, generator=generator, dtype=x.dtype)).sum() for x in end),
        start=torch.zeros((), dtype=torch.float64),
    )
    inputs = [*start.values(), *fields.values()]
    gradients = torch.autograd.grad(loss, inputs, allow_unused=True, materialize_grads=True)
    return digest(end), digest(list(gradients))


@click.command(help=__doc__.splitlines()[0])
@click.option("--size", default=12, show_default=True, help="Vertices a side.")
@click.option("--only", default="", help="Those whose name holds this.")
def main(size: int, only: str) -> None:
    """Print a line for each case."""
    for case in cases(size):
        if only in case.name:
            end, gradient = measure(case)
            click.echo(f"{case.name:32} {end} {gradient}")


if __name__ == "__main__":
    main()
