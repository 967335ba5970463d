"""USD, by the package usd-core: meshes with points over time, rigid ones with transforms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from diffcloth_torch.animation.surfaces import Animation, MovingSurface
from diffcloth_torch.extras import from_extra
from diffcloth_torch.files import replace_file

__all__ = ["write_usd"]

_RATE = 24.0  # time codes per second of a single state
_DIGITS = 6  # of a time code: uniform times become integers


def write_usd(path: Path, animation: Animation) -> None:
    """Write meters and seconds, z up. States at uniform times are at integer time codes.

    Args:
        path: The file; .usda is text, .usd and .usdc are binary.
        animation: The surfaces.

    Raises:
        InvalidInput: If usd-core is not installed.
    """
    usd = from_extra("pxr.Usd", "usd", "USD files need usd-core")
    geometry = from_extra("pxr.UsdGeom", "usd", "USD files need usd-core")
    stage = usd.Stage.CreateInMemory()
    geometry.SetStageUpAxis(stage, geometry.Tokens.z)
    geometry.SetStageMetersPerUnit(stage, 1.0)
    times = animation.times
    rate = _RATE if len(times) < 2 else (len(times) - 1) / float(times[-1] - times[0])
    rate = round(rate, _DIGITS)
    codes = np.round(times * rate, _DIGITS).tolist()
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])
    root = geometry.Xform.Define(stage, "/scene")
    stage.SetDefaultPrim(root.GetPrim())
    for surface in animation.surfaces:
        _add(stage, geometry, surface, codes)
    with replace_file(path, keeps_ending=True) as part:
        if not stage.GetRootLayer().Export(str(part)):
            raise OSError(f"{path}: usd-core could not write the file")


def _add(stage: Any, geometry: Any, surface: MovingSurface, codes: list[float]) -> None:
    values = from_extra("pxr.Vt", "usd", "USD files need usd-core")
    mesh = geometry.Mesh.Define(stage, _free_path(stage, surface.name))
    mesh.CreateSubdivisionSchemeAttr(geometry.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateFaceVertexCountsAttr(values.IntArray([3] * len(surface.faces)))
    indices = surface.faces.reshape(-1).astype(np.int32)
    mesh.CreateFaceVertexIndicesAttr(values.IntArray.FromNumpy(indices))

    def vectors(rows: Any) -> Any:
        return values.Vec3fArray.FromNumpy(np.ascontiguousarray(rows, dtype=np.float32))

    points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
    if surface.frames is not None:
        matrices = from_extra("pxr.Gf", "usd", "USD files need usd-core")
        points.Set(vectors(surface.vertices))
        extent.Set(vectors(_bounds(surface.vertices)))
        placement = mesh.AddTransformOp()
        frames = surface.frames[:1] if surface.is_still else surface.frames
        for code, frame in zip(codes, frames, strict=False):
            matrix = matrices.Matrix4d(*frame.T.reshape(-1).tolist())  # Matrix4d multiplies rows
            placement.Set(matrix) if surface.is_still else placement.Set(matrix, code)
        return
    speeds = mesh.CreateVelocitiesAttr() if "velocity" in surface.vectors else None
    for k, code in enumerate(codes):
        points.Set(vectors(surface.vertices[k]), code)
        extent.Set(vectors(_bounds(surface.vertices[k])), code)
        if speeds is not None:
            speeds.Set(vectors(surface.vectors["velocity"][k]), code)


def _bounds(vertices: Any) -> Any:
    return np.stack([vertices.min(axis=0), vertices.max(axis=0)])


def _free_path(stage: Any, name: str) -> str:
    """Path of a new prim: names become identifiers, and a number distinguishes equal ones."""
    tools = from_extra("pxr.Tf", "usd", "USD files need usd-core")
    path = "/scene/" + "/".join(tools.MakeValidIdentifier(part) for part in name.split("/"))
    free, number = path, 1
    while stage.GetPrimAtPath(free):
        free, number = f"{path}_{number}", number + 1
    return free
