"""Captures in the format of RGBench, written by these tests, and fits to the captures."""

from __future__ import annotations

import json

import numpy as np
import pytest
import rgbench
import torch
from click.testing import CliRunner

import diffcloth_torch as dc
from diffcloth_torch.geometry.rotation import quaternion_matrix

BEGIN = 1.7e9 + 0.25  # [s], as stamps of a recording have
DT, DELAY = 0.02, 0.06
F64 = torch.float64


def garment(stretch=60.0):
    cloth = dc.Cloth.grid(
        7,
        7,
        (0.3, 0.3),
        material=dc.Material(stretch=stretch, bending=1e-4, density=0.2, damping=0.02),
        pins={"left": [48], "right": [42]},
        pose=[0.3, 0.0, 0.5, 1, 0, 0, 0],
        name="garment",
    )
    contact = dc.ContactOptions(self_contact=False)
    return dc.Simulator(dc.Scene([cloth]), DT, contact=contact)


def camera():
    """Camera from world, 4 x 4."""
    found = np.eye(4)
    axis = torch.tensor([0.9, 0.1, 0.4, 0.0], dtype=F64)
    found[:3, :3] = quaternion_matrix(axis / axis.norm()).numpy()
    found[:3, 3] = [0.1, -0.2, 0.9]
    return found


def moved(start, t):
    """Position of a swinging gripper at time t."""
    return np.asarray(start) + 0.05 * np.array([np.sin(8 * t), 0.0, 0.3 * np.sin(11 * t)])


def swing(sim, parameters, steps):
    """The states of a garment whose pinned vertices follow the grippers."""
    cloth = sim.scene.cloths[0]

    def control(k, _):
        places = {n: moved(cloth.vertices[rows], (k + 1) * DT) for n, rows in cloth.pins.items()}
        return dc.Control(pins={n: torch.from_numpy(p) for n, p in places.items()})

    return sim.rollout(sim.initial_state(), control, parameters=parameters, steps=steps)


