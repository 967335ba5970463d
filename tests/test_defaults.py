"""Torch's default device and dtype change no result of any public function or method."""

from __future__ import annotations

import ast
import dataclasses
import enum
import threading
from collections.abc import Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch
from public_calls import CALLS, WITHOUT_CALL, World, names
from short_tasks import SHORT, controls_of
from torch.overrides import TorchFunctionMode
from torch.utils._device import DeviceContext, _device_constructors

import diffcloth_torch as dc

PACKAGE = Path(dc.__file__).parent


class Elsewhere(TorchFunctionMode):
    """A mode of a caller that makes tensors without an explicit device on another device."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if function in _device_constructors() and kwargs.get("device") is None:
            kwargs["device"] = "meta"
        return function(*args, **kwargs)


@contextmanager
def default_device():
    torch.set_default_device("meta")
    try:
        yield
    finally:
        torch.set_default_device(None)


@contextmanager
def default_dtype(dtype):
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def default_tensor_type():
    before = torch.get_default_dtype()
    torch.set_default_tensor_type(torch.DoubleTensor)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def several(*contexts):
    with ExitStack() as stack:
        for context in contexts:
            stack.enter_context(context)
        yield


FORMS = {
    "with device": lambda: torch.device("meta"),
    "set_default_device": default_device,
    "nested": lambda: several(torch.device("cpu"), torch.device("meta"), torch.device("meta")),
    "by hand": lambda: DeviceContext(torch.device("meta")),
    "own mode": Elsewhere,
    "over cpu": lambda: several(default_device(), torch.device("meta")),
    "float64": lambda: default_dtype(torch.float64),
    "bfloat16": lambda: default_dtype(torch.bfloat16),
    "tensor type": default_tensor_type,
    "both": lambda: several(torch.device("meta"), default_dtype(torch.float16)),
}
QUICK = ("set_default_device", "own mode", "both")
# Fields with times, or without numbers.
OMITTED = {
    "seconds",
    "make_env",
    "_engine",
    "simulator",
    "_equilibria",
    "_core",
    "core",
    "optimizer",
}


def is_omitted(name):
    return name in OMITTED or str(name).endswith(("seconds", "per_second"))


def content(value):
    """Numbers of a result with their types, in a fixed order; text for values without numbers."""
    if isinstance(value, torch.Tensor):
        assert value.device.type == "cpu"
        value = value.detach().resolve_neg()
        return str(value.dtype), tuple(value.shape), value.contiguous().numpy().tobytes()
    if isinstance(value, np.ndarray):
        return str(value.dtype), value.shape, value.tobytes()
    if isinstance(value, torch.nn.Module):
        return content(value.state_dict())
    if isinstance(value, torch.Generator):
        return content(value.get_state())
    if isinstance(value, Mapping):
        return [(str(k), content(v)) for k, v in value.items() if not is_omitted(k)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return content({f.name: getattr(value, f.name) for f in dataclasses.fields(value)})
    if isinstance(value, list | tuple):
        return [content(entry) for entry in value]
    if isinstance(value, bool | int | float | str | enum.Enum | type(None)):
        return repr(value)
    if type(value).__module__.startswith("diffcloth_torch"):
        return type(value).__name__, content(vars(value)) if hasattr(value, "__dict__") else ""
    return type(value).__name__


def result(world, name):
    """Result of a call, and the mesh and picture that it writes; other files contain times."""
    paths = [world.folder / "state.obj", world.folder / "picture.png"]
    for path in paths:
        path.unlink(missing_ok=True)
    returned = content(CALLS[name](world)())
    return returned, [path.read_bytes() for path in paths if path.exists()]


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """World by form of the defaults; None: torch's own defaults."""
    made = {}

    def of(form):
        if form not in made:
            made[form] = World(tmp_path_factory.mktemp("world"))
        return made[form]

    return of


@pytest.fixture(scope="module")
def expected(world):
    found = {}

    def of(name):
        if name not in found:
            found[name] = result(world(None), name)
        return found[name]

    return of


def test_all_of_the_surface_has_a_call():
    assert sorted([*CALLS, *WITHOUT_CALL]) == names()


@pytest.mark.filterwarnings("ignore:torch.set_default_tensor_type:UserWarning")
@pytest.mark.parametrize(
    "form",
    [form if form in QUICK else pytest.param(form, marks=pytest.mark.slow) for form in FORMS],
)
@pytest.mark.parametrize("name", CALLS)
def test_defaults_change_no_bit(world, expected, name, form):
    wanted = expected(name)
    with FORMS[form]():
        assert result(world(form), name) == wanted


# --- Longer ways through the package --------------------------------------------------------------


@pytest.fixture
def same():
    """Compare a function under all defaults with itself under torch's own."""

    def compare(function):
        wanted = content(function())
        for form in ("both", "own mode", "float64"):
            with FORMS[form]():
                found = function()
                assert content(found) == wanted, form

    return compare


@pytest.mark.parametrize("name", dc.envs.TASKS)
def test_environments_and_their_gradients(same, name):
    def transition():
        env = dc.envs.make(name, num_envs=2, size=5, seed=3)
        first, _ = env.reset()
        actions = env.scripted_actions().requires_grad_()
        observation, reward, terminated, truncated, info = env.step(actions)
        (reward.sum() + observation.sum()).backward()
        return first, observation, reward, terminated, truncated, info, actions.grad

    same(transition)


