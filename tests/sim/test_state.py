"""States: batches, selection, export, saving."""

import io
import pickle

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.geometry.meshes import read_mesh
from diffcloth_torch.model.quantities import STATE


def make(seed=0, *, report=True, batch=()):
    g = torch.Generator().manual_seed(seed)

    def random(*shape):
        return torch.rand((*batch, *shape), dtype=torch.float64, generator=g)

    diagnostics = (
        dc.Report(
            True, seed, 0.5, float("inf"), 2, 1.0, {"solve": 0.1 * seed}, cpu_seconds=0.2 * seed
        )
        if report
        else None
    )
    return dc.State(
        positions=random(4, 3),
        velocities=random(4, 3),
        body_poses=random(2, 7),
        soft_pin_targets=random(1, 3),
        body_forces=random(5, 3),
        time=random(),
        report=diagnostics,
        body_velocities=random(2, 6),
        joint_positions=random(3),
        joint_velocities=random(3),
        joint_targets=random(3),
        joint_efforts=random(3),
        base_poses=random(1, 7),
        base_velocities=random(1, 6),
    )


TENSORS = tuple(STATE)


@pytest.mark.parametrize("batch", [(), (4,)])
def test_omitted_fields_become_rows_of_zeros(batch):
    """The fields that the first version has, by position and by name."""
    full = make(batch=batch)
    first = [getattr(full, name) for name in TENSORS[:6]]
    named = dict(zip(TENSORS[:6], first, strict=True))
    for state in (dc.State(*first), dc.State(**named), dc.State(*first, full.report)):
        assert torch.equal(state.body_forces, full.body_forces)
        assert torch.equal(state.body_velocities, torch.zeros(*batch, 2, 6, dtype=torch.float64))
        for name in ("joint_positions", "joint_velocities", "joint_targets", "joint_efforts"):
            assert getattr(state, name).shape == (*batch, 0)
        assert state.base_poses.shape == (*batch, 0, 7)
        assert state.base_velocities.shape == (*batch, 0, 6)


def test_stack_then_select_returns_each_state():
    states = [make(0), make(1), make(2)]
    batch = dc.stack(states)
    assert batch.batch_size == len(batch) == 3
    for state, again in zip(states, batch, strict=True):
        for name in TENSORS:
            assert torch.equal(getattr(again, name), getattr(state, name))
        assert vars(again.report) == vars(state.report)
        assert isinstance(again.report.converged, bool)
        assert isinstance(again.report.iterations, int)
    assert torch.equal(batch[-1].positions, states[2].positions)
    assert torch.equal(batch[1:].positions, batch.positions[1:])
    assert batch.report.iterations.tolist() == [0, 1, 2]
    assert batch[1:].report.seconds["solve"].tolist() == [0.1, 0.2]


def test_stack_carries_gradients_to_each_state():
    a, b = make(0), make(1)
    x = a.positions.clone().requires_grad_()
    dc.stack([a.replace(positions=x), b]).positions[0].sum().backward()
    assert torch.equal(x.grad, torch.ones_like(x))


def test_a_missing_report_makes_the_batch_have_none():
    assert dc.stack([make(0), make(1, report=False)]).report is None


def test_where_takes_each_environment_from_one_of_two():
    a, b = dc.stack([make(0), make(1), make(2)]), dc.stack([make(3), make(4), make(5)])
    mixed = dc.where(torch.tensor([True, False, True]), a, b)
    for name in TENSORS:
        assert torch.equal(getattr(mixed, name)[0], getattr(a, name)[0])
        assert torch.equal(getattr(mixed, name)[1], getattr(b, name)[1])
    assert mixed.report.iterations.tolist() == [0, 4, 2]


def test_where_resets_environments_to_one_state():
    a, start = dc.stack([make(0), make(1)]), make(2)
    mixed = dc.where(torch.tensor([False, True]), start, a)
    for name in TENSORS:
        assert torch.equal(getattr(mixed, name)[0], getattr(a, name)[0])
        assert torch.equal(getattr(mixed, name)[1], getattr(start, name))


