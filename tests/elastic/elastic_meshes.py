"""Meshes, deformations and difference quotients shared by the tests of the elastic potentials."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.spatial

from diffcloth_torch import _kernels

Elastic = _kernels.Elastic

STEP = 0.01  # time step [s]
WOVEN = ("stretch_weft", "stretch_shear", "bending_weft", "bending_twill")

TRIANGLE = (np.array([[0.0, 0, 0], [1, 0.1, 0], [0.3, 0.8, 0]]), np.array([[0, 1, 2]], np.int32))

# In-plane maps of the triangle, with a bit of noise out of plane: tension, compression in one and
# in both directions, an inversion.
STATES = [
    pytest.param(np.diag([1.3, 1.2, 1.0]), id="tension"),
    pytest.param(np.diag([1.2, 0.7, 1.0]), id="compressed in one direction"),
    pytest.param(np.diag([0.6, 0.5, 1.0]), id="compressed"),
    pytest.param(np.array([[1.0, 0.8, 0], [0, 1, 0], [0.4, 0, 1]]), id="sheared"),
    pytest.param(np.diag([-1.1, 0.9, 1.0]), id="turned over"),
]


def grid(nu: int, nv: int, diagonal: str = "right") -> tuple[np.ndarray, np.ndarray]:
    """Unit cells split along one diagonal, the other, or alternating ones."""
    i, j = np.meshgrid(np.arange(nu), np.arange(nv), indexing="ij")
    X = np.stack([i.ravel(), j.ravel(), 0 * i.ravel()], 1).astype(float)
    faces = []
    for u in range(nu - 1):
        for v in range(nv - 1):
            a, b, c, d = u * nv + v, (u + 1) * nv + v, (u + 1) * nv + v + 1, u * nv + v + 1
            left = diagonal == "left" or (diagonal == "alternating" and (u + v) % 2 == 1)
            faces += [[a, b, d], [b, c, d]] if left else [[a, b, c], [a, c, d]]
    return X, np.array(faces, np.int32)


def equilateral(nu: int, nv: int) -> tuple[np.ndarray, np.ndarray]:
    X, faces = grid(nu, nv, "left")
    X[:, 0] += 0.5 * X[:, 1]
    X[:, 1] *= np.sqrt(0.75)
    return X, faces


def jittered(nu: int, nv: int) -> tuple[np.ndarray, np.ndarray]:
    X, faces = grid(nu, nv, "alternating")
    X[:, :2] += np.random.default_rng(1).uniform(-0.25, 0.25, (len(X), 2))
    return X, faces


def delaunay(nu: int, nv: int) -> tuple[np.ndarray, np.ndarray]:
    """Unstructured: interior points moved freely, then triangulated again."""
    X, _ = grid(nu, nv)
    inside = (X[:, 0] % (nu - 1) != 0) & (X[:, 1] % (nv - 1) != 0)
    shift = np.random.default_rng(2).uniform(-0.35, 0.35, (len(X), 2))
    X[inside, :2] += shift[inside]
    faces = scipy.spatial.Delaunay(X[:, :2]).simplices
    side = X[faces[:, 1:], :2] - X[faces[:, :1], :2]
    area = side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0]
    faces[area < 0] = faces[area < 0][:, ::-1]
    return X, faces[np.abs(area) > 1e-9].astype(np.int32)


MESHES: dict[str, Callable[[int, int], tuple[np.ndarray, np.ndarray]]] = {
    "right": lambda nu, nv: grid(nu, nv, "right"),
    "left": lambda nu, nv: grid(nu, nv, "left"),
    "alternating": lambda nu, nv: grid(nu, nv, "alternating"),
    "equilateral": equilateral,
    "jittered": jittered,
    "delaunay": delaunay,
}


def oriented(X: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A flat mesh with counterclockwise faces."""
    side = X[faces[:, 1:], :2] - X[faces[:, :1], :2]
    clockwise = side[:, 0, 0] * side[:, 1, 1] < side[:, 0, 1] * side[:, 1, 0]
    faces = np.where(clockwise[:, None], faces[:, ::-1], faces)
    return np.ascontiguousarray(X), np.ascontiguousarray(faces, np.int32)


def squeezed(name: str, nu: int, nv: int, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Cells that are `aspect` times as long along x as along y."""
    X, faces = MESHES[name](nu, nv)
    return X / [1, aspect, 1], faces


def annulus() -> tuple[np.ndarray, np.ndarray]:
    """Rings of slivers and of wide triangles in turns."""
    n, radii = 20, (1, 1.03, 1.5, 1.55)
    angle = [2 * np.pi * np.arange(n) / n + 0.08 * i for i in range(len(radii))]
    X = [
        np.stack([r * np.cos(t), r * np.sin(t), 0 * t], 1)
        for r, t in zip(radii, angle, strict=True)
    ]
    i, j = np.divmod(np.arange(n * (len(radii) - 1)), n)
    a, b = i * n + j, i * n + (j + 1) % n
    return oriented(
        np.concatenate(X),
        np.concatenate([np.stack([a, b, a + n], 1), np.stack([b, b + n, a + n], 1)]),
    )


def l_shape() -> tuple[np.ndarray, np.ndarray]:
    X, faces = grid(9, 9, "alternating")
    faces = faces[~(X[faces, :2].mean(1) > 4).all(1)]
    used, faces = np.unique(faces, return_inverse=True)
    return X[used], faces.reshape(-1, 3).astype(np.int32)


def fan() -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(8) * np.pi / 4
    X = np.stack([np.cos(t), 0.5 * np.sin(t), 0 * t], 1)
    return np.concatenate([np.zeros((1, 3)), X]), np.array(
        [[0, i + 1, (i + 1) % 8 + 1] for i in range(8)], np.int32
    )


def slivers(aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Random points of a rectangle, triangulated."""
    X = np.random.default_rng(3).uniform(size=(60, 2)) / [1, aspect]
    faces = scipy.spatial.Delaunay(X).simplices
    side = X[faces[:, 1:]] - X[faces[:, :1]]
    area = side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0]
    return oriented(np.c_[X, 0 * X[:, 0]], faces[np.abs(area) > 2e-6])


