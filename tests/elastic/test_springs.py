"""Springs between points and to targets, against their formula and differences."""

import numpy as np
import pytest
from elastic_meshes import differences

from diffcloth_torch import _kernels

RNG = np.random.default_rng(9)
# Two soft pins on one vertex; a point of a face to a target; a face to four vertices of a body.
START = np.array([0, 1, 2, 5, 12], np.int32)
POINT = np.array([1, 1, 0, 2, 3, 0, 2, 4, 5, 6, 7, 8], np.int32)
COEFFICIENT = np.array([1, 1, 0.2, 0.3, 0.5, 0.3, 0.3, 0.4, 0.6, -1.4, 0.3, -0.5])
TARGET_ROW = np.array([1, 0, 2, -1], np.int32)
STIFFNESS = np.array([2.0, 3.0, 0.5, 1.5])
TARGET = RNG.normal(size=(3, 3))
X0, X1, Z = RNG.normal(size=(3, 9, 3))
RESTS = {
    "none": np.zeros(4),
    "stretched": np.full(4, 0.01),
    "compressed": np.full(4, 20.0),
    "mixed": np.array([0.0, 0.4, 5.0, 0.3]),
}


def springs(x1=X1, stiffness=STIFFNESS, target=TARGET, x0=X0, rest=RESTS["mixed"], positive=False):
    arguments = (START, POINT, COEFFICIENT, stiffness, rest, TARGET_ROW, target)
    kernel = _kernels.Springs(*arguments, len(x1))
    return {
        "energy": kernel.energy(x1),
        "energy_change": kernel.energy_change(x0, x1),
        "gradient": kernel.gradient(x1),
        "hessian": kernel.hessian(x1, positive),
        "hessian_product": kernel.hessian_product(x1, Z),
        "left_out_product": kernel.left_out_product(x1, Z, positive),
        "hessians": kernel.hessians(x1, positive),
        "mixed": kernel.mixed(x1, Z),
    }


def maps():
    """B of each spring, [4, 9]."""
    rows = np.zeros((4, 9))
    for a in range(4):
        np.add.at(rows[a], POINT[START[a] : START[a + 1]], COEFFICIENT[START[a] : START[a + 1]])
    return rows


def ends(x):
    d = maps() @ x
    d[:3] -= TARGET[TARGET_ROW[:3]]
    return d


@pytest.mark.parametrize("name", RESTS)
def test_energy_is_that_of_springs(name):
    rest = RESTS[name]
    stretch = np.linalg.norm(ends(X1), axis=1) - rest
    assert np.isclose(springs(rest=rest)["energy"], 0.5 * (STIFFNESS * stretch**2).sum(), 1e-14)
    change = springs(rest=rest)["energy"] - springs(X0, rest=rest)["energy"]
    assert np.isclose(springs(rest=rest)["energy_change"], change, rtol=1e-12)


@pytest.mark.parametrize("name", RESTS)
def test_derivatives_match_differences(name):
    rest = RESTS[name]
    out = springs(rest=rest)
    g = differences(lambda x: springs(x, rest=rest)["energy"], X1, 1e-4).reshape(X1.shape)
    Hz = differences(lambda t: springs(X1 + t[0] * Z, rest=rest)["gradient"], np.zeros(1), 1e-4)[
        ..., 0
    ]
    np.testing.assert_allclose(out["gradient"], g, atol=2e-6)
    np.testing.assert_allclose(out["hessian_product"], Hz, atol=2e-6)
    B = maps()
    dense = np.einsum("ap,aij,aq,qj->pi", B, out["hessians"], B, Z)
    np.testing.assert_allclose(out["hessian_product"], dense, atol=1e-13)
    np.testing.assert_allclose(out["left_out_product"], dense, atol=1e-13)
    np.testing.assert_allclose(out["hessian"] @ Z.ravel(), dense.ravel(), atol=1e-13)


@pytest.mark.parametrize("name", RESTS)
def test_mixed_derivatives_match_differences(name):
    rest = RESTS[name]
    out = springs(rest=rest)
    k = differences(
        lambda k: (Z * springs(stiffness=k, rest=rest)["gradient"]).sum(), STIFFNESS, 1e-4
    )
    c = differences(lambda c: (Z * springs(target=c, rest=rest)["gradient"]).sum(), TARGET, 1e-4)
    np.testing.assert_allclose(out["mixed"]["stiffness"], -k, atol=2e-6)
    np.testing.assert_allclose(out["mixed"]["target"], -c.reshape(TARGET.shape), atol=2e-6)


@pytest.mark.parametrize("name", RESTS)
def test_the_positive_hessian_is_semi_definite_and_exact_where_springs_pull(name):
    rest = RESTS[name]
    exact = springs(rest=rest)["hessians"]
    positive = springs(rest=rest, positive=True)["hessians"]
    assert np.linalg.eigvalsh(positive).min() > -1e-14
    pulls = np.linalg.norm(ends(X1), axis=1) >= rest
    np.testing.assert_array_equal(positive[pulls], exact[pulls])
    if not pulls.all():
        assert np.linalg.eigvalsh(exact[~pulls]).min() < 0.0


def test_ends_that_coincide_pull_nowhere():
    target = TARGET.copy()
    target[TARGET_ROW[0]] = X1[POINT[0]]
    out = springs(target=target, rest=np.array([0.2, 0.0, 0.0, 0.0]))
    assert not out["hessians"][0].any()
    assert np.isfinite(out["energy_change"])
    with_none = springs(
        target=target, rest=np.zeros(4), stiffness=STIFFNESS * np.array([0, 1, 1, 1])
    )
    np.testing.assert_array_equal(out["gradient"], with_none["gradient"])
