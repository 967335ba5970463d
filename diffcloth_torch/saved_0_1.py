"""Files and names of 0.1: present modules of its classes, and conversion of its checkpoints.

A checkpoint of 0.1 is an archive of `torch.save` alone, without the record that `checkpoint.py`
adds. Stored results of simulations are not recomputed: this version rounds differently, and the
rewards of its tasks differ.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

__all__ = ["CHECKPOINTS", "MODULES", "OPTIONS", "with_names_of_today"]

MODULES = {
    "sim.contact_points": ("ContactPoints",),
    "sim.contacts": ("Contacts",),
    "sim.controls": ("Control", "Parameters"),
    "sim.report": ("Report",),
    "sim.state": ("State",),
    "sim.surfaces": ("LinkSurfaces", "Surfaces"),
}
"""Removed module that files of 0.1 refer to -> its classes."""

OPTIONS = {
    "actor_rate": "learning_rate",
    "critic_rate": "critic_learning_rate",
    "deviation": "init_std",
    "gradient_norm": "max_grad_norm",
    "plan_rate": "plan_learning_rate",
    "target_rate": "tau",
    "temperature_rate": "temperature_learning_rate",
    "trace": "gae_lambda",
}
"""Option of `TrainerOptions` in 0.1 -> its present name."""


def with_names_of_today(options: dict[str, Any]) -> dict[str, Any]:
    """Return options of a trainer under their present names."""
    return {OPTIONS.get(name, name): value for name, value in options.items()}


def _descent(content: dict[str, Any]) -> dict[str, Any]:
    """Convert an optimization; evaluations of 0.1 have no processor time."""
    found = content["found"]
    if found is None:
        return content
    unknown = {"cpu_seconds": None}
    changes = {"history": [record | unknown for record in found["history"]]}
    for name in ("first", "best"):
        evaluation = found[name]
        changes[name] = evaluation | {"statistics": evaluation["statistics"] | unknown}
    return content | {"found": found | changes}


def _trainer(content: dict[str, Any]) -> dict[str, Any]:
    """Convert a trainer, without its environments: 0.1 drew starts differently.

    Observations of 0.1 were all in the axes of the world.
    """
    return content | {
        "options": with_names_of_today(content["options"]),
        "task": content["task"] | {"frame": "world"},
        "return": torch.zeros_like(content["return"]),
        "places": None,
    }


def _fit(content: dict[str, Any]) -> dict[str, Any]:
    """Convert a start of a fit; 0.1 had no ties, and only priors of single numbers."""
    (names, kept, low, high, means, precisions), *rest = content["problem"]
    whitening = [
        [precision if column == row else 0.0 for column in range(len(precisions))]
        for row, precision in enumerate(precisions)
        if precision > 0
    ]
    return content | {"problem": [[names, kept, [], low, high, means, whitening], *rest]}


CHECKPOINTS: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "fit": _fit,
    "optimize": _descent,
    "trainer": _trainer,
}
"""Kind of a checkpoint -> function from the content of a file of 0.1 to the present content."""
