"""The contract of autograd for a step in contact: saved tensors, batches, dtypes, equal bits.

`test_contract` checks the same promises of the interface in free flight; here contact, friction
iterations and the factors kept for backward take part.
"""

import pytest
import scenes
import torch

import diffcloth_torch as dc

F64 = torch.float64
SCHEMES = ["coupled", "split"]


@pytest.fixture(params=SCHEMES)
def case(request):
    return scenes.regime("pinned", request.param)


@pytest.fixture
def coupled():
    return scenes.regime("pinned")


@pytest.fixture
def threads():
    count = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(count)


def total(state):
    """A loss of all outputs with a gradient everywhere."""
    x, v, f = state.positions, state.velocities, state.body_forces
    return (x**2).sum() + 0.01 * (v**3).sum() + (f**2).sum()


def leaves(case, names=None):
    return {
        k: t.clone().requires_grad_()
        for k, t in case.inputs().items()
        if (names is None or k in names) and k != "state.soft_pin_targets"
    }


def gradients(case, values):
    found = torch.autograd.grad(total(case.step(values)), list(values.values()))
    return dict(zip(values, found, strict=True))


def assert_same(a, b):
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name


# --- Saved tensors -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    ["state.positions", "state.body_poses", "control.pins", "control.body_poses",
     "parameters.friction", "parameters.barrier_stiffness"],
)  # fmt: skip
def test_an_input_edited_in_place_makes_backward_raise(coupled, name):
    values = {k: t.clone() for k, t in coupled.inputs().items()}
    values["state.velocities"].requires_grad_()
    loss = total(coupled.step(values))
    values[name].mul_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_a_tape_serves_once_unless_it_is_retained(coupled):
    values = leaves(coupled)
    loss = total(coupled.step(values))
    first = torch.autograd.grad(loss, list(values.values()), retain_graph=True)
    again = torch.autograd.grad(loss, list(values.values()))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    with pytest.raises(RuntimeError, match="backward through the graph a second time"):
        torch.autograd.grad(loss, list(values.values()))


@pytest.mark.parametrize("loss", [lambda x: x.sum(), lambda x: (x**2).sum()], ids=["sum", "square"])
def test_second_derivatives_are_refused(coupled, loss):
    values = leaves(coupled, ("state.positions", "parameters.friction"))
    value = loss(coupled.step(values).positions)
    for gradient in torch.autograd.grad(value, list(values.values()), create_graph=True):
        with pytest.raises(RuntimeError, match=r"second derivatives of \w+ are not available"):
            gradient.sum().backward(retain_graph=True)


# --- Which gradients -----------------------------------------------------------------------------


def test_only_required_gradients_are_computed(coupled, monkeypatch):
    asked = []
    core = coupled.sim._core

    class Spy:
        def __getattr__(self, name):
            return getattr(core, name)

        def backward(self, inputs, tape, kept, cotangents, losses, needs, threads):
            asked.append(sorted(needs))
            return core.backward(inputs, tape, kept, cotangents, losses, needs, threads)

    monkeypatch.setattr(coupled.sim._engine, "core", Spy())
    values = {k: t.clone() for k, t in coupled.inputs().items()}
    values["state.velocities"].requires_grad_()
    total(coupled.step(values)).backward()
    assert asked == [["velocities"]]
    assert [k for k, t in values.items() if t.grad is not None] == ["state.velocities"]


def test_a_single_input_gets_the_gradient_of_all_inputs(case):
    together = gradients(case, leaves(case))
    for name in together:
        assert_same(gradients(case, leaves(case, (name,))), {name: together[name]})


@pytest.mark.parametrize("name", ["parameters.friction", "parameters.slip_velocity"])
def test_a_single_friction_parameter_gets_its_gradient(name):
    """The slip velocity counts if a sheet sticks; its gradient is zero if the sheet slides."""
    case = scenes.regime("sticking")
    together = gradients(case, leaves(case))[name]
    assert together.any()
    assert_same(gradients(case, leaves(case, (name,))), {name: together})


def test_an_unused_output_has_no_part(coupled):
    values = leaves(coupled)
    after = coupled.step(values)
    x_bar = torch.autograd.grad(after.positions.sum(), list(values.values()), retain_graph=True)
    both = after.positions.sum() + 0.0 * after.velocities.sum() + 0.0 * after.body_forces.sum()
    again = torch.autograd.grad(both, list(values.values()))
    assert all(torch.equal(a, b) for a, b in zip(x_bar, again, strict=True))


