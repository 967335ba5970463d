"""Mesh files, mesh checks and simple shapes: nothing is reordered, dropped or repaired."""

import struct
import sys

import numpy as np
import pytest
import torch
from public_data import public

import diffcloth_torch as dc
from diffcloth_torch.geometry.meshes import read_body_mesh, read_mesh, write_mesh

VERTICES = np.array([[0.1, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1 / 3], [7, 8, 9]])
FACES = np.array([[0, 1, 2], [2, 1, 3]])


def volume(body):
    """Volume that a closed, outward-facing surface encloses, by the divergence theorem."""
    a, b, c = (body.vertices[body.faces[:, i]] for i in range(3))
    return (np.cross(a, b) * c).sum() / 6


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_a_written_mesh_comes_back_bit_by_bit_with_its_unreferenced_vertex(tmp_path, suffix):
    path = tmp_path / f"mesh{suffix}"
    write_mesh(path, [("sheet", VERTICES, FACES)])
    vertices, faces = read_mesh(path)
    np.testing.assert_array_equal(vertices, VERTICES)
    np.testing.assert_array_equal(faces, FACES)


def test_obj_corners_are_read_in_every_notation(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(
        "# comment\nmtllib x.mtl\no a\nv 0 0 0 1.0\nv 1 0 0 0.5 0.5 0.5\nvt 0 0\nvn 0 0 1\n"
        "v 0 1 0\nusemtl m\ns off\nf 1/1/1 2//1 3/1\nv 1 1 0\nf -1 \\\n-2 -3\n"
    )
    vertices, faces = read_mesh(path)
    np.testing.assert_array_equal(vertices[:, :2], [[0, 0], [1, 0], [0, 1], [1, 1]])
    np.testing.assert_array_equal(faces, [[0, 1, 2], [3, 2, 1]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        pytest.param("", "empty", id="empty"),
        pytest.param("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "0 triangles", id="no faces"),
        pytest.param(
            "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n", r":5: .*triangle, got 4", id="quad"
        ),
        pytest.param("v 0 0 0\nf 1 2 3\n", r":2: .*1 \.\. 1 .*got 2", id="index"),
        pytest.param("v 0 0 0\nf 0 1 1\n", r":2: .*got 0", id="zero index"),
        pytest.param("v 0 x 0\n", r":1: .*'x'", id="no number"),
        pytest.param("v 0 0\n", r":1: .*3 coordinates, got 2", id="short vertex"),
    ],
)
def test_a_bad_obj_is_refused_with_its_line(tmp_path, text, message):
    path = tmp_path / "bad.obj"
    path.write_text(text)
    with pytest.raises(dc.InvalidInput, match=message):
        read_mesh(path)


PLY_HEADER = (
    "ply\nformat {format} 1.0\ncomment by hand\nelement vertex {vertices}\n"
    "property float x\nproperty double y\nproperty float z\nproperty uchar red\n"
    "element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
)


def binary_ply(order, faces):
    header = PLY_HEADER.format(
        format={"<": "binary_little_endian", ">": "binary_big_endian"}[order],
        vertices=4,
        faces=len(faces),
    )
    body = b"".join(struct.pack(order + "fdfB", *v, 255) for v in VERTICES[:4])
    for face in faces:
        body += struct.pack(f"{order}B{len(face)}i", len(face), *face)
    return header.encode() + body


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply_of_either_byte_order_is_read(tmp_path, order):
    path = tmp_path / "a.ply"
    path.write_bytes(binary_ply(order, FACES.tolist()))
    vertices, faces = read_mesh(path)
    np.testing.assert_array_equal(vertices[:, 1], VERTICES[:4, 1])
    np.testing.assert_array_equal(vertices[:, ::2], VERTICES[:4, ::2].astype(np.float32))
    np.testing.assert_array_equal(faces, FACES)


def test_ascii_ply_is_read(tmp_path):
    path = tmp_path / "a.ply"
    rows = "".join(f"{x!r} {y!r} {z!r} 255\n" for x, y, z in VERTICES[:4].tolist())
    header = PLY_HEADER.format(format="ascii", vertices=4, faces=2)
    path.write_text(header + rows + "3 0 1 2\n3 2 1 3\n")
    vertices, faces = read_mesh(path)
    np.testing.assert_array_equal(vertices, VERTICES[:4])
    np.testing.assert_array_equal(faces, FACES)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        pytest.param(b"", "not a PLY file", id="empty"),
        pytest.param(binary_ply("<", [[0, 1, 3, 2]]), "face 0 .*got 4", id="quad"),
        pytest.param(binary_ply("<", [[0, 1, 2], [0, 1, 3, 2]]), "face 1 .*got 4", id="quad later"),
        pytest.param(binary_ply("<", FACES.tolist())[:-3], "ends within the face", id="cut off"),
        pytest.param(binary_ply("<", [[0, 1, 9]]), r"face 0 has vertex 9.* 0 \.\. 3", id="index"),
        pytest.param(
            PLY_HEADER.format(format="ascii", vertices=10**12, faces=1).encode() + b"0 0 0 0\n",
            "1000000000000 x 'vertex', but only",
            id="size checked before allocation",
        ),
        pytest.param(b"ply\nformat ascii 1.0\nelement vertex x\nend_header\n", ":3: ", id="header"),
    ],
)
def test_a_bad_ply_is_refused(tmp_path, content, message):
    path = tmp_path / "bad.ply"
    path.write_bytes(content)
    with pytest.raises(dc.InvalidInput, match=message):
        read_mesh(path)


