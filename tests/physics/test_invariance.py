"""A scene in another frame, unit or representation has the same motion."""

import dataclasses
import io

import numpy as np
import pytest
import torch
from physics_scenes import F64, jittered_sheet, matrix, quaternion, tensor

import diffcloth_torch as dc

G = 9.81
DT = 0.01
STEPS = 4
SETTINGS = {
    "coupled": {"scheme": "coupled"},
    "split": {"scheme": "split"},
    "smooth": {"scheme": "coupled", "smooth": True},
    "woven": {"scheme": "coupled", "warp": np.array([0.8, 0.6, 0.0])},
}
CONTACT = {"barrier_distance": 4e-3, "slip_velocity": 1e-2}
SAME = 1e-9


@dataclasses.dataclass
class Setting:
    """A taut sheet, pinned at two sides, over a ball that rises and turns: nothing buckles."""

    vertices: np.ndarray
    faces: np.ndarray
    pins: np.ndarray
    ball: np.ndarray  # pose
    lift: np.ndarray  # velocity of the ball
    spin: np.ndarray  # quaternion of its turn in each step
    gravity: np.ndarray
    # Units: one meter, kilogram and second in units of the setting.
    m: float = 1.0
    kg: float = 1.0
    s: float = 1.0
    far_body: bool = False
    scheme: str = "coupled"
    smooth: bool = False  # of the ball
    warp: np.ndarray | None = None  # direction; None: the cloth is isotropic

    def simulator(self):
        m, kg, s = self.m, self.kg, self.s
        material = dc.Material(
            stretch=150.0 * kg / s**2,
            bending=1e-3 * kg * m**2 / s**2,
            density=0.2 * kg / m**2,
            damping=1e-3 * s,
            friction=0.3,
            thickness=1e-3 * m,
        )
        if self.warp is not None:
            material = dataclasses.replace(
                material,
                stretch_weft=80.0 * kg / s**2,
                stretch_shear=20.0 * kg / s**2,
                bending_weft=4e-4 * kg * m**2 / s**2,
                bending_twill=7e-4 * kg * m**2 / s**2,
            )
        rest = self.vertices / 1.02  # pretension
        cloth = dc.Cloth(
            self.vertices,
            self.faces,
            rest_positions=rest,
            material=material,
            pins={"p": self.pins},
            directions=self.warp,
        )
        ball = dc.RigidBody.sphere(
            0.1 * m,
            subdivisions=2,
            smooth=self.smooth,
            motion="kinematic",
            pose=self.ball,
            friction=0.6,
        )
        bodies = [ball]
        if self.far_body:
            bodies.insert(0, dc.RigidBody.box(1.0, pose=[30, 40, 10, 1, 0, 0, 0]))
        contact = dc.ContactOptions(
            barrier_distance=CONTACT["barrier_distance"] * m,
            slip_velocity=CONTACT["slip_velocity"] * m / s,
        )
        return dc.Simulator(
            dc.Scene([cloth], bodies, gravity=self.gravity),
            DT * s,
            scheme=self.scheme,
            contact=contact,
            solver=dc.SolverOptions(tolerance=1e-9 * m / s),
        )

    def control(self, sim, state):
        poses = state.body_poses.clone()
        pose = poses[..., -1, :]
        pose[..., :3] += tensor(self.lift) * sim.dt
        turned = multiply(self.spin, pose.reshape(-1, 7)[0, 3:].numpy())
        pose[..., 3:] = tensor(turned)
        return dc.Control(body_poses=poses)

    def run(self, batch_size=None):
        sim = self.simulator()
        state = sim.initial_state(batch_size)
        for _ in range(STEPS):
            state = sim.step(state, self.control(sim, state))
        # A smooth ball touches only the face above it.
        assert np.all(np.asarray(state.report.contact_count) >= (1 if self.smooth else 5))
        return state


def multiply(p, q):
    """Product of two quaternions wxyz."""
    w = p[0] * q[0] - p[1:] @ q[1:]
    return np.concatenate([[w], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])])


