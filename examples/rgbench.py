"""Captures of real garments in the format of RGBench, for fits and for evaluation.

    python examples/rgbench.py green_tshirt/green_tshirt_grasp_2025-07-19-19-14-58

RGBench records garments that two robot arms fling, fold or grasp, as point clouds of a camera. A
folder of its data set `RGBench-Cloth-Sim2Real-v1` contains, for each capture,

    calibration/world_to_camera_transform.json              4 x 4 matrix, camera from world
    joints/{left,right}_arm_joint_states_and_end_pose.csv   with columns time, pos_x, pos_y, pos_z
    segment_pcds/pointcloud_<time>_segmented.pcd            points of the garment, in camera axes

In its protocol "fixed point" a vertex of the garment follows each gripper; the error of a frame is
the mean distance of the observed points to the nearest simulated vertex. Times count from the first
row of the arms; a camera is late by a delay of about one frame.

References:
    Hu et al., "Real Garment Benchmark (RGBench): a comprehensive benchmark for robotic garment
    manipulation featuring a high-fidelity scalable simulator", 2025, arXiv:2511.06434.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from pcd import read_pcd

from diffcloth_torch.autograd.transforms import numbers_of
from diffcloth_torch.checks import (
    ANY_NUMBER,
    NON_NEGATIVE,
    POSITIVE,
    FloatArray,
    check_finite,
    check_number,
    check_shape,
    float_array,
)
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import as_path, read_regular_file
from diffcloth_torch.optimize.compared import check_count_of, checked_points, positions_of
from diffcloth_torch.sim.records.state import State

__all__ = ["BASES", "Capture", "chamfer", "nearest_vertices", "read_capture"]

BASES: Mapping[str, Sequence[float]] = {"left": (0.0, 0.25, 0.0), "right": (0.0, -0.25, 0.0)}
"""Where the arms stand in world axes [m], as the protocol's own simulations have them."""

_TRANSFORM = "calibration/world_to_camera_transform.json"
_POSES = "joints/{}_arm_joint_states_and_end_pose.csv"
_COLUMNS = ("time", "pos_x", "pos_y", "pos_z")
_CLOUD = re.compile(r"pointcloud_([0-9]+(?:\.[0-9]+)?)_segmented\.pcd")
_LARGEST = 256 << 20  # bytes of a file
_NEARLY = 1e-3  # by which a rotation may be off: matrices are written with a few digits


@dataclass(frozen=True, eq=False)
class Capture:
    """Point clouds of a garment, in world axes, and the motion of the grippers.

    Attributes:
        times: Times of the frames [s], from the first row of the arms, with the camera's delay: the
            times for comparison with simulated states.
        clouds: Points of each frame [m], shape [n, 3].
        arms: Name of an arm -> times [s], shape [k], and positions of its gripper [m], [k, 3].
    """

    times: FloatArray
    clouds: list[FloatArray]
    arms: dict[str, tuple[FloatArray, FloatArray]]

    def grippers(self, time: float) -> dict[str, FloatArray]:
        """Position of each gripper at a time [m], between its rows straight; at rest beyond."""
        time = check_number("Capture.grippers: `time`", time, ANY_NUMBER)
        return {
            name: np.stack([np.interp(time, times, column) for column in positions.T])
            for name, (times, positions) in self.arms.items()
        }

    def steps(self, dt: float) -> list[int]:
        """The step of a simulation nearest to each frame, at least one: its states are seen."""
        check_number("Capture.steps: `dt`", dt, POSITIVE)
        return [max(round(float(time) / dt), 1) for time in self.times]

    def between(self, first: float, last: float) -> Capture:
        """The frames between two times [s], such as the evaluation window of the protocol.

        Raises:
            InvalidInput: If there is no frame between the times.
        """
        first = check_number("Capture.between: `first`", first, ANY_NUMBER)
        last = check_number("Capture.between: `last`", last, ANY_NUMBER)
        kept = [k for k, time in enumerate(self.times) if first <= time <= last]
        if not kept:
            raise InvalidInput(
                f"Capture.between: there must be a frame between {first:g} and {last:g} s; they "
                f"are between {self.times[0]:g} and {self.times[-1]:g} s"
            )
        return Capture(self.times[kept], [self.clouds[k] for k in kept], self.arms)