def test_stl_corners_are_merged_in_the_order_of_the_file(tmp_path):
    path = tmp_path / "a.stl"
    corners = VERTICES[FACES].astype(np.float32)
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *c.reshape(-1), 0) for c in corners)
    path.write_bytes(bytes(80) + struct.pack("<I", len(corners)) + body)
    vertices, faces = read_mesh(path)
    np.testing.assert_array_equal(vertices, VERTICES[:4].astype(np.float32))
    np.testing.assert_array_equal(faces, FACES)


@pytest.mark.parametrize("content", [b"no solid", bytes(range(256)) * 2])
def test_bytes_that_are_no_stl_are_refused(tmp_path, content):
    path = tmp_path / "a.stl"
    path.write_bytes(content)
    with pytest.raises(dc.InvalidInput, match="neither the header of a binary file nor a solid"):
        read_mesh(path)


@pytest.mark.parametrize("name", ["empty.stl", "mesh.gltf"])
def test_other_files_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(dc.InvalidInput, match=name):
        read_mesh(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("cloth/diffcloth_sock482.obj", 482),
        ("cloth/diffcloth_wind24x24.obj", 576),
        ("obstacles/spot.ply", 2930),
    ],
)
def test_public_meshes_are_read_as_trimesh_reads_them(name, counts):
    """Without processing, trimesh keeps these clean meshes in order."""
    trimesh = pytest.importorskip("trimesh")
    vertices, faces = read_mesh(public(name))
    reference = trimesh.load_mesh(public(name), process=False, maintain_order=True)
    assert len(vertices) == counts
    np.testing.assert_allclose(vertices, reference.vertices, rtol=1e-7)  # one file has float32
    np.testing.assert_array_equal(faces, reference.faces)


def test_the_sock_makes_a_cloth_whose_pins_keep_their_vertices():
    path = public("cloth/diffcloth_sock482.obj")
    cloth = dc.Cloth.load(path, scale=0.1, pins={"toe": [3, 17]})
    lines = [line.split() for line in path.read_text().splitlines() if line.startswith("v ")]
    expected = 0.1 * np.array([float(word) for word in lines[17][1:4]])
    np.testing.assert_array_equal(cloth.vertices[cloth.pins["toe"][1]], expected)


def square(**changes):
    arguments = {"vertices": VERTICES[:4], "faces": FACES, **changes}
    return dc.Cloth(arguments.pop("vertices"), arguments.pop("faces"), **arguments)


