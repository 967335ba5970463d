"""Trajectories in files of other programs, read back by readers that are not ours."""

import base64
import json
import math
import sys
import zipfile

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import diffcloth_torch as dc


@pytest.fixture(scope="module")
def states():
    """A hanging sheet, a box that moves and turns by more than a full turn, and a floor."""
    sheet = dc.Cloth.grid(
        4, 5, (0.3, 0.2), name="sheet", pins={"a": [0]}, pose=[0, 0, 0.1, 1, 0, 0, 0]
    )
    bodies = [
        dc.RigidBody.box(0.1, motion="kinematic", name="box", pose=[0, 0, -0.2, 1, 0, 0, 0]),
        dc.RigidBody.plane(1.0, pose=[0, 0, -0.5, 1, 0, 0, 0], name="floor"),
    ]
    simulator = dc.Simulator(dc.Scene([sheet], bodies), 0.01)

    def control(k, state):
        half = 0.6 * (k + 1)
        turn = [math.cos(half), 0.0, 0.0, math.sin(half)]
        return dc.Control(body_poses={"box": torch.tensor([0.01 * k, 0.0, -0.2, *turn])})

    start = simulator.initial_state()
    return dc.Trajectory([start, *simulator.rollout(start, control, steps=7)])


@pytest.fixture
def batch():
    simulator = dc.Simulator(dc.Scene([dc.Cloth.grid(2, 2, name="sheet")]), 0.01)
    return simulator.rollout(simulator.initial_state(2), steps=2)


def y_up(points):
    return np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1)


def test_arrays_are_read_by_numpy(states, tmp_path):
    states.save(tmp_path / "t.npz")
    arrays = dict(np.load(tmp_path / "t.npz", allow_pickle=False))
    np.testing.assert_array_equal(arrays["times"], [float(s.time) for s in states])
    np.testing.assert_array_equal(arrays["positions/sheet"], states.positions)
    np.testing.assert_array_equal(arrays["velocities/sheet"], states.velocities)
    for name, (vertices, faces) in states[3].meshes().items():
        np.testing.assert_array_equal(arrays[f"faces/{name}"], faces)
        if name != "sheet":
            pose = arrays[f"poses/{name}"][3]
            body = dc.RigidBody(arrays[f"vertices/{name}"], faces, pose=pose, name=name)
            again = dc.Simulator(
                dc.Scene([dc.Cloth.grid(2, 2, pose=[9, 9, 9, 1, 0, 0, 0])], [body]), 0.01
            )
            placed = again.initial_state().meshes()[name][0]
            torch.testing.assert_close(placed, vertices, rtol=0, atol=1e-15)  # rounding of a pose


def test_arrays_hold_batches_and_robots(tmp_path):
    gripper = dc.Robot.load(
        dc.robots.GRIPPER, actuation="position", pose=[0, 0, 1, 0.6, 0, 0.8, 0], name="hand"
    )
    scene = dc.Scene([dc.Cloth.grid(2, 2, 0.1, name="sheet")], robots=[gripper])
    simulator = dc.Simulator(scene, 0.01)
    states = simulator.rollout(simulator.initial_state(2), steps=2)
    states.save(tmp_path / "t.npz")
    arrays = np.load(tmp_path / "t.npz")
    assert arrays["positions/sheet"].shape == (2, 2, 4, 3)
    np.testing.assert_array_equal(arrays["joint_positions/hand"], states.joint_positions)
    frames = simulator.link_poses(states[-1])
    for name in scene.surface_names[1:]:
        x, y, z, *turn = arrays[f"poses/{name}"][-1, 1]
        frame = np.eye(4)
        frame[:3, :3] = Rotation.from_quat(turn, scalar_first=True).as_matrix()
        frame[:3, 3] = x, y, z
        np.testing.assert_allclose(frame, frames[name][1], rtol=0, atol=1e-14)  # rounding


