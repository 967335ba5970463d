"""The core's step for trees of links, called without the torch around it."""

from __future__ import annotations

import numpy as np

import diffcloth_torch as dc
from diffcloth_torch import _core

IDENTITY = [0.0, 0, 0, 1, 0, 0, 0]


class CoreScene:
    """A cloth, pinned at its border, and trees; forward and backward of one step on plain arrays."""

    def __init__(self, cloth, bodies, trees, *, dt=0.01, friction=0.4, **options):
        placeholder = [dc.RigidBody(b.vertices, b.faces, motion="kinematic") for b in bodies]
        far = [
            dc.RigidBody(b.vertices, b.faces, motion="kinematic", pose=[100.0 * (k + 1), 0, 0, 1, 0, 0, 0], friction=friction)
            for k, b in enumerate(placeholder)
        ]
        self.simulator = dc.Simulator(dc.Scene([cloth], far), dt, **options)
        assembly = self.simulator._assembly
        self.core = _core.Simulator(
            vertices=assembly.vertices,
            rest_vertices=assembly.rest_vertices,
            faces=assembly.faces,
            cloth_vertex_start=assembly.cloth_vertex_start,
            cloth_face_start=assembly.cloth_face_start,
            bending_models=["patch"],
            pins=assembly.pins,
            soft_pins=assembly.soft_pins,
            body_vertices=assembly.body_vertices,
            body_faces=assembly.body_faces,
            body_vertex_start=assembly.body_vertex_start,
            body_face_start=assembly.body_face_start,
            self_contact=True,
            dt=dt,
            scheme="coupled",
            metric="mass",
            friction_iterations=2,
            tolerance=1e-10,
            max_iterations=500,
            **trees,
        )

    def inputs(self, **changes):
        inputs, _ = self.simulator._inputs(self.simulator.initial_state(), None, None)
        arrays = {k: np.ascontiguousarray(v.detach().numpy()) for k, v in inputs.items()}
        for name, value in changes.items():
            arrays[name] = np.ascontiguousarray(np.array(value, dtype=float))[None]
        return arrays

    def forward(self, arrays, tape=False):
        result = self.core.forward(arrays, tape, 1)
        assert result["status"][0] == 0, (result["message"], result["residual"])
        return result

    def gradients(self, arrays, cotangents):
        result = self.forward(arrays, tape=True)
        tape = {k: v for k, v in result.items() if k.startswith("tape_")}
        return self.core.backward(arrays, tape, cotangents, list(arrays), 1)