def changed(array, index, value):
    copy = np.array(array, dtype=float)
    copy[index] = value
    return copy


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"vertices": changed(VERTICES[:4], (2, 1), np.nan)}, dc.InvalidInput, r"nan at \[2, 1\]"),
        ({"vertices": changed(VERTICES[:4], (2, 1), np.inf)}, dc.InvalidInput, r"inf at \[2, 1\]"),
        ({"vertices": VERTICES[:4, :2]}, dc.InvalidInput, r"shape \[n, 3\], got \[4, 2\]"),
        ({"vertices": [[0, 0, 0], [1, 0]]}, dc.InvalidInput, "rectangular"),
        ({"vertices": VERTICES[:4].astype(complex)}, TypeError, "complex"),
        ({"vertices": VERTICES}, dc.InvalidInput, "vertex 4 does not"),
        ({"vertices": torch.zeros(4, 3, requires_grad=True)}, dc.InvalidInput, "State.positions"),
        ({"vertices": torch.zeros(4, 3, device="meta")}, TypeError, r"\.cpu\(\)"),
        ({"faces": [[0, 1, 2], [2, 1, 4]]}, dc.InvalidInput, r"between 0 and 3, got 4 at \[1, 2\]"),
        ({"faces": [[0, 1, 2], [2, 1, -1]]}, dc.InvalidInput, r"got -1 at \[1, 2\]"),
        ({"faces": [[0, 1, 3, 2]]}, dc.InvalidInput, "only triangles"),
        ({"faces": np.zeros((0, 3), int)}, dc.InvalidInput, "at least one triangle"),
        ({"faces": FACES.astype(float)}, TypeError, "integers"),
        ({"faces": [[0, 1, 2], [2, 1, 3], [3, 3, 0]]}, dc.InvalidInput, r"different .* at \[2\]"),
        ({"faces": [[0, 1, 2], [2, 1, 3], [1, 0, 2]]}, dc.InvalidInput, "faces 0 and 2"),
        (
            {"vertices": changed(VERTICES[:4], 3, (0.55, 0, 0)), "faces": [[0, 1, 2], [0, 1, 3]]},
            dc.InvalidInput,
            r"without area at \[1\]",
        ),
        (
            {"vertices": VERTICES, "faces": [[0, 1, 2], [2, 1, 3], [1, 2, 4]]},
            dc.InvalidInput,
            r"got 3 on the edge of vertices \[1, 2\]",
        ),
        ({"rest_positions": np.zeros((4, 3))}, dc.InvalidInput, "`rest_positions`.* without area"),
        ({"rest_positions": VERTICES}, dc.InvalidInput, r"\[4, 3\], got \[5, 3\]"),
        ({"pins": [0, 1]}, dc.InvalidInput, "dict of name"),
        ({"pins": {"a": [4]}}, dc.InvalidInput, r"`pins\['a'\]` .*0 and 3, got 4 at \[0\]"),
        ({"pins": {"a": []}}, dc.InvalidInput, "at least one vertex"),
        ({"pins": {"a/b": [0]}}, dc.InvalidInput, "without '/'"),
        ({"pins": {"a": [1, 1]}}, dc.InvalidInput, "vertex 1 again"),
        ({"pins": {"a": [1], "b": [1]}}, dc.InvalidInput, r"vertex 1 again: `pins\['a'\]` does"),
        ({"pins": {"a": [1]}, "soft_pins": {"b": [1]}}, dc.InvalidInput, "vertex 1 again"),
        ({"pin_stiffness": 0.0}, dc.InvalidInput, "`pin_stiffness` must be finite and > 0"),
        ({"bending_model": "plate"}, dc.InvalidInput, "'patch', 'hinge', got 'plate'"),
        ({"material": 5}, TypeError, "Material"),
        ({"material": dc.Material(stretch=[1.0, 2.0, 3.0])}, dc.InvalidInput, r"\[2\], got \[3\]"),
        ({"name": ""}, dc.InvalidInput, "non-empty"),
        ({"name": "a\nb"}, dc.InvalidInput, "printable"),
    ],
)
def test_a_bad_cloth_is_refused(changes, error, message):
    with pytest.raises(error, match=message):
        square(**changes)


def test_a_cloth_copies_its_arguments():
    vertices = VERTICES[:4].copy()
    cloth = square(vertices=vertices)
    vertices[0] = 99
    np.testing.assert_array_equal(cloth.vertices, VERTICES[:4])
    with pytest.raises(ValueError, match="read-only"):
        cloth.vertices[0] = 0


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("stretch", 0.0, "> 0, got 0"),
        ("stretch", [1.0, -1.0], r"got -1 at \[1\]"),
        ("bending", -1.0, ">= 0"),
        ("poisson", 0.5, "between -1 and 0.5"),
        ("poisson", -1.0, "between -1 and 0.5"),
        ("density", 0, "> 0"),
        ("damping", float("nan"), "nan"),
        ("friction", -0.1, ">= 0"),
        ("thickness", float("inf"), "inf"),
        ("friction", [0.1, 0.2], r"shape \[\], got \[2\]"),
        ("stretch", [[1.0]], r"\[\] or \[F\]"),
        ("stretch", torch.tensor(1.0, requires_grad=True), "Parameters.stretch instead"),
        ("friction", torch.tensor(1.0, requires_grad=True), "Parameters.friction instead"),
    ],
)
def test_a_bad_material_is_refused(field, value, message):
    with pytest.raises(dc.InvalidInput, match=f"Material: `{field}`.*{message}"):
        dc.Material(**{field: value})


