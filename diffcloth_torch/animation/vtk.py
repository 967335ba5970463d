"""VTK: a .pvd file for ParaView, and a folder of .vtp files beside it.

The formats are XML; arrays are little-endian bytes in base64, preceded by their length. A surface
that does not move has one .vtp file for all times.
"""

from __future__ import annotations

import base64
import re
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from diffcloth_torch.animation.surfaces import Animation, MovingSurface
from diffcloth_torch.files import replace_file

__all__ = ["write_pvd"]

_HEADER = '<?xml version="1.0"?>\n<VTKFile type="{}" version="1.0" byte_order="LittleEndian" '
_TYPES = {"f": ("Float64", "<f8"), "i": ("Int64", "<i8")}


def write_pvd(path: Path, animation: Animation) -> None:
    """Write meters and seconds, z up; velocities and forces are vectors at the vertices.

    Args:
        path: The .pvd file. Its folder has the name of the file without the ending.
        animation: The surfaces.
    """
    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    lines = [_HEADER.format("Collection") + 'header_type="UInt64">', "<Collection>"]
    for part, surface in enumerate(animation.surfaces):
        stem = f"{part}_{re.sub(r'[^A-Za-z0-9.-]', '_', surface.name)}"
        still = surface.is_still and not surface.vectors
        for k, time in enumerate(animation.times.tolist()):
            file = folder / f"{stem}_{0 if still else k:04d}.vtp"
            if k == 0 or not still:
                file.write_text(_polydata(surface, k), encoding="ascii")
            entry = {
                "timestep": repr(time),
                "part": str(part),
                "name": surface.name,
                "file": f"{folder.name}/{file.name}",
            }
            attributes = " ".join(f"{key}={quoteattr(value)}" for key, value in entry.items())
            lines.append(f"<DataSet {attributes}/>")
    lines += ["</Collection>", "</VTKFile>", ""]
    with replace_file(path, keeps_ending=True) as part_file:
        part_file.write_text("\n".join(lines), encoding="utf-8")


def _polydata(surface: MovingSurface, frame: int) -> str:
    points = surface.placed(frame)
    count = len(surface.faces)
    vectors = [_array(values[frame], name) for name, values in surface.vectors.items()]
    lines = [
        _HEADER.format("PolyData") + 'header_type="UInt64">',
        f'<PolyData><Piece NumberOfPoints="{len(points)}" NumberOfPolys="{count}">',
        "<PointData>",
        *vectors,
        "</PointData>",
        f"<Points>{_array(points, 'Points')}</Points>",
        "<Polys>",
        _array(surface.faces.reshape(-1).astype(np.int64), "connectivity"),
        _array(3 * np.arange(1, count + 1), "offsets"),
        "</Polys></Piece></PolyData></VTKFile>",
        "",
    ]
    return "\n".join(lines)


def _array(values: NDArray[np.generic], name: str) -> str:
    kind, stored = _TYPES[values.dtype.kind]
    data = values.astype(stored).tobytes()
    text = base64.b64encode(len(data).to_bytes(8, "little") + data).decode("ascii")
    size = f' NumberOfComponents="{values.shape[1]}"' if values.ndim > 1 else ""
    return f'<DataArray type="{kind}" Name="{name}"{size} format="binary">{text}</DataArray>'
