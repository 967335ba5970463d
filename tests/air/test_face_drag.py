"""Drag of faces over a step, against its formula in torch and the derivatives that torch finds."""

import numpy as np
import pytest
import torch

from diffcloth_torch import _kernels

F64 = torch.float64
H = 0.02  # [s]
FACES = np.array([[0, 1, 2], [2, 1, 3], [2, 3, 4]], np.int32)
INPUTS = ("across", "along", "start", "wind")
RNG = np.random.default_rng(4)
START = RNG.normal(size=(6, 3))  # the last vertex belongs to no face
X0, X1 = START + H * RNG.normal(size=(2, 6, 3))
Z = RNG.normal(size=(6, 3))
VALUES = {
    "across": RNG.uniform(0.5, 2.0, 3),
    "along": RNG.uniform(0.1, 1.0, 3),
    "start": START,
    "wind": RNG.normal(size=3),
}
ONE_SIDED = {
    "both": VALUES,
    "across": VALUES | {"along": np.zeros(3)},
    "along": VALUES | {"across": np.zeros(3)},
    "some": VALUES | {"across": np.array([1.0, 0.0, 0.0]), "along": np.array([0.0, 0.0, 0.3])},
    "none": VALUES | {"across": np.zeros(3), "along": np.zeros(3)},
}


def kernel(values):
    return _kernels.FaceDrag(FACES, *(values[name] for name in INPUTS), H)


def tensors(values):
    return {name: torch.tensor(value, dtype=F64) for name, value in values.items()}


def energy(x, across, along, start, wind):
    """P = h sum A / 3 (a |u_n|^3 + b |u_t|^3)."""
    faces = torch.from_numpy(FACES.astype(np.int64))
    u = ((x - start) / H)[faces].mean(dim=1) - wind
    corner = start[faces]
    normal = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = 0.5 * normal.norm(dim=-1)
    n = normal / normal.norm(dim=-1, keepdim=True)
    u_n = (u * n).sum(dim=-1)
    u_t = u - u_n[:, None] * n
    return H * (area / 3 * (across * u_n.abs() ** 3 + along * u_t.norm(dim=-1) ** 3)).sum()


def gradient(x, values, create_graph=False):
    return torch.autograd.grad(energy(x, **values), x, create_graph=create_graph)[0]


@pytest.mark.parametrize("name", ONE_SIDED)
def test_energy_is_that_of_the_formula(name):
    values = ONE_SIDED[name]
    drag, given = kernel(values), tensors(values)
    e = [energy(torch.from_numpy(x), **given).item() for x in (X0, X1)]
    assert drag.energy(X1) == pytest.approx(e[1], rel=1e-13, abs=1e-16)
    assert drag.energy_change(X0, X1) == pytest.approx(e[1] - e[0], rel=1e-10, abs=1e-16)


def test_a_small_change_of_energy_does_not_cancel():
    step = 1e-9 * Z
    slope = (kernel(VALUES).gradient(X0) * step).sum()
    assert kernel(VALUES).energy_change(X0, X0 + step) == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize("name", ONE_SIDED)
def test_derivatives_by_positions_are_those_of_torch(name):
    values = ONE_SIDED[name]
    drag, given = kernel(values), tensors(values)
    x = torch.tensor(X1, requires_grad=True)
    np.testing.assert_allclose(drag.gradient(X1), gradient(x, given), rtol=1e-12, atol=1e-14)
    hessian = torch.autograd.functional.hessian(lambda y: energy(y, **given), x)
    hessian = hessian.reshape(18, 18).numpy()
    for positive in (False, True):
        np.testing.assert_allclose(drag.hessian(X1, positive), hessian, rtol=1e-10, atol=1e-10)
    product = (hessian @ Z.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(drag.hessian_product(X1, Z), product, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", ONE_SIDED)
def test_derivatives_by_inputs_are_those_of_torch(name):
    """Derivatives of z . grad P by each input, including coefficients that are zero."""
    values = ONE_SIDED[name]
    given = {n: t.requires_grad_() for n, t in tensors(values).items()}
    x = torch.tensor(X1, requires_grad=True)
    phi = (torch.from_numpy(Z) * gradient(x, given, create_graph=True)).sum()
    found = torch.autograd.grad(phi, list(given.values()))
    mixed = kernel(values).mixed(X1, Z)
    for n, expected in zip(given, found, strict=True):
        np.testing.assert_allclose(mixed[n], -expected, rtol=1e-10, atol=1e-12, err_msg=n)


@pytest.mark.parametrize("name", ONE_SIDED)
def test_tangents_are_derivatives_transposed(name):
    rng = np.random.default_rng(5)
    drag = kernel(ONE_SIDED[name])
    dots = {n: rng.normal(size=np.shape(value)) for n, value in VALUES.items()}
    mixed = drag.mixed(X1, Z)
    for n in INPUTS:
        alone = {m: dots[m] if m == n else np.zeros_like(dots[m]) for m in INPUTS}
        change = drag.tangent(X1, *(alone[m] for m in INPUTS))
        expected = -(mixed[n] * dots[n]).sum()
        assert (Z * change).sum() == pytest.approx(expected, rel=1e-11, abs=1e-13), n


def test_air_at_rest_resists_every_motion_and_is_convex():
    values = VALUES | {"wind": np.zeros(3)}
    drag = kernel(values)
    for x in (X0, X1):
        assert (drag.gradient(x) * (x - START)).sum() > 0
        assert np.linalg.eigvalsh(drag.hessian(x)).min() > -1e-12


def test_faces_that_move_with_the_wind_feel_nothing():
    x = START + H * VALUES["wind"]
    drag = kernel(VALUES)
    assert abs(drag.gradient(x)).max() < 1e-25
    assert abs(drag.hessian(x)).max() < 1e-9


@pytest.mark.parametrize("direction", ["across", "along"])
def test_flow_in_one_direction_alone_has_derivatives(direction):
    """If one of the two parts of the velocity vanishes, no derivative divides by this part."""
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0], [3, 3, 0]], float)
    wind = np.array([0.0, 0.0, 2.0] if direction == "across" else [2.0, 0.0, 0.0])
    drag = kernel(VALUES | {"start": flat, "wind": wind})
    mixed = drag.mixed(flat, Z)
    assert all(np.isfinite(value).all() for value in mixed.values())
    assert np.isfinite(drag.hessian(flat)).all()
    area = np.array([0.5, 0.5, 0.5])
    weights = VALUES[direction] * area
    axis = 2 if direction == "across" else 0
    total = drag.gradient(flat).sum(axis=0)
    assert total[axis] == pytest.approx(-4.0 * weights.sum(), rel=1e-14)
    assert np.delete(total, axis) == pytest.approx(np.zeros(2), abs=1e-15)


def test_a_face_without_area_feels_nothing():
    line = np.zeros((6, 3))
    line[:, 0] = np.arange(6)
    drag = kernel(VALUES | {"start": line})
    assert not drag.gradient(X1).any()
    assert all(np.isfinite(value).all() for value in drag.mixed(X1, Z).values())