@pytest.mark.parametrize("short", SHORT)
def test_tasks_of_configurations_and_their_gradients(same, short):
    def loss():
        task = short.load()
        actions = task.actions()
        controls = controls_of(task, actions)
        states = task.simulator.rollout(task.initial_state(), controls)
        value = task.loss(states)
        value.backward()
        return value, states[-1], {n: a.grad for n, a in actions.items()}

    same(loss)


@pytest.mark.parametrize("algorithm", ["apg", "shac", "sapo"])
def test_policies_and_their_optimizers(same, world, algorithm, tmp_path):
    options = dc.learn.TrainerOptions(algorithm, horizon=2, hidden=(8,), critic_epochs=1)

    def trained():
        trainer = dc.learn.Trainer(world(None).make_env, options, num_envs=2)
        trainer.update()
        trainer.save(tmp_path / "trainer.pt")
        again = dc.learn.Trainer(world(None).make_env, options, num_envs=2)
        again.load(tmp_path / "trainer.pt")
        log = again.update()
        assert {p.dtype for p in again.policy.parameters()} == {torch.float32}
        return log, again.policy

    same(trained)


@pytest.mark.parametrize("where", ["inside", "outside", "another thread"])
def test_gradients_wherever_backward_runs(world, where):
    """Gradients of steps, a checkpointed rollout and an equilibrium (which solves in backward)."""
    sim, hung = world(None).sim, world(None).hung

    def gradient(form):
        with form:
            given = sim.default_parameters()
            gravity = given.gravity.clone().requires_grad_()
            start = sim.initial_state(2)
            end = sim.rollout(
                start, parameters=given.replace(gravity=gravity), steps=2, checkpoint_every=1
            )[-1]
            own = hung.default_parameters().replace(gravity=gravity)
            rest = hung.equilibrium(hung.initial_state(), None, own)
            value = end.positions.sum() + end.joint_positions.sum() + rest.positions.sum()
            value = value + sim.energy(end, None, given.replace(gravity=gravity)).sum()
            if where == "inside":
                value.backward()
        if where == "outside":
            value.backward()
        if where == "another thread":
            thread = threading.Thread(target=value.backward)
            thread.start()
            thread.join()
        return gravity.grad

    wanted = gradient(nullcontext())
    for form in ("both", "own mode", "float64"):
        assert torch.equal(gradient(FORMS[form]()), wanted)


def test_equilibria_of_robots(same, world):
    def rest():
        contact = dc.ContactOptions(barrier_distance=1e-3)
        sim = dc.Simulator(dc.Scene([], robots=[world(None).robot]), 0.01, contact=contact)
        start = sim.initial_state()
        return sim.equilibrium(start.replace(joint_targets=start.joint_targets + 0.01))

    same(rest)


def test_jacobians(same, world):
    sim = world(None).hung

    def jacobian():
        def ends(gravity):
            given = sim.default_parameters().replace(gravity=gravity)
            return sim.step(sim.initial_state(), None, given).positions

        gravity = sim.default_parameters().gravity
        return torch.func.jacfwd(ends)(gravity), torch.func.jacrev(ends)(gravity)

    same(jacobian)


def test_compiled_steps(world):
    sim, start = world(None).sim, world(None).start
    wanted = sim.step(start).positions
    compiled = torch.compile(sim.step, backend="eager")
    with torch.device("meta"):
        assert torch.equal(compiled(start).positions, wanted)


def test_functions_of_a_caller_follow_the_callers_defaults(world):
    """Tensors that a callback makes without a device are on the caller's default device."""
    sim, made = world(None).hung, []

    def control(k, state):
        made.append(torch.zeros(3).device.type)

    with torch.device("meta"):
        sim.rollout(sim.initial_state(), control, steps=1)
    assert made == ["meta"]


# --- Implementation: explicit device and dtype ----------------------------------------------------

# Functions of torch that take the default device or dtype, unless both are named.
MAKERS = {f.__name__ for f in _device_constructors()} | {"Generator", "Tensor", "FloatTensor"}
MODULES = {"Linear", "LayerNorm", "Embedding", "Conv1d", "Conv2d", "GRU", "LSTM", "RNN"}


def makers(text):
    """Lines of a module that make tensors by torch's defaults."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        owner, name = ast.unparse(node.func.value), node.func.attr
        named = {keyword.arg for keyword in node.keywords}
        is_maker = owner == "torch" and name in MAKERS
        is_module = owner.split(".")[-1] == "nn" and name in MODULES and None not in named
        is_reader = (owner, name) == ("torch", "load") and "map_location" not in named
        if is_maker or is_module or is_reader:
            found.append(node.lineno)
    return found


@pytest.mark.parametrize(
    "path", [*PACKAGE.rglob("*.py")], ids=lambda p: str(p.relative_to(PACKAGE))
)
def test_tensors_are_made_in_one_module(path):
    if path.name != "cpu.py":
        assert makers(path.read_text()) == []


@pytest.mark.parametrize(
    "line", ["torch.zeros(3)", "torch.Generator()", "nn.Linear(2, 3)", "torch.load(path)"]
)
def test_tensors_made_by_defaults_are_found(line):
    assert makers(f"import torch\nx = {line}\n") == [2]