def setting(**changes):
    vertices, faces = jittered_sheet(6, 0.5)
    vertices = vertices - [0.25, 0, 0]
    pins = np.flatnonzero(np.abs(np.abs(vertices[:, 0]) - 0.25) < 1e-9)
    base = Setting(
        vertices,
        faces,
        pins,
        ball=np.array([0.03, 0.02, -0.104, 1, 0, 0, 0]),
        lift=np.array([0.2, 0.1, 0.5]),
        spin=quaternion([1, 2, 3], 0.02),
        gravity=np.array([0, 0, -G]),
    )
    return dataclasses.replace(base, **changes)


@pytest.fixture(scope="module", params=SETTINGS)
def reference(request):
    base = setting(**SETTINGS[request.param])
    return base, base.run()


def close(a, b, scale=1.0):
    return (a - b).abs().max().item() <= SAME * scale


def test_turning_moving_and_relabeling_the_scene_changes_nothing(reference):
    base, expected = reference
    q = quaternion([1, -2, 0.5], 1.3)
    R, shift = matrix(q), np.array([0.7, -1.1, 0.4])
    order = np.random.default_rng(0).permutation(len(base.vertices))
    place = np.argsort(order)  # new index of an old vertex
    faces = place[base.faces][::-1]
    faces = np.stack([np.roll(face, k % 3) for k, face in enumerate(faces)])
    moved = dataclasses.replace(
        base,
        vertices=(base.vertices @ R.T + shift)[order],
        faces=faces,
        pins=place[base.pins][::-1].copy(),
        ball=np.concatenate([R @ base.ball[:3] + shift, multiply(q, base.ball[3:])]),
        lift=R @ base.lift,
        spin=multiply(multiply(q, base.spin), q * [1, -1, -1, -1]),
        gravity=R @ base.gravity,
        warp=None if base.warp is None else R @ base.warp,
    )
    after = moved.run()
    back = (after.positions[place] - tensor(shift)) @ tensor(R)
    assert close(back, expected.positions)
    assert close(after.velocities[place] @ tensor(R), expected.velocities, 1 / DT)
    assert close(after.body_forces @ tensor(R), expected.body_forces, 10)


def test_units_do_not_matter(reference):
    base, expected = reference
    m, kg, s = 100.0, 1000.0, 10.0  # centimeters, grams, tenths of a second
    other = dataclasses.replace(
        base,
        vertices=base.vertices * m,
        ball=base.ball * [m, m, m, 1, 1, 1, 1],
        lift=base.lift * m / s,
        gravity=base.gravity * m / s**2,
        m=m,
        kg=kg,
        s=s,
    )
    after = other.run()
    assert close(after.positions / m, expected.positions)
    assert close(after.velocities * s / m, expected.velocities, 1 / DT)
    assert close(after.body_forces * s**2 / (kg * m), expected.body_forces, 10)


def test_a_far_body_changes_nothing(reference):
    base, expected = reference
    after = dataclasses.replace(base, far_body=True).run()
    assert close(after.positions, expected.positions)
    assert close(after.body_forces[8:], expected.body_forces, 10)
    assert (after.body_forces[:8] == 0).all()


def test_a_batch_behaves_as_a_single_one(reference):
    base, expected = reference
    after = base.run(batch_size=3)
    for state in (after[0], after[2]):
        assert torch.equal(state.positions, expected.positions)
        assert torch.equal(state.body_forces, expected.body_forces)


def test_a_saved_state_in_contact_continues_with_the_same_bits(reference):
    base, state = reference
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    again = torch.load(file, weights_only=True)
    sim = base.simulator()
    control = base.control(sim, state)
    expected = sim.step(state, control)
    # Another simulator: nothing that the first one learned matters.
    result = base.simulator().step(again, control)
    assert torch.equal(result.positions, expected.positions)
    assert torch.equal(result.velocities, expected.velocities)
    assert torch.equal(result.body_forces, expected.body_forces)


def test_the_reference_depends_on_the_changed_inputs(reference):
    # Each comparison above can fail: the scene reacts to gravity and the ball's motion.
    base, expected = reference
    for changes in (
        {"gravity": base.gravity * 1.001},
        {"lift": base.lift * 1.001},
        {"spin": quaternion([1, 2, 3], 0.021)},
    ):
        after = dataclasses.replace(base, **changes).run()
        assert not close(after.positions, expected.positions, 10)
    assert expected.positions.dtype == F64
