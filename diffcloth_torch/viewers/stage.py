"""The stage for pictures: lights, floor, cloths of two colors, bodies and targets.

All objects are drawn off screen. On a machine without a display VTK draws through EGL.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.extras import from_extra
from diffcloth_torch.viewers.floor import BACKGROUND, Floor, Shadow
from diffcloth_torch.viewers.look import FORCE_COLOR, GOAL_COLOR, Camera, Goal, Paint
from diffcloth_torch.viewers.shown import Bounds

__all__ = ["Skin", "Stage", "require_pyvista"]

Points = NDArray[np.float64]
Triangles = NDArray[np.integer[Any]]
Image = NDArray[np.uint8]

# Directions to the lights, for a camera that looks along +y. The lights turn with the camera, so
# that visible sides are lit. The key light also casts the shadow.
_SUN = np.array([-0.45, -0.55, 1.0])
# Direction, intensity and color of the other lights: cool ones across and from behind.
_FILL = (np.array([1.0, -0.7, 0.3]), 0.45, "#e4eeff")
_RIM = (np.array([-0.4, 1.0, 0.5]), 0.4, "#fff8f0")

_CLOTH_SHINE = {"ambient": 0.36, "diffuse": 0.78, "specular": 0.1, "specular_power": 10}
_BODY_SHINE = {"ambient": 0.4, "diffuse": 0.7, "specular": 0.25, "specular_power": 25}

_SHORTEST_ARROW = 0.002  # fraction of the scene's size; shorter arrows are left out
_CREASE_ANGLE = 35.0  # angle [degrees] between faces of a body above which an edge is drawn sharp


@dataclass(frozen=True, eq=False)
class Skin:
    """A surface and its colors.

    Attributes:
        faces: Vertex indices, shape [f, 3].
        paint: Colors, none of them None.
    """

    faces: Triangles
    paint: Paint


def require_pyvista() -> Any:
    """Import pyvista for drawing off screen.

    Raises:
        InvalidInput: If it is not installed; the message contains the command that installs it.
    """
    if not os.environ.get("DISPLAY"):
        # Otherwise VTK tries an X server first, and prints a warning about it.
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    return from_extra(
        "pyvista",
        "viewer",
        "pictures need pyvista",
        "  or leave them out with  --set 'output.viewers=[meshes]'",
    )


class _Surface:
    """A mesh with moving vertices on the stage."""

    def __init__(self, polydata: Any, crease: float | None) -> None:
        self.polydata = polydata
        self._crease = crease
        self.shown = self._with_normals()

    def move(self, vertices: Points) -> None:
        self.polydata.points = vertices
        self.shown.copy_from(self._with_normals())

    def _with_normals(self) -> Any:
        return self.polydata.compute_normals(
            cell_normals=False,
            consistent_normals=False,
            auto_orient_normals=False,
            split_vertices=self._crease is not None,
            feature_angle=self._crease or 180.0,
        )


class Stage:
    """Draws a scene with moving surfaces. A context manager: the window is freed at the end."""

    def __init__(
        self,
        cloths: Sequence[Skin],
        bodies: Sequence[Skin],
        *,
        size: Sequence[int],
        bounds: Bounds,
        ground: float | None,
        camera: Camera,
    ) -> None:
        """Set the stage.

        Args:
            cloths: Cloths, whose faces are indices into the positions for `draw`.
            bodies: Bodies and links, whose faces are indices into their own vertices.
            size: Width and height [pixels].
            bounds: Bounds of all drawn objects.
            ground: Height of the floor [m]; None: no floor.
            camera: View of the pictures.
        """
        self._pv = require_pyvista()
        self._bounds = bounds
        self._plotter = self._pv.Plotter(off_screen=True, window_size=list(size), lighting="none")
        self._plotter.set_background(BACKGROUND)
        self._plotter.enable_anti_aliasing("msaa", multi_samples=8)
        low, high = bounds
        radius = float(np.linalg.norm(high - low)) / 2
        position, target = camera.place((low + high) / 2, radius)
        sun = self._light(target - position)
        self._cloths = [(skin.faces, self._add_cloth(skin)) for skin in cloths]
        self._bodies = [(skin.faces, self._add_body(skin)) for skin in bodies]
        self._placed: Sequence[Points] = []
        self._floor = None
        if ground is not None:
            self._floor = Floor(self._pv, self._plotter, bounds, ground)
            self._shadow = Shadow(self._floor, sun)
        self._aim(camera, position, target)

    def __enter__(self) -> Stage:
        """Return the stage, which is already open."""
        return self

    def __exit__(self, *_: object) -> None:
        """Free the window."""
        self._plotter.close()

    def add_goal(self, goal: Goal) -> None:
        """Show a translucent target shape with its border."""
        shape = self._pv.PolyData.from_regular_faces(goal.vertices, goal.faces)
        self._plotter.add_mesh(shape, color=GOAL_COLOR, opacity=0.25, lighting=False)
        border = shape.extract_feature_edges(
            boundary_edges=True, feature_edges=False, manifold_edges=False, non_manifold_edges=False
        )
        if border.n_cells:
            width = 0.0012 * float(np.linalg.norm(self._bounds[1] - self._bounds[0]))
            tube = border.strip(join=True).tube(radius=width)
            self._plotter.add_mesh(tube, color=GOAL_COLOR, ambient=0.5)

    def draw(
        self, positions: Points, bodies: Sequence[Points], arrows: Points | None = None
    ) -> Image:
        """Draw one picture.

        Args:
            positions: Cloth vertices [m], shape [N, 3].
            bodies: Vertices of each body or link [m], shape [v, 3].
            arrows: Arrows that end at the vertices of the bodies and links [m], body by body, shape
                [V, 3].

        Returns:
            Colors of the pixels, shape [height, width, 3].
        """
        casters = []
        for faces, surface in self._cloths:
            surface.move(positions)
            casters.append((positions, faces))
        for k, (faces, surface) in enumerate(self._bodies):
            if not self._placed or (bodies[k] != self._placed[k]).any():
                surface.move(bodies[k])
            casters.append((bodies[k], faces))
        self._placed = bodies
        if arrows is not None:
            self._show_arrows(bodies, arrows)
        if self._floor is not None:
            self._shadow.cast(casters)
        self._plotter.reset_camera_clipping_range()
        self._plotter.render()  # otherwise a screenshot would show the previous picture
        image = self._plotter.screenshot(return_img=True)
        return np.ascontiguousarray(image[..., :3])

    def _show_arrows(self, ends: Sequence[Points], arrows: Points) -> None:
        lengths = np.linalg.norm(arrows, axis=1)
        seen = lengths > _SHORTEST_ARROW * np.linalg.norm(self._bounds[1] - self._bounds[0])
        if not seen.any():
            self._plotter.remove_actor("arrows")
            return
        cloud = self._pv.PolyData(np.concatenate(ends)[seen] - arrows[seen])
        cloud["arrows"] = arrows[seen]
        shapes = cloud.glyph(orient="arrows", scale="arrows", geom=self._pv.Arrow())
        self._plotter.add_mesh(shapes, name="arrows", color=FORCE_COLOR, ambient=0.5)

    def _light(self, view: Points) -> Points:
        """Add the lights for a direction of view; return the direction to the shadow light."""
        low, high = self._bounds
        center, size = (low + high) / 2, float(np.linalg.norm(high - low))
        azimuth = np.arctan2(-view[0], view[1])
        cosine, sine = np.cos(azimuth), np.sin(azimuth)
        turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        for direction, intensity, color in ((_SUN, 0.8, "#fff4e6"), _FILL, _RIM):
            light = self._pv.Light(
                position=tuple(center + 3 * size * (turn @ direction)),
                focal_point=tuple(center),
                intensity=intensity,
                color=color,
                light_type="scene light",
            )
            self._plotter.add_light(light)
        sun: Points = turn @ _SUN
        return sun

    def _add_cloth(self, skin: Skin) -> _Surface:
        vertices = np.zeros((int(skin.faces.max()) + 1, 3))
        surface = _Surface(self._pv.PolyData.from_regular_faces(vertices, skin.faces), None)
        self._plotter.add_mesh(
            surface.shown,
            color=skin.paint.color,
            smooth_shading=True,
            backface_params={"color": skin.paint.back_color, **_CLOTH_SHINE},
            **_CLOTH_SHINE,
        )
        return surface

    def _add_body(self, skin: Skin) -> _Surface:
        vertices = np.zeros((int(skin.faces.max()) + 1, 3))
        polydata = self._pv.PolyData.from_regular_faces(vertices, skin.faces)
        surface = _Surface(polydata, _CREASE_ANGLE)
        self._plotter.add_mesh(
            surface.shown, color=skin.paint.color, smooth_shading=True, **_BODY_SHINE
        )
        return surface

    def _aim(self, camera: Camera, position: Points, target: Points) -> None:
        view = self._plotter.camera
        view.position = tuple(position)
        view.focal_point = tuple(target)
        view.up = tuple(camera.up)
        view.view_angle = camera.field_of_view
