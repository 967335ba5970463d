"""Steps of trees of links in the core, called without torch."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

import diffcloth_torch as dc
from diffcloth_torch import _core
from diffcloth_torch.sim.solve.step import diagnostics_of

DT = 0.01
FIXED, REVOLUTE, PRISMATIC = 0, 1, 2


def transform(position, angles=(0, 0, 0)):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    matrix[:3, 3] = position
    return matrix


def one_body(*, free=True):
    """One link with a free or a prescribed root."""
    return trees(free, [FIXED], [np.eye(4)], [[0, 0, 0]], [-1], [1], [0], prescribed=[])


def chain(*, free):
    """Four links: a hinge with limits, a prescribed slide, a hinge that mimics the first."""
    n = 6 if free else 0
    return trees(
        free,
        [FIXED, REVOLUTE, PRISMATIC, REVOLUTE],
        [
            np.eye(4),
            transform([0.05, 0, -0.08], (0.1, 0.2, 0.3)),
            transform([0.06, 0.02, -0.09], (-0.2, 0.1, 0)),
            transform([0.05, 0.05, 0], (0, 0.3, 0.1)),
        ],
        [[0, 0, 0], [0, 1, 0], [0, 0.6, 0.8], [1, 0, 0]],
        [-1, n, n + 1, n],
        [0, 1, 1, -0.5],
        [0, 0, 0, 0.1],
        prescribed=[0, 1],
        lower=[-0.5, -np.inf],
        upper=[0.2, np.inf],
        limit_stiffness=[50.0, 0.0],
    )


def trees(
    free,
    kind,
    offset,
    axis,
    coordinate,
    multiplier,
    constant,
    *,
    prescribed,
    lower=(),
    upper=(),
    limit_stiffness=(),
):
    root = 6 if free else 0
    links = len(kind)
    return {
        "tree_free": np.array([int(free)], np.int32),
        "link_tree": np.zeros(links, np.int32),
        "link_parent": np.arange(-1, links - 1, dtype=np.int32),
        "link_kind": np.array(kind, np.int32),
        "link_offset": np.array(offset, float),
        "link_axis": np.array(axis, float),
        "link_coordinate": np.array(coordinate, np.int32),
        "link_multiplier": np.array(multiplier, float),
        "link_constant": np.array(constant, float),
        "coordinate_prescribed": np.array([0] * root + list(prescribed), np.int32),
        "coordinate_held": np.zeros(root + len(prescribed), np.int32),
        "coordinate_lower": np.array([-np.inf] * root + list(lower)),
        "coordinate_upper": np.array([np.inf] * root + list(upper)),
        "limit_stiffness": np.array([0.0] * root + list(limit_stiffness)),
        "limit_zone": 0.01,
        "velocity_stiffness": np.array([0.0] * root + [40.0] * len(prescribed)),
        "velocity_force": np.array([0.0] * root + [0.2] * len(prescribed)),
        "surface_link": np.arange(links, dtype=np.int32),
        "ignored_pairs": np.array(
            [(1 + a, 1 + b) for b in range(links) for a in range(b)], np.int32
        ).reshape(-1, 2),
    }


class CoreScene:
    """A cloth, held at two sides, and one tree of links with a box each."""

    def __init__(self, trees, sizes, cells=5):
        border = [i for i in range(cells**2) if i // cells in (0, cells - 1)]
        cloth = dc.Cloth.grid(cells, cells, size=(0.5, 0.5), pins={"border": border})
        boxes = [dc.RigidBody.box(size) for size in sizes]
        # Far from each other: only arrays and defaults are taken from this simulator.
        apart = [
            dc.RigidBody(
                b.vertices, b.faces, motion="kinematic", pose=[9.0 * (k + 1), *[0] * 2, 1, *[0] * 3]
            )
            for k, b in enumerate(boxes)
        ]
        self.simulator = dc.Simulator(dc.Scene([cloth], apart), DT)
        assembly = self.simulator._assembly
        names = ("vertices", "rest_positions", "faces", "cloth_vertex_start", "cloth_face_start")
        names += ("pins", "soft_pins", "body_vertices", "body_faces", "body_vertex_start")
        self.core = _core.Simulator(
            **{name: getattr(assembly, name) for name in names},
            bending_models=["patch"],
            self_contact=True,
            dt=DT,
            scheme="coupled",
            metric="mass",
            elastic="newton",
            friction_iterations=2,
            tolerance=1e-10,
            max_iterations=500,
            **trees,
        )
        inputs, _ = self.simulator._inputs(self.simulator.initial_state(), None, None)
        self.defaults = {
            name: np.ascontiguousarray(tensor.detach().numpy()) for name, tensor in inputs.items()
        }

    def inputs(self, after=None, **changes):
        """Inputs of a step that continues from the outputs `after` of an earlier step."""
        arrays = dict(self.defaults)
        if after is not None:
            arrays["positions"], arrays["velocities"] = after["positions"], after["velocities"]
        for name, value in changes.items():
            arrays[name] = np.ascontiguousarray(np.array(value, dtype=float))[None]
        return arrays

    def forward(self, arrays, *, tape=False):
        result = self.core.forward(arrays, tape, 1)
        found = diagnostics_of(result)
        assert found["status"] == [0], (found["message"], found["residual"])
        return result | found

    def gradients(self, arrays, cotangents):
        result = self.forward(arrays, tape=True)
        tape = {name: array for name, array in result.items() if name.startswith("tape_")}
        found = self.core.backward(arrays, tape, result["kept"], cotangents, 1, list(arrays), 1)
        return {name: gradient[0] for name, gradient in found.items()}
