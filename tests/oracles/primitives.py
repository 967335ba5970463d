"""Distance to simple solids by brute force: the nearest of many points of the surface.

This is slow, obvious, and independent of the core's formulas. Surfaces are given by charts of two
parameters; the search refines a grid around the best point so far.
"""

from collections.abc import Callable

import numpy as np

Chart = Callable[[np.ndarray, np.ndarray], np.ndarray]


def sphere(radius):
    """One chart over the unit square, and a predicate for points inside."""

    def chart(s, t):
        a, b = np.pi * s, 2 * np.pi * t
        return radius * np.stack([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)], -1)

    return [chart], lambda y: np.linalg.norm(y) < radius


def capsule(radius, half_length):
    def cap(side):
        def chart(s, t):
            a, b = np.pi / 2 * s, 2 * np.pi * t
            return np.stack(
                [
                    radius * np.sin(a) * np.cos(b),
                    radius * np.sin(a) * np.sin(b),
                    side * (half_length + radius * np.cos(a)),
                ],
                -1,
            )

        return chart

    def wall(s, t):
        b = 2 * np.pi * t
        return np.stack([radius * np.cos(b), radius * np.sin(b), half_length * (2 * s - 1)], -1)

    def inside(y):
        if abs(y[2]) <= half_length:
            return np.hypot(y[0], y[1]) < radius
        return np.linalg.norm(y - [0, 0, np.sign(y[2]) * half_length]) < radius

    return [cap(1), cap(-1), wall], inside


def box(*half):
    half = np.array(half)

    def side(axis, sign):
        others = [k for k in range(3) if k != axis]

        def chart(s, t):
            point = np.zeros((*s.shape, 3))
            point[..., axis] = sign * half[axis]
            point[..., others[0]] = half[others[0]] * (2 * s - 1)
            point[..., others[1]] = half[others[1]] * (2 * t - 1)
            return point

        return chart

    charts = [side(axis, sign) for axis in range(3) for sign in (-1, 1)]
    return charts, lambda y: bool((np.abs(y) < half).all())


def nearest_point(charts: list[Chart], y: np.ndarray) -> np.ndarray:
    """The nearest of the points of all charts."""
    best, distance = y, np.inf
    for chart in charts:
        low, high = np.zeros(2), np.ones(2)
        for _ in range(16):
            s, t = np.meshgrid(
                np.linspace(low[0], high[0], 41), np.linspace(low[1], high[1], 41), indexing="ij"
            )
            points = chart(s, t)
            distances = np.linalg.norm(points - y, axis=-1)
            k = np.unravel_index(distances.argmin(), distances.shape)
            if distances[k] < distance:
                best, distance = points[k], distances[k]
            middle = np.array([s[k], t[k]])
            width = (high - low) / 8
            low, high = np.maximum(middle - width, 0), np.minimum(middle + width, 1)
    return best
