"""Files of any content: each reader returns the file's data or raises one `InvalidInput`."""

import os
import signal
import struct
from contextlib import contextmanager

import numpy as np
import pytest

import diffcloth_torch as dc
from diffcloth_torch.config.documents import read_document
from diffcloth_torch.geometry.meshes import read_body_mesh, read_mesh
from diffcloth_torch.model.urdf import read_urdf

pytest.importorskip("hypothesis")
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

OBJ = b"# by hand\nv 0 0 0\nv 1.0 0 0 0.5 0.5 0.5\nvn 0 0 1\nv 0 1e0 0\nf 1//1 2//1 \\\n-1//1\n"
PLY_HEADER = (
    b"ply\nformat %s 1.0\ncomment by hand\nelement vertex 3\nproperty float x\nproperty double y\n"
    b"property short z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
)
PLY = PLY_HEADER % b"ascii" + b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
CORNERS = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]


def binary_ply(order, name):
    rows = b"".join(struct.pack(order + "fdh", *corner) for corner in CORNERS)
    return PLY_HEADER % name + rows + struct.pack(order + "B3i", 3, 0, 1, 2)


BINARY_PLY = [binary_ply("<", b"binary_little_endian"), binary_ply(">", b"binary_big_endian")]
STL = b"\0" * 80 + struct.pack("<I12fH", 1, 0, 0, 1, *sum(CORNERS, ()), 0)
ASCII_STL = (
    b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
    b"endloop\nendfacet\nendsolid a\n"
)
YAML = b"task: drape\nscene:\n  cloths:\n  - &a {name: b, size: [1, 1e-3]}\n  - *a\n"
DAE = b"""<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset/>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="9">
0 0 0 1 0 0 0 1 0</float_array><technique_common><accessor source="#a" count="3" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
</accessor></technique_common></source><vertices id="v"><input semantic="POSITION" source="#p"/>
</vertices><triangles count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p>
</triangles></mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s">
<node><instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def glb():
    trimesh = pytest.importorskip("trimesh")
    corner = trimesh.Trimesh(CORNERS, [[0, 1, 2]], process=False)
    return trimesh.Scene([corner]).export(file_type="glb")


SEEDS = {
    ".dae": [DAE],
    ".glb": [glb()],
    ".obj": [OBJ],
    ".ply": [PLY, *BINARY_PLY],
    ".stl": [STL, ASCII_STL],
    ".yaml": [YAML],
    ".urdf": [b'<?xml version="1.0"?><robot name="a"><link name="b"/></robot>'],
}
READERS = {".yaml": read_document, ".urdf": read_urdf}
OF_BODIES = (".dae", ".glb")


@contextmanager
def seconds(count):
    """Fail if the block does not end within `count` seconds."""

    def too_long(*_):
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, too_long)
    signal.alarm(count)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def read(path):
    if path.suffix in OF_BODIES:
        return read_body_mesh(path, "path")[:2]
    return READERS.get(path.suffix, read_mesh)(path)


def written(folder, suffix, content):
    path = folder / f"file{suffix}"
    path.write_bytes(content)
    return path


# --- Any bytes -----------------------------------------------------------------------------------


def mutations(seeds, words):
    """Bytes of any kind, and good files with pieces cut out, replaced, or put in."""
    piece = st.binary(max_size=8) | st.sampled_from(words)
    cut = st.tuples(st.floats(0, 1), st.integers(0, 12), piece)

    def changed(seed, cuts):
        for place, length, put in cuts:
            at = int(place * len(seed))
            seed = seed[:at] + put + seed[at + length :]
        return seed

    return st.binary(max_size=200) | st.builds(
        changed, st.sampled_from(seeds), st.lists(cut, min_size=1, max_size=6)
    )


WORDS = {
    ".dae": [
        b"<p>0 1 9</p>",
        b"nan ",
        b"#v",
        b"<node/>",
        b"<polylist>",
        b"</mesh>",
        b"99999999999",
    ],
    ".glb": [b"glTF", b"JSON", b"BIN\0", b"5126", b"[", b"{", b"\xff\xff\xff\xff", b"nan"],
    ".obj": [b"v ", b"f 1 2 3\n", b"1_0", b"\xef\xbb\xbf", b"\xe2\x80\xa8", b"\0", b"#", b"\\\n"],
    ".ply": [
        b"element vertex 3\n",
        b"element face 99999999999\n",
        b"property list float int vertex_indices\n",
        b"property list int double x\n",
        b"property uint x\n",
        b"end_header\n",
        b"-1 ",
        b"1e400 ",
        b"nan ",
        b"1.5 ",
        b"\xff\xff\xff\xff",
    ],
    ".stl": [b"solid", b"facet normal ", b"vertex ", b"nan ", b"\xff\xff\xff\xff", b"endsolid\n"],
    ".yaml": [b"&a ", b"*a", b"<<: ", b"[", b"{", b"? ", b"!!", b"2001-99-99", b"---\n", b"- "],
    ".urdf": [b"<link name='c'/>", b"<joint", b"&lt;", b"<!DOCTYPE a>", b"<![CDATA[", b"</robot>"],
}


@pytest.mark.parametrize("suffix", SEEDS)
def test_any_bytes_are_read_or_refused(tmp_path, suffix):
    if suffix == ".dae":
        pytest.importorskip("collada")
    outcomes = {"read": 0, "refused": 0}

    @settings(
        max_examples=int(os.environ.get("DIFFCLOTH_FUZZ_EXAMPLES", "300")),
        deadline=None,
        derandomize="DIFFCLOTH_FUZZ_EXAMPLES" not in os.environ,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(mutations(SEEDS[suffix], WORDS[suffix]))
    def fuzz(content):
        path = written(tmp_path, suffix, content)
        try:
            with seconds(60):  # the first may import much
                result = read(path)
        except dc.InvalidInput:
            outcomes["refused"] += 1
            return
        outcomes["read"] += 1
        if suffix not in READERS:
            vertices, faces = result
            assert vertices.dtype == np.float64
            assert vertices.shape[1:] == faces.shape[1:] == (3,)
            assert np.isfinite(vertices).all()
            assert faces.dtype == np.int64
            assert faces.min() >= 0
            assert faces.max() < len(vertices)

    fuzz()
    assert min(outcomes.values()) > 0


@pytest.mark.parametrize(
    ("suffix", "content"),
    [(suffix, seed) for suffix, seeds in SEEDS.items() for seed in seeds],
)
def test_the_files_that_are_changed_are_good_ones(tmp_path, suffix, content):
    result = read(written(tmp_path, suffix, content))
    if suffix not in READERS:
        np.testing.assert_array_equal(result[0], CORNERS)
        np.testing.assert_array_equal(result[1], [[0, 1, 2]])


# --- Paths that are no files ---------------------------------------------------------------------


@pytest.mark.parametrize("suffix", SEEDS)
@pytest.mark.parametrize("kind", ["folder", "fifo", "device", "socket link"])
def test_only_regular_files_are_read(tmp_path, suffix, kind):
    path = tmp_path / f"a{suffix}"
    if kind == "folder":
        path.mkdir()
    elif kind == "fifo":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        os.mkfifo(tmp_path / "pipe")
        path.symlink_to(tmp_path / "pipe")
    with seconds(10), pytest.raises(dc.InvalidInput, match=r"a\..* must be a regular file"):
        read(path)


@pytest.mark.parametrize("suffix", [s for s in SEEDS if s != ".yaml"])
def test_a_file_that_is_not_there_is_an_os_error(tmp_path, suffix):
    with pytest.raises(FileNotFoundError):
        read(tmp_path / f"a{suffix}")


def test_a_path_with_a_nul_is_refused():
    with pytest.raises(dc.InvalidInput, match="no path"):
        read_mesh("a\0b.obj")


def test_a_file_of_absurd_size_is_refused_unread(tmp_path):
    path = tmp_path / "a.obj"
    path.touch()
    os.truncate(path, 2**31)  # a hole, without content on the disk
    with seconds(10), pytest.raises(dc.InvalidInput, match="at most 1024 MiB"):
        read_mesh(path)


# --- OBJ -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"\xef\xbb\xbf" + OBJ, id="byte order mark"),
        pytest.param(OBJ.replace(b"\n", b"\r\n"), id="lines of another system"),
        pytest.param(OBJ.replace(b"\n", b"\r"), id="lines of an old system"),
        pytest.param(OBJ + "# a\u2028v 1\x85f 1\x0bv".encode(), id="line ends in a comment"),
        pytest.param(b"# C:\\parts\\\n" + OBJ, id="backslash in a comment"),
        pytest.param(OBJ.rstrip(b"\n") + b"\\", id="backslash at the end"),
    ],
)
def test_the_same_mesh_in_other_writing(tmp_path, content):
    vertices, faces = read_mesh(written(tmp_path, ".obj", content))
    np.testing.assert_array_equal(vertices, CORNERS)
    np.testing.assert_array_equal(faces, [[0, 1, 2]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        pytest.param(b"v 1_0 0 0\n", r":1: a coordinate must be a number, got '1_0'", id="1_0"),
        pytest.param(OBJ + b"f 1 2_0 3\n", r":8: a face index must be .* '2_0'", id="index 2_0"),
        pytest.param(OBJ + b"f 1 2 3.0\n", r":8: a face index must be .* '3.0'", id="index 3.0"),
        pytest.param("v ١ 0 0\n".encode(), ":1: a coordinate must be", id="other digits"),
        pytest.param(OBJ + b"g a\0b\n", ":8: .* byte 0", id="nul"),
        pytest.param(OBJ.decode().encode("utf-16"), "byte 0", id="utf-16"),
        pytest.param(OBJ.replace(b"1.0", b"1e999"), "finite, got inf at vertex 1", id="infinite"),
        pytest.param(OBJ + b"f 1 2 " + b"9" * 5000 + b"\n", ":8: ", id="a long index"),
    ],
)
def test_an_obj_of_other_numbers_is_refused(tmp_path, content, message):
    with pytest.raises(dc.InvalidInput, match=message):
        read_mesh(written(tmp_path, ".obj", content))


# --- PLY -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"uchar int", b"float int", "'vertex_indices' must have a length that is an integer"),
        (b"uchar int", b"uchar float", "'vertex_indices' must hold integers"),
        (b"\n3 0 1 2", b"\n3.0 0 1 2", "face 0 must hold numbers of the types .* got '3.0'"),
        (b"\n3 0 1 2", b"\n3 0 1.7 2", "face 0 must hold numbers of the types .* got '1.7'"),
        (b"\n3 0 1 2", b"\n3 0 1_0 2", "got '1_0'"),
        (b"\n3 0 1 2", b"\n-3 0 1 2", "got a length of -3"),
        (b"\n3 0 1 2", b"\n3 0 1 99999999999", "beyond 32 bits"),
        (b"\n3 0 1 2", b"\n3 0 1 -1", "face 0 has vertex -1"),
        (b"\n1 0 0", b"\n1_0 0 0", "vertex 1 must hold numbers .* got '1_0'"),
        (b"\n1 0 0", b"\nnan 0 0", "finite, got nan at vertex 1"),
        (b"vertex 3", b"vertex 3.0", ":4: malformed header line"),
        (b"vertex 3", b"vertex -3", ":4: malformed header line"),
        (b"vertex 3", b"vertex 1_0", ":4: malformed header line"),
        (b"short z", b"float16 z", ":7: malformed header line"),
        (b"short z", b"short x", "twice"),
        (b"short z", b"list uchar short z", "no property 'z'"),
        (b"element face", b"element vertex", "twice"),
        (b"list uchar int", b"int", "no list 'vertex_indices'"),
        (b"comment by hand", b"remark by hand", ":3: malformed header line 'remark by hand'"),
        (b"end_header", b"comment end_header", ":11: malformed header line '0 0 0'"),
        (b"ascii 1.0", b"ascii 2.0", ":2: malformed header line"),
        (b"format ascii 1.0\n", b"", "no format line"),
    ],
)
def test_a_ply_with_something_else_is_refused(tmp_path, old, new, message):
    assert PLY.count(old) == 1
    with pytest.raises(dc.InvalidInput, match=message):
        read_mesh(written(tmp_path, ".ply", PLY.replace(old, new)))


def test_a_binary_list_of_absurd_length_is_refused_before_it_is_read(tmp_path):
    header = PLY_HEADER.replace(b"element vertex", b"element other 1\nproperty list uint int l\n%s")
    content = (
        header % (b"binary_little_endian", b"element vertex") + b"\xff\xff\xff\x7f" + b"0" * 40
    )
    with pytest.raises(dc.InvalidInput, match="ends within the other rows"):
        read_mesh(written(tmp_path, ".ply", content))


# --- YAML ----------------------------------------------------------------------------------------

BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        pytest.param(BOMB, "at most 100000 values, aliases written out", id="bomb"),
        pytest.param("a: &a [*a]", r"alias \*a must follow the end", id="holds itself"),
        pytest.param("a: &a {b: *a}", r"alias \*a must follow the end", id="mapping of itself"),
        pytest.param("a: &a 1\nb: &a 2", "anchor &a must stand once", id="anchor twice"),
        pytest.param("a: *b", r"alias \*b must follow", id="no anchor"),
        pytest.param("[" * 100_000, "at most 50 levels", id="deep"),
        pytest.param("a:\n  " + "- " * 60 + "1", "at most 50 levels", id="deep in a line"),
        pytest.param("a: [" + "1," * 100_001 + "]", "at most 100000 values", id="long"),
        pytest.param("a: 1\na: 2", "duplicate key", id="key twice"),
        pytest.param("a: {b: 1, b: 2}", "duplicate key", id="key twice in a line"),
        pytest.param("1: 2", "a key must be text, got 1", id="number as key"),
        pytest.param("? [a]\n: 2", "a key must be text", id="list as key"),
        pytest.param("a: 2001-99-99", "not readable as YAML", id="no date"),
        pytest.param("a: 2001-01-01", "`a` must hold text or numbers, got a date", id="date"),
        pytest.param("a: !!set {b}", "must hold text or numbers, got a set", id="set"),
        pytest.param("a: !!python/object:os.system b", "not readable as YAML", id="object"),
        pytest.param("a: 1" + "0" * 5000, "not readable as YAML", id="long number"),
        pytest.param("a\0: 1", "not readable as YAML", id="nul"),
        pytest.param("- a", "must be a mapping", id="list"),
        pytest.param("", "must be a mapping", id="empty"),
        pytest.param("a: " + "b" * 2**20, "at most 1 MiB", id="large"),
    ],
)
def test_a_yaml_that_is_no_page_of_keys_is_refused(tmp_path, text, message):
    with seconds(60), pytest.raises(dc.InvalidInput, match=message):
        read_document(written(tmp_path, ".yaml", text.encode()))


def test_yaml_is_that_of_its_second_version(tmp_path):
    text = b"a: 1e-3\nb: on\nc: 010\nd: 1:30\ne: &e [yes, ~]\nf: *e\ng: {<<: {h: 1}, i: .5}\n"
    assert read_document(written(tmp_path, ".yaml", text)) == {
        "a": 1e-3,
        "b": "on",
        "c": 10,
        "d": "1:30",
        "e": ["yes", None],
        "f": ["yes", None],
        "g": {"h": 1, "i": 0.5},
    }
