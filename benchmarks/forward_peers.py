"""Time this package forward beside simulators of cloth without gradients, and count intersections.

    python -m venv ../newton && ../newton/bin/pip install newton
    python -m venv ../mujoco && ../mujoco/bin/pip install mujoco
    python -m benchmarks.forward_peers --newton ../newton/bin/python --mujoco ../mujoco/bin/python

The peers are Newton's Vertex Block Descent (`SolverVBD`) and MuJoCo's flex, each in a separate
environment; all use one core, and processor time is counted. The scenes of `benchmarks.peers`, and
a sheet whose upper half falls on the lower one, run for 15 frames at 60 Hz with equal mesh,
density, gravity, friction, and stiffness of stretch and bending, and with a contact radius of 1 mm
in the peers. The docstrings of the workers list their settings and sources.
Differences: the laws of stretch agree only for small strains; MuJoCo assigns equal masses to all
vertices, and has damping; its mode `ipc` has no friction.

Crossings are intersecting pairs of triangles of the sheet, vertices inside are vertices within the
body, both the maximum over frames. `stretch` is the longest edge over its length at rest.
"""

from __future__ import annotations

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
from benchmarks import peers
from benchmarks.crossings import Crossings
from benchmarks.scenes import self_contact

SCENES = (*peers.SCENES, "self-contact")
FOLDING = ("sphere", "self-contact")  # scenes for which MuJoCo detects self-contact of the sheet
RADIUS = 1e-3  # contact radius in the peers [m]

Records = dict[str, Any]


def scene(name: str, size: int) -> Records:
    """The scene for all simulators, as plain numbers."""
    if name == "self-contact":
        told = peers.scene("hanging", size)
        cloth = self_contact(size).scene.cloths[0]
        vertices = np.array(cloth.vertices)
        told["rest"] = np.array(cloth.rest_positions).tolist()
        told["pinned"] = [int(v) for pins in cloth.pins.values() for v in pins]
        told["vertices"], told["velocities"] = vertices.tolist(), np.zeros_like(vertices).tolist()
    else:
        told = peers.scene(name, size)
        told["rest"] = told["vertices"]
    rest, faces = np.array(told["rest"]), np.array(told["faces"])
    corners = rest[faces]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    told.update(
        name=name,
        radius=RADIUS,
        folds=name in FOLDING,
        ipc=False,
        bending=peers.MATERIAL.bending,
        mass=told["density"] * float(np.linalg.norm(sides, axis=1).sum()) / 2,
        edge_hinge=_edge_hinge(rest, faces),
    )
    for key in ("weights", "directions", "difference_steps", "hinge"):
        del told[key]
    return told


def _edge_hinge(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> float:
    """Mean torque of the hinges of a plate, over their angle and length [N]: 3 D l / area."""
    lengths, areas = peers.hinges(vertices, faces)
    return float(np.mean(3 * peers.MATERIAL.bending * lengths / areas))


def time_ours(told: Records) -> Records:
    """The scene by this package."""
    pins = {"pinned": told["pinned"]} if told["pinned"] else {}
    cloth = dc.Cloth(
        np.array(told["vertices"]),
        np.array(told["faces"]),
        rest_positions=np.array(told["rest"]),
        pins=pins,
        material=peers.MATERIAL,
    )
    bodies = []
    if told["body"] == "plane":
        bodies = [dc.RigidBody.plane(4.0, friction=told["friction"])]
    elif told["body"]:
        center, radius = told["body"]
        pose = [*center, 1, 0, 0, 0]
        bodies = [dc.RigidBody.sphere(radius, pose=pose, friction=told["friction"], smooth=True)]
    simulator = dc.Simulator(dc.Scene([cloth], bodies), told["dt"])
    velocities = torch.tensor(told["velocities"], dtype=torch.float64)
    start = simulator.initial_state().replace(velocities=velocities)
    seconds = []
    for _ in range(told["repeats"] + 1):
        begin = time.process_time()
        with torch.no_grad():
            states = simulator.rollout(start, steps=told["frames"])
        seconds.append(time.process_time() - begin)
    return {
        "version": dc.__version__,
        "substeps": 1,
        "forward": 1e3 * median(seconds[1:]) / told["frames"],
        "frames": [s.positions.numpy() for s in (start, *states)],
    }


def judge(told: Records, found: Records) -> Records:
    """Crossings, vertices inside, depth [mm], and stretch, each the worst of all frames."""
    frames = np.array(found["frames"], dtype=float)
    if not np.isfinite(frames).all():
        raise click.ClickException(f"{told['name']}: positions are not finite")
    faces, rest = np.array(told["faces"]), np.array(told["rest"])
    crossings = Crossings(dc.Scene([dc.Cloth(rest, faces)]))
    inside = 0
    if told["body"] == "plane":
        inside = int((frames[..., 2] < 0.0).sum(axis=1).max())
    elif told["body"]:
        center, radius = np.array(told["body"][0]), told["body"][1]
        inside = int((np.linalg.norm(frames - center, axis=-1) < radius).sum(axis=1).max())
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])

    def lengths(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=-1)

    return {
        "crossings": max(crossings.count_points(x) for x in frames),
        "inside": inside,
        "depth": 1e3 * peers.depth(told, {"frames": frames}),
        "stretch": max(float((lengths(x) / lengths(rest)).max()) for x in frames),
    }


def time_all(newton: Path, mujoco: Path, size: int) -> Iterator[Records]:
    """Yield one row for each scene and simulator."""
    for name in SCENES:
        told = scene(name, size)
        runs = [
            ("ours", lambda told=told: time_ours(told)),
            ("Newton, VBD", lambda told=told: peers.time_peer(told, newton, "vbd_worker.py")),
            ("MuJoCo", lambda told=told: peers.time_peer(told, mujoco, "mujoco_worker.py")),
        ]
        if told["folds"]:
            frictionless = {**told, "ipc": True}
            runs.append(
                (
                    "MuJoCo, ipc",
                    lambda t=frictionless: peers.time_peer(t, mujoco, "mujoco_worker.py"),
                )
            )
        for who, run in runs:
            found = run()
            yield {
                "scene": name,
                "size": size,
                "by": f"{who} {found['version']}",
                "substeps": found["substeps"],
                "forward": found["forward"],
                **judge(told, found),
            }


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.option(
    "--newton",
    required=True,
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Python of an environment that has it.",
)
@click.option(
    "--mujoco",
    required=True,
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Python of an environment that has it.",
)
@click.option("--size", default=24, show_default=True)
def main(newton: Path, mujoco: Path, size: int) -> None:
    torch.set_num_threads(1)
    print(
        "scene         by                  substeps  forward [ms]  crossings  inside  depth [mm]",
        end="",
    )
    print("  stretch")
    for row in time_all(newton, mujoco, size):
        print(
            f"{row['scene']:13} {row['by']:19} {row['substeps']:8} {row['forward']:13.2f} "
            f"{row['crossings']:10} {row['inside']:7} {row['depth']:11.3f} {row['stretch']:8.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
