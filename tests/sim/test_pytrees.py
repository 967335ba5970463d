"""States, controls, parameters and trajectories in the tools of a code base that uses torch."""

import pytest
import torch
from torch.utils._pytree import keystr, tree_flatten, tree_flatten_with_path, tree_map
from torch.utils.data import DataLoader, default_collate

import diffcloth_torch as dc


@pytest.fixture(scope="module")
def simulator():
    """A pinned sheet that hangs over a ball; its stiffness differs from face to face."""
    sheet = dc.Cloth.grid(
        *(3, 3, 0.2),
        name="sheet",
        pins={"edge": [0, 1, 2]},
        material=dc.Material(stretch=torch.linspace(90, 110, 8)),
    )
    ball = dc.RigidBody.sphere(0.05, subdivisions=1, name="ball", pose=[0, 0.05, -0.06, 1, 0, 0, 0])
    return dc.Simulator(dc.Scene([sheet], [ball]), 0.01)


def tensors(state):
    return {name: value for name, value in vars(state).items() if isinstance(value, torch.Tensor)}


def test_a_state_is_a_tree_of_its_tensors(simulator):
    state = simulator.step(simulator.initial_state())
    leaves, structure = tree_flatten(state)
    assert [*map(id, leaves)] == [*map(id, tensors(state).values())]
    paths, _ = tree_flatten_with_path(state)
    assert keystr(paths[0][0]) == ".positions"
    again = structure.unflatten(leaves)
    assert isinstance(again, dc.State)
    assert again.report is None  # a report describes one step, which did not yield other tensors
    assert again.meshes().keys() == {"sheet", "ball"}
    assert torch.equal(simulator.step(again).positions, simulator.step(state).positions)
    axes = tree_map(lambda _: None, state)
    assert axes.positions is None
    assert axes.pin_forces is None


def test_trees_of_different_simulators_are_combined(simulator):
    other = dc.Simulator(simulator.scene, 0.02)
    a, b = simulator.step(simulator.initial_state()), other.step(other.initial_state())
    middle = tree_map(lambda x, y: (x + y) / 2, a, b)
    assert torch.equal(middle.positions, (a.positions + b.positions) / 2)


def test_gradients_by_a_whole_state(simulator):
    state = simulator.step(simulator.initial_state())

    def loss(state):
        return simulator.step(state).positions.square().sum()

    found = torch.func.grad(loss)(state)
    x, v = (t.clone().requires_grad_() for t in (state.positions, state.velocities))
    expected = torch.autograd.grad(loss(state.replace(positions=x, velocities=v)), (x, v))
    assert torch.equal(found.positions, expected[0])
    assert torch.equal(found.velocities, expected[1])
    assert expected[0].abs().max() > 0


def test_a_control_is_a_tree_of_its_set_fields(simulator):
    state = simulator.initial_state()
    control = dc.Control(pins={"edge": state.positions[:3] + 0.001}, wind=torch.zeros(3))
    leaves, _ = tree_flatten(control)
    assert len(leaves) == 2
    moved = tree_map(lambda tensor: tensor + 0.001, control)
    assert isinstance(moved, dc.Control)
    assert moved.forces is None
    assert torch.equal(moved.pins["edge"], state.positions[:3] + 0.002)
    found = torch.func.grad(lambda c: simulator.step(state, c).positions.sum())(control)
    assert found.pins["edge"].shape == (3, 3)
    # Gradients are computed by each of several fields.
    assert found.wind.shape == (3,)


def test_parameters_are_a_tree_of_their_set_fields(simulator):
    parameters = simulator.default_parameters()
    found = torch.func.grad(
        lambda p: simulator.step(simulator.initial_state(), None, p).positions.square().sum()
    )(parameters)
    assert found.stretch.shape == (8,)
    assert found.gravity.abs().max() > 0
    assert found.stretch_weft is None
    named = dc.Parameters(friction={("sheet", "ball"): torch.tensor(0.2)})
    twice = tree_map(lambda tensor: 2 * tensor, named)
    assert twice.friction[("sheet", "ball")].item() == pytest.approx(0.4)


def test_mapped_parameters_of_another_shape_may_have_a_batch_axis(simulator):
    """Eight faces and eight environments: a simulator's own [F] is clear, a new one is not."""
    state = simulator.initial_state(8)
    same = tree_map(torch.clone, simulator.default_parameters())
    simulator.step(state, None, same)
    wide = tree_map(lambda t: t.expand(8, *t.shape).clone(), simulator.default_parameters())
    with pytest.raises(dc.InvalidInput, match=r"`parameters\.\w+` .* environment or per face"):
        simulator.step(state, None, wide)


def test_a_trajectory_is_a_tree_of_states(simulator):
    states = simulator.rollout(simulator.initial_state(), steps=2)
    detached = tree_map(torch.detach, states)
    assert isinstance(detached, dc.Trajectory)
    assert torch.equal(detached.positions, states.positions)
    paths, _ = tree_flatten_with_path(states)
    assert keystr(paths[0][0]) == "[0].positions"


def test_states_are_collated(simulator):
    states = simulator.rollout(simulator.initial_state(), steps=4)
    batch = default_collate([*states])
    assert isinstance(batch, dc.State)
    assert batch.batch_size == 4
    assert batch.report is None
    assert torch.equal(batch.positions, states.positions)
    samples = [{"state": state, "target": k} for k, state in enumerate(states)]
    first, second = DataLoader(samples, batch_size=2)
    assert torch.equal(first["state"].positions, states.positions[:2])
    assert second["target"].tolist() == [2, 3]
    after = simulator.step(second["state"])
    assert torch.equal(after.positions[0], simulator.step(states[2]).positions)
    pair = default_collate([states[:2], states[2:]])
    assert isinstance(pair, dc.Trajectory)
    assert pair.positions.shape == (2, 2, 9, 3)
    with pytest.raises(dc.InvalidInput, match="must have no batch axis, got one at"):
        default_collate([batch, batch])


def test_a_state_stays_on_the_cpu(simulator):
    state = simulator.initial_state()
    for same in (("cpu",), (torch.device("cpu", 0),), (torch.float64,), (state.positions,), ()):
        assert state.to(*same, non_blocking=True) is state
    copy = state.to(device="cpu", copy=True)
    assert torch.equal(copy.positions, state.positions)
    assert copy.positions.data_ptr() != state.positions.data_ptr()
    sentence = r"State\.to: the device must be the CPU, where the simulator works, got {}; move"
    for device, name in (("cuda:1", "cuda"), (torch.device("meta"), "meta"), (0, "index 0")):
        with pytest.raises(dc.InvalidInput, match=sentence.format(name)):
            state.to(device)
    with pytest.raises(dc.InvalidInput, match=sentence.format("meta")):
        state.to(torch.empty(1, device="meta"))
    with pytest.raises(TypeError, match=r"dtype must be torch\.float64, .* got torch\.float32"):
        state.to("cpu", torch.float32)
    with pytest.raises(TypeError, match="must be a device, a dtype or a tensor, got dict"):
        state.to({})
