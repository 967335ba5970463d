"""Options of a training."""

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
_LARGEST_COUNT = 10**6  # of steps, epochs, batches, critics, starts, updates
_LARGEST = 1e6  # above every sensible value
_POSITIVE = (
    "learning_rate", "plan_learning_rate", "critic_learning_rate", "temperature_learning_rate",
    "max_grad_norm", "max_move", "init_std", "temperature",
)  # fmt: skip
_COUNTS = (
    "horizon", "critic_epochs", "critic_batches", "critics", "check_every", "fit_iterations",
    "retained_rollouts",
)  # fmt: skip


def name_now(name: str) -> str:
    """Return a suffix for the message of an unknown option: its name since 0.2.0, or nothing."""
    return f"; since 0.2.0 its name is `{OPTIONS[name]}`" if name in OPTIONS else ""


class _RefusesOldNames:
    """Base class that refuses names of options of 0.1, and reports the present names."""

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
    """Options of a training.

    Attributes:
        algorithm: "apg": the rewards of a rollout alone. "shac": also the value of the last state,
            estimated by a critic that is learned beside the policy. "sapo": also the entropy of the
            policy, with noise that depends on observations, and several critics.
        horizon: Steps of a rollout, which is differentiated as a whole.
        feedback: If true, gradients also flow through the observations of the policy. If false,
            each action is differentiated like an action of a plan: a policy is stationary if its
            plan is, and observations do not multiply gradients step by step.
        discount: Discount factor of rewards from step to step, gamma.
        gae_lambda: Lambda of lambda returns.
        learning_rate: Learning rate of Adam for the policy.
        critic_learning_rate: Learning rate of Adam for the critics.
        decay_updates: Number of updates over which `learning_rate`, `critic_learning_rate` and
            `plan_learning_rate` fall linearly to a tenth; 0: constant rates.
        scale: Block over which Adam averages squared gradients of the policy. "number": each number
            has its own scale, as usual, and all numbers move about equally fast. "tensor": one
            scale for all numbers of a tensor, such as the knots of a plan; numbers with small
            gradients move little.
        betas: Decay rates of the moments of all Adam optimizers.
        critic_epochs: Passes of the critics over each rollout.
        critic_batches: Batches of a pass, each with one step of the critics.
        critic_only: Number of first updates that improve the critics alone.
        tau: Polyak rate: share by which the target critics move towards the critics after each
            rollout.
        max_grad_norm: Largest norm of a gradient of the policy; longer ones are clipped.
        init_std: Initial standard deviation of the noise of actions.
        critics: Number of critics of "sapo": the policy maximizes the mean over critics, and the
            critics learn from the minimum over critics.
        temperature: Initial temperature of "sapo": reward that equals one unit of entropy.
        temperature_learning_rate: Learning rate of Adam for the logarithm of the temperature.
        target_entropy: Mean entropy, per number of an action, to which the temperature is adapted.
        first_action: Initial action of the policy, between -1 and 1; None for zeros.
        plan_knots: Number of actions, at evenly spaced times of an episode and interpolated
            linearly, that are learned as a plan. A policy is then the sum of the plan, a linear
            function of the observation, and the network. The task must observe its "time". 0: the
            network alone.
        plan_learning_rate: Learning rate of Adam for the plan; the linear function has the learning
            rate of the policy.
        action_step: Root mean square change of actions at which an update aims. The gradient of
            each environment with respect to its actions is divided by its own norm and moves the
            actions of the rollout by this step, and the policy is fitted to the moved actions by
            `fit_iterations` steps of Adam, while its actions are retained at observations of the
            `retained_rollouts` rollouts before. Rewards of the last `Task.holds` steps of an
            episode without success count four times. The step falls with `decay_updates`, the scale
            of observations is fixed after ten updates, and `max_grad_norm` has no effect. Not with
            "sapo", whose loss depends on more than actions, nor with `feedback`. None: a step of
            Adam along the gradient of the weights.
        max_move: Largest change of a number of an action at which an update with `action_step`
            aims. Where the gradient concentrates on few numbers, such as the effort of fingers, a
            large move crosses cliffs of the return.
        fit_iterations: Steps of Adam in an update with `action_step`.
        retained_rollouts: Number of former rollouts at whose observations an update with
            `action_step` retains the actions. Tasks whose starts need different motions need more.
        draws: Number of plans of which the training begins at the best, by the mean reward of a
            rollout without noise: the initial plan, which is `first_action` or the plan of an
            initial policy, and random plans near this plan. It needs `plan_knots`. 0: the initial
            plan.
        hidden: Sizes of hidden layers.
        max_change: Largest change of actions by an update: root mean square, without noise, over
            the observations of the rollout. A larger update is scaled back. The scale of
            observations, on which actions also depend, remains fixed after the first update, or as
            in the initial policy. None: 0.02 for a training that begins at a policy, otherwise no
            bound. Actions lie between -1 and 1, so 2 bounds no update.
        held_out: Number of starts, excluded from rollouts, at which the policy is checked initially
            and after every `check_every` updates. If success has fallen by more than two standard
            errors, the last good policy is restored; `Trainer.check` restores it after any fall.
            None: 16 for a training that begins at a policy, otherwise 0; 0: no checks.
        check_every: Updates from one check to the next.
        seed: Seed of networks, noise and starts.

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
    action_step: float | None = None
    max_move: float = 0.3
    fit_iterations: int = 20
    retained_rollouts: int = 10
    draws: int = 0
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
        for name in _COUNTS:
            check_count(f"TrainerOptions: `{name}`", getattr(self, name), 1, _LARGEST_COUNT)
        check_count("TrainerOptions: `draws`", self.draws, 0, _LARGEST_COUNT)
        for name in ("critic_only", "decay_updates", "plan_knots", "seed"):
            check_count(f"TrainerOptions: `{name}`", getattr(self, name), 0)
        for name in ("discount", "gae_lambda", "tau"):
            _check_number(name, getattr(self, name), lambda v: 0 <= v <= 1, "in [0, 1]")
        accepted = f"positive and below {_LARGEST:g}"
        for name in _POSITIVE:
            _check_number(name, getattr(self, name), lambda v: 0 < v < _LARGEST, accepted)
        if self.max_change is not None:
            _check_number("max_change", self.max_change, lambda v: 0 < v < _LARGEST, accepted)
        if self.action_step is not None:
            name, value = "action_step", self.action_step
            _check_number(name, value, lambda v: 0 < v <= 1, "in (0, 1]")
            if self.feedback or self.has_entropy:
                raise InvalidInput(
                    "TrainerOptions: `action_step` must be None with `feedback` and with the "
                    f'algorithm "sapo", got {value!r}'
                )
        if self.draws and not self.plan_knots:
            raise InvalidInput(
                f"TrainerOptions: `draws` must be 0 without `plan_knots`, got {self.draws}"
            )
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
        """Return whether a critic estimates the value of the end of a rollout."""
        return self.algorithm != "apg"

    @property
    def has_entropy(self) -> bool:
        """Return whether the loss includes the entropy of the policy."""
        return self.algorithm == "sapo"

    def rate_share(self, updates: int) -> float:
        """Return the factor on the learning rates after some updates."""
        if self.decay_updates == 0:
            return 1.0
        return 1.0 - (1.0 - _LEAST_SHARE) * min(updates / self.decay_updates, 1.0)


def _check_number(
    name: str, value: object, is_accepted: Callable[[float], bool], accepted: str
) -> None:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not is_number or not is_accepted(value):  # type: ignore[arg-type]
        raise InvalidInput(f"TrainerOptions: `{name}` must be {accepted}, got {value!r}")
