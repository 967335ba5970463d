"""Cloths whose rest mesh is cut: tubes and sheets that are sewn from flat pieces."""

import io
import pickle

import numpy as np
import pytest
import torch
from differences import directional

import diffcloth_torch as dc
from diffcloth_torch.viewers.layers import strain

F64 = torch.float64
COLUMNS, ROWS, RADIUS = 14, 6, 0.05
WEIGHTLESS = (0.0, 0.0, 0.0)


def unrolled(columns, seed=None):
    """Flat strip of columns x (ROWS - 1) cells; with a seed, irregular, the same in each turn."""
    wide = 2 * RADIUS * np.sin(np.pi / COLUMNS)  # chords: the triangles of the tube are those here
    i, j = np.meshgrid(np.arange(columns + 1), np.arange(ROWS))
    X = np.stack([wide * i, wide * j, 0.0 * i], axis=-1).astype(float)
    a = j[:-1, :-1] * (columns + 1) + i[:-1, :-1]
    b = a + columns + 1
    faces = np.stack([a, a + 1, b + 1, a, b + 1, b], axis=-1)
    if seed is not None:
        noise = np.random.default_rng(seed).uniform(-0.2 * wide, 0.2 * wide, (ROWS, COLUMNS, 2))
        X[..., :2] += noise[:, np.arange(columns + 1) % COLUMNS]
    return X.reshape(-1, 3), faces.reshape(-1, 3)


def rolled(X, start=0):
    column = X[:, 0] / (2 * RADIUS * np.sin(np.pi / COLUMNS)) + start
    angle = 2 * np.pi * column / COLUMNS
    return np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), X[:, 1]], axis=1)


def tube(seed=None, start=0, **keywords):
    """A tube from one flat piece with a seam at a column."""
    rest, rest_faces = unrolled(COLUMNS, seed)
    row, column = np.divmod(np.arange(len(rest)), COLUMNS + 1)
    vertex = row * COLUMNS + (column + start) % COLUMNS
    vertices = np.empty((ROWS * COLUMNS, 3))
    vertices[vertex] = rolled(rest, start)
    return dc.Cloth(
        vertices,
        vertex[rest_faces],
        rest_positions=rest,
        rest_faces=rest_faces,
        material=dc.Material(stretch=80.0, bending=1e-3, poisson=0.3),
        **keywords,
    )


def roll(turns, seed=None, **keywords):
    """A piece of several turns on the same cylinder, without a seam."""
    rest, faces = unrolled(turns * COLUMNS, seed)
    material = dc.Material(stretch=80.0, bending=1e-3, poisson=0.3)
    return dc.Cloth(rolled(rest), faces, rest_positions=rest, material=material, **keywords)


def simulator_of(cloth, **keywords):
    options = {"gravity": WEIGHTLESS} | keywords
    contact = dc.ContactOptions(self_contact=False)
    return dc.Simulator(dc.Scene([cloth], **options), 0.01, contact=contact)


def energy_and_forces(cloth):
    """Elastic energy at the start, by part, and its gradient."""
    simulator = simulator_of(cloth)
    state = simulator.initial_state()
    x = state.positions.clone().requires_grad_()
    parts = simulator.energy(state.replace(positions=x), parts=True)
    elastic = parts["stretch"] + parts["bending"]
    (gradient,) = torch.autograd.grad(elastic, x)
    return {name: value.item() for name, value in parts.items()}, gradient.numpy()


# --- The tube ------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["patch", "hinge"])
@pytest.mark.parametrize("seed", [None, 5])
def test_a_tube_is_a_turn_of_a_long_roll(seed, model):
    """A roll of three turns has one more turn than a roll of two, far from its ends."""
    found, forces = energy_and_forces(tube(seed, bending_model=model))
    (two, _), (three, of_roll) = (
        energy_and_forces(roll(n, seed, bending_model=model)) for n in (2, 3)
    )
    scale = three["stretch"] + three["bending"]
    for part in ("stretch", "bending"):
        assert found[part] == pytest.approx(three[part] - two[part], abs=1e-12 * scale)
    middle = of_roll.reshape(ROWS, -1, 3)[:, COLUMNS : 2 * COLUMNS]
    np.testing.assert_allclose(
        forces.reshape(ROWS, COLUMNS, 3), middle, atol=1e-12 * np.abs(of_roll).max()
    )
    if seed is None:
        assert found["stretch"] < 1e-20
    assert found["bending"] > 1e-5


