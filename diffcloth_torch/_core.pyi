# The C++ extension: types of the names that the package uses. docs/core_stub.py replaces the core
# when the site is built, and needs the values of names against which defaults are checked.

from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]

schemes: dict[str, dict[str, bool]] = {
    "coupled": {"barrier": True, "moves_bodies": True, "elastic_stage": False, "metrics": False},
    "split": {"barrier": True, "moves_bodies": False, "elastic_stage": True, "metrics": True},
    "projective": {
        "barrier": False,
        "moves_bodies": False,
        "elastic_stage": True,
        "metrics": False,
    },
}
"""Capabilities of each scheme; the default is first."""
integrators: list[str] = ["implicit_euler", "second_order"]
metrics: list[str] = ["energy", "elastic", "mass", "identity"]
elastic_solvers: list[str] = ["newton", "projective"]
criteria: list[str]
"""Names of the criteria that end a solve, indexed by the number "criterion" of a step."""
input_names: list[str]
number_names: list[str]
"""Names of the entries of "numbers", which a step returns."""

class SimulationError(RuntimeError): ...

def build_info() -> dict[str, Any]: ...
def abandon_calls() -> None: ...
def parked_threads() -> list[int]: ...
def are_within(arrays: list[NDArray[np.float64]], largest: float) -> bool: ...
def have_quaternions(poses: NDArray[np.float64], shortest: float) -> bool: ...

class SmoothFunction:
    def values(self, inputs: Arrays, threads: int) -> Arrays: ...
    def gradients(
        self, inputs: Arrays, cotangents: Arrays, losses: int, needs: list[str], threads: int
    ) -> Arrays: ...
    def tangents(self, inputs: Arrays, directions: Arrays, count: int, threads: int) -> Arrays: ...

class Tree: ...

joint_kinds: dict[str, tuple[float, float]]

def tree(
    *,
    parent: list[int],
    order: list[int],
    kind: list[int],
    offset: NDArray[np.float64],
    axis: NDArray[np.float64],
    dof: list[int],
    multiplier: NDArray[np.float64],
    constant: NDArray[np.float64],
    joint_count: int,
) -> Tree: ...
def link_frames(tree: Tree) -> SmoothFunction: ...
def robot_functions(
    *,
    tree: Tree,
    base: int,
    actuation: list[int],
    vertex_link: list[int],
    points: NDArray[np.float64],
    dt: float,
    largest: float,
    is_at_rest: bool,
    bounds_weight: bool,
) -> tuple[SmoothFunction, SmoothFunction]: ...
def body_functions(count: int, dt: float) -> tuple[SmoothFunction, SmoothFunction]: ...

class Kept: ...

class Simulator:
    largest_factor_bytes: int
    factor_bytes: int
    last_turns: list[tuple[int, float]]
    def __init__(
        self,
        *,
        vertices: NDArray[np.float64],
        rest_positions: NDArray[np.float64],
        faces: NDArray[np.int32],
        rest_embedding: NDArray[np.float64] = ...,
        rest_faces: NDArray[np.int32] = ...,
        material_axes: NDArray[np.float64],
        cloth_vertex_start: NDArray[np.int32],
        cloth_face_start: NDArray[np.int32],
        bending_models: list[str],
        pins: NDArray[np.int32],
        soft_pins: NDArray[np.int32],
        attachment_start: NDArray[np.int32],
        attachment_points: NDArray[np.int32],
        attachment_coefficients: NDArray[np.float64],
        attachment_rest_lengths: NDArray[np.float64],
        attachment_targets: NDArray[np.int32],
        body_vertices: NDArray[np.float64],
        body_faces: NDArray[np.int32],
        body_radii: NDArray[np.float64],
        body_vertex_start: NDArray[np.int32],
        self_contact: bool,
        dt: float,
        scheme: str,
        integrator: str = ...,
        certify: bool = ...,
        metric: str,
        elastic: str,
        friction_iterations: int,
        tolerance: float,
        max_iterations: int,
        surface_names: list[str] = ...,
        pin_names: list[str] = ...,
        ignored_pairs: NDArray[np.int32] = ...,
        primitive_kinds: list[str] = ...,
        primitive_sizes: NDArray[np.float64] = ...,
        **trees: NDArray[Any] | float,
    ) -> None: ...
    def smallest_nonadjacent_distance(self) -> float: ...
    def default_barrier_stiffness(
        self, inputs: Arrays, barrier_distance: float
    ) -> NDArray[np.float64]: ...
    def find_overlap(self, inputs: Arrays) -> str | None: ...
    def find_throws(
        self, inputs: Arrays, threads: int
    ) -> list[tuple[str, float, float, float] | None]: ...
    def stored_energy(self, inputs: Arrays) -> dict[str, NDArray[np.float64]]: ...
    def energy_backward(
        self, inputs: Arrays, cotangents: Arrays, losses: int, needs: list[str], threads: int
    ) -> Arrays: ...
    def energy_tangent(
        self, inputs: Arrays, tangents: Arrays, directions: int, threads: int
    ) -> Arrays: ...
    def path(self, inputs: Arrays) -> NDArray[np.float64]: ...
    def reference_factorization_seconds(self, inputs: Arrays, repeats: int) -> float: ...
    def forget_factors(self) -> None: ...
    def forward(self, inputs: Arrays, tape: bool, threads: int) -> dict[str, Any]: ...
    def backward(
        self,
        inputs: Arrays,
        tape: Arrays,
        kept: Kept,
        cotangents: Arrays,
        losses: int,
        needs: list[str],
        threads: int,
    ) -> Arrays: ...
    def tangent(
        self,
        inputs: Arrays,
        tape: Arrays,
        kept: Kept,
        tangents: Arrays,
        directions: int,
        threads: int,
    ) -> Arrays: ...