@pytest.mark.parametrize("is_first", [True, False])
def test_where_takes_the_status_of_one_state_for_all(is_first):
    batch, one = dc.stack([make(0), make(1)]), make(2)
    one = one.replace(report=dc.Report(False, 9, 0.5, 1.0, 2, 1.0, {"solve": 0.1}))
    mask = torch.tensor([True, False])
    mixed = dc.where(mask, one, batch) if is_first else dc.where(~mask, batch, one)
    assert mixed.report.status == ("not_converged", "converged")
    assert mixed.report.iterations.tolist() == [9, 1]


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda s: s[0], dc.InvalidInput, "batch axis"),
        (lambda s: dc.stack([s, s])[2], dc.InvalidInput, r"0 \.\. 1, got 2"),
        (lambda s: dc.stack([s, s])[1.5], TypeError, "integer"),
        (lambda s: dc.stack([]), dc.InvalidInput, "at least one"),
        (lambda s: dc.stack([s, dc.stack([s])]), dc.InvalidInput, r"at \[1\]"),
        (
            lambda s: dc.stack([s, s.replace(velocities=torch.zeros(5, 3))]),
            dc.InvalidInput,
            "`velocities` must have the same shape",
        ),
        (lambda s: dc.where([True], s, s), TypeError, "boolean tensor"),
        (
            lambda s: dc.where(torch.ones(3) > 0, s, dc.stack([s, s])),
            dc.InvalidInput,
            "`b` .*got 2",
        ),
        (lambda s: s.replace(position=1), dc.InvalidInput, "positions, .*got 'position'"),
        (lambda s: s.replace(_surfaces=1), dc.InvalidInput, "got '_surfaces'"),
        (lambda s: s.export("a.obj"), dc.InvalidInput, "come from a Simulator"),
        (lambda s: dc.stack([s]).export("a.obj"), dc.InvalidInput, r"state\[i\]"),
    ],
)
def test_misuse_is_refused(call, error, message):
    with pytest.raises(error, match=message):
        call(make())


def test_detach_drops_the_graph():
    state = make()
    state = state.replace(positions=state.positions.requires_grad_() * 2)
    assert not state.detach().positions.requires_grad
    assert state.detach().report is state.report


def test_a_state_survives_torch_save_and_pickle():
    state = make(3)
    file = io.BytesIO()
    torch.save([state, dc.stack([state, state])], file)
    file.seek(0)
    single, batch = torch.load(file, weights_only=True)
    for again in (single, batch[1], pickle.loads(pickle.dumps(state))):
        for name in TENSORS:
            assert torch.equal(getattr(again, name), getattr(state, name))
        assert again.report.iterations == 3
        assert again.report.seconds == state.report.seconds


def scene():
    cloths = [dc.Cloth.grid(3, 3, name="a"), dc.Cloth.grid(2, 2, pose=[0, 0, 1, 1, 0, 0, 0])]
    box = dc.RigidBody.box(0.5, pose=[0, 0, 3, 0.5, 0, 0, 0], motion="kinematic")
    return dc.Scene(cloths, [box])


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_export_writes_the_positions_exactly(tmp_path, suffix):
    simulator = dc.Simulator(scene(), 0.01)
    state = simulator.initial_state()
    path = tmp_path / f"state{suffix}"
    state.replace(positions=state.positions / 3).export(path)
    vertices, faces = read_mesh(path)
    np.testing.assert_array_equal(vertices, (state.positions / 3).numpy())
    assert faces.tolist() == [*dc.Cloth.grid(3, 3).faces.tolist(), [9, 10, 12], [9, 12, 11]]


def test_export_adds_the_bodies_at_their_poses(tmp_path):
    state = dc.Simulator(scene(), 0.01).initial_state(batch_size=2)[1]
    state.export(tmp_path / "all.obj", bodies=True)
    vertices, faces = read_mesh(tmp_path / "all.obj")
    assert len(faces) == 8 + 2 + 12
    np.testing.assert_allclose(vertices[13:], dc.RigidBody.box(0.5).vertices + np.array([0, 0, 3]))


def test_a_saved_state_can_be_exported(tmp_path):
    state = dc.Simulator(scene(), 0.01).initial_state()
    torch.save(state, tmp_path / "state.pt")
    torch.load(tmp_path / "state.pt", weights_only=True).export(tmp_path / "a.obj", bodies=True)
    assert len(read_mesh(tmp_path / "a.obj")[0]) == 9 + 4 + 8