def test_series_are_read_by_vtk(states, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    states.save(tmp_path / "t.pvd")
    reader = pyvista.get_reader(tmp_path / "t.pvd")
    assert reader.time_values == [float(s.time) for s in states]
    for state, time in zip(states, reader.time_values, strict=True):
        reader.set_active_time_value(time)
        for block, (vertices, faces) in zip(reader.read(), state.meshes().values(), strict=True):
            # Rounding of a rotation, in another order.
            np.testing.assert_allclose(block.points, vertices, rtol=0, atol=1e-15)
            np.testing.assert_array_equal(block.faces.reshape(-1, 4)[:, 1:], faces)
        sheet = reader.read()[0]
        np.testing.assert_array_equal(sheet["velocity"], state.velocities)
        np.testing.assert_array_equal(sheet["contact_force"], state.contact_forces)


@pytest.mark.parametrize("ending", ["glb", "gltf"])
def test_gltf_is_played_by_vtk(states, tmp_path, ending):
    geometry = pytest.importorskip("vtkmodules.vtkIOGeometry")
    pyvista = pytest.importorskip("pyvista")
    states.save(tmp_path / f"t.{ending}")
    reader = geometry.vtkGLTFReader()
    reader.SetFileName(str(tmp_path / f"t.{ending}"))
    reader.ApplyDeformationsToGeometryOn()
    reader.SetFrameRate(100)
    reader.UpdateInformation()
    assert reader.GetNumberOfAnimations() == 1
    assert reader.GetAnimationDuration(0) == pytest.approx(float(states[-1].time))
    reader.EnableAnimation(0)
    for state in states:
        reader.UpdateTimeStep(float(state.time))
        scene = pyvista.wrap(reader.GetOutput())
        placed = [mesh for mesh in scene.recursive_iterator() if mesh is not None]
        for mesh, (vertices, _) in zip(placed, state.meshes().values(), strict=True):
            # float32 of numbers below 1 m, and of the time of a state.
            np.testing.assert_allclose(mesh.points, y_up(vertices.numpy()), rtol=0, atol=1e-6)


def test_gltf_begins_at_the_first_state(states, tmp_path):
    import trimesh

    states[4:].save(tmp_path / "t.glb")
    scene = trimesh.load(tmp_path / "t.glb")
    assert set(scene.geometry) == {"sheet", "box", "floor"}
    for name, (vertices, faces) in states[4].meshes().items():
        frame, _ = scene.graph[name]
        mesh = scene.geometry[name].copy().apply_transform(frame)
        np.testing.assert_array_equal(mesh.faces, faces)
        np.testing.assert_allclose(mesh.vertices, y_up(vertices.numpy()), rtol=0, atol=1e-7)


def test_gltf_turns_the_shorter_way(states, tmp_path):
    """Some players interpolate quaternions of opposite signs through zero."""
    states.save(tmp_path / "t.gltf")
    document = json.loads((tmp_path / "t.gltf").read_text())
    data = base64.b64decode(document["buffers"][0]["uri"].partition(",")[2])
    motion = document["animations"][0]
    (channel,) = (c for c in motion["channels"] if c["target"]["path"] == "rotation")
    accessor = document["accessors"][motion["samplers"][channel["sampler"]]["output"]]
    start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    turns = np.frombuffer(data, "<f4", 4 * accessor["count"], start).reshape(-1, 4)
    np.testing.assert_allclose((turns[1:] * turns[:-1]).sum(1), math.cos(0.6), atol=1e-6)


@pytest.mark.parametrize("ending", ["usd", "usda", "usdc"])
def test_usd_is_read_by_pxr(states, tmp_path, ending):
    pytest.importorskip("pxr", reason="usd-core is in the extra `usd`")
    from pxr import Usd, UsdGeom

    states.save(tmp_path / f"t.{ending}")
    stage = Usd.Stage.Open(str(tmp_path / f"t.{ending}"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == pytest.approx(100.0)
    assert stage.GetEndTimeCode() == 7.0
    for k, state in enumerate(states):
        assert k / stage.GetTimeCodesPerSecond() == pytest.approx(float(state.time))
        for name, (vertices, faces) in state.meshes().items():
            mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/scene/{name}"))
            points = np.array(mesh.GetPointsAttr().Get(k))
            frame = np.array(mesh.ComputeLocalToWorldTransform(k))
            placed = points @ frame[:3, :3] + frame[3, :3]
            np.testing.assert_allclose(placed, vertices, rtol=0, atol=1e-7)  # float32
            indices = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
            np.testing.assert_array_equal(indices, faces)
        sheet = UsdGeom.Mesh(stage.GetPrimAtPath("/scene/sheet"))
        speeds = np.array(sheet.GetVelocitiesAttr().Get(k))
        np.testing.assert_allclose(speeds, state.velocities, rtol=1e-6, atol=1e-7)


def test_a_missing_extra_is_named(states, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr.Usd", None)
    with pytest.raises(dc.InvalidInput, match=r"USD files need usd-core: run .*\[usd\]"):
        states.save(tmp_path / "t.usd")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["t.h5", "t.vtk", "t.vtkhdf", "t", "t.usdz", "t.PT.bak"])
def test_other_endings_are_refused(states, tmp_path, name):
    accepted = r"must end in \.pt, \.npz, \.pvd, \.glb, \.gltf, \.usd, \.usda, \.usdc, got"
    with pytest.raises(dc.InvalidInput, match=accepted):
        states.save(tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", [".pvd", ".glb", ".usd"])
def test_states_that_a_format_cannot_hold_are_refused(states, batch, tmp_path, ending):
    file = tmp_path / f"t{ending}"
    file.write_text("kept")
    with pytest.raises(dc.InvalidInput, match=r"one environment .* got a batch of 2"):
        batch.save(file)
    with pytest.raises(dc.InvalidInput, match=r"increase .* got 0.01 s after 0.02 s at \[1\]"):
        dc.Trajectory([states[2], states[1]]).save(file)
    with pytest.raises(dc.InvalidInput, match="needs at least one state"):
        dc.Trajectory().save(file)
    with pytest.raises(dc.InvalidInput, match=r"`positions` must have the same shape"):
        dc.Trajectory([states[0], batch[0][0]]).save(file)
    plain = dc.State(
        **{
            n: getattr(states[0], n)
            for n in (
                "positions",
                "velocities",
                "body_poses",
                "soft_pin_targets",
                "body_forces",
                "time",
            )
        }
    )
    with pytest.raises(dc.InvalidInput, match="must come from a Simulator"):
        dc.Trajectory([plain]).save(file)
    with pytest.raises(FileNotFoundError):
        states.save(tmp_path / "none" / f"t{ending}")
    assert [(f.name, f.read_text()) for f in tmp_path.iterdir()] == [(f"t{ending}", "kept")]


def test_a_file_that_cannot_be_finished_keeps_the_one_before(states, tmp_path, monkeypatch):
    states.save(tmp_path / "t.npz")
    before = (tmp_path / "t.npz").read_bytes()

    def full(*_args, **_keywords):
        raise OSError("no space")

    monkeypatch.setattr(zipfile.ZipFile, "open", full)
    with pytest.raises(OSError, match="no space"):
        states.save(tmp_path / "t.npz")
    assert [f.name for f in tmp_path.iterdir()] == ["t.npz"]
    assert (tmp_path / "t.npz").read_bytes() == before
