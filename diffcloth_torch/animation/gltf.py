"""glTF 2.0: cloths as morph targets, one for each state; bodies and links as moving nodes.

A morph target holds the displacements from the first state. At the time of state k its weight is
one and all others are zero; players interpolate linearly between two times. glTF is y up: a root
node turns the scene, and all nodes below it have our axes. Numbers are float32.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.animation.surfaces import Animation, MovingSurface
from diffcloth_torch.checks import FloatArray
from diffcloth_torch.files import replace_file
from diffcloth_torch.geometry.poses import poses_of_frames

__all__ = ["write_gltf"]

_FLOAT, _UNSIGNED = 5126, 5125
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views
_HALF = 0.5**0.5
_TO_Y_UP = [-_HALF, 0.0, 0.0, _HALF]  # quaternion (x, y, z, w): -90 degrees about x

Json = dict[str, Any]


def write_gltf(path: Path, animation: Animation) -> None:
    """Write meters and seconds, y up; times begin at zero.

    Args:
        path: The file; .glb is binary, .gltf is JSON that holds its buffer.
        animation: The surfaces.
    """
    document, data = _document(animation)
    if path.suffix.lower() == ".gltf":
        uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode("ascii")
        document["buffers"] = [{"uri": uri, "byteLength": len(data)}]
        content = json.dumps(document).encode("utf-8")
    else:
        document["buffers"] = [{"byteLength": len(data)}]
        text = json.dumps(document).encode("utf-8")
        chunks = _chunk(b"JSON", text + b" " * (-len(text) % 4)) + _chunk(b"BIN\0", data)
        content = b"glTF" + np.array([2, 12 + len(chunks)], dtype="<u4").tobytes() + chunks
    with replace_file(path, keeps_ending=True) as part:
        part.write_bytes(content)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return len(data).to_bytes(4, "little") + kind + data


class _Buffer:
    """The binary buffer of a file, with its views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[Json] = []
        self.accessors: list[Json] = []

    def add(self, values: NDArray[Any], kind: str, target: int | None = None) -> int:
        """Append values as an accessor of a kind such as "VEC3"; returns its index."""
        component = _UNSIGNED if values.dtype.kind in "iu" else _FLOAT
        stored = values.astype("<u4" if component == _UNSIGNED else "<f4")
        view: Json = {
            "buffer": 0,
            "byteOffset": len(self.data),
            "byteLength": stored.nbytes,
        }
        if target is not None:
            view["target"] = target
        rows = stored.reshape(len(stored), -1)
        self.accessors.append(
            {
                "bufferView": len(self.views),
                "componentType": component,
                "count": len(stored),
                "type": kind,
                "min": rows.min(axis=0).tolist(),
                "max": rows.max(axis=0).tolist(),
            }
        )
        self.views.append(view)
        self.data += stored.tobytes()
        return len(self.accessors) - 1


def _document(animation: Animation) -> tuple[Json, bytes]:
    buffer = _Buffer()
    times = buffer.add(animation.times - animation.times[0], "SCALAR")
    meshes: list[Json] = []
    nodes: list[Json] = [{"name": "z_up", "rotation": _TO_Y_UP, "children": []}]
    samplers: list[Json] = []
    channels: list[Json] = []

    def animate(path: str, values: FloatArray, kind: str) -> None:
        output = buffer.add(values, kind)
        channels.append({"sampler": len(samplers), "target": {"node": len(nodes), "path": path}})
        samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})

    several = len(animation.times) > 1
    for surface in animation.surfaces:
        node: Json = {"name": surface.name, "mesh": len(meshes)}
        mesh, count = _mesh(buffer, surface)
        meshes.append(mesh)
        if count:
            weights = np.concatenate([np.zeros((1, count)), np.eye(count)])
            animate("weights", weights.reshape(-1), "SCALAR")
        if surface.frames is not None:
            poses = poses_of_frames(surface.frames)
            translation, rotation = poses[:, :3], _quaternions(poses)
            node |= {"translation": translation[0].tolist(), "rotation": rotation[0].tolist()}
            if several and not surface.is_still:
                animate("translation", translation, "VEC3")
                animate("rotation", rotation, "VEC4")
        nodes[0]["children"].append(len(nodes))
        nodes.append(node)
    document: Json = {
        "asset": {"version": "2.0", "generator": "diffcloth_torch"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": [{"doubleSided": True}],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
    }
    if channels:
        motion = {"name": "motion", "samplers": samplers, "channels": channels}
        document["animations"] = [motion]
    return document, bytes(buffer.data)


def _mesh(buffer: _Buffer, surface: MovingSurface) -> tuple[Json, int]:
    """The mesh, and its number of morph targets."""
    states = surface.vertices[None] if surface.frames is not None else surface.vertices
    primitive: Json = {
        "attributes": {"POSITION": buffer.add(states[0], "VEC3", _VERTICES)},
        "indices": buffer.add(surface.faces.reshape(-1), "SCALAR", _INDICES),
        "material": 0,
    }
    if surface.frames is not None or surface.is_still:
        return {"name": surface.name, "primitives": [primitive]}, 0
    first = states[0].astype(np.float32).astype(np.float64)
    primitive["targets"] = [
        {"POSITION": buffer.add(state - first, "VEC3", _VERTICES)} for state in states[1:]
    ]
    count = len(states) - 1
    return {"name": surface.name, "primitives": [primitive], "weights": [0.0] * count}, count


def _quaternions(poses: FloatArray) -> FloatArray:
    """Quaternions (x, y, z, w) of poses [T, 7]; successive ones never have opposite signs."""
    turns = np.roll(poses[:, 3:], -1, axis=1)
    opposite = (turns[1:] * turns[:-1]).sum(axis=1) < 0.0
    turns[1:] *= np.where(np.cumsum(opposite) % 2, -1.0, 1.0)[:, None]
    return turns
