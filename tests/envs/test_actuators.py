"""Effects of actions: pickers, pins, forces, and the velocities of bodies and hands."""

from __future__ import annotations

import math

import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.envs.actuators import Forces, Pickers, Twist, Velocities, path_of

F64 = torch.float64
SHEET = dc.Cloth.grid(3, 3, 0.2, pose=[0, 0, 0.1, 1, 0, 0, 0], name="sheet")  # 10 cm apart
STATE = dc.Simulator(dc.Scene([SHEET]), 0.01).initial_state(batch_size=1)
CORNER = STATE.positions[0, 0]
PULL = {"stride": 0.02, "reach": 0.03, "floor": 0.05}


def at(*points):
    return torch.stack([torch.as_tensor(p, dtype=F64) for p in points])[None]


def action(moves, grasp):
    return torch.tensor([[*moves, grasp]], dtype=F64)


class TestPickers:
    def test_pickers_move_in_equal_parts_and_stay_above_the_floor(self):
        pickers = Pickers(SHEET, 1, **PULL)
        start = pickers.start(at([0.5, 0.5, 0.06]))
        controls, tools = pickers.act(start, STATE, action((1.0, -0.5, -1.0), 0.0), 4)
        end = torch.tensor([0.52, 0.49, 0.05], dtype=F64)
        torch.testing.assert_close(tools["points"][0, 0], end)
        for k, control in enumerate(controls, start=1):
            expected = start["points"][0, 0] + k / 4 * (end - start["points"][0, 0])
            targets = control.attachments["picker_0"][0]
            torch.testing.assert_close(targets, expected.expand_as(targets))
            assert not control.attachment_weights["picker_0"].any()

    @pytest.mark.parametrize(("distance", "holds"), [(0.029, True), (0.031, False)])
    def test_pickers_close_on_vertices_within_reach(self, distance, holds):
        pickers = Pickers(SHEET, 1, **PULL)
        start = pickers.start(at(CORNER + torch.tensor([0.0, 0.0, distance], dtype=F64)))
        controls, tools = pickers.act(start, STATE, action((0, 0, 0), 0.5), 1)
        assert tools["held"].tolist() == [[0 if holds else -1]]
        weights = controls[0].attachment_weights["picker_0"][0]
        assert weights.tolist() == [0.5 * holds] + [0.0] * 8
        if holds:  # the target starts at the vertex, so the vertex does not jump
            torch.testing.assert_close(controls[0].attachments["picker_0"][0, 0], CORNER)

    def test_pickers_hold_their_vertices_until_they_open(self):
        pickers = Pickers(SHEET, 1, **PULL)
        _, tools = pickers.act(pickers.start(at(CORNER)), STATE, action((0, 0, 0), 1.0), 1)
        # Beside another vertex the picker keeps its vertex, at the same distance.
        away = {**tools, "points": at(STATE.positions[0, 4])}
        _, kept = pickers.act(away, STATE, action((0, 0, 0), 1.0), 1)
        assert kept["held"].tolist() == [[0]]
        _, opened = pickers.act(kept, STATE, action((0, 0, 0), -0.1), 1)
        assert opened["held"].tolist() == [[-1]]
        assert not opened["offsets"].any()

    def test_offsets_end_with_the_grasp(self):
        pickers = Pickers(SHEET, 1, **PULL)
        start = pickers.start(at(CORNER + torch.tensor([0.02, 0.0, 0.0], dtype=F64)))
        _, closed = pickers.act(start, STATE, action((0, 0, 0), 1.0), 1)
        assert closed["offsets"].norm() == pytest.approx(0.02)
        _, opened = pickers.act(closed, STATE, action((0, 0, 0), -1.0), 1)
        assert not opened["offsets"].any()

    def test_grasps_count_from_where_they_open(self):
        pickers = Pickers(SHEET, 1, **PULL, opens_at=-1.0)
        controls, _ = pickers.act(pickers.start(at(CORNER)), STATE, action((0, 0, 0), 0.0), 1)
        assert controls[0].attachment_weights["picker_0"][0, 0] == 0.5