def test_bodies_may_have_unreferenced_vertices_but_no_flat_faces():
    assert len(dc.RigidBody(VERTICES, FACES).vertices) == len(VERTICES)
    with pytest.raises(dc.InvalidInput, match="without area"):
        dc.RigidBody(np.zeros((3, 3)), [[0, 1, 2]])


def test_useless_faces_of_a_body_are_dropped_with_a_warning():
    """The rest is the body: its solid is closed by the faces that are dropped."""
    box = dc.RigidBody.box(1.0)
    # Face 0 becomes two faces that share an extra vertex on an edge.
    a, b, c = box.faces[0].tolist()
    middle = len(box.vertices)
    vertices = np.concatenate([box.vertices, box.vertices[[a, b]].mean(axis=0)[None]])
    split = [[a, middle, c], [middle, b, c]]
    for extra, dropped in (
        ([[a, b, middle]], "1 without area, 0 with"),
        ([[a, b, middle], [2, 2, 3]], "2 without area, 0 with"),
        ([[a, b, middle], [4, 1, 2], [2, 1, 4]], "1 without area, 1 with"),
    ):
        faces = [*split, *box.faces[1:].tolist(), *extra]
        with pytest.warns(UserWarning, match=f"RigidBody: dropped . of .. faces: {dropped}"):
            body = dc.RigidBody(vertices, faces, motion="dynamic", density=2.0)
        assert body.mass == pytest.approx(2.0)
    twice = np.concatenate([box.faces, box.faces[:3]])
    with pytest.warns(UserWarning, match="dropped 3 of 15 faces: 0 without area, 3 with"):
        body = dc.RigidBody(box.vertices, twice, motion="dynamic", density=2.0)
    assert body.mass == pytest.approx(2.0)
    np.testing.assert_array_equal(body.faces, box.faces)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".binary.ply"])
def test_polygons_of_bodies_are_cut(tmp_path, suffix):
    """A quad, a triangle, a dart that is cut at its reflex corner, and a pentagon."""
    points = [(0, 0), (1, 0), (1, 1), (0, 1), (4, 0), (5, 2), (4, 1), (3, 2), (2, 0.5)]
    polygons = [[0, 1, 2, 3], [0, 2, 3], [5, 6, 7, 4], [0, 1, 8, 2, 3]]
    vertices = np.array([(x, y, 0.0) for x, y in points])
    path = tmp_path / f"a{suffix}"
    header = "ply\nformat {} 1.0\nelement vertex 9\nproperty double x\nproperty double y\n"
    header += "property double z\nelement face 4\nproperty list uchar int vertex_indices\n"
    header += "property uchar red\nend_header\n"
    if suffix == ".obj":
        lines = [f"v {x} {y} {z}" for x, y, z in vertices]
        lines += [" ".join(["f", *(str(i + 1) for i in polygon)]) for polygon in polygons]
        path.write_text("\n".join(lines))
    elif suffix == ".ply":
        rows = [" ".join(map(str, row)) for row in vertices]
        rows += [" ".join(map(str, [len(row), *row, 7])) for row in polygons]
        path.write_text(header.format("ascii") + "\n".join(rows) + "\n")
    else:
        body = vertices.tobytes()
        for row in polygons:
            body += struct.pack(f"<B{len(row)}iB", len(row), *row, 7)
        path.write_bytes(header.format("binary_little_endian").encode() + body)
    with pytest.raises(dc.InvalidInput, match="must be a triangle, got 4 corners"):
        read_mesh(path)
    with pytest.raises(dc.InvalidInput, match="must be a triangle, got 4 corners"):
        dc.RigidBody.load(path, triangulate=False)
    found, faces, _ = read_body_mesh(path, "path")
    np.testing.assert_array_equal(found, vertices)
    assert faces.tolist() == [
        *([3, 0, 1], [1, 2, 3], [0, 2, 3]),
        *([4, 5, 6], [6, 7, 4]),
        *([1, 8, 2], [3, 0, 1], [1, 2, 3]),
    ]


