"""Times of steps, forward and backward, and of a reference factorization between steps."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

import diffcloth_torch as dc
from benchmarks.extra import require
from benchmarks.scenes import DT, Scene, in_regime

try:
    from diffcloth_torch.autograd.core_function import as_array
    from diffcloth_torch.geometry.poses import transform
except ModuleNotFoundError:  # in the first version, which we compare with
    from diffcloth_torch.poses import transform
    from diffcloth_torch.step import as_array

ipctk = require("ipctk")

REPEATS = 5  # repetitions of the derivatives of one step, after one untimed repetition
MANY = 8  # directions
BLOCK = 5  # steps between two reference factorizations
WARM_UP = 2  # steps with backward whose times are dropped: caches fill


@dataclass(frozen=True)
class Spread:
    """Median and quartiles."""

    median: float
    lower: float
    upper: float

    @staticmethod
    def of(values: list[float]) -> Spread:
        lower, middle, upper = np.quantile(values, [0.25, 0.5, 0.75]).tolist()
        return Spread(middle, lower, upper)


@dataclass(frozen=True)
class Timing:
    """One row of the table; times are per environment.

    Attributes:
        scene: Name of the scene.
        size: Vertices along a side.
        batch: Number of environments, 0 for a state without a batch axis.
        threads: Number of threads of torch.
        steps: Number of timed steps.
        forward: Time of one step [ms].
        backward: Time of backward of one step [ms].
        reference: Time of one Eigen LDL^T factorization of the contact-free Hessian, EF [ms].
        tangent: Time of one tangent over the time of one backward, both in the core, last step.
        many_tangents: Time of `MANY` tangents at once over the time of one backward.
        phases: Medians of the phases in the report of a step [ms].
        iterations: Median Newton iterations of a step.
        residual: Largest residual of all steps [m/s].
        contacts: Median number of pairs in contact.
        contact_share: Median share of the vertices that are in contact [-].
    """

    scene: str
    size: int
    batch: int
    threads: int
    steps: int
    forward: Spread
    backward: Spread
    reference: Spread
    tangent: float
    many_tangents: float
    phases: dict[str, float]
    iterations: float
    residual: float
    contacts: float
    contact_share: float

    @property
    def forward_in_ef(self) -> float:
        return self.forward.median / self.reference.median

    @property
    def backward_in_ef(self) -> float:
        return self.backward.median / self.reference.median

    def record(self) -> dict[str, Any]:
        """Everything, as plain numbers."""
        in_ef = {"forward_in_ef": self.forward_in_ef, "backward_in_ef": self.backward_in_ef}
        return {**asdict(self), **in_ef}


def time_steps(
    name: str,
    size: int,
    batch: int,
    threads: int,
    steps: int,
    scene: Scene,
    kept: Path | None = None,
) -> Timing:
    """Bring a scene into its regime and time the following steps, each with its backward.

    Positions and velocities are differentiated by positions and velocities before the step and by
    the targets of the bodies. The file `kept` is passed to `in_regime`.
    """
    simulator = dc.Simulator(scene.scene, DT)
    repeats = 3 if size <= 24 else 1
    torch.set_num_threads(threads)
    state = in_regime(simulator, scene, batch, kept)
    samples: list[dict[str, Any]] = []
    references: list[float] = []
    for k in range(WARM_UP + steps):
        if (k - WARM_UP) % BLOCK == 0 and k >= WARM_UP:
            references.append(reference_seconds(simulator, state, repeats))
        before, control = state, scene.control(state)
        state, sample = _timed_step(simulator, state, control)
        if k >= WARM_UP:
            samples.append(sample)
    references.append(reference_seconds(simulator, state, repeats))
    tangent, many = tangent_ratios(simulator, before, control)

    def all_of(key: str, factor: float = 1.0) -> list[float]:
        return [factor * sample[key] for sample in samples]

    return Timing(
        scene=name,
        size=size,
        batch=batch,
        threads=threads,
        steps=steps,
        forward=Spread.of(all_of("forward", 1e3)),
        backward=Spread.of(all_of("backward", 1e3)),
        reference=Spread.of([1e3 * seconds for seconds in references]),
        tangent=tangent,
        many_tangents=many,
        phases={
            phase: 1e3 * median(sample["phases"][phase] for sample in samples)
            for phase in samples[0]["phases"]
        },
        iterations=median(all_of("iterations")),
        residual=max(all_of("residual")),
        contacts=median(all_of("contacts")),
        contact_share=median(all_of("contact_share")),
    )


def reference_seconds(simulator: dc.Simulator, state: dc.State, repeats: int) -> float:
    """Seconds of one EF: Eigen's factorization of the contact-free Hessian at this state."""
    inputs, _ = simulator._inputs(state, None, None)
    arrays = {name: as_array(tensor) for name, tensor in inputs.items()}
    return simulator._core.reference_factorization_seconds(arrays, repeats)