# --- Layouts and types ---------------------------------------------------------------------------


def transposed(tensor):
    """An equal tensor with another memory layout."""
    if tensor.dim() < 2:
        return torch.stack([tensor, tensor], dim=-1)[..., 0]
    return tensor.transpose(0, 1).contiguous().transpose(0, 1)


def test_layout_changes_no_bit(case):
    values = leaves(case)
    views = {k: transposed(t) for k, t in values.items()}
    assert not all(view.is_contiguous() for view in views.values())
    found = torch.autograd.grad(total(case.step(views)), list(values.values()))
    assert_same(dict(zip(values, found, strict=True)), gradients(case, leaves(case)))


def test_expanded_inputs_sum_their_gradients(coupled):
    """One force for all vertices and one friction for all pairs are expanded views."""
    shape = coupled.state.positions.shape
    force = torch.tensor([1e-3, 2e-3, -1e-3], dtype=F64, requires_grad=True)
    friction = torch.tensor(0.6, dtype=F64, requires_grad=True)
    views = {"control.forces": force.expand(shape), "parameters.friction": friction.expand(2, 2)}
    found = torch.autograd.grad(total(coupled.step(views)), (force, friction))
    dense = {k: t.detach().clone().requires_grad_() for k, t in views.items()}
    expected = gradients(coupled, dense)
    torch.testing.assert_close(found[0], expected["control.forces"].sum(dim=0))
    torch.testing.assert_close(found[1], expected["parameters.friction"].sum())
    assert found[0].all()
    assert found[1] != 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_gradients_come_back_in_the_type_of_the_input(coupled, dtype):
    values = {
        k: t.to(dtype).requires_grad_()
        for k, t in leaves(coupled).items()
        if k in ("control.forces", "control.soft_pins", "parameters.friction", "parameters.gravity")
    }
    values = {k: t.detach().requires_grad_() for k, t in values.items()}
    found = gradients(coupled, values)
    promoted = {k: t.detach().double().requires_grad_() for k, t in values.items()}
    expected = gradients(coupled, promoted)
    for name in values:
        assert found[name].dtype == dtype
        assert torch.equal(found[name], expected[name].to(dtype))


# --- Equal bits ----------------------------------------------------------------------------------


def test_a_factor_dropped_is_rebuilt_with_the_same_bits(case):
    kept = gradients(case, leaves(case))
    values = leaves(case)
    loss = total(case.step(values))
    case.sim._core.forget_factors()
    dropped = torch.autograd.grad(loss, list(values.values()))
    assert_same(kept, dict(zip(values, dropped, strict=True)))


def three_states(case):
    noise = scenes.tensor_noise(case.state.velocities.shape, 0.1, 3)
    return [
        case.state.replace(velocities=case.state.velocities + k * noise) for k in (0.0, 1.0, -2.0)
    ]


def batch_inputs(case):
    """Stacked states, and their shared inputs."""
    stacked = dc.stack(three_states(case))
    shared = {k: t for k, t in leaves(case).items() if not k.startswith("state.")}
    return stacked, shared


def batch_gradients(case):
    stacked, shared = batch_inputs(case)
    own = {
        k: getattr(stacked, k).clone().requires_grad_()
        for k in ("positions", "velocities", "body_poses")
    }
    batch = case.where(state=stacked.replace(**own))
    given = {**{f"state.{k}": t for k, t in own.items()}, **shared}
    given["state.soft_pin_targets"] = stacked.soft_pin_targets
    after = batch.step(given)
    found = torch.autograd.grad(total(after), [*own.values(), *shared.values()])
    return after, dict(zip([*own, *shared], found, strict=True))


def test_a_batch_has_the_bits_of_its_environments_and_sums_shared_inputs(case):
    after, found = batch_gradients(case)
    sums = {}
    for i, state in enumerate(three_states(case)):
        single = case.where(state=state)
        values = leaves(single)
        alone = single.step(values)
        assert torch.equal(alone.positions, after.positions[i])
        assert torch.equal(alone.body_forces, after.body_forces[i])
        gradient = torch.autograd.grad(total(alone), list(values.values()))
        for name, value in zip(values, gradient, strict=True):
            part, _, field = name.partition(".")
            if part == "state":
                assert torch.equal(value, found[field][i]), name
            else:
                sums[name] = sums[name] + value if name in sums else value
    for name, value in sums.items():  # in the order of the environments: the same bits, too
        assert torch.equal(value, found[name]), name


