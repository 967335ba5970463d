"""Meshes of files: texture coordinates as rest shape, polygons, doubled vertices, units."""

import warnings

import numpy as np
import pytest
import torch
import trimesh

import diffcloth_torch as dc
from diffcloth_torch.geometry.polygons import triangulated, welded


@pytest.fixture
def write(tmp_path):
    def file(text, name="mesh.obj"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return file


def textured(sheet, texture, faces=None):
    """An OBJ file of a mesh with one pair of texture coordinates a vertex."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in sheet.vertices.tolist()]
    lines += [f"vt {u!r} {v!r}" for u, v in texture.tolist()]
    faces = sheet.faces if faces is None else faces
    lines += [f"f {a}/{a}/1 {b}/{b}/1 {c}/{c}/1" for a, b, c in (faces + 1).tolist()]
    return "\n".join(["vn 0 0 1", *lines])


def arched(count=9):
    """A sheet of .3 x .2 m that is bent over a cylinder without being stretched."""
    flat = dc.Cloth.grid((count, 5), (0.3, 0.2))
    x, y, _ = flat.vertices.T
    bent = np.stack([0.1 * np.sin(x / 0.1), y, 0.1 * np.cos(x / 0.1)], axis=1)
    return dc.Cloth(bent, flat.faces), flat.vertices[:, :2]


# --- Texture coordinates --------------------------------------------------------------------------


def test_texture_coordinates_are_the_rest_shape(write):
    arch, flat = arched()
    texture = (flat + np.array([0.15, 0.1])) / 0.3  # in the unit square
    path = write(textured(arch, texture))
    cloth = dc.Cloth.load(path, rest="uv", rest_scale=0.3)
    np.testing.assert_array_equal(cloth.vertices, arch.vertices)
    np.testing.assert_allclose(cloth.rest_positions[:, :2] - [0.15, 0.1], flat, atol=1e-15)
    assert not cloth.rest_positions[:, 2].any()
    energies = []
    for one in (cloth, dc.Cloth.load(path)):
        simulator = dc.Simulator(dc.Scene([one], gravity=(0, 0, 0)), 0.01)
        parts = simulator.energy(simulator.initial_state(), parts=True)
        energies.append(float(parts["bending"]))
    # Bending of a cylinder: half of D times the squared curvature, over the area.
    bending = cloth.material.bending * (1 / 0.1) ** 2 / 2 * 0.06
    assert energies[0] == pytest.approx(bending, rel=0.2)
    assert energies[1] < 1e-30


def test_a_larger_cut_hangs_lower(write):
    """A flag whose texture coordinates are 5 % larger than its mesh."""
    flag = dc.Cloth.grid((5, 5), 0.2)
    path = write(textured(flag, flag.vertices[:, :2]))
    lengths = []
    for scale in (1.0, 1.05):
        cloth = dc.Cloth.load(path, rest="uv", rest_scale=scale, pins={"top": range(20, 25)})
        simulator = dc.Simulator(dc.Scene([cloth], gravity=(0, -9.81, 0)), 0.01)
        rest = simulator.equilibrium(simulator.initial_state())
        lengths.append(float(rest.positions[20:, 1].mean() - rest.positions[:5, 1].mean()))
    assert lengths[1] / lengths[0] == pytest.approx(
        1.05, abs=0.01
    )  # the pins are not farther apart


SEWN = """v 0 0 0\nv .1 0 0\nv 0 .1 0\nv .1 .1 .02
vt 0 0\nvt 1 0\nvt 0 1\nvt 4 4\nvt 4 3\nvt 5 3\nvt -0 1
f 1/1 2/2 3/3\nf 2/4 4/5 3/6\n"""


def test_seams_of_the_texture_are_joined_in_space(write):
    """Two islands: vertices and faces come from the file, the rest mesh has its own."""
    cloth = dc.Cloth.load(write(SEWN), rest="uv", rest_scale=0.1)
    assert len(cloth.vertices) == 4
    assert cloth.faces.tolist() == [[0, 1, 2], [1, 3, 2]]
    corners = cloth.rest_positions[cloth.rest_faces]
    expected = [[[0, 0], [0.1, 0], [0, 0.1]], [[0.4, 0.4], [0.4, 0.3], [0.5, 0.3]]]
    np.testing.assert_allclose(corners[..., :2], expected, atol=1e-16)
    assert cloth.has_seams
    assert len(cloth.rest_positions) == 6
    joined = write(SEWN.replace("2/4 4/5 3/6", "2/2 4/5 3/7"))
    one = dc.Cloth.load(joined, rest="uv", rest_scale=0.1)
    assert not one.has_seams  # -0 and 0 are one place
    assert one.rest_faces is one.faces


def test_the_warp_runs_along_u_in_each_island(write):
    """In space along -x in an island turned by half a turn, along -y in one by a quarter."""
    material = dc.Material(stretch=100.0, stretch_weft=10.0, stretch_shear=1.0)
    load = {"rest": "uv", "rest_scale": 0.1, "material": material}
    flat = SEWN.replace(".1 .1 .02", ".1 .1 0")
    turned = flat.replace("vt 4 4\nvt 4 3\nvt 5 3", "vt 4 4\nvt 3 4\nvt 3 3")
    energies = []
    for text in (flat, turned):
        cloth = dc.Cloth.load(write(text), **load)
        simulator = dc.Simulator(dc.Scene([cloth], gravity=(0, 0, 0)), 0.01)
        state = simulator.initial_state()
        wider = state.replace(positions=state.positions.clone())
        wider.positions[:, 0] *= 1.1
        energies.append(float(simulator.energy(wider, parts=True)["stretch"]))
    half = 0.1**2 / 2 * 0.1**2 / 2  # of k e^2 / 2 over one of the triangles
    assert energies == pytest.approx([2 * 100 * half, (100 + 10) * half], rel=1e-9)


def test_corners_that_are_missing_and_folds_are_refused(write):
    two = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv .1 .1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvt 1 1\nvt 2 0\nvt 2 1\n"
    load = {"rest": "uv", "rest_scale": 0.1}
    for missing in (
        "f 1/1 2/2 3/3\nf 2 4 3",
        "f 1/1 2/2 3/3\nf 2/2 4//1 3/3",
        "f 1/1 2/2 3/3\nf 2/2 4/9 3/3",
    ):
        with pytest.raises(dc.InvalidInput, match=r"at all corners; face 1 has none \(1 of 2\)"):
            dc.Cloth.load(write(two + missing), **load)
    folded = write(two + "vt .2 .2\nf 1/1 2/2 3/3\nf 2/2 4/7 3/3")
    with pytest.raises(
        dc.InvalidInput, match=r"faces 0 and 1 lie on one side of the edge between them \(1 such"
    ):
        dc.Cloth.load(folded, **load)
    flat = write(two + "f 1/1 2/2 3/3\nf 2/2 4/1 3/3")
    with pytest.raises(dc.InvalidInput, match="faces 0 and 1 lie on one side"):
        dc.Cloth.load(flat, **load)
    point = write(two + "f 1/1 2/2 3/3\nf 2/2 4/4 3/4")
    with pytest.raises(dc.InvalidInput, match="area > 0 in `rest_positions`"):
        dc.Cloth.load(point, **load)
    stl = write("", "mesh.stl")
    trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], [[0, 1, 2]]).export(stl)
    with pytest.raises(dc.InvalidInput, match=r"needs an \.obj file with texture coordinates"):
        dc.Cloth.load(stl, **load)


@pytest.mark.parametrize(
    ("keywords", "error", "message"),
    [
        pytest.param({"rest": "uv"}, dc.InvalidInput, "`rest_scale` must be given", id="scale"),
        pytest.param({"rest_scale": 1.0}, dc.InvalidInput, "without `rest`", id="alone"),
        pytest.param({"rest": "st", "rest_scale": 1.0}, dc.InvalidInput, "one of 'uv'", id="name"),
        pytest.param(
            {"rest": "uv", "rest_scale": 1.0, "rest_positions": np.eye(3)},
            dc.InvalidInput,
            "beside `rest_positions`",
            id="both",
        ),
        pytest.param(
            {"rest": "uv", "rest_scale": 1.0, "rest_faces": [[0, 1, 2]]},
            dc.InvalidInput,
            "beside `rest_faces`",
            id="faces",
        ),
        pytest.param({"weld": -1.0}, dc.InvalidInput, "`weld` must be finite and >= 0", id="weld"),
        pytest.param({"triangulate": 1}, TypeError, "`triangulate` must be True", id="flag"),
    ],
)
def test_other_arguments_are_refused(write, keywords, error, message):
    path = write("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3")
    with pytest.raises(error, match=rf"^Cloth\.load: .*{message}"):
        dc.Cloth.load(path, **keywords)


# --- Polygons -------------------------------------------------------------------------------------


@pytest.mark.parametrize("first", range(4))
def test_quads_are_cut_along_their_shorter_diagonal(write, first):
    """Whichever corner a file begins with."""
    text = "v 0 0 0\nv .2 0 0\nv .3 .1 0\nv .1 .1 0\nv .2 .2 0\nvt 0 0\nvt 1 1\n"
    quad = " ".join(np.roll(["1/1", "2/1", "3/1", "4/2"], -first))
    path = write(f"{text}f {quad}\nf 4 3 5")
    with pytest.raises(
        dc.InvalidInput, match=r"mesh\.obj:8: a face must be a triangle.*triangulate=True"
    ):
        dc.Cloth.load(path)
    cloth = dc.Cloth.load(path, triangulate=True)
    found = [sorted(face) for face in cloth.faces.tolist()]
    assert sorted(found[:2]) == [[0, 1, 3], [1, 2, 3]]
    assert found[2] == [2, 3, 4]
    a, b, c = (cloth.vertices[cloth.faces[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


@pytest.mark.parametrize("format", ["ascii", "binary_little_endian"])
def test_quads_of_ply_files_are_cut(tmp_path, format):
    header = (
        f"ply\nformat {format} 1.0\nelement vertex 6\nproperty float x\nproperty float y\n"
        "property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    )
    points = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [1, 1, 0], [2, 1.5, 0]], "<f4")
    quads = [[0, 1, 4, 3], [1, 2, 5, 4]]
    body = b"".join(bytes([4]) + np.array(q, "<i4").tobytes() for q in quads)
    data = points.tobytes() + body
    if format == "ascii":
        rows = [" ".join(map(str, p)) for p in points.tolist()]
        data = "\n".join([*rows, *(f"4 {' '.join(map(str, q))}" for q in quads)]).encode()
    path = tmp_path / "mesh.ply"
    path.write_bytes(header.encode() + data)
    with pytest.raises(dc.InvalidInput, match=r"face 0 must be a triangle.*triangulate=True"):
        dc.RigidBody.load(path, triangulate=False)
    body = dc.RigidBody.load(path)
    assert len(body.faces) == 4
    assert trimesh.Trimesh(body.vertices, body.faces).area == pytest.approx(1 + 1.25)


def star(count, seed):
    """A star-shaped polygon, tilted in space, with a random radius at each corner."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(count) / count
    flat = rng.uniform(0.3, 1.0, (count, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return flat, np.pad(flat, ((0, 0), (0, 1))) @ turn.T


@pytest.mark.parametrize("count", [4, 5, 8, 13])
def test_polygons_are_covered_once(count):
    for seed in range(20):
        flat, points = star(count, seed)
        triangles = triangulated("file", points, [range(count)])
        assert triangles.shape == (count - 2, 3)
        a, b, c = (flat[triangles[:, k]] for k in range(3))
        u, v = b - a, c - a
        areas = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
        assert (areas > 0).all()
        x, y = flat.T
        assert areas.sum() == pytest.approx((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)


@pytest.mark.parametrize("first", range(4))
def test_doubled_corners_of_a_polygon_are_cut_off(write, first):
    """The flat triangle keeps its edges in pairs; a body drops the triangle, a cloth refuses it."""
    quad = " ".join(np.roll(["1", "2", "3", "4"], -first))
    path = write(f"v 0 0 0\nv 1 0 0\nv 1 0 0\nv 0 1 0\nf {quad}\n")
    with pytest.warns(UserWarning, match="dropped 1 of 2 faces: 1 without area, 0 with"):
        body = dc.RigidBody.load(path)
    assert trimesh.Trimesh(body.vertices, body.faces).area == pytest.approx(0.5)
    with pytest.raises(dc.InvalidInput, match="`faces` must have an area > 0"):
        dc.Cloth.load(path, triangulate=True)


def test_polygons_without_ears_are_refused():
    line = np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0], [2, 0, 0.0]])
    for points in (line, line[[0, 0, 0, 0]]):
        with pytest.raises(dc.InvalidInput, match="file: face 0 must have an area > 0"):
            triangulated("file", points, [range(4)])
    bow = np.array([[0, 0, 0], [2, 2, 0], [2, 0, 0], [0, 1, 0.0]])
    pentagram = [[np.cos(a), np.sin(a), 0] for a in 4 * np.pi / 5 * np.arange(5)]
    for crossed in (bow, bow[::-1], np.array(pentagram)):
        with pytest.raises(dc.InvalidInput, match="file: face 0 must not cross itself"):
            triangulated("file", crossed, [range(len(crossed))])


# --- Doubled vertices -----------------------------------------------------------------------------


def test_doubled_vertices_are_merged_and_mapped_back(write):
    sheet = dc.Cloth.grid((5, 4), 0.2)
    rng = np.random.default_rng(3)
    soup = sheet.vertices[sheet.faces].reshape(-1, 3)
    soup = soup + rng.uniform(-1e-7, 1e-7, soup.shape)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in soup.tolist()]
    lines += [f"f {3 * k + 1} {3 * k + 2} {3 * k + 3}" for k in range(len(sheet.faces))]
    path = write("\n".join(lines))
    cloth = dc.Cloth.load(path, weld=1e-6)
    assert len(cloth.vertices) == len(sheet.vertices)
    assert cloth.file_vertices.shape == (len(soup),)
    np.testing.assert_array_equal(cloth.faces.reshape(-1), cloth.file_vertices)
    np.testing.assert_allclose(cloth.vertices[cloth.file_vertices], soup, atol=1e-6)
    first = [int(np.flatnonzero(cloth.file_vertices == i)[0]) for i in range(20)]
    np.testing.assert_array_equal(cloth.vertices, soup[first])  # the first one stays, in order
    assert first == sorted(first)
    assert len(dc.Cloth.load(path, weld=0.0).vertices) == len(soup)
    assert dc.Cloth.load(path).file_vertices.tolist() == list(range(len(soup)))
    assert sheet.file_vertices is None


