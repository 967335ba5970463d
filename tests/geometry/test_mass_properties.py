"""Mass, center and inertia of closed meshes, and of dynamic bodies."""

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.geometry import shapes
from diffcloth_torch.geometry.mass_properties import check_inertia, is_closed, mass_properties
from diffcloth_torch.geometry.poses import rotation_matrix

TURN = rotation_matrix(np.array([0.7, 0.3, -0.5, 0.4]))


def box_inertia(a, b, c):
    return np.diag([b * b + c * c, a * a + c * c, a * a + b * b]) * a * b * c / 12


@pytest.mark.parametrize("segments", [(1, 1, 1), (3, 2, 4)])
def test_a_box_has_the_inertia_of_the_textbook(segments):
    size = np.array([0.3, 0.5, 0.7])
    volume, center, inertia = mass_properties(*shapes.box(size, segments))
    assert volume == pytest.approx(size.prod(), rel=1e-14)
    np.testing.assert_allclose(center, 0, atol=1e-16)
    np.testing.assert_allclose(inertia, box_inertia(*size), rtol=1e-13, atol=1e-18)


def test_a_far_and_turned_mesh_has_the_same_moments():
    """About the center only the axes change; rounding grows only with the distance."""
    vertices, faces = shapes.capsule(0.2, 0.5)
    volume, center, inertia = mass_properties(vertices, faces)
    far = np.array([100.0, -200.0, 300.0])
    moved = mass_properties(vertices @ TURN.T + far, faces)
    assert moved[0] == pytest.approx(volume, rel=1e-11)
    np.testing.assert_allclose(moved[1], TURN @ center + far, rtol=1e-14)
    np.testing.assert_allclose(
        moved[2], TURN @ inertia @ TURN.T, rtol=0, atol=1e-11 * inertia.max()
    )


@pytest.mark.parametrize(
    "mesh", [shapes.sphere(0.3, 2), shapes.capsule(0.1, 0.4), shapes.cylinder(0.2, 0.3)]
)
def test_moments_are_those_of_trimesh(mesh):
    trimesh = pytest.importorskip("trimesh")
    vertices = mesh[0] @ TURN.T + [0.1, 0.2, 0.3]
    vertices[:, :2] *= 1.5 + 2 * vertices[:, 2:]  # no symmetry, and uneven triangles
    volume, center, inertia = mass_properties(vertices, mesh[1])
    expected = trimesh.Trimesh(vertices, mesh[1], process=False).mass_properties
    assert volume == pytest.approx(expected.mass, rel=1e-12)
    np.testing.assert_allclose(center, expected.center_mass, rtol=1e-12)
    np.testing.assert_allclose(inertia, expected.inertia, rtol=0, atol=1e-12 * inertia.max())


def test_moments_are_those_of_points_inside():
    rng = np.random.default_rng(0)
    corners = rng.standard_normal((4, 3))
    if np.linalg.det(corners[1:] - corners[0]) < 0:
        corners = corners[[0, 2, 1, 3]]
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    volume, center, inertia = mass_properties(corners, faces)
    points = rng.dirichlet(np.ones(4), 400_000) @ corners  # evenly spread over a tetrahedron
    np.testing.assert_allclose(center, corners.mean(axis=0), atol=1e-14)
    x = points - points.mean(axis=0)
    expected = volume * ((x**2).sum() / len(x) * np.eye(3) - x.T @ x / len(x))
    # Means over 4e5 points scatter by some 1 / sqrt(4e5) = 0.2 %.
    np.testing.assert_allclose(inertia, expected, rtol=0, atol=0.01 * inertia.max())


def test_closed_means_closed_and_of_one_orientation():
    vertices, faces = shapes.box(np.ones(3))
    assert is_closed(faces)
    assert not is_closed(faces[1:])
    flipped = faces.copy()
    flipped[0] = flipped[0, ::-1]
    assert not is_closed(flipped)
    assert is_closed(np.concatenate([faces, faces + 8]))
    assert not is_closed(shapes.plane(np.ones(2))[1])
    assert mass_properties(vertices, faces[:, ::-1])[0] == pytest.approx(-1)


@pytest.mark.parametrize(
    ("inertia", "message"),
    [
        (np.eye(2), r"shape \[3, 3\], got \[2, 2\]"),
        (np.diag([1, 1, np.nan]), "finite, got nan"),
        ([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]], r"symmetric, got 0.1 at \[0, 1\] and 0 at \[1, 0\]"),
        (np.diag([0, 1, 1]), "positive definite, got principal moments 0, 1, 1"),
        (np.diag([-1, 1, 1]), "positive definite"),
        (np.zeros((3, 3)), "positive definite"),
        (np.diag([1, 2, 3.1]), "no principal moment above the sum of the other two, .*1, 2, 3.1"),
    ],
)
def test_an_inertia_that_no_body_has_is_refused(inertia, message):
    with pytest.raises(dc.InvalidInput, match=f"^here must .*{message}"):
        check_inertia("here", np.asarray(inertia, dtype=np.float64))


def test_an_inertia_is_accepted_within_rounding():
    flat = np.diag([1.0, 2.0, 3.0 * (1 + 1e-9)])  # a plate: the sum exactly
    flat[0, 1] = 1e-9
    checked = check_inertia("here", flat)
    np.testing.assert_array_equal(checked, checked.T)


# --- Bodies ---------------------------------------------------------------------------------------


