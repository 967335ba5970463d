"""Policies: networks of known sizes, and their files."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checkpoint import (
    check_like,
    read_checkpoint,
    refusing_damage,
    write_checkpoint,
)
from diffcloth_torch.checks import check_count
from diffcloth_torch.envs.gym import ClothVectorEnv
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.extras import from_extra
from diffcloth_torch.files import as_path, replace_file
from diffcloth_torch.learn.networks import Actor, Critics, Scale
from diffcloth_torch.learn.options import TrainerOptions
from diffcloth_torch.memory import check_memory
from diffcloth_torch.operations import called

__all__ = [
    "TRAINER",
    "Policy",
    "PolicySizes",
    "begin_at",
    "check_fits",
    "file_to_write",
    "load_policy",
]

TRAINER = "trainer"
"""Kind of the files of `Trainer.save`."""

_POLICY = "policy"  # kind of the files of `Policy.save`
_WEIGHT_BYTES = 16  # including its gradient and the moments of Adam


@dataclass(frozen=True)
class PolicySizes:
    """Sizes on which a policy and its environments agree.

    Attributes:
        observations: O, the length of an observation.
        actions: A, the length of an action.
        time: Index in an observation of the elapsed share of the episode; None if it is not
            observed.

    Raises:
        InvalidInput: If a value is not accepted.
    """

    observations: int
    actions: int
    time: int | None = None

    def __post_init__(self) -> None:
        check_count("PolicySizes: `observations`", self.observations, 1)
        check_count("PolicySizes: `actions`", self.actions, 1)
        if self.time is not None:
            check_count("PolicySizes: `time`", self.time, 0, self.observations - 1)

    @staticmethod
    def of(env: ClothVectorEnv) -> PolicySizes:
        """Return the sizes of environments.

        Raises:
            TypeError: If `env` is no `ClothVectorEnv`.
        """
        given: object = env
        if not isinstance(given, ClothVectorEnv):
            kind = type(given).__name__
            raise TypeError(f"PolicySizes.of: `env` must be a ClothVectorEnv, got {kind}")
        task = env.task
        slices = task.observation_slices
        length = max(place.stop for place in slices.values())
        time = slices["time"].start if "time" in slices else None
        return PolicySizes(int(length), task.action_size, time)


class Policy(torch.nn.Module):
    """A policy, its critics, their target copies, and the scale of observations.

    Attributes:
        sizes: Sizes of observations and actions.
        options: Options that determine the networks.
        log_temperature: Logarithm of the temperature; used by "sapo" alone.
    """

    def __init__(self, sizes: PolicySizes | ClothVectorEnv, options: TrainerOptions) -> None:
        """Make networks.

        Args:
            sizes: Sizes of observations and actions, or environments with these sizes.
            options: Algorithm, first action, sizes of the networks.

        Raises:
            InvalidInput: If the networks do not fit into memory, the first action has another
                length, or a plan has no time to follow.
        """
        super().__init__()
        name = "observations that have none"
        if isinstance(sizes, ClothVectorEnv):
            name, sizes = f"{sizes.task.name}", PolicySizes.of(sizes)
        self.sizes, self.options = sizes, options
        _check_memory(sizes, options)
        if options.plan_knots and sizes.time is None:
            raise InvalidInput(
                f"TrainerOptions: `plan_knots` must be 0 for {name}, "
                'which does not observe its "time"'
            )
        first = options.first_action
        if first is not None and len(first) != sizes.actions:
            raise InvalidInput(
                f"TrainerOptions: `first_action` must have {sizes.actions} numbers, "
                f"got {len(first)}"
            )
        self.actor = Actor(
            sizes.observations,
            cpu.tensor(first or [0.0] * sizes.actions, dtype=torch.float32),
            options.hidden,
            options.init_std,
            sees_width=options.has_entropy,
            knots=options.plan_knots,
        )
        critics = options.critics if options.has_entropy else 1
        self.critics = Critics(sizes.observations, options.hidden, critics)
        self.targets = Critics(sizes.observations, options.hidden, critics)
        self.targets.load_state_dict(self.critics.state_dict())
        self.scale = Scale(sizes.observations)
        self.log_temperature = torch.nn.Parameter(
            cpu.tensor(options.temperature, dtype=torch.float32).log()
        )

    @property
    def observations(self) -> int:
        """O, the length of an observation."""
        return self.sizes.observations

    @property
    def temperature(self) -> float:
        """Reward that equals one unit of entropy; 0 unless the algorithm is "sapo"."""
        if not self.options.has_entropy:
            return 0.0
        return float(self.log_temperature.detach().exp())

    def forward(self, observation: Tensor, noise: Tensor | None = None) -> Tensor:
        """Return actions [B, A] for observations [B, O]; `noise` is standard normal [B, A]."""
        if noise is None:
            noise = cpu.zeros(1, dtype=torch.float32)
        return self.act(observation, noise)[0]

    def act(self, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions [B, A], and minus the logarithm of their density [B]; see `Actor`."""
        time = observation[:, self.sizes.time] if self.options.plan_knots else None
        actions, entropy = self.actor(self.scale(observation), noise, time)
        return actions, entropy

    @called("Policy.save")
    def save(self, path: str | Path) -> None:
        """Write the policy to a file, which `load_policy` reads without environments.

        The file replaces an older one completely or not at all.

        Raises:
            InvalidInput: If the folder of the file does not exist.
            OSError: If the file cannot be written; an older file remains unchanged.
        """
        content = {
            "sizes": asdict(self.sizes),
            "options": asdict(self.options),
            "policy": {name: tensor.clone() for name, tensor in self.state_dict().items()},
        }
        write_checkpoint(file_to_write("Policy.save", path), _POLICY, content)

    @called("Policy.export")
    def export(self, path: str | Path) -> None:
        """Write the policy without noise as an ONNX model; requires the extra "onnx".

        The input "observation" is float32 [B, O] for any B, the output "actions" float32 [B, A].

        Raises:
            InvalidInput: If the folder does not exist, or a package of the extra is missing.
            OSError: If the file cannot be written; an older one remains unchanged.
        """
        file = file_to_write("Policy.export", path)
        for module in ("onnx", "onnxscript"):
            from_extra(module, "onnx", f"Policy.export needs {module}")
        example = cpu.zeros(2, self.observations, dtype=torch.float32)
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # warnings about internals of the exporter
            program: Any = torch.onnx.export(
                self,
                (example,),
                input_names=["observation"],
                output_names=["actions"],
                dynamic_shapes=({0: torch.export.Dim("B")},),
                dynamo=True,
                verbose=False,
            )
        with replace_file(file, keeps_ending=True) as part:
            program.save(str(part), external_data=False)