def test_batched_controls_and_parameters_have_the_bits_of_their_environments(case):
    g = torch.Generator().manual_seed(0)
    inputs = {k: t for k, t in case.inputs().items() if not k.startswith("state.")}
    batched = {
        k: torch.stack([t, t * (1 + 1e-3 * torch.rand(t.shape, dtype=F64, generator=g))])
        for k, t in inputs.items()
        if k != "control.body_poses"  # one motion for all
    }
    batched = {k: t.requires_grad_() for k, t in batched.items()}
    stacked = dc.stack([case.state, case.state])
    states = {f"state.{k}": getattr(stacked, k) for k in scenes.STATE}
    after = case.where(state=stacked).step({**states, **batched})
    found = torch.autograd.grad(total(after), list(batched.values()))
    for i in range(2):
        values = {k: t[i].detach().clone().requires_grad_() for k, t in batched.items()}
        single = gradients(case, values)
        assert torch.equal(case.step(values).positions, after.positions[i])
        assert_same(single, {k: bar[i] for k, bar in zip(batched, found, strict=True)})


def test_the_number_of_threads_changes_no_bit(case, threads):
    threads(1)
    one, one_bars = batch_gradients(case)
    threads(2)
    two, two_bars = batch_gradients(case)
    assert torch.equal(one.positions, two.positions)
    assert_same(one_bars, two_bars)


@pytest.mark.parametrize("every", [1, 3])
def test_checkpoints_change_no_bit_in_contact(case, every):
    def run(checkpoint_every):
        values = {
            k: t.clone().requires_grad_()
            for k, t in case.inputs().items()
            if k in ("state.positions", "state.body_poses", "parameters.friction")
        }
        start = case.state.replace(
            positions=values["state.positions"], body_poses=values["state.body_poses"]
        )
        parameters = case.sim.default_parameters().replace(friction=values["parameters.friction"])
        states = case.sim.rollout(
            start, None, parameters, steps=4, checkpoint_every=checkpoint_every
        )
        assert states[-1].report.contact_count > 0
        loss = sum(total(state) for state in states)
        found = torch.autograd.grad(loss, list(values.values()))
        return states[-1].positions, dict(zip(values, found, strict=True))

    x, plain = run(None)
    again, checkpointed = run(every)
    assert torch.equal(x, again)
    assert_same(plain, checkpointed)


# --- Steps without a gradient --------------------------------------------------------------------


def test_a_step_that_did_not_converge_has_no_gradient(coupled):
    sim = dc.Simulator(
        coupled.sim.scene,
        coupled.sim.dt,
        contact=coupled.sim.contact,
        solver=dc.SolverOptions(throw=False, max_iterations=1),
    )
    control = {k: t for k, t in coupled.control.items() if k != "body_poses"}
    case = coupled.where(sim=sim, control=control)
    values = leaves(case, ("state.positions",))
    after = case.step(values)
    assert not after.report.converged
    with pytest.raises(dc.NotConverged, match="did not converge has no gradient"):
        after.positions.sum().backward()
    assert values["state.positions"].grad is None


def test_an_unconverged_environment_refuses_for_its_batch():
    """A sheet that falls freely needs one iteration, one that vibrates more."""
    vertices, faces = scenes.grid(4, 4)
    sim = dc.Simulator(
        dc.Scene([dc.Cloth(vertices, faces)]),
        scenes.DT,
        solver=dc.SolverOptions(throw=False, max_iterations=1),
    )
    state = sim.initial_state(2)
    v = state.velocities.clone()
    v[1] = scenes.tensor_noise(v[1].shape, 1.0)
    x = state.positions.clone().requires_grad_()
    after = sim.step(state.replace(positions=x, velocities=v))
    assert after.report.converged.tolist() == [True, False]
    with pytest.raises(dc.NotConverged, match=r"environments \[1\]") as caught:
        after.positions.sum().backward()
    assert caught.value.environments == (1,)


@pytest.mark.parametrize("name", ["pinned", "hanging"])
def test_a_loss_of_nothing_has_a_gradient_of_exact_zeros(name):
    case = scenes.regime(name)
    values = leaves(case)
    loss = 0.0 * total(case.step(values))
    for gradient in torch.autograd.grad(loss, list(values.values())):
        assert not gradient.isnan().any()
        assert not gradient.any()
