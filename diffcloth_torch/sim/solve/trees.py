"""The mechanisms of a scene in the core's order: all links in one list, parents first."""

from __future__ import annotations

from typing import Any

import numpy as np

from diffcloth_torch.dynamics.limits import ZONE, LimitStiffness
from diffcloth_torch.model.assembly import Assembly
from diffcloth_torch.model.mechanism import JOINT_KINDS

__all__ = ["tree_arguments"]

_ROOT = 6  # coordinates of a floating root


def tree_arguments(
    assembly: Assembly, limit_stiffness: LimitStiffness, *, all_prescribed: bool = False
) -> dict[str, Any]:
    """Make the arguments of the core that describe all trees, bodies first.

    Args:
        assembly: Arrays of the scene.
        limit_stiffness: Stiffness of the barriers at the limits of coordinates.
        all_prescribed: True if the values of all coordinates at the end of a step are given.
    """
    links: dict[str, list[Any]] = {
        name: []
        for name in (
            "tree",
            "parent",
            "kind",
            "offset",
            "axis",
            "coordinate",
            "multiplier",
            "constant",
        )
    }
    prescribed: list[bool] = []
    lower: list[float] = []
    upper: list[float] = []
    place: dict[tuple[int, int], int] = {}  # index of a mechanism's link in the list of all links
    for t, mechanism in enumerate(assembly.mechanisms):
        if mechanism.base == "floating":
            prescribed += [False] * _ROOT
            lower += [-np.inf] * _ROOT
            upper += [np.inf] * _ROOT
        first_joint = len(prescribed)
        for link in mechanism.order:
            place[t, link] = len(place)
            dof = int(mechanism.dof[link])
            links["tree"].append(t)
            links["parent"].append(place.get((t, int(mechanism.parent[link])), -1))
            links["kind"].append(JOINT_KINDS.index(mechanism.kind[link]))
            links["offset"].append(mechanism.offset[link])
            links["axis"].append(mechanism.axis[link])
            links["coordinate"].append(-1 if dof < 0 else first_joint + dof)
            links["multiplier"].append(mechanism.multiplier[link])
            links["constant"].append(mechanism.constant[link])
        prescribed += (~mechanism.forced).tolist()
        lower += mechanism.lower.tolist()
        upper += mechanism.upper.tolist()
    owners = zip(assembly.surface_mechanism.tolist(), assembly.surface_link.tolist(), strict=True)
    return {
        "tree_free": _indices([m.base == "floating" for m in assembly.mechanisms]),
        "link_tree": _indices(links["tree"]),
        "link_parent": _indices(links["parent"]),
        "link_kind": _indices(links["kind"]),
        "link_offset": np.array(links["offset"], dtype=np.float64).reshape(-1, 4, 4),
        "link_axis": np.array(links["axis"], dtype=np.float64).reshape(-1, 3),
        "link_coordinate": _indices(links["coordinate"]),
        "link_multiplier": np.array(links["multiplier"], dtype=np.float64),
        "link_constant": np.array(links["constant"], dtype=np.float64),
        "surface_link": _indices([place[owner] for owner in owners]),
        "coordinate_prescribed": _indices([all_prescribed or given for given in prescribed]),
        "coordinate_held": _indices([all_prescribed and not given for given in prescribed]),
        "coordinate_lower": np.array(lower, dtype=np.float64),
        "coordinate_upper": np.array(upper, dtype=np.float64),
        "limit_stiffness": limit_stiffness.positions,
        "limit_zone": ZONE,
        "velocity_stiffness": limit_stiffness.velocities,
        "velocity_force": limit_stiffness.forces,
    }


def _indices(values: list[Any]) -> np.ndarray[Any, np.dtype[np.int32]]:
    return np.array(values, dtype=np.int32)
