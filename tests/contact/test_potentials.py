"""The potentials of contact and friction: their sum over features, and every derivative."""

import contact_scenes
import numpy as np
import pytest
import trimesh
from oracles.feature_sum import FeatureSum

from diffcloth_torch import _kernels as kernels

NAMES = list(contact_scenes.SCENES)
MEASURES = ("vertex_area", "edge_area", "edge_length_sq", "face_area", "mean_face_area")


def energy(potential, x):
    return potential.energies(x, x)[0].sum()


def difference(f, x, d, step):
    """Central difference of fourth order along d."""
    return (
        sum(
            w * f(x + k * step * d)
            for k, w in ((-2, 1 / 12), (-1, -2 / 3), (1, 2 / 3), (2, -1 / 12))
        )
        / step
    )


def directions(shape, count=4, seed=3):
    return np.random.default_rng(seed).normal(size=(count, *shape))


@pytest.mark.parametrize("scale", [1e-4, 1e-3, 1e-2, 0.1])
@pytest.mark.parametrize("name", ["on_relief", "on_a_ball", "crumpled"])
def test_the_safe_fraction_is_the_least_of_all_pairs(name, scale):
    """A random walk with kept pairs: pairs that are omitted as harmless do not limit the step."""
    scene = contact_scenes.make(name)
    potential = scene.potential()
    mesh = kernels.BroadPhase(
        scene.faces.astype(np.int32), scene.surface, scene.cloth_count, scene.self_contact, scene.X
    )
    rng = np.random.default_rng(4)
    at, fractions = scene.x, []
    for _ in range(12):
        to = at + scale * rng.normal(size=at.shape) * ~scene.prescribed[:, None]
        steps = [1.0]
        pairs = mesh.find(at, to, 0.2)
        for kind in (0, 1):
            corners = pairs[pairs[:, 0] == kind, 1:5]
            steps += list(kernels.safe_step(bool(kind), at[corners], to[corners], 0.0, scene.d_hat))
        fractions.append(potential.safe_fraction(at, to))
        # A search ends when its advance is less than 1e-12 of the time.
        assert fractions[-1] == pytest.approx(min(steps), rel=1e-11)
        at = at + 0.9 * fractions[-1] * (to - at)
    assert (min(fractions) < 1) == (scale > 1e-3)


@pytest.mark.quick(
    "on_relief-0",
    "on_a_ball-0",
    "on_a_lump-0",
    "on_a_corner-0",
    "on_a_triangle-0",
    "on_slivers-0",
    "two_cloths-0",
    "crumpled-0",
    "pinned-0",
    "pinned_under_a_body-0",
    "thick-0",
    "two_lumps-0",
    "box_on_relief-0",
    "boxes_aslant-0",
    "ridges_across-0",
    "between_bodies-0",
    "on_a_round_ball-0",
    "on_a_capsule-0",
    "on_a_short_capsule-0",
    "along_a_capsule-0",
    "round_on_relief-0",
    "round_on_a_box-0",
    "round_heap-0",
)
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", NAMES)
def test_the_energy_is_the_sum_over_all_features(name, seed):
    scene = contact_scenes.make(name, seed)
    expected = FeatureSum(scene).energy(scene.x)
    assert expected > 1e-6
    # Distances of ipctk agree to 1e-12; the sum has terms of both signs.
    np.testing.assert_allclose(energy(scene.potential(), scene.x), expected, rtol=1e-10)


