"""Random attachments: seams, grasps and pickers, with targets that move and weights that fall."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from random_draws import log_uniform, maybe

import diffcloth_torch as dc

SHARE = 0.4  # of the scenes with cloths


@dataclass(frozen=True)
class Pull:
    """Controls of an attachment.

    Attributes:
        name: Name of the attachment.
        weight: Weight before the release, in 0 .. 1.
        release: Step from which the weight is zero.
        target: Target at the start [m], shape [3]; None if both ends are points.
        velocity: Velocity of the target [m/s], shape [3].
        rows: Vertices of all cloths whose weighted sum is the first end.
        shares: Weight of each of these vertices.
        stiffness: Stiffness [N/m].
        rest_length: Rest length [m].
    """

    name: str
    weight: float
    release: int
    target: np.ndarray | None
    velocity: np.ndarray
    rows: list[int]
    shares: np.ndarray
    stiffness: float
    rest_length: float

    def weight_at(self, k: int) -> float:
        """In step k."""
        return self.weight if k < self.release else 0.0

    def target_at(self, k: int, dt: float) -> np.ndarray:
        """Target at the end of step k, [3]."""
        return self.target + (k + 1) * dt * self.velocity

    def force(self, positions: np.ndarray, k: int, dt: float) -> np.ndarray:
        """Force of the target on the cloth in step k, computed independently [N]."""
        if self.target is None:
            return np.zeros(3)
        way = self.target_at(k, dt) - self.shares @ positions[self.rows]
        length = np.linalg.norm(way)
        if length == 0.0:
            return np.zeros(3)
        return self.weight_at(k) * self.stiffness * (1 - self.rest_length / length) * way


def controlled(control: dc.Control, pulls: tuple[Pull, ...], k: int, dt: float) -> dc.Control:
    """A control that also has the targets and weights of step k."""
    if not pulls:
        return control
    weights = {p.name: torch.tensor([p.weight_at(k)], dtype=torch.float64) for p in pulls}
    targets = {
        p.name: torch.from_numpy(p.target_at(k, dt)[None]) for p in pulls if p.target is not None
    }
    return control.replace(attachments=targets or None, attachment_weights=weights)


def draw_attachments(
    seed: int, index: int, d: dict[str, Any], scene: dc.Scene
) -> tuple[dc.Scene, tuple[Pull, ...]]:
    """The scene with up to three attachments of its cloths, and their controls.

    The first end is a vertex of a cloth or a point on one of its faces. The second end is a target,
    another vertex or, if one solve moves cloths and bodies, a point of a body.
    """
    # A separate random stream keeps all other draws of a scene unchanged.
    rng = np.random.default_rng([seed, index, 2])
    if not scene.cloths or rng.random() >= SHARE:
        return scene, ()
    attachments, pulls = [], []
    first = np.cumsum([0, *(len(cloth.vertices) for cloth in scene.cloths)])
    kinds = ["target", "cloth"]
    if d["scheme"] == "coupled" and d.get("coupling", "monolithic") == "monolithic":
        kinds += ["body"] * bool(scene.bodies)
    for i in range(int(rng.integers(1, 4))):
        c = int(rng.integers(len(scene.cloths)))
        cloth = scene.cloths[c]
        corners = cloth.faces[rng.integers(len(cloth.faces))]
        shares = rng.dirichlet(np.ones(3)) if rng.random() < 0.5 else np.array([1.0, 0.0, 0.0])
        point = shares @ cloth.vertices[corners]
        kind = str(rng.choice(kinds))
        target = None
        if kind == "target":
            target, end = point + 0.1 * d["size"] * rng.normal(size=3), None
        elif kind == "cloth":
            other = int(rng.integers(len(scene.cloths)))
            vertices = np.arange(len(scene.cloths[other].vertices))
            if other == c:
                vertices = np.setdiff1d(vertices, corners)
            end = (scene.cloth_names[other], int(rng.choice(vertices)))
        else:
            b = int(rng.integers(len(scene.bodies)))
            end = (scene.body_names[b], scene.bodies[b].vertices[0])
        stretch = float(np.mean(cloth.material.stretch))
        pull = Pull(
            name=f"a{i}",
            weight=float(rng.uniform(0.2, 1.0)),
            release=int(rng.integers(1, d["steps"] + 2)),
            target=target,
            velocity=np.sqrt(9.81 * d["size"]) * 0.3 * rng.normal(size=3),
            rows=(first[c] + corners).tolist(),
            shares=shares,
            stiffness=stretch * log_uniform(rng, 1e-3, 1.0),
            rest_length=maybe(rng, 0.5, d["size"] * rng.uniform(0.0, 0.3)),
        )
        attachments.append(
            dc.Attachment(
                (scene.cloth_names[c], corners.tolist(), shares.tolist()),
                end,
                stiffness=pull.stiffness,
                rest_length=pull.rest_length,
                name=pull.name,
            )
        )
        pulls.append(pull)
        d.setdefault("attachments", []).append(kind)
    with_attachments = dc.Scene(
        scene.cloths,
        scene.bodies,
        scene.robots,
        gravity=scene.gravity,
        air_density=scene.air_density,
        attachments=attachments,
    )
    return with_attachments, tuple(pulls)
