"""Default weights of attachments, and the check that weighted attachments have targets."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch.autograd.transforms import numbers_of
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.operations import label
from diffcloth_torch.sim.inputs.layout import Layout

__all__ = ["Targets", "default_weights", "refuse_untargeted"]

Targets = Tensor | Mapping[str, Tensor]
"""A field that a control sets: all rows, or some by name."""


def default_weights(layout: Layout, targets: Targets | None) -> Tensor:
    """One for every spring with both ends, zero for springs without a target; [1, A]."""
    unset = layout.zeros["attachment_weights"]
    if targets is None:
        return unset
    return torch.from_numpy(_are_whole(layout, targets)).to(unset)[None]


def refuse_untargeted(layout: Layout, weights: Tensor, targets: Targets | None) -> None:
    """Refuse nonzero weights [B, A] of attachments without a target.

    Raises:
        InvalidInput: If a weight of such an attachment is not zero.
    """
    if isinstance(targets, Tensor):
        return
    for name in layout.assembly.springs.target_groups:
        springs = layout.assembly.springs.groups[name]
        if name not in (targets or ()) and numbers_of(weights)[:, springs].any():
            raise InvalidInput(
                f"{label('control', 'attachments')} must set the target of {name!r}, whose "
                "weight is not zero"
            )


def _are_whole(layout: Layout, targets: Targets | None) -> NDArray[np.bool_]:
    """Mask of springs with both ends; as numbers, which no transform of torch wraps."""
    springs = layout.assembly.springs
    whole = np.asarray(springs.targets < 0)
    names = springs.target_groups if isinstance(targets, Tensor) else targets or ()
    for name in names:
        whole[springs.groups[name]] = True
    return whole