@pytest.mark.parametrize("name", NAMES)
def test_contacts_are_where_they_say(name):
    scene = contact_scenes.make(name)
    potential = scene.potential()
    corners, c, weight, distance = potential.contacts(scene.x)
    t = np.einsum("ki,kij->kj", c, scene.x[corners])
    np.testing.assert_allclose(np.linalg.norm(t, axis=1), distance, rtol=1e-9)
    xi = max(scene.thickness, default=0.0) + sum(sorted(scene.radius)[-2:])
    assert (distance < 0.1 + xi).all()
    assert (weight != 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_the_gradient_is_that_of_the_energy(name):
    scene = contact_scenes.make(name)
    potential = scene.potential()
    g = potential.gradient(scene.x).ravel()
    assert np.abs(g).max() > 1e-4
    for d in directions(scene.x.shape):
        # Far below the width of the slivers, 1.5e-5.
        found = difference(lambda x: energy(potential, x), scene.x, d, 1e-7)
        assert found == pytest.approx(g @ d.ravel(), abs=1e-7 * np.linalg.norm(g))


@pytest.mark.parametrize("name", NAMES)
def test_the_hessian_is_that_of_the_gradient(name):
    scene = contact_scenes.make(name)
    potential = scene.potential()
    h = potential.hessian(scene.x)
    np.testing.assert_allclose(h, h.T, atol=1e-12 * np.abs(h).max())
    for d in directions(scene.x.shape):
        found = difference(potential.gradient, scene.x, d, 1e-7)
        product = potential.hessian_product(scene.x, d)
        scale = np.abs(product).max()
        np.testing.assert_allclose(found, product, atol=2e-6 * scale)
        np.testing.assert_allclose(h @ d.ravel(), product.ravel(), atol=1e-11 * scale)


@pytest.mark.parametrize("name", NAMES)
def test_the_projected_hessian_is_positive(name):
    scene = contact_scenes.make(name)
    for h in (
        scene.potential().hessian(scene.x, positive=True),
        scene.potential().friction(scene.x, scene.x).hessian(scene.x + 0.01, positive=True),
    ):
        lowest, highest = np.linalg.eigvalsh(h)[[0, -1]]
        assert highest > 0
        assert lowest > -1e-12 * highest


@pytest.mark.parametrize("seed", range(2))
def test_the_projected_hessian_is_no_smaller_than_the_exact_one(seed):
    """This includes nearly parallel edges, whose curvature is mostly due to the mollifier."""
    scene = contact_scenes.make("two_cloths", seed)
    potential = scene.potential()
    positive = potential.hessian(scene.x, positive=True)
    lowest = np.linalg.eigvalsh(positive - potential.hessian(scene.x))[0]
    assert lowest > -1e-12 * np.abs(positive).max()


def parameter_of(scene, name):
    count = scene.surface_count
    if name == "kappa":
        return scene.kappa.ravel()
    if name == "thickness":
        return np.array(scene.thickness or [1e-3] * count)
    if name == "friction":
        return 0.1 + np.arange(count**2) / count**2
    return np.array(getattr(scene, name))


def with_measure(scene, name, values, **changes):
    potential = scene.potential(**changes)
    potential.set_measure(name, values.tolist())
    return potential


def check_parameters(scene, found, value):
    """Compare the cotangents `found` with difference quotients of `value(potential)`."""
    if not scene.thickness:
        scene.thickness = parameter_of(scene, "thickness").tolist()
    scale = max(np.abs(v).max(initial=0) for k, v in found.items() if k != "x_lag")
    assert scale > 0
    for name in ("kappa", "d_hat", "slip", "thickness", "friction"):
        at = parameter_of(scene, name)
        for d in directions(at.shape, 2):
            expected = np.sum(found[name] * d)
            step = 1e-5 * np.abs(at).max()
            slope = difference(
                lambda v, name=name: value(scene.potential(**{name: v.tolist()})), at, d, step
            )
            assert slope == pytest.approx(expected, rel=2e-6, abs=1e-9 * scale), name
    for name in MEASURES:
        at = np.array(scene.potential().measure(name))
        if not at.any():  # of skeletons, or without cloths
            continue
        for d in directions(at.shape, 2):
            d *= at > 0
            expected = np.sum(found[name] * d)
            slope = difference(
                lambda v, name=name: value(with_measure(scene, name, v)), at, d, 1e-5 * at.max()
            )
            assert slope == pytest.approx(expected, rel=2e-6, abs=1e-9 * scale), name


@pytest.mark.parametrize("name", NAMES)
def test_mixed_derivatives_are_those_of_the_gradient(name):
    scene = contact_scenes.make(name)
    if not scene.thickness:
        scene.thickness = parameter_of(scene, "thickness").tolist()
    for z in directions(scene.x.shape, 1, seed=8):
        found = scene.potential().mixed(scene.x, z)
        check_parameters(scene, found, lambda p, z=z: (p.gradient(scene.x) * z).sum())


def moved(scene, amount, seed=5):
    return scene.x + amount * np.random.default_rng(seed).normal(size=scene.x.shape)


def rotation(angle, seed):
    axis = np.random.default_rng(seed).normal(size=3)
    return trimesh.transformations.rotation_matrix(angle, axis)[:3, :3]


# Displacements against the slip of 0.02: sticking, sliding.
@pytest.mark.parametrize("amount", [0.003, 0.05])
@pytest.mark.parametrize("name", NAMES)
def test_friction_has_the_derivatives_of_its_energy(name, amount):
    scene = contact_scenes.make(name)
    potential = scene.potential()
    start, x = moved(scene, amount), moved(scene, amount, 6)
    friction = potential.friction(scene.x, start)
    g, h = friction.gradient(x), friction.hessian(x)
    for d in directions(x.shape, 2):
        slope = difference(lambda at: friction.energy_change(start, at), x, d, 1e-7)
        assert slope == pytest.approx((g * d).sum(), abs=1e-7 * np.linalg.norm(g))
        curvature = difference(friction.gradient, x, d, 1e-7)
        product = friction.hessian_product(x, d)
        scale = np.abs(product).max()
        np.testing.assert_allclose(curvature, product, atol=1e-5 * scale)
        np.testing.assert_allclose(h @ d.ravel(), product.ravel(), atol=1e-11 * scale)


# At the start itself every displacement is exactly zero. Scenes have entries of all kinds, and
# counts that are no multiples of the lanes.
@pytest.mark.parametrize("amount", [0.0, 0.003, 0.05])
@pytest.mark.parametrize("name", NAMES)
def test_slips_in_lanes_are_those_of_single_entries(name, amount):
    scene = contact_scenes.make(name)
    start, x = moved(scene, amount), moved(scene, amount, 6 if amount else 5)
    friction = scene.potential().friction(scene.x, start)
    p = directions(x.shape, 1)[0]
    alone = friction.slips(x, p, "")
    assert len(alone) > 0
    for level in kernels.kernel_levels():
        found = friction.slips(x, p, level)
        np.testing.assert_array_equal(found[:, :20], alone[:, :20])
        # Changes by differences of 1e-6, whose error is 1e-10 over the step.
        np.testing.assert_allclose(
            found[:, 20:], alone[:, 20:], atol=1e-7 * np.abs(alone[:, 20:]).max()
        )


@pytest.mark.quick(
    "on_relief-0.003-0.0",
    "on_relief-0.003-1.6",
    "on_relief-0.05-0.5",
    "on_a_ball-0.003-0.0",
    "on_a_ball-0.003-1.6",
    "on_a_ball-0.05-0.5",
    "on_a_lump-0.003-0.0",
    "on_a_lump-0.003-1.6",
    "on_a_lump-0.05-0.5",
    "on_a_corner-0.003-0.0",
    "on_a_corner-0.003-1.6",
    "on_a_corner-0.05-0.5",
    "on_a_triangle-0.003-0.0",
    "on_a_triangle-0.003-1.6",
    "on_a_triangle-0.05-0.5",
    "on_slivers-0.003-0.0",
    "on_slivers-0.003-1.6",
    "on_slivers-0.05-0.5",
    "two_cloths-0.003-0.0",
    "two_cloths-0.003-1.6",
    "two_cloths-0.05-0.5",
    "crumpled-0.003-0.0",
    "crumpled-0.003-1.6",
    "crumpled-0.05-0.5",
    "pinned-0.003-0.0",
    "pinned-0.003-1.6",
    "pinned-0.05-0.5",
    "pinned_under_a_body-0.003-0.0",
    "pinned_under_a_body-0.003-1.6",
    "pinned_under_a_body-0.05-0.5",
    "thick-0.003-0.0",
    "thick-0.003-1.6",
    "thick-0.05-0.5",
    "two_lumps-0.003-0.0",
    "two_lumps-0.003-1.6",
    "two_lumps-0.05-0.5",
    "box_on_relief-0.003-0.0",
    "box_on_relief-0.003-1.6",
    "box_on_relief-0.05-0.5",
    "boxes_aslant-0.003-0.0",
    "boxes_aslant-0.003-1.6",
    "boxes_aslant-0.05-0.5",
    "ridges_across-0.003-0.0",
    "ridges_across-0.003-1.6",
    "ridges_across-0.05-0.5",
    "between_bodies-0.003-0.0",
    "between_bodies-0.003-1.6",
    "between_bodies-0.05-0.5",
    "on_a_round_ball-0.003-0.0",
    "on_a_round_ball-0.003-1.6",
    "on_a_round_ball-0.05-0.5",
    "on_a_capsule-0.003-0.0",
    "on_a_capsule-0.003-1.6",
    "on_a_capsule-0.05-0.5",
    "on_a_short_capsule-0.003-0.0",
    "on_a_short_capsule-0.003-1.6",
    "on_a_short_capsule-0.05-0.5",
    "along_a_capsule-0.003-0.0",
    "along_a_capsule-0.003-1.6",
    "along_a_capsule-0.05-0.5",
    "round_on_relief-0.003-0.0",
    "round_on_relief-0.003-1.6",
    "round_on_relief-0.05-0.5",
    "round_on_a_box-0.003-0.0",
    "round_on_a_box-0.003-1.6",
    "round_on_a_box-0.05-0.5",
    "round_heap-0.003-0.0",
    "round_heap-0.003-1.6",
    "round_heap-0.05-0.5",
)
@pytest.mark.parametrize("angle", [0.0, 0.5, 1.6])
@pytest.mark.parametrize("amount", [0.003, 0.05])
@pytest.mark.parametrize("name", NAMES)
def test_mixed_derivatives_of_friction(name, amount, angle):
    """Frames of gaps rotate, also by angles at which start gaps are not scaled to lagged ones."""
    scene = contact_scenes.make(name)
    if not scene.thickness:
        scene.thickness = parameter_of(scene, "thickness").tolist()
    start, x = moved(scene, amount) @ rotation(angle, 3).T, moved(scene, amount, 6)
    z = directions(x.shape, 1, seed=8)[0]

    def value(potential, lag=scene.x):
        return (potential.friction(lag, start).gradient(x) * z).sum()

    found = scene.potential().friction_mixed(scene.x, start, x, z)
    check_parameters(scene, found, value)
    for d in directions(x.shape, 3):
        slope = difference(lambda lag: value(scene.potential(), lag), scene.x, d, 1e-7)
        expected = found["x_lag"] @ d.ravel()
        assert slope == pytest.approx(expected, abs=2e-6 * np.linalg.norm(found["x_lag"]))
        slope = difference(
            lambda at: (scene.potential().friction(scene.x, at).gradient(x) * z).sum(),
            start,
            d,
            1e-7,
        )
        expected = found["x_start"] @ d.ravel()
        assert slope == pytest.approx(expected, abs=2e-6 * np.linalg.norm(found["x_start"]))


def random_tangents(found, seed=9):
    """A direction of everything that a dictionary of cotangents has."""
    rng = np.random.default_rng(seed)
    return {name: rng.normal(size=np.shape(bar)).tolist() for name, bar in found.items()}


def pairing(found, dot):
    """Pairing of cotangents and tangents, and the sum of the absolute values of its terms."""
    terms = [np.dot(np.ravel(bar), np.ravel(dot[name])) for name, bar in found.items()]
    return sum(terms), sum(abs(term) for term in terms)


@pytest.mark.parametrize("name", NAMES)
def test_tangents_are_mixed_derivatives_transposed(name):
    scene = contact_scenes.make(name)
    for z in directions(scene.x.shape, 2, seed=8):
        found = scene.potential().mixed(scene.x, z)
        dot = random_tangents(found)
        expected, size = pairing(found, dot)
        y = scene.potential().tangent(scene.x, dot)
        # Both are sums of the same products.
        assert (y * z).sum() == pytest.approx(expected, abs=1e-12 * size)
        assert size > 0


@pytest.mark.parametrize("angle", [0.0, 0.5, 1.6])
@pytest.mark.parametrize("amount", [0.003, 0.05])
@pytest.mark.parametrize("name", NAMES)
def test_tangents_of_friction_are_mixed_derivatives_transposed(name, amount, angle):
    """Frames of gaps rotate, also by angles at which start gaps are not scaled to lagged ones."""
    scene = contact_scenes.make(name)
    start, x = moved(scene, amount) @ rotation(angle, 3).T, moved(scene, amount, 6)
    for z in directions(scene.x.shape, 2, seed=8):
        found = scene.potential().friction_mixed(scene.x, start, x, z)
        dot = random_tangents(found)
        dot["x_start"], dot["x_lag"] = np.array(dot["x_start"]), np.array(dot["x_lag"])
        expected, size = pairing(found, dot)
        y = scene.potential().friction_tangent(scene.x, start, x, dot)
        # Both are sums of the same products.
        assert (y * z).sum() == pytest.approx(expected, abs=1e-11 * size)
        assert size > 0


def test_contacts_that_are_expected_to_slide_are_as_soft_as_there():
    """At rest the curvature is the sticking curvature, which is thousands of times larger."""
    scene = contact_scenes.make("two_cloths")
    potential = scene.potential(slip=1e-6)
    slide = np.zeros_like(scene.x)
    slide[scene.surface == 0] = [2e-3, 1e-3, 0.0]
    friction = potential.friction(scene.x, scene.x)
    at_rest = friction.hessian(scene.x)
    sliding = friction.hessian(scene.x + slide, True)
    expects, h, positive = friction.expecting(scene.x, scene.x + slide)
    along = slide.ravel()
    assert expects
    assert along @ h @ along == pytest.approx(along @ sliding @ along, rel=1e-6)
    np.testing.assert_array_equal(h, positive)
    assert along @ at_rest @ along > 1e3 * (along @ h @ along)
    np.testing.assert_array_equal(friction.hessian(scene.x), at_rest)  # the exact one stays
    # A step ends the expectation.
    friction.after(scene.x, slide)
    np.testing.assert_array_equal(friction.hessian(scene.x, True), at_rest)


def test_nothing_is_expected_where_all_sticks():
    scene = contact_scenes.make("two_cloths")
    friction = scene.potential(slip=1e-6).friction(scene.x, scene.x)
    shift = np.zeros_like(scene.x)
    shift[scene.surface == 0] = [3e-8, 0.0, 0.0]
    expects, h, positive = friction.expecting(scene.x, scene.x + shift)
    assert not expects
    exact = friction.hessian(scene.x)
    np.testing.assert_array_equal(h, exact)
    np.testing.assert_array_equal(positive, exact)


@pytest.mark.parametrize("name", ["pinned_under_a_body", "on_a_capsule", "boxes_aslant"])
def test_nothing_is_expected_of_bodies_that_forces_move(name):
    """Objects held by such bodies often stick, even if inertia alone would move them."""
    scene = contact_scenes.make(name)
    friction = scene.potential(slip=1e-6).friction(scene.x, scene.x)
    slide = np.zeros_like(scene.x)
    slide[scene.surface == 0] = [2e-3, 1e-3, 0.0]
    assert np.abs(friction.gradient(scene.x + slide)).max() > 1e-4  # the contact would slide
    exact = friction.hessian(scene.x)
    expects, h, _ = friction.expecting(scene.x, scene.x + slide)
    assert not expects
    np.testing.assert_array_equal(h, exact)


@pytest.mark.parametrize("name", ["two_cloths", "on_a_lump", "on_relief"])
def test_duals_remember_the_other_side_of_a_kink(name):
    """A slip that reverses: no exact curvature, but twice the majorant's curvature with duals.

    The majorant omits contacts of negative weight, whose duals would reduce the curvature.
    """
    scene = contact_scenes.make(name)
    potential = scene.potential(slip=1e-6)
    slide = np.zeros_like(scene.x)
    slide[scene.surface == 0] = [2e-3, 1e-3, 0.0]
    x = scene.x + slide
    has_duals, h = potential.friction(scene.x, scene.x).after(x, -2 * slide)
    majorant, exact = (
        potential.friction(scene.x, scene.x).hessian(scene.x - slide, positive)
        for positive in (True, False)
    )
    along = slide.ravel()
    most = along @ majorant @ along
    assert has_duals
    assert abs(along @ exact @ along) < 1e-9 * most
    assert along @ h @ along == pytest.approx(2 * most, rel=1e-6)
    # A step that stays on one side of the kink has no duals.
    has_duals, h = potential.friction(scene.x, scene.x).after(x, -0.5 * slide)
    assert not has_duals
    exact = potential.friction(scene.x, scene.x).hessian(scene.x + 0.5 * slide)
    np.testing.assert_allclose(h, exact, rtol=1e-9, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize("lag", ["start", "end"])
@pytest.mark.parametrize("angle", [1e-3, 0.1, 1.0])
@pytest.mark.parametrize("name", NAMES)
def test_common_rigid_motion_has_no_friction(name, angle, lag):
    """Rigid motion of all bodies and cloths, lagged at either end, for any slip velocity."""
    scene = contact_scenes.make(name)
    potential = scene.potential(slip=1e-9)
    start = scene.x
    end = start @ rotation(angle, 1).T + [0.3, -0.2, 0.5]
    friction = potential.friction({"start": start, "end": end}[lag], start)
    g, sliding = friction.gradient(end), friction.gradient(moved(scene, 0.003, 6))
    # Rounding of positions divided by the slip, relative to full friction.
    assert np.abs(g).max() < 1e-5 * np.abs(sliding).max()
    assert abs(friction.energy_change(start, end)) < 1e-13


# Sticking and sliding, against gaps of some .02 and a slip of .02.
@pytest.mark.parametrize("amount", [0.003, 0.05])
@pytest.mark.parametrize("angle", [0.0, 0.6])
@pytest.mark.parametrize("name", NAMES)
def test_friction_has_no_couple(name, angle, amount):
    """At the lagged positions, for any change and rotation of the gap since the start."""
    scene = contact_scenes.make(name)
    start = moved(scene, 1e-4)
    rng = np.random.default_rng(7)
    for k in range(scene.surface_count):
        here = scene.surface == k
        own = rotation(0.1 * angle, k) @ rotation(0.9 * angle, 3)
        start[here] = start[here] @ own.T + amount * rng.normal(size=3)
    friction = scene.potential().friction(scene.x, start)
    g = friction.gradient(scene.x)
    assert np.abs(g).max() > 1e-6
    np.testing.assert_allclose(g.sum(axis=0), 0, atol=1e-13 * np.abs(g).sum())
    couple = np.cross(scene.x, g).sum(axis=0)
    np.testing.assert_allclose(couple, 0, atol=1e-12 * np.abs(g).sum())


def edge_to_edge(degrees):
    """Two triangles whose first edges cross at an angle, one above the other."""
    edge = np.array([[-0.22, 0, 0], [0.22, 0, 0], [0.02, 0.01, 0.3]])
    faces = np.array([[0, 1, 2]])
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 0, 1])[:3, :3]
    other = edge * [1, -1, -1] - [0, 0, 0.05]
    scene = contact_scenes.stack([(edge, edge @ turn.T, faces), (edge, other, faces)], [])
    scene.kappa = np.full((2, 2), 3.0)
    return scene


