"""Selection, stacking and choice of environments, shared by all records of a step.

A record combines each of its entries by one of three rules: tensors with a leading axis of
environments; numbers, which are plain numbers without that axis; and items, one for each
environment in a tuple. A record without the axis has one environment.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from diffcloth_torch import cpu

__all__ = ["Choice", "Combination", "Selection", "Stack"]

Items = tuple[Any, ...]


class Combination(ABC):
    """Combination of entries of several records into the entry of another record.

    Attributes:
        size: Environments of the result, None if it has no axis of environments.
    """

    size: int | None

    @abstractmethod
    def tensors(self, parts: Sequence[Tensor]) -> Tensor:
        """Combine tensors."""

    @abstractmethod
    def items(self, parts: Sequence[Items]) -> Items:
        """Combine tuples of one item for each environment."""

    def numbers(self, parts: Sequence[Any]) -> Any:
        """Combine numbers, or tensors of one for each environment."""
        combined = self.tensors([cpu.as_tensor(part) for part in parts])
        return combined.item() if self.size is None else combined


class Selection(Combination):
    """One environment of a record, or several."""

    def __init__(self, index: int | slice | Tensor, count: int) -> None:
        """Keep the index.

        Args:
            index: An integer, or the index of a tensor's first axis.
            count: Environments of the record.
        """
        self._index = index
        self._chosen = cpu.arange(count)[index].reshape(-1).tolist()
        self.size = None if isinstance(index, int) else len(self._chosen)

    def tensors(self, parts: Sequence[Tensor]) -> Tensor:
        """Select rows."""
        return parts[0][self._index]

    def items(self, parts: Sequence[Items]) -> Items:
        """Select items."""
        return tuple(parts[0][i] for i in self._chosen)


class Stack(Combination):
    """A batch of records without an axis of environments."""

    def __init__(self, count: int) -> None:
        self.size = count

    def tensors(self, parts: Sequence[Tensor]) -> Tensor:
        """Stack tensors."""
        return torch.stack(list(parts))

    def items(self, parts: Sequence[Items]) -> Items:
        """Collect the only item of each."""
        return tuple(part[0] for part in parts)


class Choice(Combination):
    """Environments of a first record where a mask is true, else of a second one."""

    def __init__(self, mask: Tensor, batched: Sequence[bool]) -> None:
        """Keep the mask.

        Args:
            mask: Booleans, [B].
            batched: For each of the two records, true if it has an axis of environments; otherwise
                its only environment is used for all.
        """
        self._mask, self._batched = mask, batched
        self.size = len(mask)

    def tensors(self, parts: Sequence[Tensor]) -> Tensor:
        """Choose rows."""
        a, b = (t if own else t[None] for t, own in zip(parts, self._batched, strict=True))
        return torch.where(self._mask.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    def items(self, parts: Sequence[Items]) -> Items:
        """Choose items."""
        a, b = (
            part if own else part * len(self._mask)
            for part, own in zip(parts, self._batched, strict=True)
        )
        return tuple(a[i] if is_a else b[i] for i, is_a in enumerate(self._mask.tolist()))
