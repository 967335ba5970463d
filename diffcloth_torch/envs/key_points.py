"""Points of a sheet that are observed: the same material points at every size of its mesh."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffcloth_torch import cpu

__all__ = ["KeyPoints"]


@dataclass(frozen=True, eq=False)
class KeyPoints:
    """Material points of cloth; each is a vertex, or lies between the four vertices of a cell.

    Points that are evenly spaced between the edges of a sheet do not depend on the size of its
    mesh, and neither does a policy that observes them. The vertices nearest to them do.

    Attributes:
        vertices: Vertices of each point, [k, n], with k = 1 or 4.
        weights: Their bilinear weights, which sum to one, [k, n, 1]; exactly 1 at a vertex.
    """

    vertices: Tensor
    weights: Tensor

    @staticmethod
    def at(vertices: Tensor) -> KeyPoints:
        """Vertices [n] by their indices."""
        return KeyPoints(vertices[None], cpu.ones(1, len(vertices), 1))

    @staticmethod
    def on_grid(size: tuple[int, int], shape: tuple[int, int] = (4, 4)) -> KeyPoints:
        """Points of a grid, evenly spaced from edge to edge, by rows.

        Args:
            size: Rows and columns of vertices, each >= 2; vertices are numbered by rows.
            shape: Rows and columns of points, each >= 2.
        """
        rows, down = _between(size[0], shape[0])
        columns, right = _between(size[1], shape[1])
        vertices, weights = [], []
        for i in (0, 1):
            for j in (0, 1):
                vertices.append((rows[i][:, None] * size[1] + columns[j]).flatten())
                weights.append((down[i][:, None] * right[j]).flatten())
        if bool((weights[0] == 1).all()):
            return KeyPoints.at(vertices[0])
        return KeyPoints(torch.stack(vertices), torch.stack(weights)[..., None])

    def __len__(self) -> int:
        return self.vertices.shape[1]

    def of(self, values: Tensor) -> Tensor:
        """Interpolate values of vertices [B, N, 3] at the points, [B, n, 3]."""
        if len(self.vertices) == 1:
            return values[:, self.vertices[0]]
        # Terms are added one by one: bits of a row must not depend on the number of rows.
        a, b, c, d = (values[:, self.vertices] * self.weights).unbind(dim=1)
        return a + b + c + d


def _between(size: int, count: int) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Two vertices of a line of `size` around each of `count` points, and their weights."""
    places = cpu.arange(count) * (size - 1)  # in units of 1 / (count - 1) edges, so that no
    low = places // (count - 1)  # point at a vertex is rounded off this vertex
    share = (places - low * (count - 1)).double() / (count - 1)
    return (low, (low + 1).clamp(max=size - 1)), (1 - share, share)