def read_capture(
    folder: str | Path,
    *,
    delay: float = 0.0,
    bases: Mapping[str, Sequence[float]] = BASES,
) -> Capture:
    """Read a capture without empty frames and without frames before the arms move.

    Args:
        folder: Folder of the capture.
        delay: Delay of the camera [s], >= 0; the benchmark lists one for each capture.
        bases: Positions of the arms in world axes [m]. Arms without a file are left out.

    Raises:
        InvalidInput: If a file does not have the format, or no frame or arm is left.
        OSError: If a file cannot be read.
    """
    owner = "rgbench.read_capture"
    root = as_path(f"{owner}: `folder`", folder)
    late = check_number(f"{owner}: `delay`", delay, NON_NEGATIVE)
    if not root.is_dir():
        raise InvalidInput(f"{owner}: `folder` must be a folder, got {str(root)!r}")
    arms = {}
    for name, base in bases.items():
        place = float_array(f"{owner}: `bases[{name!r}]`", base)
        check_shape(f"{owner}: `bases[{name!r}]`", place.shape, [(3,)])
        file = root / _POSES.format(name)
        if file.is_file():
            times, positions = _read_poses(file)
            arms[name] = times, positions + place
    if not arms:
        raise InvalidInput(f"{owner}: {root} must have {_POSES.format('left')} or the like")
    begin = min(float(times[0]) for times, _ in arms.values())
    seen, clouds = _read_clouds(root, _read_transform(root / _TRANSFORM), begin)
    if not clouds:
        raise InvalidInput(
            f"{owner}: {root} must have segment_pcds/pointcloud_<time>_segmented.pcd with points, "
            f"at times from {begin:.3f} on"
        )
    return Capture(
        times=np.array(seen) + late,
        clouds=clouds,
        arms={name: (t - begin, positions) for name, (t, positions) in arms.items()},
    )


def nearest_vertices(positions: object, grippers: Mapping[str, object]) -> dict[str, int]:
    """The vertex that each gripper holds in the protocol "fixed point": its nearest vertex.

    Args:
        positions: Vertices of the garment at the grasp [m], shape [N, 3].
        grippers: Name of an arm -> position of its gripper [m], shape [3].

    Raises:
        InvalidInput: If a shape or value is not accepted.
    """
    owner = "rgbench.nearest_vertices"
    vertices = checked_points(f"{owner}: `positions`", positions)
    if not len(vertices):
        raise InvalidInput(f"{owner}: `positions` must have one or more vertices, got none")
    found = {}
    given: object = grippers
    if not isinstance(given, Mapping):
        raise TypeError(f"{owner}: `grippers` must be by name, got {type(given).__name__}")
    for name, gripper in grippers.items():
        place = float_array(f"{owner}: `grippers[{name!r}]`", gripper)
        check_shape(f"{owner}: `grippers[{name!r}]`", place.shape, [(3,)])
        check_finite(f"{owner}: `grippers[{name!r}]`", place)
        found[name] = int(np.linalg.norm(vertices - place, axis=1).argmin())
    return found


def chamfer(states: Sequence[State], clouds: Sequence[object], *, norm: int = 1) -> list[float]:
    """Mean distance [m] of the observed points of each frame to the nearest simulated vertex.

    The distance is one-sided, from real to simulated. The benchmark reports the distance by norm 1,
    the sum of the absolute differences of the coordinates. `dc.residuals.point_cloud` computes
    residuals for fits.

    Args:
        states: States without a batch axis, one for each cloud.
        clouds: Points of each frame [m], shape [n, 3], n >= 1.
        norm: 1 or 2.

    Raises:
        InvalidInput: If a shape or value is not accepted.
    """
    from scipy.spatial import cKDTree

    owner = "rgbench.chamfer"
    if norm not in (1, 2):
        raise InvalidInput(f"{owner}: `norm` must be 1 or 2, got {norm!r}")
    positions = positions_of(owner, states)
    check_count_of(owner, "clouds", clouds, len(states))
    found = []
    for k, cloud in enumerate(clouds):
        points = checked_points(f"{owner}: `clouds`[{k}]", cloud)
        if not len(points):
            raise InvalidInput(f"{owner}: `clouds`[{k}] must have one or more points, got none")
        tree: Any = cKDTree(numbers_of(positions[k]))
        found.append(float(np.mean(tree.query(points, p=norm)[0])))
    return found


