"""Time this package beside a peer that differentiates cloth, and check the gradients of both.

    python -m venv ../peer && ../peer/bin/pip install newton
    python -m benchmarks.peers --newton ../peer/bin/python

The peer is Newton, in a separate environment; both use one core, and processor time is counted. A
sheet of 1 m hangs by two corners, slides on a floor, or drops on a sphere, 15 frames at 60 Hz; the
loss is the final position of its center. Newton's cloth uses explicit substeps, the smallest power
of two for which no edge is stretched by half its length, and a different material law with the same
modulus: the two solve the same problem, but not the same equations. Each gradient is compared with
differences of its own loss, along three translations and a rotation of the initial velocities. The
error is the error of the worst direction, at the best of several difference steps, relative to the
largest slope.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import click
import numpy as np
import torch
from numpy.typing import NDArray

import diffcloth_torch as dc
from benchmarks.scenes import sheet

SCENES = ("hanging", "plane", "sphere")
DT = 1 / 60  # [s]
FRAMES = 15
REPEATS = 3
DIFFERENCE_STEPS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)  # of velocities [m/s]
SINGLE_DIFFERENCE_STEPS = (1e-1, 3e-2, 1e-2, 3e-3)  # difference steps in single precision
MATERIAL = dc.Material(friction=0.4)
CONTACT_DAMPING = 0.1  # of the peer's penalty [N s/m]: a third of critical for one vertex
RADIUS = 0.2  # of the sphere [m]
WORKER = "newton_worker.py"

Records = dict[str, Any]


def scene(name: str, size: int) -> Records:
    """The scene for both simulators, as plain numbers."""
    vertices, faces = sheet(size)
    vertices[:, 2] += 0.1 / (size - 1)
    velocities = np.zeros_like(vertices)
    body: Any = None
    pinned: list[int] = []
    if name == "hanging":
        pinned = [size * (size - 1), size * size - 1]
    elif name == "plane":
        body = "plane"
        velocities += (0.8, 0.3, 0.0)
    else:
        body = [[0.02, 0.03, -RADIUS], RADIUS]
    turn = np.cross([0.0, 0.0, 1.0], vertices)
    directions = [*(np.broadcast_to(axis, vertices.shape) for axis in np.eye(3)), turn]
    free = np.ones(len(vertices))
    free[pinned] = 0.0
    return {
        "name": name,
        "dt": DT,
        "frames": FRAMES,
        "repeats": REPEATS,
        "gravity": 9.81,
        "vertices": vertices.tolist(),
        "faces": faces.tolist(),
        "velocities": velocities.tolist(),
        "pinned": pinned,
        "body": body,
        "density": MATERIAL.density,
        "stretch": MATERIAL.stretch,
        "hinge": _hinge(vertices, faces),
        "friction": MATERIAL.friction,
        "slip_velocity": 1e-3,
        "contact_damping": CONTACT_DAMPING,
        "weights": np.tile(
            np.array([0.6, 0.48, 0.64]) / len(vertices), (len(vertices), 1)
        ).tolist(),
        "directions": [(d * free[:, None]).tolist() for d in directions],
        "difference_steps": SINGLE_DIFFERENCE_STEPS,
    }


def hinges(
    vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lengths of the edges between two triangles [m], and areas of the two together [m^2]."""
    opposite: dict[tuple[int, int], list[int]] = {}
    for a, b, c in faces.tolist():
        for i, j, k in ((a, b, c), (b, c, a), (c, a, b)):
            opposite.setdefault((min(i, j), max(i, j)), []).append(k)
    inner = np.array([(*edge, *others) for edge, others in opposite.items() if len(others) == 2])
    start, end, *others = (vertices[inner[:, i]] for i in range(4))
    edge = end - start
    twice = sum(np.linalg.norm(np.cross(edge, other - start), axis=-1) for other in others)
    return np.linalg.norm(edge, axis=-1), twice / 2