@pytest.mark.parametrize("distance", [0.0, 0.05, 0.2])
def test_merged_vertices_are_those_within_a_distance(distance):
    rng = np.random.default_rng(5)
    points = np.round(rng.uniform(0, 1, (200, 3)), 1)
    left, index = welded(points, distance)
    near = np.linalg.norm(points[:, None] - points[None], axis=-1) <= distance
    reach = np.linalg.matrix_power(near.astype(np.int64), 2) > 0
    while (reach != (reach @ reach > 0)).any():
        reach = reach @ reach > 0
    np.testing.assert_array_equal(index[:, None] == index[None], reach)
    np.testing.assert_array_equal(left[index][np.unique(index, return_index=True)[1]], left)


# --- Units ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("load", [dc.Cloth.load, dc.RigidBody.load])
def test_sizes_of_other_units_are_remarked_on(write, load):
    path = write("v 0 0 0\nv 700 0 0\nv 0 500 0\nf 1 2 3")  # millimeters
    with pytest.warns(
        UserWarning, match=r"mesh\.obj is 700 m long with scale=1, .* pass scale=0\.001"
    ):
        load(path)
    with pytest.warns(UserWarning, match=r"is 0\.0007 m long with scale=1e-06"):
        load(path, scale=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load(path, scale=0.001)


def test_a_loaded_cloth_keeps_its_map_in_a_file(write, tmp_path):
    cloth = dc.Cloth.load(write("v 0 0 0\nv .1 0 0\nv 0 .1 0\nf 1 2 3"))
    torch.save(dc.Scene([cloth]), tmp_path / "scene.pt")
    again = torch.load(tmp_path / "scene.pt", weights_only=True)
    assert again.cloths[0].file_vertices.tolist() == [0, 1, 2]