def dynamic(**keywords):
    return dc.RigidBody.box([0.3, 0.5, 0.7], motion="dynamic", **keywords)


def test_a_dynamic_body_is_filled_evenly():
    volume = 0.3 * 0.5 * 0.7
    by_density, by_mass = dynamic(density=200), dynamic(mass=200 * volume)
    for body in (by_density, by_mass):
        assert body.mass == pytest.approx(200 * volume)
        np.testing.assert_allclose(body.center, 0, atol=1e-16)
        np.testing.assert_allclose(body.inertia, 200 * box_inertia(0.3, 0.5, 0.7), atol=1e-15)
    assert by_mass.mass == 200 * volume  # to the bit


def test_given_mass_properties_are_kept():
    center, inertia = [0.1, 0, 0], np.diag([1.0, 2, 2])
    body = dynamic(mass=3, center=center, inertia=inertia)
    assert body.mass == 3
    np.testing.assert_array_equal(body.center, center)
    np.testing.assert_array_equal(body.inertia, inertia)
    np.testing.assert_array_equal(dynamic(density=1, inertia=inertia).inertia, inertia)
    np.testing.assert_array_equal(dynamic(mass=1, center=center).inertia, dynamic(mass=1).inertia)
    plane = dc.RigidBody.plane(1.0, motion="dynamic", mass=3, center=center, inertia=inertia)
    np.testing.assert_array_equal(plane.inertia, inertia)
    inward = dc.RigidBody(
        body.vertices, body.faces[:, ::-1], motion="dynamic", mass=3, center=center, inertia=inertia
    )
    assert inward.mass == 3


def test_bodies_that_no_force_moves_have_no_mass():
    body = dc.RigidBody.box(1.0, motion="kinematic")
    assert body.mass == 0
    assert not body.center.any()
    assert not body.inertia.any()


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: dynamic(), dc.InvalidInput, "`density` or `mass`, one of them, got neither"),
        (lambda: dynamic(density=1, mass=1), dc.InvalidInput, "one of them, got both"),
        (lambda: dynamic(density=0), dc.InvalidInput, "`density` must be finite and > 0"),
        (lambda: dynamic(mass=-1), dc.InvalidInput, "`mass` must be finite and > 0, got -1"),
        (lambda: dynamic(mass="1"), TypeError, "`mass` must hold real numbers"),
        (
            lambda: dynamic(mass=1, center=[0, 0]),
            dc.InvalidInput,
            r"`center` must have shape \[3\]",
        ),
        (
            lambda: dynamic(mass=1, inertia=-np.eye(3)),
            dc.InvalidInput,
            "`inertia` must be positive",
        ),
        (
            lambda: dynamic(mass=torch.ones((), requires_grad=True)),
            dc.InvalidInput,
            "differentiate with respect to Parameters.body_mass instead",
        ),
        (lambda: dc.RigidBody.box(1.0, mass=1), dc.InvalidInput, '`mass` needs motion="dynamic"'),
        (
            lambda: dc.RigidBody.box(1.0, motion="kinematic", inertia=np.eye(3)),
            dc.InvalidInput,
            "`inertia` needs motion=\"dynamic\", got 'kinematic'",
        ),
        (
            lambda: dc.RigidBody.plane(1.0, motion="dynamic", mass=1),
            dc.InvalidInput,
            "`mass`, `center` and `inertia` where its mesh is not closed",
        ),
        (
            lambda: dc.RigidBody.plane(
                1.0, motion="dynamic", density=1, center=[0, 0, 0], inertia=np.eye(3)
            ),
            dc.InvalidInput,
            "where its mesh is not closed",
        ),
        (
            lambda: dc.RigidBody(*_inward(), motion="dynamic", mass=1),
            dc.InvalidInput,
            "must face outward, so that it holds a volume > 0, got -1 m",
        ),
        (
            lambda: dc.RigidBody(*_flat(0.0), motion="dynamic", mass=1),
            dc.InvalidInput,
            "a volume > 0, got 0 m",
        ),
        (
            lambda: dc.RigidBody(*_flat(1e-16), motion="dynamic", density=1),
            dc.InvalidInput,
            "a volume > 0, got .*e-17 m",
        ),
    ],
)
def test_bad_mass_properties_are_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()


def _flat(height):
    """A closed tetrahedron of nearly zero height."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, height]])
    return vertices, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]


def _inward():
    vertices, faces = shapes.box(np.ones(3))
    return vertices, faces[:, ::-1]


def test_a_cylinder_is_one():
    body = dc.RigidBody.cylinder(0.1, 0.4, motion="dynamic", density=1000, name="can")
    assert body.name == "can"
    # Inscribed with 30 segments: sin(12 degrees) / (12 degrees in radians) = 0.9927 of the area.
    assert body.mass == pytest.approx(1000 * np.pi * 0.01 * 0.4 * 0.9927, rel=1e-4)
    np.testing.assert_allclose(body.vertices[:, 2].max(), 0.2)
    with pytest.raises(dc.InvalidInput, match=r"RigidBody.cylinder: `length` must be .*> 0"):
        dc.RigidBody.cylinder(0.1, 0.0)
    with pytest.raises(dc.InvalidInput, match=r"RigidBody.cylinder: `rings` must be at least 1"):
        dc.RigidBody.cylinder(0.1, 0.4, rings=0)
    assert len(dc.RigidBody.cylinder(0.1, 0.1, rings=8).faces) == 2 * 6 * 8**2 + 2 * 48