def on_cylinder(X: np.ndarray, curvature: float, angle: float) -> np.ndarray:
    """Roll a flat sheet onto a cylinder; `angle` is between x and the bent direction [rad]."""
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    s, t = X[:, :2] @ along, X[:, :2] @ across
    x = np.outer(np.sin(curvature * s) / curvature, [*along, 0.0])
    x += np.outer(t, [*across, 0.0])
    x[:, 2] = (1 - np.cos(curvature * s)) / curvature
    return x


def on_sphere(X: np.ndarray, radius: float) -> np.ndarray:
    x = X - X.mean(0)
    x[:, 2] = np.sqrt(radius**2 - (x[:, :2] ** 2).sum(1))
    return x


def rigid(x: np.ndarray, seed: int = 0) -> np.ndarray:
    """Turn and move by amounts of order one."""
    rng = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    return np.ascontiguousarray(x @ rotation.T + rng.normal(size=3))


def rest_mesh(rest: str) -> tuple[np.ndarray, np.ndarray]:
    """Irregular rest shape in general position: flat, or on a cylinder or a sphere."""
    X, faces = grid(4, 3, "alternating")
    X[:, :2] += 0.1 * np.random.default_rng(8).normal(size=(len(X), 2))
    match rest:
        case "cylinder":
            X = on_cylinder(X, 0.3, 0.4)
        case "sphere":
            X = on_sphere(X, 5.0)
    return rigid(X), faces


def random_materials(
    rng: np.random.Generator, face_count: int, damped: float, woven: bool = False
) -> dict[str, np.ndarray]:
    """Materials that differ from face to face; `damped` scales the damping."""
    of_weave = {
        "angles": rng.uniform(-np.pi, np.pi, face_count),
        "stretch_weft": 1.2 * rng.uniform(1, 2, face_count),
        "stretch_shear": 0.3 * rng.uniform(1, 2, face_count),
        "bending_weft": 0.2 * rng.uniform(1, 2, face_count),
        "bending_twill": 0.5 * rng.uniform(1, 2, face_count),
    }
    isotropic = {
        "stretch": 2.0 * rng.uniform(1, 2, face_count),
        "bending": 0.5 * rng.uniform(1, 2, face_count),
        "poisson": 0.3 * rng.uniform(0.5, 1, face_count),
        "damping": 0.02 * rng.uniform(0.5, 1, face_count) * damped,
    }
    return isotropic | of_weave if woven else isotropic


def model(
    X: np.ndarray,
    faces: np.ndarray,
    bending_model: str = "patch",
    *,
    stretch: float | np.ndarray = 0.0,
    bending: float | np.ndarray = 0.0,
    poisson: float | np.ndarray = 0.0,
    damping: float | np.ndarray = 0.0,
    x_n: np.ndarray | None = None,
    **woven: float | np.ndarray,
) -> Elastic:
    """A model; woven if `angles` from the first sides of faces to the warp are given."""
    elastic = Elastic(X, faces, bending_model)
    set_parameters(
        elastic,
        len(faces),
        stretch=stretch,
        bending=bending,
        poisson=poisson,
        damping=damping,
        x_n=X if x_n is None else x_n,
        **woven,
    )
    return elastic


def set_parameters(
    elastic: Elastic,
    face_count: int,
    *,
    x_n: np.ndarray | None,
    angles: np.ndarray | None = None,
    **parameters: float | np.ndarray,
) -> None:
    one = np.ones(face_count)
    if angles is None:
        elastic.set_weave(np.empty(0), np.empty(0))
    else:
        axes = np.stack([np.cos(angles), np.sin(angles)], 1).ravel()
        values = [parameters.get(name, parameters[name.split("_")[0]]) for name in WOVEN]
        elastic.set_weave(axes, np.concatenate([value * one for value in values]))
    elastic.set_parameters(
        parameters["stretch"] * one,
        parameters["bending"] * one,
        parameters["poisson"] * one,
        parameters["damping"] * one,
        STEP,
        None if x_n is None else np.ascontiguousarray(x_n),
    )


def angles_along(X: np.ndarray, faces: np.ndarray, direction: float) -> np.ndarray:
    """Angles from the first sides of a flat mesh's faces to a direction, given from x [rad]."""
    side = X[faces[:, 1]] - X[faces[:, 0]]
    return direction - np.arctan2(side[:, 1], side[:, 0])


def differences(f: Callable[[np.ndarray], float | np.ndarray], x: np.ndarray, eps: float):
    """Derivative of f along every entry of x, by fourth-order central differences."""
    columns = []
    for k in range(x.size):
        e = np.zeros(x.size)
        e[k] = eps
        e = e.reshape(x.shape)
        near = np.asarray(f(x + e)) - np.asarray(f(x - e))
        far = np.asarray(f(x + 2 * e)) - np.asarray(f(x - 2 * e))
        columns.append((8 * near - far) / (12 * eps))
    return np.stack(columns, -1)