def test_a_polygon_whose_corners_see_few_others_is_cut(tmp_path):
    path = tmp_path / "comb.obj"
    x = [0, 6, 6, 5, 5, 4, 4, 3, 3, 2, 2, 1, 1, 0]
    y = [0, 0, 3, 3, 1, 1, 3, 3, 1, 1, 3, 3, 1, 1]
    lines = [f"v {a} {b} 0" for a, b in zip(x, y, strict=True)]
    path.write_text("\n".join([*lines, "f " + " ".join(map(str, range(1, 15)))]))
    body = dc.RigidBody.load(path)
    assert len(body.faces) == 12
    a, b, c = (body.vertices[body.faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(6 + 3 * 2)


def test_a_polygon_that_crosses_itself_is_refused(tmp_path):
    path = tmp_path / "bow.obj"
    path.write_text("v 0 0 0\nv 2 2 0\nv 2 0 0\nv 0 1 0\nf 1 2 3 4\n")
    with pytest.raises(dc.InvalidInput, match=r"bow\.obj: face 0 must not cross itself"):
        dc.RigidBody.load(path)


def test_nodes_of_a_gltf_file_are_placed(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene()
    corner = trimesh.Trimesh(np.eye(3), [[0, 1, 2]], process=False)
    frame = np.eye(4)
    frame[:3, 3] = [1, 2, 3]
    scene.add_geometry(corner)
    scene.add_geometry(corner, transform=frame)
    scene.export(tmp_path / "two.glb")
    vertices, faces, _ = read_body_mesh(tmp_path / "two.glb", "path")
    expected = np.concatenate([np.eye(3), np.eye(3) + np.array([1, 2, 3])])
    found = {tuple(point) for point in vertices[faces].reshape(-1, 3)}
    assert found == {tuple(point) for point in expected}


COLLADA = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="{unit}"/><up_axis>Y_UP</up_axis></asset>
<library_effects><effect id="e"><profile_COMMON><newparam sid="s"><sampler2D><source>none</source>
</sampler2D></newparam></profile_COMMON></effect></library_effects>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="12">
0 0 0 1 0 0 1 1 0 0 1 0</float_array><technique_common><accessor source="#a" count="4" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
</accessor></technique_common></source><vertices id="v"><input semantic="POSITION" source="#p"/>
</vertices><polylist count="1"><input semantic="VERTEX" source="#{source}" offset="0"/>
<vcount>4</vcount><p>0 1 2 3</p></polylist></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><scale>2 1 1</scale>
<instance_geometry url="#g"/><instance_camera url="#none"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def test_the_unit_of_a_collada_file_applies_and_its_up_axis_does_not(tmp_path):
    """Faults beside the meshes have no effect: a texture and a camera are missing."""
    pytest.importorskip("collada")
    path = tmp_path / "a.dae"
    for unit in (1.0, 0.001):
        path.write_text(COLLADA.format(unit=unit, source="v"))
        vertices, faces, _ = read_body_mesh(path, "path")
        assert faces.tolist() == [[0, 1, 2], [0, 2, 3]]
        expected = unit * np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
        np.testing.assert_allclose(vertices, expected, rtol=1e-15)
    with pytest.raises(dc.InvalidInput, match=r"a\.dae: .* always cut .* pass triangulate=True"):
        dc.RigidBody.load(path, triangulate=False)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not well-formed XML: no element found"),
        ("<COLLADA/>", "not a readable COLLADA file"),
        (COLLADA.format(unit=1, source="none"), "not a readable COLLADA file"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><COLLADA/>', "no DOCTYPE and no entities"),
    ],
)
def test_a_bad_collada_file_is_refused(tmp_path, content, message):
    pytest.importorskip("collada")
    path = tmp_path / "a.dae"
    path.write_text(content)
    with pytest.raises(dc.InvalidInput, match=f"a.dae: .*{message}"):
        dc.RigidBody.load(path)


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_bytes_that_are_no_gltf_are_refused(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    for content in (b"", b"{}", b"glTF" + bytes(range(60)), bytes(range(256)) * 2):
        path.write_bytes(content)
        with pytest.raises(dc.InvalidInput, match=r"not a readable glTF|the mesh is empty"):
            dc.RigidBody.load(path)


def test_the_extra_is_named_where_pycollada_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "collada", None)
    (tmp_path / "a.dae").write_text("<COLLADA/>")
    with pytest.raises(dc.InvalidInput, match=r"diffcloth-torch\[robots\]', or save the mesh as"):
        dc.RigidBody.load(tmp_path / "a.dae")


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"motion": "free"}, "'static', 'kinematic', 'dynamic', got 'free'"),
        ({"pose": [0, 0, 0, 0, 0, 0, 0]}, "quaternion"),
        ({"pose": [0, 0, 0]}, r"\[7\], got \[3\]"),
        ({"friction": -1}, ">= 0"),
        ({"thickness": -1}, ">= 0"),
        ({"pose": torch.zeros(7, requires_grad=True)}, "Control.body_poses"),
    ],
)
def test_a_bad_body_is_refused(keywords, message):
    with pytest.raises(dc.InvalidInput, match=message):
        dc.RigidBody.box(1.0, **keywords)