@called("load_policy")
def load_policy(path: str | Path) -> Policy:
    """Read a policy; it needs no environments, `policy(observation)` returns actions.

    Args:
        path: A file of `Policy.save`, of `Trainer.save`, or the `policy.pt` of `diffcloth train`.

    Raises:
        InvalidInput: If `path` is no such file, or its content was changed or is damaged.
        OSError: If the file cannot be read.
    """
    path = as_path("load_policy: `path`", path)
    if not path.is_file():
        raise InvalidInput(f"load_policy: `path` must be a file, got {str(path)!r}")
    content = read_checkpoint("load_policy", path, _POLICY, TRAINER)
    with refusing_damage("load_policy", path):
        return _read(content)


def _read(content: Any) -> Policy:
    if not isinstance(content, dict) or not {"options", "policy"} <= content.keys():
        raise InvalidInput("its content must be a dict with options and a policy")
    options = TrainerOptions(**content["options"])
    sizes = PolicySizes(**content["sizes"]) if "sizes" in content else _sizes_of(content["task"])
    # Initial weights are replaced; drawing them must not advance the generator of the caller.
    with torch.random.fork_rng(devices=[]):
        policy = Policy(sizes, options)
    check_like("the policy", dict(content["policy"]), policy.state_dict())
    policy.load_state_dict(content["policy"])
    return policy