@pytest.mark.parametrize(
    ("start", "lag", "face"),
    [
        (8, 8, True),
        (25, 25, True),
        (30, 30, False),
        (70, 70, False),
        (25, 70, True),
        (70, 25, True),
        (30, 70, False),
    ],
)
def test_gaps_between_edges_turn_with_a_face_where_these_are_nearly_parallel(start, lag, face):
    """The couple of friction about the gap also acts on the third vertex of a face.

    This is the case if either of the edges' crossing angles `start` and `lag` [degrees] is small.
    """
    scene = edge_to_edge(lag)
    x = scene.x.copy()
    x[:3] += [0.01, 0.02, 0]
    g = scene.potential().friction(scene.x, edge_to_edge(start).x).gradient(x)
    assert np.abs(g[:2]).max() > 1e-6
    assert np.abs(g[5]).any() == face


@pytest.mark.parametrize("where", ["start", "lag"])
def test_a_face_that_is_a_line_turns_no_gap(where):
    """The vertices of a degenerate face define no rotation; friction there omits the rotation."""
    scene = edge_to_edge(0)
    flat = scene.x.copy()
    flat[5] = 0.5 * (flat[3] + flat[4])
    start, lag = (flat, scene.x) if where == "start" else (scene.x, flat)
    friction = scene.potential(slip=1e-9).friction(lag, start)
    g = friction.gradient(start + np.array([0.01, 0.02, 0.03]))
    assert np.abs(g).max() > 1e-6
    np.testing.assert_allclose(g.sum(axis=0), 0, atol=1e-13)


@pytest.mark.parametrize("name", NAMES)
def test_energies_are_comparable_between_positions(name):
    """Entry by entry they change no more than the positions do."""
    scene = contact_scenes.make(name)
    potential = scene.potential()
    rng = np.random.default_rng(9)
    other = scene.x + 1e-9 * rng.normal(size=scene.x.shape)
    a, b = potential.energies(scene.x, other)
    assert np.abs(b - a).max() < 1e-5 * a.max()
    assert energy(potential, other) == pytest.approx(b.sum(), rel=1e-12)


def test_touching_is_infinite():
    """This holds also if another weight at the same distance is negative."""
    scene = contact_scenes.make("on_relief")
    x = scene.x.copy()
    body = scene.surface == 1
    x[0] = x[body][20]
    assert energy(scene.potential(), x) == np.inf