def tangent_ratios(
    simulator: dc.Simulator, state: dc.State, control: dc.Control
) -> tuple[float, float]:
    """Time of one tangent and of `MANY` at once, relative to one backward, all in the core.

    Positions and velocities are differentiated by positions and velocities before the step and by
    the targets of the bodies.
    """
    with torch.no_grad():
        given, _ = simulator._inputs(state.detach(), control, None)
    inputs = {name: as_array(tensor) for name, tensor in given.items()}
    core, threads = simulator._core, torch.get_num_threads()
    result = core.forward(inputs, True, threads)
    taken = inputs, {k: v for k, v in result.items() if k.startswith("tape_")}, result["kept"]
    names = [n for n in ("positions", "velocities", "body_targets") if inputs[n].size]
    noise = np.random.default_rng(1)
    cotangents = {
        name: np.zeros((1, *result[name].shape))
        for name in ("body_forces", "contact_forces", "pin_forces", "coordinates")
        if name in result
    }
    for name in ("positions", "velocities"):
        cotangents[name] = noise.standard_normal((1, *result[name].shape))
    tangents = {n: noise.standard_normal((MANY, *inputs[n].shape)) for n in names}
    one = {n: values[:1] for n, values in tangents.items()}
    backward = _median_seconds(lambda: core.backward(*taken, cotangents, 1, names, threads))
    tangent = _median_seconds(lambda: core.tangent(*taken, one, 1, threads))
    many = _median_seconds(lambda: core.tangent(*taken, tangents, MANY, threads))
    return tangent / backward, many / backward


def _median_seconds(call: Callable[[], object]) -> float:
    seconds = []
    for _ in range(1 + REPEATS):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return median(seconds[1:])


def _timed_step(
    simulator: dc.Simulator, state: dc.State, control: dc.Control
) -> tuple[dc.State, dict[str, Any]]:
    before = state.detach()
    leaves = [before.positions, before.velocities]
    if isinstance(control.body_poses, torch.Tensor):
        leaves.append(control.body_poses)
    for leaf in leaves:
        leaf.requires_grad_()

    start = time.perf_counter()
    after = simulator.step(before, control)
    forward = time.perf_counter() - start

    outputs = [after.positions, after.velocities]
    generator = torch.Generator().manual_seed(1)
    cotangents = [torch.randn(x.shape, generator=generator, dtype=x.dtype) for x in outputs]
    start = time.perf_counter()
    torch.autograd.backward(outputs, cotangents)
    backward = time.perf_counter() - start

    after = after.detach()
    environments = list(after) if after.batch_size else [after]
    reports = [environment.report for environment in environments]
    count = len(environments)
    phases = {
        phase: sum(report.seconds[phase] for report in reports) / count
        for phase in reports[0].seconds
    }
    return after, {
        "forward": forward / count,
        "backward": backward / count,
        "phases": phases,
        "iterations": sum(report.iterations for report in reports) / count,
        "residual": max(report.residual for report in reports),
        "contacts": sum(report.contact_count for report in reports) / count,
        "contact_share": sum(contact_share(simulator, e) for e in environments) / count,
    }


def contact_share(simulator: dc.Simulator, state: dc.State) -> float:
    """Share of the cloth's vertices that belong to a pair in contact, as found by ipctk [-]."""
    faces, vertices = [], [state.positions.numpy()]
    start = 0
    for cloth in simulator.scene.cloths:
        faces.append(cloth.faces + start)
        start += len(cloth.vertices)
    cloth_vertices = start
    for body, pose in zip(simulator.scene.bodies, state.body_poses.numpy(), strict=True):
        faces.append(body.faces + start)
        vertices.append(transform(body.vertices, pose))
        start += len(body.vertices)
    if simulator.scene.robots:
        meshes = state.meshes()
        for name in simulator.surfaces[len(simulator.scene.cloths) + len(simulator.scene.bodies) :]:
            placed, triangles = meshes[name]
            faces.append(triangles.numpy() + start)
            vertices.append(placed.numpy())
            start += len(placed)
    all_vertices, all_faces = np.concatenate(vertices), np.concatenate(faces)
    mesh = ipctk.CollisionMesh(all_vertices, ipctk.edges(all_faces), all_faces)
    collisions = ipctk.NormalCollisions()
    # 0.1, to compare with, has the other name.
    own = getattr(simulator, "default_parameters", None) or simulator.parameters
    collisions.build(mesh, all_vertices, own().barrier_distance.item())
    touched = {
        int(vertex)
        for k in range(len(collisions))
        for vertex in collisions[k].vertex_ids(mesh.edges, mesh.faces)
    }
    return sum(0 <= vertex < cloth_vertices for vertex in touched) / cloth_vertices
