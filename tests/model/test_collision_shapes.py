"""Collision shapes of links: meshes, poses, and accepted files."""

import numpy as np
import pytest
from robot_files import link, load

import diffcloth_torch as dc
from diffcloth_torch.geometry import shapes
from diffcloth_torch.geometry.mass_properties import is_closed, mass_properties
from diffcloth_torch.geometry.meshes import write_mesh

ORIGIN = '<origin xyz="1 2 3" rpy="0.1 0.2 0.3"/>'


def collision(geometry, origin=""):
    return f"<collision>{origin}<geometry>{geometry}</geometry></collision>"


def surface(tmp_path, geometry, origin="", **keywords):
    return load(tmp_path, link("a", collision(geometry, origin)), **keywords).surfaces[0]


def longest_edge(vertices, faces):
    corners = vertices[faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max()


def smallest_angle(vertices, faces):
    corners = vertices[faces]
    a, b = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    cosine = (a * b).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
    return np.degrees(np.arccos(cosine)).min()


def is_manifold(faces):
    """Return whether each edge occurs once per direction and the surface is a sphere.

    A sphere has V - E + F = 2.
    """
    edges = {(a, b) for f in faces.tolist() for a, b in zip(f, f[1:] + f[:1], strict=True)}
    closed = len(edges) == 3 * len(faces) and all((b, a) in edges for a, b in edges)
    return closed and len(np.unique(faces)) - len(faces) / 2 == 2


SHAPES = {
    "box": ('<box size="0.2 0.3 0.1"/>', 0.2 * 0.3 * 0.1),
    "cylinder": ('<cylinder radius="0.1" length="0.5"/>', np.pi * 0.1**2 * 0.5),
    "disk": ('<cylinder radius="0.2" length="0.01"/>', np.pi * 0.2**2 * 0.01),
    "sphere": ('<sphere radius="0.1"/>', 4 / 3 * np.pi * 0.1**3),
    "capsule": ('<capsule radius="0.1" length="0.3"/>', np.pi * (0.1**2 * 0.3 + 4 / 3 * 0.1**3)),
}


@pytest.mark.parametrize("edge_length", [None, 0.1, 0.03, 0.02])
@pytest.mark.parametrize("name", SHAPES)
def test_primitives_are_closed_with_edges_as_short_as_asked(tmp_path, name, edge_length):
    geometry, volume = SHAPES[name]
    vertices, faces = surface(tmp_path, geometry, edge_length=edge_length)
    assert is_manifold(faces)
    if edge_length is not None:
        assert longest_edge(vertices, faces) <= edge_length
        # Not much shorter than required: a factor of 2 from halving, the rest from rounding up.
        assert longest_edge(vertices, faces) > edge_length / 3
    # Inscribed meshes: 16 segments lose 3 % of the volume, 50 segments a tenth of this.
    assert 0.8 < mass_properties(vertices, faces)[0] / volume < 1 + 1e-12


@pytest.mark.parametrize(
    ("rings", "rows", "radius", "length"),
    [(5, 0, 0.1, 0.1), (5, 0, 0.1, 1.0), (1, 1, 1, 1), (2, 3, 1, 1), (9, 20, 0.1, 0.2)],
)
def test_triangles_of_a_cylinder_are_well_shaped(rings, rows, radius, length):
    mesh = shapes.cylinder(radius, length, rings, rows)
    assert is_manifold(mesh[1])
    assert smallest_angle(*mesh) > 11  # beside 12 segments a radius of rows 5 times as long
    assert mass_properties(*mesh)[0] > 0
    on_end = np.isclose(np.abs(mesh[0][:, 2]), length / 2)
    off_axis = np.linalg.norm(mesh[0][:, :2], axis=1)
    np.testing.assert_allclose(off_axis[~on_end], radius)


def test_a_cut_box_has_its_vertices_on_a_lattice():
    vertices, faces = shapes.box(np.array([2.0, 3.0, 4.0]), (2, 3, 4))
    assert is_manifold(faces)
    assert len(vertices) == 3 * 4 * 5 - 1 * 2 * 3
    np.testing.assert_allclose(vertices, np.round(vertices * 2) / 2, rtol=0, atol=1e-15)
    plain = shapes.box(np.array([2.0, 3.0, 4.0]))
    for a, b in zip(mass_properties(vertices, faces), mass_properties(*plain), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-13)


def test_a_tiny_edge_length_is_refused_before_memory_runs_out(tmp_path):
    for geometry, _ in SHAPES.values():
        with pytest.raises(dc.InvalidInput, match=r"`edge_length` must leave a .* got 1e-07 m"):
            surface(tmp_path, geometry, edge_length=1e-7)


def test_a_shape_is_where_its_origin_is(tmp_path):
    plain, moved = (surface(tmp_path, SHAPES["box"][0], origin) for origin in ("", ORIGIN))
    turn = np.eye(3)
    for i, j, angle in ((1, 2, 0.1), (2, 0, 0.2), (0, 1, 0.3)):
        about = np.eye(3)
        about[[i, j], [i, j]] = np.cos(angle)
        about[j, i], about[i, j] = np.sin(angle), -np.sin(angle)
        turn = about @ turn  # about fixed axes: x first
    np.testing.assert_allclose(moved.vertices, plain.vertices @ turn.T + [1, 2, 3], atol=1e-15)


def test_several_shapes_are_one_surface(tmp_path):
    content = collision('<sphere radius="0.1"/>') + collision(SHAPES["box"][0], ORIGIN)
    robot = load(tmp_path, link("a", content), friction={"a": 0.9})
    (both,) = robot.surfaces
    assert len(both.vertices) == 642 + 8
    assert len(both.faces) == 1280 + 12
    assert both.faces[1280:].min() == 642
    assert is_closed(both.faces)


def test_a_link_without_shapes_has_no_surface(tmp_path):
    assert load(tmp_path, link("a")).surfaces == (None,)


# --- Mesh files -----------------------------------------------------------------------------------

TETRAHEDRON = (
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
)


def mesh_file(folder, name="part.obj", mesh=TETRAHEDRON):
    folder.mkdir(exist_ok=True, parents=True)
    write_mesh(folder / name, [("part", *mesh)])


def test_meshes_are_scaled_and_mirrored(tmp_path):
    mesh_file(tmp_path)
    vertices, faces = surface(tmp_path, '<mesh filename="part.obj" scale="2 3 -0.5"/>')
    np.testing.assert_array_equal(vertices, TETRAHEDRON[0] * [2, 3, -0.5])
    assert mass_properties(vertices, faces)[0] == pytest.approx(2 * 3 * 0.5 / 6)
    with pytest.raises(dc.InvalidInput, match="`scale` must be different from zero"):
        surface(tmp_path, '<mesh filename="part.obj" scale="1 0 1"/>')


def test_corners_of_stl_files_are_merged(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.Trimesh(*TETRAHEDRON, process=False).export(tmp_path / "part.stl")
    vertices, faces = surface(tmp_path, '<mesh filename="part.stl"/>')
    assert len(vertices) == 4
    assert is_manifold(faces)


@pytest.mark.parametrize("scheme", ["package://", "package:///"])
@pytest.mark.parametrize(
    ("name", "folder", "mesh_root"),
    [
        pytest.param("parts/meshes/", "root/parts/meshes", "root", id="in the root"),
        pytest.param("root/meshes/", "root/meshes", "root", id="the root itself"),
        pytest.param("other/meshes/", "root/meshes", "root", id="the root by another name"),
        pytest.param("parts/meshes/", "a/parts/meshes", None, id="beside the file"),
        pytest.param("parts/meshes/", "parts/meshes", None, id="above the file"),
        pytest.param("a/meshes/", "a/meshes", None, id="a folder above the file"),
        pytest.param("other/meshes/", "a/meshes", None, id="a folder above by another name"),
    ],
)
def test_packages_are_found(tmp_path, scheme, name, folder, mesh_root):
    mesh_file(tmp_path / folder)
    (tmp_path / "a" / "urdf").mkdir(parents=True, exist_ok=True)
    (tmp_path / "root").mkdir(exist_ok=True)
    root = None if mesh_root is None else str(tmp_path / mesh_root)
    geometry = f'<mesh filename="{scheme}{name}part.obj"/>'
    assert len(surface(tmp_path / "a" / "urdf", geometry, mesh_root=root).faces) == 4


@pytest.mark.parametrize("variable", ["ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"])
def test_packages_are_found_where_ros_finds_them(tmp_path, monkeypatch, variable):
    inside = "share/parts/meshes" if "AMENT" in variable else "parts/meshes"
    mesh_file(tmp_path / "ws" / inside)
    folder = tmp_path / "a"
    folder.mkdir()
    geometry = '<mesh filename="package://parts/meshes/part.obj"/>'
    with pytest.raises(dc.InvalidInput, match="ROS_PACKAGE_PATH and AMENT_PREFIX_PATH"):
        surface(folder, geometry)
    monkeypatch.setenv(variable, f"/nowhere::{tmp_path / 'ws'}")
    assert len(surface(folder, geometry).faces) == 4
    assert len(surface(folder, geometry, mesh_root=folder).faces) == 4  # a trusted folder


def test_a_package_of_the_name_comes_before_other_folders(tmp_path):
    """Two packages have a mesh of one name; the nearer package is not the named one."""
    mesh_file(tmp_path / "mine" / "meshes")
    mesh_file(tmp_path / "other" / "meshes", mesh=(TETRAHEDRON[0], TETRAHEDRON[1][:3]))
    folder = tmp_path / "mine" / "urdf"
    folder.mkdir()
    for name, count in (("mine", 4), ("other", 3), ("renamed", 4)):
        geometry = f'<mesh filename="package://{name}/meshes/part.obj"/>'
        assert len(surface(folder, geometry).faces) == count


@pytest.mark.parametrize(
    "filename", ["meshes/part.obj", "../meshes/part.obj", "{}/meshes/part.obj"]
)
def test_paths_are_found_from_the_file_and_from_folders_above(tmp_path, filename):
    mesh_file(tmp_path / "meshes")
    folder = tmp_path / "urdf"
    folder.mkdir()
    geometry = f'<mesh filename="{filename.format(tmp_path)}"/>'
    assert len(surface(folder, geometry).faces) == 4
    assert len(surface(folder, geometry, mesh_root=tmp_path).faces) == 4


def test_meshes_must_stay_inside_a_mesh_root_that_is_given(tmp_path):
    root = tmp_path / "robot"
    mesh_file(tmp_path)
    mesh_file(root / "inside")
    (root / "linked.obj").symlink_to(tmp_path / "part.obj")
    (root / "fine.obj").symlink_to(root / "inside" / "part.obj")
    (root / "ring.obj").symlink_to(root / "ring.obj")
    absolute = root / "inside" / "part.obj"
    for name in ("fine.obj", absolute):
        assert len(surface(root, f'<mesh filename="{name}"/>', mesh_root=root).faces) == 4
    outside = [tmp_path / "part.obj", "../part.obj", "linked.obj", "package://a/../part.obj"]
    for name in outside:
        geometry = f'<mesh filename="{name}"/>'
        with pytest.raises(dc.InvalidInput, match="must stay inside `mesh_root`"):
            surface(root, geometry, mesh_root=root)
        assert len(surface(root, geometry).faces) == 4
    assert len(surface(root, '<mesh filename="../part.obj"/>', mesh_root=tmp_path).faces) == 4
    with pytest.raises(dc.InvalidInput, match="must stay inside"):
        surface(root, '<mesh filename="fine.obj"/>', mesh_root=root / "nowhere")
    for name in ("missing.obj", "inside", "ring.obj", "package://a", "x" * 900):
        with pytest.raises(
            dc.InvalidInput, match=r"`filename` (must be a file|.* cannot be found)"
        ):
            surface(root, f'<mesh filename="{name}"/>')
    for name in ("http://localhost/part.obj", "file:///part.obj", "://x"):
        with pytest.raises(dc.InvalidInput, match="a path or start with package://"):
            surface(root, f'<mesh filename="{name}"/>')


def test_useless_faces_of_a_mesh_are_dropped_with_a_warning(tmp_path):
    vertices, faces = TETRAHEDRON
    more = np.concatenate([faces, [[2, 1, 0], [0, 1, 2], [1, 1, 2], [0, 1, 4]]])
    mesh_file(tmp_path, mesh=(np.concatenate([vertices, [[0.5, 0, 0]]]), more))
    message = r"part.obj: dropped 4 of 8 faces: 2 without area, 2 with the vertices of another"
    with pytest.warns(UserWarning, match=message):
        found = surface(tmp_path, '<mesh filename="part.obj"/>')
    np.testing.assert_array_equal(found.faces, faces)


def test_polygons_of_a_mesh_are_triangulated(tmp_path):
    (tmp_path / "box.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\n"
        "f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n"
    )
    vertices, faces = surface(tmp_path, '<mesh filename="box.obj"/>')
    assert is_manifold(faces)
    assert mass_properties(vertices, faces)[0] == pytest.approx(1)


def test_collada_and_gltf_files_are_read(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("collada")
    mesh = trimesh.Trimesh(*TETRAHEDRON, process=False)
    for name in ("part.dae", "part.glb"):
        mesh.export(tmp_path / name)
        vertices, faces = surface(tmp_path, f'<mesh filename="{name}" scale="2 2 2"/>')
        assert len(vertices) == 4
        assert mass_properties(vertices, faces)[0] == pytest.approx(8 / 6)


def test_bad_meshes_are_refused_by_their_file(tmp_path):
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]])
    mesh_file(tmp_path, "flat.obj", flat)
    with pytest.raises(dc.InvalidInput, match=r"flat.obj: `faces` must have an area > 0"):
        surface(tmp_path, '<mesh filename="flat.obj"/>')
    (tmp_path / "part.fbx").write_text("")
    with pytest.raises(
        dc.InvalidInput, match=r"end in .obj, .ply, .stl, .dae, .glb, .gltf, got .*part.fbx"
    ):
        surface(tmp_path, '<mesh filename="part.fbx"/>')
    (tmp_path / "empty.obj").write_text("")
    with pytest.raises(dc.InvalidInput, match=r"empty.obj: the mesh is empty"):
        surface(tmp_path, '<mesh filename="empty.obj"/>')
    (tmp_path / "far.obj").write_text("v 1e300 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n")
    with pytest.raises(dc.InvalidInput, match=r"far.obj: `vertices` must be at most 1e\+30"):
        surface(tmp_path, '<mesh filename="far.obj" scale="1e20 1 1"/>')