@pytest.mark.parametrize("start", [1, 5])
def test_the_place_of_the_seam_does_not_matter(start):
    at, forces = energy_and_forces(tube())
    moved, other = energy_and_forces(tube(start=start))
    assert moved["bending"] == pytest.approx(at["bending"], rel=1e-12)
    np.testing.assert_allclose(other, forces, atol=1e-12 * np.abs(forces).max())


def test_the_bending_of_a_tube_is_that_of_a_cylinder():
    cloth = tube()
    area = 2 * np.pi * RADIUS * np.ptp(cloth.vertices[:, 2])
    found, _ = energy_and_forces(cloth)
    # Half of D times the squared curvature; chords shorten the turn, and the rims are free.
    assert found["bending"] == pytest.approx(area * 1e-3 / RADIUS**2 / 2, rel=0.05)


def test_a_tube_has_no_strain_and_the_masses_of_its_piece():
    cloth = tube()
    assert strain([cloth], cloth.vertices).max() < 1e-14
    masses = simulator_of(cloth).vertex_masses()
    flat = simulator_of(roll(1)).vertex_masses().reshape(ROWS, COLUMNS + 1)
    sewn = flat[:, :COLUMNS].clone()
    sewn[:, 0] += flat[:, COLUMNS]
    torch.testing.assert_close(masses, sewn.flatten(), rtol=1e-14, atol=0)


# --- Sheets of several pieces --------------------------------------------------------------------


def turns(count):
    """Rigid motions of the plane, every second one mirrored."""
    result = []
    for k in range(count):
        c, s = np.cos(0.7 * k), np.sin(0.7 * k)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.diag([1, (-1) ** k, 1])
        result.append((turn, np.array([0.3 * k, -0.2 * k, 0.0])))
    return result


def pieces(sheet, **keywords):
    """A sheet whose rest mesh consists of four pieces, turned, moved and mirrored."""
    island = (sheet.vertices[sheet.faces].mean(axis=1)[:, :2] > 0.01) @ np.array([1, 2])
    pairs = np.stack([np.repeat(island, 3), sheet.faces.ravel()], axis=1)
    distinct, rest_faces = np.unique(pairs, axis=0, return_inverse=True)
    moves = turns(4)
    rest = np.array([moves[k][0] @ sheet.rest_positions[v] + moves[k][1] for k, v in distinct])
    along = np.array([moves[k][0] @ np.array([1.0, 0.4, 0.0]) for k in island])
    return dc.Cloth(
        sheet.vertices,
        sheet.faces,
        rest_positions=rest,
        rest_faces=rest_faces.reshape(-1, 3),
        material=sheet.material,
        directions=along if sheet.material.is_orthotropic else None,
        **keywords,
    )


WOVEN = dc.Material(
    stretch=60.0,
    stretch_weft=40.0,
    stretch_shear=10.0,
    bending=1e-4,
    bending_weft=2e-4,
    bending_twill=1e-4,
    density=0.2,
)


def sheet(material, **keywords):
    flat = dc.Cloth.grid((7, 6), (0.3, 0.2))
    bent = flat.vertices + np.random.default_rng(3).normal(scale=4e-3, size=flat.vertices.shape)
    return dc.Cloth(bent, flat.faces, rest_positions=flat.vertices, material=material, **keywords)


@pytest.mark.parametrize("material", [dc.Material(), WOVEN], ids=["isotropic", "woven"])
def test_pieces_anywhere_in_the_plane_are_one_sheet(material):
    keywords = {"directions": [1.0, 0.4, 0.0]} if material.is_orthotropic else {}
    whole, cut = sheet(material, **keywords), pieces(sheet(material))
    assert cut.has_seams
    assert not whole.has_seams
    (one, forces), (other, found) = energy_and_forces(whole), energy_and_forces(cut)
    for part, value in one.items():
        assert other[part] == pytest.approx(value, rel=1e-11, abs=1e-18)
    np.testing.assert_allclose(found, forces, atol=1e-11 * np.abs(forces).max())


@pytest.mark.parametrize("scheme", ["coupled", "split"])
def test_pieces_fall_as_one_sheet(scheme):
    table = dc.RigidBody.box((1.0, 1.0, 0.1), pose=[0, 0, -0.07, 1, 0, 0, 0])
    ends = []
    contact = dc.ContactOptions(barrier_distance=2e-3, barrier_stiffness=1e4)
    for cloth in (sheet(dc.Material()), pieces(sheet(dc.Material()))):
        simulator = dc.Simulator(dc.Scene([cloth], [table]), 0.02, scheme=scheme, contact=contact)
        state = simulator.initial_state()
        for _ in range(3):
            state = simulator.step(state)
        ends.append(state.positions)
    torch.testing.assert_close(ends[1], ends[0], rtol=0, atol=1e-8)


