"""How a policy is learned."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from diffcloth_torch.checks import check_choice, check_count
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.reprs import dataclass_text
from diffcloth_torch.saved_0_1 import OPTIONS

__all__ = ["ALGORITHMS", "SCALES", "TrainerOptions", "name_now"]

ALGORITHMS = ("apg", "shac", "sapo")
SCALES = ("number", "tensor")
_LEAST_SHARE = 0.1
_LARGEST_COUNT = 10**6  # of what each update repeats
_LARGEST = 1e6  # above every sensible rate
_POSITIVE = (
    "learning_rate", "plan_learning_rate", "critic_learning_rate", "temperature_learning_rate",
    "max_grad_norm", "init_std", "temperature",
)  # fmt: skip


def name_now(name: str) -> str:
    """Text that follows the message of an unknown option: its name since 0.2.0, if it has one."""
    return f"; since 0.2.0 its name is `{OPTIONS[name]}`" if name in OPTIONS else ""


class _RefusesOldNames:
    """Refuses names that options had in 0.1, and reports the names of today."""

    def __new__(cls, *_: object, **options: object) -> _RefusesOldNames:
        for name in options:
            if name in OPTIONS:
                raise TypeError(f"TrainerOptions: `{name}` is no option{name_now(name)}")
        return super().__new__(cls)

    if not TYPE_CHECKING:  # type checkers know the fields

        def __getattr__(self, name: str) -> Any:
            kind = type(self).__name__
            raise AttributeError(f"{kind!r} object has no attribute {name!r}{name_now(name)}")


@dataclass(frozen=True)
class TrainerOptions(_RefusesOldNames):
    """How a policy is learned.

    Attributes:
        algorithm: "apg": the rewards of a rollout alone. "shac": also the value of its end, by a
            critic that learns beside the policy. "sapo": also the entropy of the policy, whose
            noise depends on what it sees, and several critics.
        horizon: Steps of a rollout that is differentiated at once.
        feedback: Whether gradients flow through what the policy sees, too. Without, each action is
            differentiated as that of a plan: where a plan cannot be improved the policy cannot
            either, and what a policy sees does not multiply gradients step by step.
        discount: Of rewards from step to step, gamma.
        gae_lambda: Of lambda returns, lambda.
        learning_rate: Learning rate of Adam for the policy.
        critic_learning_rate: The same for the critic.
        decay_updates: Number of updates over which these and `plan_learning_rate` fall, linearly,
            to a tenth; 0 for never.
        scale: What Adam divides the steps of the policy by. "number": a scale for each number, as
            usual, so that all of them move equally fast. "tensor": one scale for all numbers of a
            tensor, such as the knots of a plan, so that what counts little moves little.
        betas: Of Adam for all of them.
        critic_epochs: How often the critic sees each rollout.
        critic_batches: Parts of a rollout between two steps of the critic.
        critic_only: Updates at first that improve the critic alone.
        tau: Polyak rate: share by which the target critic moves towards the critic after each
            rollout.
        max_grad_norm: Largest norm of a gradient of the policy; longer ones are shortened.
        init_std: Standard deviation of the noise of actions at first.
        critics: Number of critics of "sapo": their mean is the value that a policy climbs, their
            least one the value that they learn.
        temperature: Of "sapo" at first: what a unit of entropy is worth, in units of reward.
        temperature_learning_rate: Learning rate of Adam for its logarithm.
        target_entropy: Mean entropy, per number of an action, that the temperature aims at.
        first_action: Action of the policy at first, between -1 and 1; None for zeros.
        plan_knots: Number of actions, at even times of an episode and with lines between them, that
            are learned as a plan. A policy is then the sum of that plan, of a linear function of
            what it sees, and of its network. The task must observe its "time". 0 for the network
            alone.
        plan_learning_rate: Learning rate of Adam for the plan; the linear function has the rate of
            the policy.
        hidden: Sizes of hidden layers.
        max_change: Largest change of actions by an update: root mean square, without noise, over
            the observations of the rollout. A larger update is scaled back, and the scale of
            observations, on which actions depend, too, stays as it was after the first update or in
            the policy that training begins at. None: 0.02 for a training that begins at a policy,
            otherwise no bound. As actions lie between -1 and 1, 2 bounds no update.
        held_out: Number of starts, which no rollout has, at which the policy is checked at first
            and after every `check_every` updates: where success there has fallen, the policy is
            restored. None: 16 for a training that begins at a policy, otherwise 0; 0: no checks.
        check_every: Updates from one check to the next.
        seed: Of networks, noise and starts.

    Raises:
        InvalidInput: If a value is not accepted.
    """

    algorithm: str = "shac"
    horizon: int = 16
    feedback: bool = False
    discount: float = 0.99
    gae_lambda: float = 0.95
    learning_rate: float = 2e-3
    critic_learning_rate: float = 2e-3
    decay_updates: int = 0
    scale: str = "number"
    betas: tuple[float, float] = (0.7, 0.95)
    critic_epochs: int = 16
    critic_batches: int = 4
    critic_only: int = 0
    tau: float = 0.2
    max_grad_norm: float = 1.0
    init_std: float = 0.1
    critics: int = 2
    temperature: float = 1e-3
    temperature_learning_rate: float = 2e-2
    target_entropy: float = -1.0
    first_action: tuple[float, ...] | None = None
    plan_knots: int = 0
    plan_learning_rate: float = 4e-2
    hidden: tuple[int, ...] = (128, 64, 32)
    seed: int = 0
    max_change: float | None = None
    held_out: int | None = None
    check_every: int = 10

    __repr__ = dataclass_text

    def __post_init__(self) -> None:
        check_choice("TrainerOptions: `algorithm`", self.algorithm, ALGORITHMS)
        check_choice("TrainerOptions: `scale`", self.scale, SCALES)
        if not isinstance(self.feedback, bool):
            raise InvalidInput(f"TrainerOptions: `feedback` must be a bool, got {self.feedback!r}")
        for name in ("horizon", "critic_epochs", "critic_batches", "critics", "check_every"):
            check_count(f"TrainerOptions: `{name}`", getattr(self, name), 1, _LARGEST_COUNT)
        for name in ("critic_only", "decay_updates", "plan_knots", "seed"):
            check_count(f"TrainerOptions: `{name}`", getattr(self, name), 0)
        for name in ("discount", "gae_lambda", "tau"):
            _check_number(name, getattr(self, name), lambda v: 0 <= v <= 1, "in [0, 1]")
        accepted = f"positive and below {_LARGEST:g}"
        for name in _POSITIVE:
            _check_number(name, getattr(self, name), lambda v: 0 < v < _LARGEST, accepted)
        if self.max_change is not None:
            _check_number("max_change", self.max_change, lambda v: 0 < v < _LARGEST, accepted)
        if self.held_out is not None:
            check_count("TrainerOptions: `held_out`", self.held_out, 0, _LARGEST_COUNT)
        _check_number("target_entropy", self.target_entropy, math.isfinite, "finite")
        for name in ("betas", "hidden", "first_action"):
            value = getattr(self, name)
            if not isinstance(value, tuple) and (name, value) != ("first_action", None):
                raise InvalidInput(f"TrainerOptions: `{name}` must be a tuple, got {value!r}")
        if len(self.betas) != 2:
            raise InvalidInput(f"TrainerOptions: `betas` must be two numbers, got {self.betas}")
        for k, beta in enumerate(self.betas):
            _check_number(f"betas[{k}]", beta, lambda v: 0 <= v < 1, "in [0, 1)")
        for k, size in enumerate(self.hidden):
            check_count(f"TrainerOptions: `hidden[{k}]`", size, 1)
        for k, value in enumerate(self.first_action or ()):
            _check_number(f"first_action[{k}]", value, lambda v: -1 < v < 1, "between -1 and 1")

    @property
    def has_critic(self) -> bool:
        """Whether a critic says what the end of a rollout is worth."""
        return self.algorithm != "apg"

    @property
    def has_entropy(self) -> bool:
        """Whether the entropy of the policy counts, too."""
        return self.algorithm == "sapo"

    def rate_share(self, updates: int) -> float:
        """Share of the learning rates that is left after some updates."""
        if self.decay_updates == 0:
            return 1.0
        return 1.0 - (1.0 - _LEAST_SHARE) * min(updates / self.decay_updates, 1.0)


def _check_number(
    name: str, value: object, is_accepted: Callable[[float], bool], accepted: str
) -> None:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not is_number or not is_accepted(value):  # type: ignore[arg-type]
        raise InvalidInput(f"TrainerOptions: `{name}` must be {accepted}, got {value!r}")