def test_grid_is_row_major_centered_and_faces_up():
    cloth = dc.Cloth.grid(3, 4, size=(3.0, 1.0))
    rows = cloth.vertices.reshape(3, 4, 3)
    np.testing.assert_allclose(rows[1, :, 0], [-1.5, -0.5, 0.5, 1.5])
    np.testing.assert_allclose(rows[:, 2, 1], [-0.5, 0, 0.5])
    a, b, c = (cloth.vertices[cloth.faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] > 0).all()
    np.testing.assert_allclose(normals[:, 2].sum() / 2, 3.0)


def test_a_pose_moves_the_cloth_and_not_its_rest_shape():
    half = np.sqrt(0.5)
    cloth = dc.Cloth.grid(2, 2, size=2.0, pose=[0, 0, 5, half, half, 0, 0])  # 90 degrees about x
    np.testing.assert_allclose(cloth.vertices[3], [1, 0, 6], atol=1e-15)
    np.testing.assert_array_equal(cloth.rest_positions, dc.Cloth.grid(2, 2, size=2.0).vertices)


def test_shapes_are_closed_and_face_outward():
    assert volume(dc.RigidBody.box((1, 2, 3))) == pytest.approx(6)
    # Polyhedra inscribed in round shapes: a little smaller.
    ball = 4 / 3 * np.pi * 0.5**3
    assert 0.98 * ball < volume(dc.RigidBody.sphere(0.5)) < ball
    capsule = ball + np.pi * 0.5**2 * 2
    assert 0.98 * capsule < volume(dc.RigidBody.capsule(0.5, 2.0)) < capsule
    for body in (dc.RigidBody.box(1), dc.RigidBody.sphere(1), dc.RigidBody.capsule(1, 1)):
        directed = body.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        assert sorted(map(tuple, directed)) == sorted(map(tuple, directed[:, ::-1]))


def test_round_shapes_lie_on_their_surface():
    np.testing.assert_allclose(np.linalg.norm(dc.RigidBody.sphere(0.3).vertices, axis=1), 0.3)
    vertices = dc.RigidBody.capsule(0.2, 1.0).vertices
    axis = np.clip(vertices[:, 2], -0.5, 0.5)
    distance = np.hypot(np.hypot(*vertices[:, :2].T), vertices[:, 2] - axis)
    np.testing.assert_allclose(distance, 0.2)


def test_a_plane_faces_up():
    body = dc.RigidBody.plane((2, 4))
    a, b, c = body.vertices[body.faces[0]]
    assert np.cross(b - a, c - a)[2] > 0
    np.testing.assert_array_equal(np.abs(body.vertices), np.tile([1, 2, 0], (4, 1)))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3])
def test_the_flattest_face_that_is_accepted(scale):
    # Twice the area over the longest side squared; below 1e-12 rounding decides about its normal.
    def triangle(height):
        return [[0, 0, 0], [scale, 0, 0], [0.5 * scale, height * scale, 0]], [[0, 1, 2]]

    for make in (dc.Cloth, dc.RigidBody):
        assert make(*triangle(1.1e-12)).faces.shape == (1, 3)
        with pytest.raises(dc.InvalidInput, match=r"without area at \[0\]"):
            make(*triangle(0.9e-12))


REST = 1.5 * VERTICES[:4]


def test_a_rest_shape_has_the_vertices_of_the_cloth():
    np.testing.assert_array_equal(
        dc.Cloth(VERTICES[:4], FACES, rest_positions=REST).rest_positions, REST
    )
    posed = dc.Cloth.grid(2, 2, pose=[0, 0, 1, 1, 0, 0, 0], rest_positions=REST)
    np.testing.assert_array_equal(posed.rest_positions, REST)
    with pytest.raises(dc.InvalidInput, match="`rest_positions` must have shape"):
        dc.Cloth(VERTICES[:4], FACES, rest_positions=REST[:3])