def _read_poses(file: Path) -> tuple[FloatArray, FloatArray]:
    """Times [k] and positions [k, 3] of a gripper, in the axes of its arm."""
    text = read_regular_file(file, _LARGEST).decode("utf-8", errors="replace")
    rows = csv.DictReader(io.StringIO(text))
    missing = [name for name in _COLUMNS if name not in (rows.fieldnames or ())]
    if missing:
        raise InvalidInput(f"{file}: must have the column {missing[0]!r}, got {rows.fieldnames}")
    found: list[list[float]] = []
    for k, row in enumerate(rows):
        try:
            numbers = [float(row[name]) for name in _COLUMNS]
        except (TypeError, ValueError) as error:
            raise InvalidInput(f"{file}: the row [{k}] must have numbers: {error}") from error
        if not np.isfinite(numbers).all() or (found and numbers[0] <= found[-1][0]):
            raise InvalidInput(
                f"{file}: the row [{k}] must be finite, and later than the one before, got "
                f"{numbers}"
            )
        found.append(numbers)
    if not found:
        raise InvalidInput(f"{file}: must have one or more rows, got none")
    table = np.array(found)
    return table[:, 0], table[:, 1:]


def _read_transform(file: Path) -> FloatArray:
    """World from camera, 4 x 4: the inverse of the rotation and translation that the file has."""
    try:
        found = np.array(json.loads(read_regular_file(file, _LARGEST)), dtype=np.float64)
    except (ValueError, TypeError, RecursionError) as error:
        raise InvalidInput(f"{file}: must be a matrix of 4 x 4 numbers: {error}") from error
    rigid = found.shape == (4, 4) and bool(np.isfinite(found).all())
    if rigid:
        rotation = found[:3, :3]
        rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=_NEARLY) and np.allclose(
            found[3], [0, 0, 0, 1]
        )
        rigid = rigid and bool(np.linalg.det(rotation) > 0)
    if not rigid:
        raise InvalidInput(
            f"{file}: must be a 4 x 4 matrix of a rotation and a translation, got "
            f"{np.array2string(found, threshold=16)}"
        )
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = found[:3, :3].T, -found[:3, :3].T @ found[:3, 3]
    return inverse


def _read_clouds(
    root: Path, world_from_camera: FloatArray, begin: float
) -> tuple[list[float], list[FloatArray]]:
    """Times after the first row of the arms, and points in world axes, of frames with points."""
    named = [(_CLOUD.fullmatch(file.name), file) for file in (root / "segment_pcds").glob("*.pcd")]
    frames = sorted((float(match[1]) - begin, file) for match, file in named if match)
    times, clouds = [], []
    for time, file in frames:
        if time < 0:
            continue
        points = read_pcd(file, read_regular_file(file, _LARGEST))
        if len(points):
            times.append(time)
            clouds.append(points @ world_from_camera[:3, :3].T + world_from_camera[:3, 3])
    return times, clouds


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--delay", default=0.0, help="By how much the camera is late [s].")
def main(folder: Path, delay: float) -> None:
    """Read a capture and print its frames, with the positions of the grippers."""
    capture = read_capture(folder, delay=delay)
    for time, cloud in zip(capture.times, capture.clouds, strict=True):
        places = [f"{n} {np.round(p, 3).tolist()}" for n, p in capture.grippers(time).items()]
        print(f"{time:.3f} s: {len(cloud)} points, grippers {', '.join(places)}")


if __name__ == "__main__":
    main()