def _sizes_of(task: Any) -> PolicySizes:
    """Return sizes from the description of a task in a file of a trainer."""
    check_like("the task", {name: task[name] for name in ("actions",)}, {"actions": 0})
    places: Any = task["observations"]
    if not isinstance(places, Mapping) or not places:
        raise InvalidInput("its observations must be a dict of places")
    for name, place in places.items():
        check_like(f"the place of {name!r}", place, [0, 0])
    time = places["time"][0] if "time" in places else None
    return PolicySizes(max(stop for _, stop in places.values()), task["actions"], time)


def check_fits(owner: str, policy: Policy, sizes: PolicySizes) -> None:
    """Require the sizes of a policy to match the sizes of environments.

    Raises:
        InvalidInput: If a size differs; the message names the size.
    """
    for name in ("observations", "actions"):
        own, others = getattr(policy.sizes, name), getattr(sizes, name)
        if own != others:
            raise InvalidInput(
                f"{owner} must be for {others} {name}, as the environments have, got {own}"
            )
    if policy.options.plan_knots and policy.sizes.time != sizes.time:
        raise InvalidInput(
            f"{owner} reads the time of an episode at observation {policy.sizes.time}, but the "
            f"environments have it at {sizes.time}"
        )


def begin_at(owner: str, policy: Policy, other: Policy) -> None:
    """Copy the weights of another policy; actions without noise are then equal.

    Deviations that depend on observations, critics and the temperature are copied if both policies
    have them.

    Args:
        owner: Prefix of messages.
        policy: Policy whose weights change.
        other: Policy whose weights are copied.

    Raises:
        InvalidInput: If the shapes of the networks differ; the message names the option.
    """
    check_fits(owner, other, policy.sizes)
    for name in ("hidden", "plan_knots"):
        own, others = getattr(policy.options, name), getattr(other.options, name)
        if own != others:
            raise InvalidInput(
                f"{owner} has TrainerOptions({name}={others!r}), but `options` has "
                f"{name}={own!r}: both must be the same"
            )
    actions, copied = policy.sizes.actions, other.state_dict()
    left_out = set()
    if not (policy.options.has_entropy and other.options.has_entropy):
        left_out.add("log_temperature")
    if len(policy.critics.values) != len(other.critics.values):
        left_out |= {"critics", "targets"}
    with torch.no_grad():
        for name, tensor in policy.state_dict().items():
            if name.partition(".")[0] in left_out:
                continue
            if tensor.shape == copied[name].shape:
                tensor.copy_(copied[name])
            else:  # the last layer, if only one of both has rows for deviations
                tensor[:actions] = copied[name][:actions]
                tensor[actions:] = 0.0


def file_to_write(owner: str, path: object) -> Path:
    """Require the path of a file in an existing folder, and return it."""
    file = as_path(f"{owner}: `path`", path)
    if not file.parent.is_dir():
        raise InvalidInput(f"{owner}: the folder of `path` must exist, got {str(file)!r}")
    return file


def _check_memory(sizes: PolicySizes, options: TrainerOptions) -> None:
    """Refuse networks that do not fit into memory, before their allocation."""
    layers = [sizes.observations, *options.hidden]
    inner = sum((before + 3) * after for before, after in pairwise(layers))
    critics = 2 * (options.critics if options.has_entropy else 1)  # and their target copies
    weights = (1 + critics) * (inner + (layers[-1] + 1) * 2 * sizes.actions)
    names = "TrainerOptions: the weights by `hidden` and `critics`"
    check_memory(names, weights, _WEIGHT_BYTES, "a weight")
    knots = "TrainerOptions: `plan_knots`"
    check_memory(knots, options.plan_knots, sizes.actions * _WEIGHT_BYTES, "a knot")