def test_velocities_move_pins_at_the_speed_of_the_action():
    pins = Velocities({"sheet/left": [0, 3], "sheet/right": [8]}, dt=0.01, speed=2.0)
    actions = torch.tensor([[0.5, 0.0, -1.0, 0.0, 1.0, 0.0]], dtype=F64)
    controls, _ = pins.act({}, STATE, actions, 3)
    for k, control in enumerate(controls, start=1):
        shift = 0.01 * k * 2.0 * actions.reshape(2, 3)
        for name, rows, g in (("sheet/left", [0, 3], 0), ("sheet/right", [8], 1)):
            found = control.pins[name] - STATE.positions[:, rows]
            torch.testing.assert_close(found, shift[g].expand_as(found))


def test_forces_are_shared_by_their_group():
    steady = torch.zeros(9, 3, dtype=F64)
    steady[4, 2] = 0.25
    forces = Forces([[0, 1, 2], [8]], steady, largest=6.0)
    actions = torch.tensor([[0.5, 0, 0, 0, -1.0, 0]], dtype=F64)
    controls, _ = forces.act({}, STATE, actions, 2)
    assert len(controls) == 2
    found = controls[1].forces[0] - steady
    torch.testing.assert_close(found[:3], torch.tensor([1.0, 0, 0], dtype=F64).expand(3, -1))
    torch.testing.assert_close(found[8], torch.tensor([0, -6.0, 0], dtype=F64))
    assert not found[3:8].any()


def test_twists_turn_about_axes_of_the_world():
    quarter = math.pi / 2
    about_x = [math.cos(quarter / 2), math.sin(quarter / 2), 0, 0]
    pose = torch.tensor([[1.0, 0, 0, *about_x]], dtype=F64)
    twist = torch.tensor([[0, 0.5, 0, 0, 0, quarter]], dtype=F64)
    found = path_of(pose, twist, 1)[0][0]
    torch.testing.assert_close(found[:3], torch.tensor([1.0, 0.5, 0], dtype=F64))
    # z of the body lay along -y of the world, and lies along x after a quarter turn about its z.
    w, x, y, z = found[3:].tolist()
    axis = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    assert axis == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)


def test_a_body_turns_as_far_in_any_number_of_substeps():
    twist = Twist("ball", 0, dt=0.01, speed=1.0, spin=3.0)
    pose = [0, 0, -0.2, 1, 0, 0, 0]
    ball = dc.RigidBody.sphere(0.1, motion="kinematic", pose=pose, name="ball")
    state = dc.Simulator(dc.Scene([SHEET], [ball]), 0.01).initial_state(batch_size=1)
    actions = torch.tensor([[0.5, 0, 0, 0, 0, 1.0]], dtype=F64)
    controls, _ = twist.act({}, state, actions, 5)
    pose = controls[-1].body_poses["ball"][0].tolist()
    assert pose[0] == pytest.approx(0.5 * 0.05)
    assert 2 * math.acos(pose[3]) == pytest.approx(3.0 * 0.05)


def test_actions_beyond_their_range_are_clipped():
    env = dc.envs.make("FoldCloth", 2, size=6)
    ends = []
    for size in (1.0, 7.0):
        env.reset(seed=0)
        env.step(torch.full((2, 8), size))
        ends.append(env.env_state)
    assert torch.equal(ends[0].state.positions, ends[1].state.positions)
    assert torch.equal(ends[0].tools["points"], ends[1].tools["points"])


def test_failed_environments_have_no_graph_and_others_have(monkeypatch):
    """Environment 1 fails in its second transition, and continues from there."""
    env = dc.envs.make("FoldCloth", 2, size=6, opens_at=-1.0, reach=0.06, autoreset_mode="Disabled")
    env.reset(seed=0)
    from diffcloth_torch.envs import env as module

    fails = [False]
    monkeypatch.setattr(module, "failures", lambda state: torch.tensor([False, fails[0]]))
    actions = torch.full((2, 8), 0.3, requires_grad=True)
    env.step(actions)
    fails[0] = True
    env.step(actions)
    fails[0] = False
    assert env.env_state.failed.tolist() == [False, True]
    for tensor in (
        env.env_state.state.positions,
        env.env_state.tools["points"],
        env.task.reward(env.env_state),
        env.task.observation(env.env_state),
    ):
        (gradient,) = torch.autograd.grad(tensor.sum(), actions, retain_graph=True)
        assert gradient[0].any()
        assert not gradient[1].any()