def test_the_default_barrier_is_the_one_of_the_sheet():
    flat = dc.Cloth.grid((7, 6), (0.3, 0.2))
    found = [
        dc.Simulator(dc.Scene([cloth]), 0.01).default_parameters() for cloth in (flat, pieces(flat))
    ]
    for name in ("barrier_distance", "barrier_stiffness"):
        values = [getattr(parameters, name) for parameters in found]
        torch.testing.assert_close(values[1], values[0], rtol=1e-9, atol=0)


def test_a_piece_of_another_size_stretches_its_neighbor():
    """A piece at half the size has a quarter of the mass; no rest configuration exists in space."""
    flat = dc.Cloth.grid((3, 2), (0.2, 0.1))
    island = (flat.vertices[flat.faces].mean(axis=1)[:, 0] > 0).astype(int)
    pairs = np.stack([np.repeat(island, 3), flat.faces.ravel()], axis=1)
    distinct, faces = np.unique(pairs, axis=0, return_inverse=True)
    scale = np.where(distinct[:, :1] == 1, 0.5, 1.0)
    cloth = dc.Cloth(
        flat.vertices,
        flat.faces,
        rest_positions=scale * flat.vertices[distinct[:, 1]],
        rest_faces=faces.reshape(-1, 3),
    )
    density = cloth.material.density
    assert float(simulator_of(cloth).vertex_masses().sum()) == pytest.approx(
        density * 0.01 * 1.25, rel=1e-12
    )
    parts, _ = energy_and_forces(cloth)
    # Half of the stretch stiffness times |F - R|^2 = 2 over an area of 25 cm^2.
    assert parts["stretch"] == pytest.approx(cloth.material.stretch * 0.0025, rel=1e-12)
    embedding = cloth.rest_embedding
    assert np.ptp(embedding[:, 0]) == pytest.approx(0.2 * np.sqrt(1.25 / 2))


# --- Gradients -----------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["coupled", "split", "projective"])
def test_gradients_by_the_rest_vertices(scheme):
    """Gradients of a step of a tube that falls on a box."""
    cloth = tube(5)
    box = dc.RigidBody.box((0.3, 0.3, 0.1), pose=[0, 0, -0.0555, 1, 0, 0, 0])
    contact = (
        None
        if scheme == "projective"
        else dc.ContactOptions(barrier_distance=2e-3, barrier_stiffness=1e4, self_contact=False)
    )
    solver = dc.SolverOptions(tolerance=1e-12)
    scene = dc.Scene([cloth], [box] if contact else [], gravity=(0.3, 0.0, -5.0))
    options = {} if contact is None else {"contact": contact}
    simulator = dc.Simulator(scene, 0.01, scheme=scheme, solver=solver, **options)
    given, state = simulator.default_parameters(), simulator.initial_state()
    weights = torch.as_tensor(np.random.default_rng(0).normal(size=cloth.vertices.shape))

    def loss(inputs):
        after = simulator.step(state, None, given.replace(**inputs))
        return (weights * after.positions).sum()

    inputs = {"rest_positions": given.rest_positions, "density": given.density}
    assert inputs["rest_positions"].shape == (ROWS * (COLUMNS + 1), 3)
    assert directional(loss, inputs, ["rest_positions"]) < 1e-5


def test_gradient_of_the_masses_by_the_rest_vertices():
    simulator = simulator_of(tube(5))
    rest = simulator.default_parameters().rest_positions

    def total(inputs):
        masses = simulator.vertex_masses(simulator.default_parameters().replace(**inputs))
        return (masses * torch.linspace(1, 2, len(masses), dtype=F64)).sum()

    assert directional(total, {"rest_positions": rest}, ["rest_positions"]) < 1e-7


# --- Parameters, files, refusals -----------------------------------------------------------------


