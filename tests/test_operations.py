"""An error message begins with the called operation, for the whole public surface.

Each argument of each call is replaced in turn by values of a wrong type, shape or dtype, by numbers
that are not finite, and by tensors on another device. A refusal names the operation.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Mapping

import numpy as np
import pytest
import torch
from public_calls import CALLS, HOMES, World

import diffcloth_torch as dc


class Nothing:
    """An object of no kind that the package knows."""

    def __repr__(self):
        return "Nothing()"


def spoiled(value):
    """Kind of a mistake -> a wrong value in the place of an accepted one."""
    yield "type", Nothing()
    yield "text", "\0 no such thing"
    if isinstance(value, torch.Tensor | np.ndarray) or is_numbers(value):
        tensor = value if isinstance(value, torch.Tensor) else torch.tensor(np.array(value))
        yield "shape", torch.zeros(1, 2, 3, 4, 5, dtype=torch.float64)
        yield "dtype", tensor.to(torch.complex64)
        yield "device", tensor.to("meta")
        if tensor.numel() and tensor.dtype != torch.bool:
            wrong = tensor.detach().to(torch.float64).clone()
            wrong.reshape(-1)[0] = torch.nan
            yield "finite", wrong
    elif isinstance(value, bool):
        yield "dtype", 1.5
    elif isinstance(value, int | float):
        yield "shape", [1.0, 2.0]
        yield "dtype", 1j
        yield "finite", np.nan
        yield "device", torch.zeros((), device="meta")
    elif isinstance(value, dc.State | dc.Parameters | dc.Control):
        for field in dataclasses.fields(value):
            tensor = getattr(value, field.name)
            if isinstance(tensor, torch.Tensor) and tensor.numel() and field.name != "time":
                for kind, wrong in spoiled(tensor):
                    yield f"{field.name} {kind}", value.replace(**{field.name: wrong})
    elif isinstance(value, Mapping):
        for key, entry in value.items():
            for kind, wrong in spoiled(entry):
                yield f"[{key!r}] {kind}", {**value, key: wrong}
        yield "name", {**value, "no such name": 1.0}
    elif isinstance(value, list | tuple) and value and isinstance(value[0], dc.State):
        for kind, wrong in spoiled(value[0].positions):
            yield f"[0] {kind}", [value[0].replace(positions=wrong), *value[1:]]
        yield "[0] type", [Nothing(), *value[1:]]
    elif isinstance(value, list | tuple) and value:
        for kind, wrong in spoiled(value[0]):
            yield f"[0] {kind}", [wrong, *value[1:]]


def is_numbers(value):
    if not isinstance(value, list | tuple) or not value:
        return False
    return all(isinstance(v, int | float) or is_numbers(v) for v in value)


def mistakes(call):
    """The call with each argument in turn replaced by wrong values."""
    for i, value in enumerate(call.arguments):
        for kind, wrong in spoiled(value):
            arguments = (*call.arguments[:i], wrong, *call.arguments[i + 1 :])
            yield f"{i} {kind}", dataclasses.replace(call, arguments=arguments)
    for key, value in call.keywords.items():
        for kind, wrong in spoiled(value):
            yield f"{key} {kind}", dataclasses.replace(call, keywords={**call.keywords, key: wrong})


# Functions that the package or torch calls with checked arguments, and functions of lists.
INNER = {
    "Cloth.material_axes",
    "DeformingBody.material_axes",
    "ContactPoints.of",
    "Descent.restore",
    "Evaluation.is_better_than",
    "Material.per_face",
    "Report.check_environments",
    "Report.select",
    "Report.stack",
    "Report.where",
    "Robot",
    "Trajectory",
    "Trajectory.__getitem__",
    "Camera.place",
    "envs.Actuator",
    "envs.Actuator.act",
    "envs.EnvState.rows",
    "envs.EnvState.where",
    "envs.Pickers.act",
    "envs.Pickers.start",
    "envs.Task.draw",
    "envs.Task.features",
    "envs.Task.frame_of",
    "envs.Task.goals",
    "envs.Task.in_world",
    "envs.Task.initial",
    "envs.Task.observation",
    "envs.Task.outcome",
    "envs.Task.place",
    "envs.Task.reward",
    "envs.Task.sample",
    "envs.Task.scripted",
    "envs.Task.sensed",
    "envs.Task.start",
    "envs.Task.succeeded",
    "envs.Task.success",
    "envs.Task.terminal",
    "envs.Task.transition",
    "envs.Velocities.act",
    "learn.Jobs.map",
    "learn.Policy",
    "learn.Policy.act",
    "learn.Policy.forward",
    "learn.TrainerOptions.rate_share",
}
# Functions without arguments, and records, whose fields are checked on use.
WITHOUT_REFUSAL = {
    "ContactPoints",
    "Control",
    "Control.replace",
    "Descent",
    "Descent.metrics",
    "Descent.record",
    "Evaluation",
    "Evaluation.record",
    "Fit",
    "Fit.lines",
    "Parameters",
    "Parameters.replace",
    "Simulator.default_parameters",
    "Simulator.parameters",
    "Stage",
    "State",
    "State.clone",
    "State.detach",
    "State.meshes",
    "State.replace",
    "Trajectory.detach",
    "build_info",
    "envs.ClothEnv.close",
    "envs.ClothEnv.render",
    "envs.ClothEnv.scripted_action",
    "envs.ClothVectorEnv.clear_grad",
    "envs.ClothVectorEnv.close_extras",
    "envs.ClothVectorEnv.generator_states",
    "envs.ClothVectorEnv.initialize_trajectory",
    "envs.ClothVectorEnv.render",
    "envs.ClothVectorEnv.scripted_actions",
    "envs.EnvState",
    "envs.EnvState.detach",
    "envs.Task.example",
    "fabrics.Measurement",
    "learn.Episodes",
    "learn.Jobs",
    "learn.Trainer.check",
    "learn.Trainer.update",
    "robots.panda",
}
# Openings of messages that begin neither with the name nor with its class.
OPENINGS = {
    "State.__getitem__": ("state[i]",),
    "envs.Task": ("FoldCloth",),
}


def openings(name):
    """A function is named, a method by itself or with its class, and a class for its arguments."""
    module, _, inside = name.partition(".")
    bare = inside if f"{module}." in HOMES else name
    owner, _, method = bare.rpartition(".")
    return OPENINGS.get(name, {name, bare, method, owner} - {""})


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return World(tmp_path_factory.mktemp("world"))


def test_lists_name_public_operations_once():
    assert set(CALLS) >= INNER | WITHOUT_REFUSAL
    assert not INNER & WITHOUT_REFUSAL


def refusal(function):
    """Message with which the package refuses a call; None if the call is accepted."""
    try:
        function()
    except (dc.InvalidInput, dc.SimulationError, TypeError) as error:
        return str(error)
    return None


@pytest.mark.parametrize("name", [name for name in CALLS if name not in INNER])
def test_refusals_open_with_the_operation(world, name, recwarn):
    refused = set()
    for kind, wrong in mistakes(CALLS[name](world)):
        message = refusal(wrong)
        if message is not None:
            assert message.partition(":")[0] in openings(name), kind
            refused.add(kind)
    assert bool(refused) == (name not in WITHOUT_REFUSAL)


# --- Named operation ------------------------------------------------------------------------------


def lost(state):
    """A state that no step accepts."""
    return state.replace(velocities=torch.full_like(state.velocities, torch.nan))


def test_operations_of_a_callback_name_themselves(world):
    sim, messages = world.hung, []

    def control(k, state):
        with pytest.raises(dc.InvalidInput) as caught:
            sim.energy(lost(state))
        messages.append(str(caught.value))
        return dc.Control(forces=torch.zeros(2, 3)) if k == 1 else None

    with pytest.raises(dc.InvalidInput, match=r"^rollout: `control\.forces` must have shape"):
        sim.rollout(sim.initial_state(), control, steps=2)
    assert len(messages) == 2
    assert all(message.startswith("energy: `state.velocities` must be") for message in messages)
    with pytest.raises(dc.InvalidInput, match=r"^step: "):
        sim.step(lost(sim.initial_state()))


def test_repeated_steps_of_backward_name_the_rollout(world):
    sim, wrong = world.hung, []

    def control(k, state):
        return dc.Control(forces=torch.zeros(2, 3)) if wrong else None

    start = sim.initial_state()
    start = start.replace(positions=start.positions.requires_grad_())
    states = sim.rollout(start, control, steps=2, checkpoint_every=1)
    wrong.append(True)
    with pytest.raises(dc.InvalidInput, match=r"^rollout: "):
        states[-1].positions.sum().backward()


@pytest.mark.parametrize("method", ["step", "rollout", "equilibrium"])
def test_failures_name_the_operation(world, method):
    solver = dc.SolverOptions(max_iterations=1, tolerance=1e-9)
    contact = dc.ContactOptions(self_contact=False)
    sim = dc.Simulator(dc.Scene([world.cloth]), 0.02, contact=contact, solver=solver)
    options = {"steps": 1} if method == "rollout" else {}
    with pytest.raises(dc.NotConverged, match=f"^{method}: the solver stopped"):
        getattr(sim, method)(sim.initial_state(), **options)


def test_threads_have_operations_of_their_own(world):
    sim, found, ready = world.hung, {}, threading.Barrier(2)

    def refuse(method):
        ready.wait()
        for _ in range(50):
            message = refusal(lambda: getattr(sim, method)(lost(sim.initial_state())))
            found.setdefault(method, set()).add(message.partition(":")[0])

    threads = [threading.Thread(target=refuse, args=(m,)) for m in ("momentum", "energy")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == {"momentum": {"momentum"}, "energy": {"energy"}}
