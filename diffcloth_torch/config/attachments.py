"""Attachments of a configuration, and the motion of their targets and weights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.config.keyframes import moved, select_vertices, values_at
from diffcloth_torch.config.scene_schema import AttachmentSection, EndSection
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.geometry.poses import transform
from diffcloth_torch.model.attachment import Attachment
from diffcloth_torch.model.cloth import Cloth
from diffcloth_torch.model.scene import Scene

__all__ = ["attachment", "attachment_motions"]


def attachment(section: AttachmentSection, cloths: Sequence[Cloth]) -> Attachment:
    """Make an attachment of a section."""
    by_name = {cloth.name or "": cloth for cloth in cloths}
    label = f"attachments.{section.name}"
    return Attachment(
        _end(f"{label}.a", section.a, by_name),
        None if section.b is None else _end(f"{label}.b", section.b, by_name),
        stiffness=section.stiffness,
        rest_length=section.rest_length,
        name=section.name,
    )


def _end(label: str, section: EndSection, cloths: dict[str, Cloth]) -> tuple[Any, ...]:
    if section.points is not None:
        return section.surface, np.array(section.points)
    if section.surface not in cloths:
        raise InvalidInput(
            f"`scene`: {label} must give `points` of {section.surface!r}, which is no cloth"
        )
    selection = section.selection()
    vertices = select_vertices(label, selection, cloths[section.surface].vertices)
    return (section.surface, vertices)


def attachment_motions(
    sections: Sequence[AttachmentSection], scene: Scene, times: Tensor
) -> dict[str, dict[str, Tensor]]:
    """Targets [steps, n, 3] and weights [steps, n] of attachments by name, after each step.

    Targets start at the points of the first end; without keyframes they stay there.
    """
    targets: dict[str, Tensor] = {}
    weights: dict[str, Tensor] = {}
    for section, name in zip(sections, scene.attachment_names, strict=True):
        rows = scene.springs.groups[name]
        if name in scene.springs.target_groups:
            start = _starts(scene, rows)
            keyframes = section.target_trajectory
            still = start.expand(len(times), *start.shape)
            targets[name] = moved(start, keyframes, times) if keyframes else still
        if section.weight_trajectory:
            values = values_at(section.weight_trajectory, 1.0, times)
            weights[name] = values[:, None].expand(-1, rows.stop - rows.start)
    return {"attachments": targets, "attachment_weights": weights}


def _starts(scene: Scene, rows: slice) -> Tensor:
    """Initial positions of the first ends of springs to targets, [n, 3]."""
    placed = [cloth.vertices for cloth in scene.cloths]
    placed += [transform(body.vertices, body.pose) for body in scene.bodies]
    vertices = np.concatenate(placed)
    springs = scene.springs
    points = []
    for k in range(rows.start, rows.stop):
        entries = slice(springs.start[k], springs.start[k + 1])
        points.append(springs.coefficients[entries] @ vertices[springs.points[entries]])
    return torch.from_numpy(np.array(points))