def test_rest_positions_by_the_name_of_a_cloth():
    cloth, flat = (
        tube(name="tube"),
        dc.Cloth.grid((3, 3), 0.1, name="flat", pose=[0, 0, 1, 1, 0, 0, 0]),
    )
    contact = dc.ContactOptions(self_contact=False)
    simulator = dc.Simulator(dc.Scene([flat, cloth]), 0.01, contact=contact)
    rest = simulator.default_parameters().rest_positions
    assert rest.shape == (9 + len(cloth.rest_positions), 3)
    named = dc.Parameters(rest_positions={"tube": 1.1 * torch.tensor(cloth.rest_positions)})
    masses = simulator.vertex_masses(named) / simulator.vertex_masses()
    torch.testing.assert_close(masses[:9], torch.ones(9, dtype=F64))
    torch.testing.assert_close(masses[9:], torch.full((len(cloth.vertices),), 1.21, dtype=F64))
    with pytest.raises(dc.InvalidInput, match=r"rest_positions.*shape \[99, 3\]"):
        simulator.vertex_masses(dc.Parameters(rest_positions=torch.zeros(93, 3, dtype=F64)))
    rest[-1] = rest[-2]
    with pytest.raises(dc.InvalidInput, match="area > 0 in `rest_positions`"):
        simulator.step(simulator.initial_state(), None, dc.Parameters(rest_positions=rest))


def test_cloths_with_seams_in_files():
    cloth = tube()
    for again in (pickle.loads(pickle.dumps(cloth)), saved_and_loaded(cloth)):
        np.testing.assert_array_equal(again.rest_faces, cloth.rest_faces)
        np.testing.assert_array_equal(again.rest_positions, cloth.rest_positions)
    simulator = simulator_of(cloth)
    other = pickle.loads(pickle.dumps(simulator))
    state, after = (
        saved_and_loaded(simulator.initial_state()),
        simulator.step(simulator.initial_state()),
    )
    assert torch.equal(other.step(state).positions, after.positions)


def test_exports_have_the_mesh_in_space(tmp_path):
    cloth = tube()
    simulator_of(cloth).initial_state().export(tmp_path / "tube.obj")
    again = dc.Cloth.load(tmp_path / "tube.obj")
    np.testing.assert_array_equal(again.vertices, cloth.vertices)
    np.testing.assert_array_equal(again.faces, cloth.faces)


def saved_and_loaded(value):
    file = io.BytesIO()
    torch.save(value, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def test_cloths_without_seams_have_files_as_before():
    grid = dc.Cloth.grid((3, 3))
    same = dc.Cloth(grid.vertices, grid.faces, rest_positions=grid.vertices, rest_faces=grid.faces)
    for cloth in (grid, same):
        assert cloth.rest_faces is cloth.faces
        assert "rest_faces" not in cloth.__getstate__()
        again = pickle.loads(pickle.dumps(cloth))
        assert again.rest_faces is again.faces


TWO = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
FACES = np.array([[0, 1, 2], [1, 3, 2]])
APART = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [3, 0, 0], [3, 1, 0], [2, 1, 0]])


@pytest.mark.parametrize(
    ("keywords", "error", "message"),
    [
        pytest.param(
            {"rest_faces": FACES}, dc.InvalidInput, "without `rest_positions`", id="alone"
        ),
        pytest.param(
            {"rest_positions": APART, "rest_faces": [[0, 1, 2]]},
            dc.InvalidInput,
            r"`rest_faces` must have shape \[2, 3\], got \[1, 3\]",
            id="shape",
        ),
        pytest.param(
            {"rest_positions": APART, "rest_faces": [[0, 1, 2], [3, 4, 6]]},
            dc.InvalidInput,
            r"`rest_faces` must be indices between 0 and 5, got 6 at \[1, 2\]",
            id="range",
        ),
        pytest.param(
            {"rest_positions": APART, "rest_faces": [[0, 1, 2], [3, 4, 2]]},
            dc.InvalidInput,
            r"must name each rest vertex; 5 is not named \(1 in all\)",
            id="unused",
        ),
        pytest.param(
            {"rest_positions": APART[:5], "rest_faces": [[0, 1, 2], [3, 4, 1]]},
            dc.InvalidInput,
            r"one vertex, got 1 for the vertices 1 and 2, at \[0, 1\]",
            id="two vertices",
        ),
        pytest.param(
            {"rest_positions": 0 * APART, "rest_faces": [[0, 1, 2], [3, 4, 5]]},
            dc.InvalidInput,
            "area > 0 in `rest_positions`",
            id="area",
        ),
        pytest.param(
            {"rest_positions": APART, "rest_faces": [[0.0, 1, 2], [3, 4, 5]]},
            TypeError,
            "`rest_faces` must hold integers",
            id="type",
        ),
    ],
)
def test_bad_rest_meshes_are_refused(keywords, error, message):
    with pytest.raises(error, match=rf"^Cloth: .*{message}"):
        dc.Cloth(TWO, FACES, **keywords)