def _hinge(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> float:
    """Mean torque of the peer's hinges, over their angle and squared length, of a plate [N/m]."""
    lengths, areas = hinges(vertices, faces)
    return float(np.mean(3 * MATERIAL.bending * lengths / areas**2))


def time_ours(told: Records) -> Records:
    """The scene by this package."""
    vertices, faces = np.array(told["vertices"]), np.array(told["faces"])
    pins = {"corners": told["pinned"]} if told["pinned"] else {}
    cloth = dc.Cloth(vertices, faces, pins=pins, material=MATERIAL)
    bodies = []
    if told["body"] == "plane":
        bodies = [dc.RigidBody.plane(4.0, friction=MATERIAL.friction)]
    elif told["body"]:
        center, radius = told["body"]
        pose = [*center, 1, 0, 0, 0]
        bodies = [dc.RigidBody.sphere(radius, pose=pose, friction=MATERIAL.friction)]
    simulator = dc.Simulator(dc.Scene([cloth], bodies), DT)
    start = simulator.initial_state()
    weights = torch.tensor(told["weights"], dtype=torch.float64)

    def loss(velocities: torch.Tensor) -> tuple[torch.Tensor, list[dc.State]]:
        states = simulator.rollout(start.replace(velocities=velocities), steps=FRAMES)
        return (states[-1].positions * weights).sum(), states

    v = torch.tensor(told["velocities"], dtype=torch.float64).requires_grad_()
    forward, backward = [], []
    for _ in range(REPEATS + 1):
        begin = time.process_time()
        end, states = loss(v)
        forward.append(time.process_time() - begin)
        begin = time.process_time()
        (gradient,) = torch.autograd.grad(end, v)
        backward.append(time.process_time() - begin)
    directions = [torch.tensor(d, dtype=torch.float64) for d in told["directions"]]
    differences = []
    with torch.no_grad():
        for d in directions:
            ends = [
                [loss(v + sign * step * d)[0].item() for sign in (1, -1)]
                for step in DIFFERENCE_STEPS
            ]
            differences.append(
                [(a - b) / (2 * step) for (a, b), step in zip(ends, DIFFERENCE_STEPS, strict=True)]
            )
    return {
        "version": dc.__version__,
        "substeps": 1,
        "forward": 1e3 * median(forward[1:]) / FRAMES,
        "backward": 1e3 * median(backward[1:]) / FRAMES,
        "slopes": [(gradient * d).sum().item() for d in directions],
        "differences": differences,
        "frames": [s.positions.detach().numpy() for s in (start, *states)],
    }


def time_peer(told: Records, python: Path, worker: str) -> Records:
    """Results of a peer for the scene `told`, in its own environment, on one core."""
    core = min(os.sched_getaffinity(0))
    result = subprocess.run(
        [python, str(Path(__file__).with_name(worker))],
        input=json.dumps(told),
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: os.sched_setaffinity(0, [core]),
    )
    if result.returncode != 0:
        raise click.ClickException(f"{worker} failed:\n{result.stderr}")
    return json.loads(result.stdout.splitlines()[-1])


def gradient_error(found: Records) -> float:
    """Largest error of a slope at its best difference step, relative to the largest slope."""
    slopes, differences = np.array(found["slopes"]), np.array(found["differences"])
    return float(np.abs(differences - slopes[:, None]).min(axis=1).max() / np.abs(slopes).max())


def depth(told: Records, found: Records) -> float:
    """Largest depth of the sheet below the surface of the body over all frames [m]."""
    body, faces = told["body"], np.array(told["faces"])
    if body is None:
        return 0.0
    frames = np.array(found["frames"])
    if body == "plane":
        return max(0.0, -float(frames[..., 2].min()))
    import trimesh

    center, radius = np.array(body[0]), body[1]
    nearest = []
    for x in frames:
        triangles = x[faces]
        points = trimesh.triangles.closest_point(triangles, np.tile(center, (len(triangles), 1)))
        nearest.append(np.linalg.norm(points - center, axis=-1).min())
    return max(0.0, radius - float(min(nearest)))


def time_all(newton: Path, size: int) -> Iterator[Records]:
    """Yield one row for each scene and each of the two simulators."""
    for name in SCENES:
        told = scene(name, size)
        for who, found in (("ours", time_ours(told)), ("Newton", time_peer(told, newton, WORKER))):
            yield {
                "scene": name,
                "size": size,
                "by": f"{who} {found['version']}",
                **{key: found[key] for key in ("substeps", "forward", "backward")},
                "gradient_error": gradient_error(found),
                "depth": 1e3 * depth(told, found),
            }


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.option(
    "--newton",
    required=True,
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Python of an environment that has it.",
)
@click.option("--size", default=24, show_default=True)
def main(newton: Path, size: int) -> None:
    torch.set_num_threads(1)
    print("scene    by               substeps  forward  backward [ms]  gradient  depth [mm]")
    for row in time_all(newton, size):
        print(
            f"{row['scene']:8} {row['by']:16} {row['substeps']:8} {row['forward']:8.2f} "
            f"{row['backward']:9.2f} {row['gradient_error']:14.1e} {row['depth']:11.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
