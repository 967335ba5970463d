"""A scene in a page of the browser: nodes of a viser scene, which show one moment at a time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.viewers.layers import colors
from diffcloth_torch.viewers.look import FORCE_COLOR, GOAL_COLOR, Camera, Goal
from diffcloth_torch.viewers.motion import Motion
from diffcloth_torch.viewers.shown import Bounds, Shown

__all__ = ["Drawing"]

_ARROW_COLORS = {"forces": FORCE_COLOR, "gradient": "#3b4cc0"}
_LONGEST_ARROW = 0.2  # fraction of the scene's size, for the largest vector
_SHORTEST_ARROW = 0.01  # of the longest; shorter arrows are left out
_SHAFT = 0.0025  # fraction of the scene's size: radius of an arrow
_SPACING = 1.25  # from one environment to the next, in sizes of the scene along an axis
_SIDES = ("front", "back")
# To limit the size of files, positions are rounded to a power of two below this fraction of the
# scene's size, and normals to this many steps.
_RESOLUTION = 1e-5
_NORMAL_STEPS = 128


class Drawing:
    """The nodes of a viser scene that show the surfaces of a scene.

    Cloths of one color are meshes whose vertices move. Meshes of viser have no colors of vertices:
    cloths colored by numbers are binary glTF files, one for each moment, of which one is visible.
    """

    def __init__(
        self,
        api: Any,
        shown: Shown,
        motion: Motion,
        goals: Sequence[Goal],
        *,
        bounds: Bounds | None = None,
        first: int = 0,
        places: int | None = None,
    ) -> None:
        """Prepare the nodes; moving ones are added by the first `draw`.

        Args:
            api: The scene of a viser server.
            shown: The drawn surfaces of the scene.
            motion: Moments, which may grow in number.
            goals: Target shapes.
            bounds: Bounds of all drawn objects; None: the bounds of the motion.
            first: Place of the first environment, if several drawings share a page.
            places: Number of places of all drawings; None: the number of environments of the
                motion.
        """
        self._api, self._shown, self._motion, self._goals = api, shown, motion, goals
        self._first, self._places, self._given = first, places, bounds
        self._cloths: list[list[Any]] = []
        self._bodies: list[list[Any]] = []
        self._colored: dict[tuple[str, int], list[Any]] = {}
        self._tops: dict[str, float] = {}
        self._arrows: dict[tuple[int, str], Any] = {}
        self.bounds: Bounds = (np.zeros(3), np.ones(3))

    def aim(self, server: Any, camera: Camera) -> None:
        """Move the camera of the page to the position of the camera of pictures."""
        low, high = self.bounds
        wide = np.array([*(high - low)[:2] * _SPACING * (self._columns() - 1), 0.0])
        low, high = low - wide / 2, high + wide / 2
        radius = float(np.linalg.norm(high - low)) / 2
        position, target = camera.place((low + high) / 2, radius)
        view = server.initial_camera
        view.up, view.position, view.look_at = camera.up, tuple(position), tuple(target)
        view.fov = math.radians(camera.field_of_view)
        view.near, view.far = 1e-3 * radius, 1e3 * radius

    def restart(self, motion: Motion) -> None:
        """Draw another motion of the same scene from now on."""
        self._motion = motion
        self._forget_colored()

    def draw(self, k: int, layer: str, vectors: Sequence[str]) -> None:
        """Show moment k.

        Args:
            k: Index of the moment.
            layer: Coloring of the cloths, one of `LAYERS`.
            vectors: Arrows to show: "forces", "gradient" or both.
        """
        if not self._bodies:
            self._set_up()
        moment = self._motion[k]
        for e, (cloths, bodies) in enumerate(zip(self._cloths, self._bodies, strict=True)):
            for c, mesh in enumerate(cloths):
                first, end = self._shown.cloth_starts[c // 2], self._shown.cloth_starts[c // 2 + 1]
                mesh.visible = layer == "plain"
                if layer == "plain":
                    mesh.vertices = self._rounded(moment.positions[e, first:end])
            for body, frame in zip(bodies, moment.frames[e], strict=True):
                body.position = tuple(frame[:3, 3])
                body.wxyz = _quaternion(frame)
        self._show_colored(k, layer)
        self._show_arrows(k, vectors)

    def _set_up(self) -> None:
        first = self._motion[0]
        self.bounds = self._motion.bounds(self._goals) if self._given is None else self._given
        api = self._api
        api.set_up_direction("+z")
        for e in range(len(first.positions)):
            root = self.root(e)
            api.add_frame(root, show_axes=False, position=self._offset(e))
            self._cloths.append(self._add_cloths(root, first.positions[e]))
            self._bodies.append(self._add_bodies(root))
            for g, goal in enumerate(self._goals):
                self._add_goal(f"{root}/goal_{g}", goal)
        if self._first == 0:
            self._add_floor()

    def _add_cloths(self, root: str, positions: FloatArray) -> list[Any]:
        meshes = []
        for c, name in enumerate(self._shown.scene.cloth_names):
            paint = self._shown.paints[name]
            first, end = self._shown.cloth_starts[c], self._shown.cloth_starts[c + 1]
            for side, color in zip(_SIDES, (paint.color, paint.back_color), strict=True):
                mesh = self._api.add_mesh_simple(
                    f"{root}/{name}/{side}",
                    positions[first:end].astype(np.float32),
                    self._shown.cloth_faces[c].astype(np.uint32),
                    color=_rgb(color),
                    side=side,
                )
                meshes.append(mesh)
        return meshes

    def _add_bodies(self, root: str) -> list[Any]:
        return [
            self._api.add_mesh_simple(
                f"{root}/{rigid.name}",
                rigid.vertices.numpy().astype(np.float32),
                rigid.faces.numpy().astype(np.uint32),
                color=_rgb(self._shown.paints[rigid.owner].color),
                flat_shading=len(rigid.faces) <= 12,  # a box, not something round
                side="double",
            )
            for rigid in self._shown.shown_rigid
        ]

    def _add_goal(self, name: str, goal: Goal) -> None:
        self._api.add_mesh_simple(
            name,
            goal.vertices.astype(np.float32),
            goal.faces.astype(np.uint32),
            color=_rgb(GOAL_COLOR),
            opacity=0.3,
            side="double",
            cast_shadow=False,
        )

    def _add_floor(self) -> None:
        low, high = self.bounds
        size = self._size
        cell = 10.0 ** math.floor(math.log10(size))
        width = 2 * size * (1 + self._columns())
        center = (low + high) / 2
        self._api.add_grid(
            "/floor",
            width=width,
            height=width,
            cell_size=cell / 10,
            section_size=cell,
            plane="xy",
            position=(center[0], center[1], self._shown.ground(self.bounds)),
        )

    def prepare(self, layer: str) -> None:
        """Add the colored cloths of all moments, hidden.

        A page without a server restarts with the nodes as they were at first.
        """
        for k in range(len(self._motion) if layer != "plain" else 0):
            self._add_colored(k, layer, visible=False)

    def _show_colored(self, k: int, layer: str) -> None:
        if layer != "plain":
            top = self._motion.top(layer)
            if self._tops.setdefault(layer, top) != top:  # later moments have larger numbers
                self._forget_colored()
                self._tops[layer] = top
            if (layer, k) not in self._colored:
                self._add_colored(k, layer, visible=True)
        for key, handles in self._colored.items():
            for handle in handles:
                handle.visible = key == (layer, k)

    def _forget_colored(self) -> None:
        for handle in itertools.chain.from_iterable(self._colored.values()):
            handle.remove()
        self._colored.clear()
        self._tops.clear()

    def _add_colored(self, k: int, layer: str, *, visible: bool) -> None:
        painted = colors(self._motion.values(layer, k), self._motion.top(layer))
        handles = []
        for e, positions in enumerate(self._rounded(self._motion[k].positions)):
            for c, name in enumerate(self._shown.scene.cloth_names):
                rows = slice(self._shown.cloth_starts[c], self._shown.cloth_starts[c + 1])
                mesh = _colored_mesh(positions[rows], self._shown.cloth_faces[c], painted[e, rows])
                node = f"{self.root(e)}/{name}/{layer}_{k}"
                handles.append(self._api.add_glb(node, mesh, visible=visible))
        self._colored[layer, k] = handles

    def _show_arrows(self, k: int, vectors: Sequence[str]) -> None:
        moment = self._motion[k]
        for e in range(len(moment.positions)):
            ends = np.concatenate([moment.positions[e], *self._shown.placed(moment.frames[e])])
            for what in _ARROW_COLORS:
                found = moment.vectors(what) if what in vectors else None
                none = np.zeros((0, 2, 3))
                points = none if found is None else self._arrow_points(what, ends, found[e])
                if len(points) or (e, what) in self._arrows:
                    self._set_arrows(e, what, points)

    def _arrow_points(self, what: str, ends: FloatArray, vectors: FloatArray) -> FloatArray:
        """Start and end of the arrows that are long enough to be visible, [n, 2, 3]."""
        longest = self._motion.longest(what)
        seen = np.linalg.norm(vectors, axis=1) > _SHORTEST_ARROW * longest
        if not seen.any():
            return np.zeros((0, 2, 3))
        scaled = vectors[seen] * (_LONGEST_ARROW * self._size / longest)
        points = ends[: len(seen)][seen]
        # A force ends at its point of action; a gradient begins at its vertex.
        start = points - scaled if what == "forces" else points
        return np.stack([start, start + scaled], axis=1)

    def _set_arrows(self, e: int, what: str, points: FloatArray) -> None:
        known = self._arrows.get((e, what))
        if known is not None:
            if len(points):
                known.points = points.astype(np.float32)
            known.visible = bool(len(points))
            return
        self._arrows[e, what] = self._api.add_arrows(
            f"{self.root(e)}/{what}",
            points,
            _rgb(_ARROW_COLORS[what]),
            shaft_radius=_SHAFT * self._size,
            head_radius=2.5 * _SHAFT * self._size,
            head_length=5 * _SHAFT * self._size,
        )

    @property
    def _size(self) -> float:
        low, high = self.bounds
        return float(np.linalg.norm(high - low))

    def _rounded(self, positions: FloatArray) -> NDArray[np.float32]:
        step = 2.0 ** math.floor(math.log2(_RESOLUTION * self._size))
        return (np.round(positions / step) * step).astype(np.float32)

    def root(self, e: int) -> str:
        """Name of the node of an environment, which holds all of its drawn objects."""
        return f"/environment_{self._first + e}"

    @property
    def _count(self) -> int:
        return len(self._motion[0].positions) if self._places is None else self._places

    def _columns(self) -> int:
        return math.ceil(math.sqrt(self._count))

    def _offset(self, e: int) -> tuple[float, float, float]:
        """Position of an environment: in rows, around the middle."""
        low, high = self.bounds
        columns = self._columns()
        row, column = divmod(self._first + e, columns)
        middle = (columns - 1) / 2
        x, y = _SPACING * (high - low)[:2] * (column - middle, row - middle)
        return float(x), float(y), 0.0


def _rgb(color: str | None) -> tuple[int, int, int]:
    assert color is not None, "paints are complete"
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def _quaternion(frame: FloatArray) -> tuple[float, ...]:
    from trimesh.transformations import quaternion_from_matrix

    return tuple(quaternion_from_matrix(frame))  # type: ignore[no-untyped-call]


def _colored_mesh(positions: FloatArray, faces: NDArray[Any], painted: NDArray[np.uint8]) -> bytes:
    """A binary glTF file of a mesh with colors of its vertices, visible from both sides."""
    from trimesh import Scene, Trimesh
    from trimesh.exchange.gltf import export_glb

    normals = Trimesh(positions, faces, process=False).vertex_normals
    mesh = Trimesh(
        positions,
        faces,
        vertex_colors=painted,
        vertex_normals=np.round(normals * _NORMAL_STEPS) / _NORMAL_STEPS,
        process=False,
    )

    def both_sides(tree: dict[str, Any]) -> None:
        tree["materials"] = [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0}}]
        for primitive in tree["meshes"][0]["primitives"]:
            primitive["material"] = 0

    file: bytes = export_glb(  # type: ignore[no-untyped-call]
        Scene(mesh), include_normals=True, unitize_normals=False, tree_postprocessor=both_sides
    )
    return file
