"""Surfaces in contact after a step: number of contacts and net force of each pair."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import FloatArray, texts
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.reprs import record_text, value_text
from diffcloth_torch.saved import saved
from diffcloth_torch.sim.records.environments import Combination

__all__ = ["Contacts", "PairContact"]

Pair = tuple[str, str]

_MOST_SHOWN = 8  # pairs


@dataclass(frozen=True, eq=False)
class PairContact:
    """The contact between two surfaces at the end of a step.

    Attributes:
        count: Number of contacts, as in `Report.contact_count`; in a batch a tensor [B].
        force: Net contact force of the first surface on the second, barrier and friction [N], shape
            [3], or [B, 3] in a batch. Zero for a surface and itself.
    """

    count: int | Tensor
    force: Tensor


@saved
@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts of a step by pairs of names: `contacts["gripper/left", "shirt"]`.

    A pair may be named in either order; swapping the names reverses the force. A pair without
    contact has zeros. Iteration yields the pairs in contact, in the order of the surfaces.

    Attributes:
        surfaces: Names of all surfaces.
        batch_size: Number of environments, None without a batch axis.
        counts: Pair in contact -> int64 tensor, shape [] or [B].
        forces: Pair in contact -> force of the first on the second [N], shape [3] or [B, 3].
        rows: Single contacts of each environment, for `Simulator.contacts`.
    """

    surfaces: tuple[str, ...] = ()
    batch_size: int | None = None
    counts: dict[Pair, Tensor] = field(default_factory=dict)
    forces: dict[Pair, Tensor] = field(default_factory=dict)
    rows: tuple[Tensor, ...] = ()

    @staticmethod
    def of(
        found: Sequence[Sequence[Any]],
        rows: Sequence[FloatArray],
        surfaces: Sequence[str],
        *,
        batched: bool,
    ) -> Contacts:
        """Collect the contacts that a core reports for each environment.

        Args:
            found: For each environment, (first, second, count, force) of each pair of surfaces in
                contact.
            rows: For each environment, its single contacts.
            surfaces: Names of all surfaces.
            batched: True if the result has an axis of environments.
        """
        counts: dict[tuple[int, int], NDArray[np.int64]] = {}
        forces: dict[tuple[int, int], FloatArray] = {}
        for i, pairs in enumerate(found):
            for first, second, count, force in pairs:
                key = (first, second)
                if key not in counts:
                    counts[key] = np.zeros(len(found), np.int64)
                    forces[key] = np.zeros((len(found), 3))
                counts[key][i] += count
                forces[key][i] += force
        names = {key: (surfaces[key[0]], surfaces[key[1]]) for key in sorted(counts)}
        rows_kept = tuple(map(torch.from_numpy, rows))

        def tensors(values: Mapping[tuple[int, int], NDArray[Any]]) -> dict[Pair, Tensor]:
            every = {name: torch.from_numpy(values[key]) for key, name in names.items()}
            return every if batched else {name: tensor[0] for name, tensor in every.items()}

        size = len(found) if batched else None
        return Contacts(tuple(surfaces), size, tensors(counts), tensors(forces), rows_kept)

    def __getitem__(self, pair: Pair) -> PairContact:
        """Contacts of two surfaces.

        Raises:
            InvalidInput: If one of them is not a surface of the scene.
        """
        given: Any = pair
        if not isinstance(given, tuple) or len(given) != 2:
            raise InvalidInput(f"contacts: must be asked for a pair of names, got {pair!r}")
        for name in pair:
            if name not in self.surfaces:
                raise InvalidInput(
                    f"contacts: the surfaces are {texts(self.surfaces)}; got {name!r}"
                )
        turned = (pair[1], pair[0])
        key = turned if turned in self.counts and pair not in self.counts else pair
        shape = () if self.batch_size is None else (self.batch_size,)
        if key not in self.counts:
            none = cpu.zeros(shape, dtype=torch.int64)
            return PairContact(_plain(none), cpu.zeros(*shape, 3))
        force = self.forces[key]
        return PairContact(_plain(self.counts[key]), force.clone() if key == pair else -force)

    def __eq__(self, other: object) -> bool:
        """Whether both have the same surfaces and the same contacts."""
        if not isinstance(other, Contacts):
            return NotImplemented
        same = (self.surfaces, self.batch_size) == (other.surfaces, other.batch_size)
        same = same and len(self.rows) == len(other.rows)
        same = same and all(map(torch.equal, self.rows, other.rows))
        return same and all(
            list(mine) == list(theirs) and all(torch.equal(mine[p], theirs[p]) for p in mine)
            for mine, theirs in ((self.counts, other.counts), (self.forces, other.forces))
        )

    __hash__ = None  # type: ignore[assignment]

    def __iter__(self) -> Iterator[Pair]:
        """Iterate over the pairs in contact."""
        return iter(self.counts)

    def __len__(self) -> int:
        """Number of pairs in contact."""
        return len(self.counts)

    def __repr__(self) -> str:
        pairs = [f"{pair}: {value_text(_plain(count))}" for pair, count in self.counts.items()]
        more = len(pairs) - _MOST_SHOWN
        rest = [f"and {more} more pairs"] if more > 0 else []
        return record_text("Contacts", pairs[:_MOST_SHOWN] + rest)

    @staticmethod
    def combined(how: Combination, parts: Sequence[Contacts]) -> Contacts:
        """Combine environments; a pair without contact in one of the parts has zeros there."""
        surfaces = max((part.surfaces for part in parts), key=len)
        order = {name: i for i, name in enumerate(surfaces)}
        pairs = sorted({p for part in parts for p in part}, key=lambda p: [order[n] for n in p])

        def entries(table: str, pair: Pair, row: tuple[int, ...], dtype: torch.dtype) -> Tensor:
            shapes = ((() if p.batch_size is None else (p.batch_size,)) + row for p in parts)
            return how.tensors(
                [
                    getattr(part, table).get(pair, cpu.zeros(shape, dtype=dtype))
                    for part, shape in zip(parts, shapes, strict=True)
                ]
            )

        counts = {p: entries("counts", p, (), torch.int64) for p in pairs}
        forces = {p: entries("forces", p, (3,), torch.float64) for p in pairs}
        known = all(part.rows for part in parts)
        rows = how.items([part.rows for part in parts]) if known else ()
        return Contacts(surfaces, how.size, counts, forces, rows)


def _plain(count: Tensor) -> int | Tensor:
    return int(count) if count.ndim == 0 else count.clone()
