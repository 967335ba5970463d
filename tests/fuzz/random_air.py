"""Random air: drag of cloths, and a wind that changes from step to step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from random_draws import log_uniform, maybe

SHARE = 0.4  # of the scenes with cloths


@dataclass(frozen=True)
class Air:
    """Air around the cloths of a scene.

    Attributes:
        normal_drag: Drag coefficient of all cloths [-].
        tangential_drag: Drag coefficient of all cloths [-].
        density: Density of the air [kg/m^3].
        wind: Wind before the first step [m/s], shape [3].
        gust: Increment of the wind in each step [m/s], shape [3].
    """

    normal_drag: float = 0.0
    tangential_drag: float = 0.0
    density: float = 1.2
    wind: np.ndarray | None = None
    gust: np.ndarray | None = None

    def wind_at(self, k: int) -> np.ndarray | None:
        """In step k."""
        return None if self.wind is None else self.wind + k * self.gust

    def force(
        self, faces: np.ndarray, before: np.ndarray, after: np.ndarray, k: int, dt: float
    ) -> np.ndarray:
        """On all faces together in step k, by hand [N]."""
        wind = self.wind_at(k)
        if wind is None:
            return np.zeros(3)
        u = ((after - before) / dt)[faces].mean(axis=1) - wind
        a, b, c = (before[faces[:, i]] for i in range(3))
        normals = 0.5 * np.cross(b - a, c - a)
        area = np.linalg.norm(normals, axis=1, keepdims=True)
        n = normals / area
        u_n = (u * n).sum(axis=1, keepdims=True)
        u_t = u - u_n * n
        pressure = self.normal_drag * np.abs(u_n) * u_n * n
        friction = self.tangential_drag * np.linalg.norm(u_t, axis=1, keepdims=True) * u_t
        return -0.5 * self.density * (area * (pressure + friction)).sum(axis=0)


NO_AIR = Air()


def draw_air(rng: np.random.Generator, d: dict[str, Any]) -> Air:
    """No air, or wind between a breeze and a storm for cloths of that size."""
    if rng.random() >= SHARE:
        return NO_AIR
    speed = np.sqrt(9.81 * d["size"])  # of a fall through the cloth's own size
    air = Air(
        normal_drag=maybe(rng, 0.8, log_uniform(rng, 0.05, 3.0)),
        tangential_drag=maybe(rng, 0.8, log_uniform(rng, 1e-3, 0.5)),
        density=log_uniform(rng, 0.1, 3.0),
        wind=speed * rng.uniform(0, 2) * rng.normal(size=3),
        gust=0.2 * speed * rng.normal(size=3),
    )
    d["air"] = {"density": air.density, "wind": air.wind.tolist(), "gust": air.gust.tolist()}
    return air