def write_pcd(path, points, data="binary"):
    content = points.astype("<f4")
    head = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA {data}\n"
    )
    lines = "\n".join(" ".join(map(repr, map(float, row))) for row in content)
    path.write_bytes(head.encode() + (content.tobytes() if data == "binary" else lines.encode()))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A capture of a swinging garment; its frames show half of it, with noise of 1 mm."""
    root = tmp_path_factory.mktemp("tshirt_fling_2025-01-01-00-00-00")
    for name in ("calibration", "joints", "segment_pcds"):
        (root / name).mkdir()
    (root / "calibration/world_to_camera_transform.json").write_text(json.dumps(camera().tolist()))
    sim = garment()
    with torch.no_grad():
        states = swing(sim, None, 20)
    start = sim.initial_state().positions.numpy()
    for arm, vertex in {"left": 48, "right": 42}.items():
        rows = ["time,pos_1,pos_gripper,pos_x,pos_y,pos_z,orn_w,orn_x,orn_y,orn_z"]
        for k in range(201):
            place = moved(start[vertex], k * 0.002) - rgbench.BASES[arm]
            numbers = [BEGIN + k * 0.002, 0.1, 0.02, *place, 1, 0, 0, 0]
            rows.append(",".join(f"{x:.9f}" for x in numbers))
        file = root / f"joints/{arm}_arm_joint_states_and_end_pose.csv"
        file.write_text("\n".join(rows) + "\n")
    generator = np.random.default_rng(0)
    for step in (5, 10, 15, 20):
        seen = states[step - 1].positions.numpy()[:28]  # no camera saw the others
        seen = seen + 1e-3 * generator.standard_normal(seen.shape)
        points = seen @ camera()[:3, :3].T + camera()[:3, 3]
        name = f"pointcloud_{BEGIN + step * DT - DELAY:.6f}_segmented.pcd"
        write_pcd(root / "segment_pcds" / name, points, "ascii" if step == 10 else "binary")
    write_pcd(root / f"segment_pcds/pointcloud_{BEGIN - 1:.6f}_segmented.pcd", np.zeros((2, 3)))
    write_pcd(root / f"segment_pcds/pointcloud_{BEGIN + 9:.6f}_segmented.pcd", np.zeros((0, 3)))
    (root / "segment_pcds/notes.pcd").write_text("something else")
    return root


def test_a_capture_is_in_world_axes_and_on_the_clock_of_the_arms(recorded):
    capture = rgbench.read_capture(recorded, delay=DELAY)
    np.testing.assert_allclose(capture.times, [0.1, 0.2, 0.3, 0.4], atol=1e-5)
    assert capture.steps(DT) == [5, 10, 15, 20]
    assert [len(cloud) for cloud in capture.clouds] == [28] * 4
    with torch.no_grad():
        states = [swing(garment(), None, 20)[k - 1] for k in capture.steps(DT)]
    for state, cloud in zip(states, capture.clouds, strict=True):
        np.testing.assert_allclose(cloud, state.positions.numpy()[:28], atol=5e-3)
    start = garment().initial_state().positions.numpy()
    for time in (0.1, 0.1013, -1.0, 9.0):
        found = capture.grippers(time)
        for arm, vertex in {"left": 48, "right": 42}.items():
            expected = moved(start[vertex], min(max(time, 0.0), 0.4))
            np.testing.assert_allclose(found[arm], expected, atol=1e-5)
    assert rgbench.nearest_vertices(start, capture.grippers(0.0)) == {"left": 48, "right": 42}
    window = capture.between(0.15, 0.35)
    assert [len(window.clouds), *window.steps(DT)] == [2, 10, 15]


def test_the_program_prints_a_line_for_each_frame(recorded):
    result = CliRunner().invoke(rgbench.main, [str(recorded), "--delay", str(DELAY)])
    lines = result.output.splitlines()
    assert len(lines) == 4, result.output
    assert lines[0].startswith("0.100 s: 28 points, grippers left [")


def test_chamfer_is_that_of_all_pairs_from_real_to_simulated(recorded):
    capture = rgbench.read_capture(recorded, delay=DELAY)
    with torch.no_grad():
        states = [swing(garment(), None, 20)[k - 1] for k in capture.steps(DT)]
    for norm in (1, 2):
        for state, cloud, found in zip(
            states, capture.clouds, rgbench.chamfer(states, capture.clouds, norm=norm), strict=True
        ):
            pairs = cloud[:, None] - state.positions.numpy()[None]
            expected = np.linalg.norm(pairs, ord=norm, axis=2).min(axis=1).mean()
            assert found == pytest.approx(expected, rel=1e-12)
            assert found < 5e-3, "what no camera saw does not count"


def test_a_stiffness_is_fitted_to_a_capture(recorded):
    capture = rgbench.read_capture(recorded, delay=DELAY)
    sim = garment()

    def residuals(parameters):
        given = sim.default_parameters().replace(stretch=parameters.stretch)
        states = swing(sim, given, 20)
        seen = [states[k - 1] for k in capture.steps(DT)]
        return dc.residuals.point_cloud(seen, capture.clouds, noise=1e-3)

    found = dc.fit({"stretch": dc.Variable(40.0)}, residuals)
    low, high = found.intervals["stretch"]
    assert low < 60.0 < high < 1.5 * low


def spoil(recorded, tmp_path, file, content):
    """A copy of the capture with another file."""
    import shutil

    root = tmp_path / "capture"
    shutil.copytree(recorded, root)
    (root / file).write_text(content)
    return root


POSES = "joints/left_arm_joint_states_and_end_pose.csv"
TRANSFORM = "calibration/world_to_camera_transform.json"


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        (POSES, "time,pos_x,pos_y\n", "must have the column 'pos_z'"),
        (POSES, "time,pos_x,pos_y,pos_z\n", "must have one or more rows"),
        (POSES, "time,pos_x,pos_y,pos_z\n1,2,3\n", r"the row \[0\] must have numbers"),
        (POSES, "time,pos_x,pos_y,pos_z\n1,2,3,4\n1,2,3,4\n", r"the row \[1\] must be finite, and"),
        (POSES, "time,pos_x,pos_y,pos_z\n1,2,3,nan\n", r"the row \[0\] must be finite"),
        (TRANSFORM, "[[1, 2], [3]]", "must be a matrix of 4 x 4 numbers"),
        (TRANSFORM, "{", "must be a matrix of 4 x 4 numbers"),
        (TRANSFORM, json.dumps(np.eye(3).tolist()), "must be a 4 x 4 matrix of a rotation"),
        (TRANSFORM, json.dumps((2 * np.eye(4)).tolist()), "must be a 4 x 4 matrix of a rotation"),
        (f"segment_pcds/pointcloud_{BEGIN + 1}_segmented.pcd", "x", "must have a PCD header"),
    ],
)
def test_bad_captures_are_refused(recorded, tmp_path, file, content, message):
    with pytest.raises(dc.InvalidInput, match=message):
        rgbench.read_capture(spoil(recorded, tmp_path, file, content))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda root: rgbench.read_capture(root / "nothing"), "`folder` must be a folder"),
        (lambda root: rgbench.read_capture(root / "joints"), "must have joints/left_arm"),
        (lambda root: rgbench.read_capture(root, delay=-1.0), "`delay` must be finite and >= 0"),
        (
            lambda root: rgbench.read_capture(root, bases={"left": [0, 0]}),
            r"`bases\['left'\]` must have shape \[3\]",
        ),
        (lambda root: rgbench.read_capture(root).between(7, 8), "must be a frame between 7 and 8"),
        (lambda root: rgbench.chamfer([], [], norm=3), "`norm` must be 1 or 2, got 3"),
        (
            lambda root: rgbench.chamfer([], [np.zeros((1, 3))]),
            "`states` must be one or more, got none",
        ),
        (lambda root: rgbench.nearest_vertices(np.zeros((0, 3)), {}), "one or more vertices"),
        (
            lambda root: rgbench.nearest_vertices(np.zeros((2, 3)), {"left": [0, 0, np.nan]}),
            r"`grippers\['left'\]` must be finite",
        ),
    ],
)
def test_bad_arguments_are_refused(recorded, call, message):
    with pytest.raises(dc.InvalidInput, match=message):
        call(recorded)
