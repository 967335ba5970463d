"""The core of an environment: a task as pure functions of its state.

The module does not depend on gymnasium. All functions work on batches of independent environments,
and all except the random start are differentiable.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import check_choice, check_count
from diffcloth_torch.envs.actuators import Actuator, Tools
from diffcloth_torch.envs.frames import Frame, vectors_out_of
from diffcloth_torch.envs.randomization import Randomization, Ranges
from diffcloth_torch.envs.safety import SafetyStop
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.operations import operation
from diffcloth_torch.reprs import dataclass_text
from diffcloth_torch.sim.records.controls import Parameters
from diffcloth_torch.sim.records.state import State, where
from diffcloth_torch.sim.simulator import Simulator

__all__ = ["FRAMES", "EnvState", "Task", "add_steps", "graded", "lengths", "steps_made"]

FRAMES = ("task", "world")

_made = 0  # environment steps of this process, and of workers on its behalf


def steps_made() -> int:
    """Return the number of environment steps of this process, and of its workers."""
    return _made


def add_steps(count: int) -> None:
    """Count environment steps."""
    global _made
    _made += count


@dataclass(frozen=True, eq=False)
class EnvState:
    """The state of a batch of environments.

    Attributes:
        state: State of the simulation.
        tools: State of the actuator: positions of pickers and the vertices that they hold.
        drawn: Random numbers of the start, and quantities derived from the start, such as a goal.
        elapsed: Transitions since the start, int64 [B].
        failed: Whether the simulation failed in the last transition, [B]; the state is then the
            last state that was reached.
        blocked: Whether a prescribed motion of the last transition was infeasible and was stopped,
            [B].
        held: Number of transitions, up to the last one, in which the task was done, int64 [B].
    """

    state: State
    tools: Tools
    drawn: dict[str, Tensor]
    elapsed: Tensor
    failed: Tensor
    blocked: Tensor
    held: Tensor

    __repr__ = dataclass_text

    def __len__(self) -> int:
        return len(self.elapsed)

    def detach(self) -> EnvState:
        """A copy without a graph."""
        return self._map(lambda t: t.detach(), self.state.detach())

    @staticmethod
    def where(mask: Tensor, a: EnvState, b: EnvState) -> EnvState:
        """Environment i of `a` where mask[i], else of `b`."""

        def choose(x: Tensor, y: Tensor) -> Tensor:
            return torch.where(mask.reshape(-1, *[1] * (x.dim() - 1)), x, y)

        return EnvState(
            where(mask, a.state, b.state),
            {name: choose(a.tools[name], b.tools[name]) for name in b.tools},
            {name: choose(a.drawn[name], b.drawn[name]) for name in b.drawn},
            *(choose(getattr(a, name), getattr(b, name)) for name in _COUNTS),
        )

    def rows(self, rows: Tensor) -> EnvState:
        """Environments by their indices [n]."""
        chosen = self._map(lambda t: t[rows], self.state[rows])
        return replace(chosen, **{name: getattr(self, name)[rows] for name in _COUNTS})

    def _map(self, change: Callable[[Tensor], Tensor], state: State) -> EnvState:
        return replace(
            self,
            state=state,
            tools={name: change(t) for name, t in self.tools.items()},
            drawn={name: change(t) for name, t in self.drawn.items()},
        )


_COUNTS = ("elapsed", "failed", "blocked", "held")


class Task(ABC):
    """A task: the distribution of its starts, its tools, its reward and its success.

    Rewards are at least `worst`, which is the reward of a blocked motion. A failed simulation costs
    `worst` for its transition and for each remaining transition, so no failure has a larger return
    than an episode that continues.

    Attributes:
        name: Name of the task in `make`, and "diffcloth/NAME-v0" in gymnasium.
        worst: The smallest reward of a transition.
        holds: Number of last transitions in which a task must be done for success.
        scales: Whether `randomize` may draw a scale of the cloths: `place` then scales the start.
        simulator: Simulator of the scene, shared by all environments.
        actuator: Conversion of actions to controls.
        horizon: Transitions after which an episode ends.
        substeps: Time steps of a transition.
        frame: The axes of observations and actions: "task", fixed at the start of an episode, or
            "world".
    """

    name: ClassVar[str]
    worst: ClassVar[float] = -1.0
    holds: ClassVar[int] = 5
    scales: ClassVar[bool] = False

    def __init__(
        self,
        simulator: Simulator,
        actuator: Actuator,
        *,
        horizon: int,
        substeps: int,
        frame: str = "task",
        randomize: Ranges = False,
    ) -> None:
        if not isinstance(getattr(self, "name", None), str):
            raise InvalidInput(f"{type(self).__name__}: a task must have a `name`")
        owner = operation(self.name)
        if not math.isfinite(self.worst):
            raise InvalidInput(f"{owner}: `worst` must be finite, got {self.worst}")
        if simulator.solver.throw:
            raise InvalidInput(
                f"{owner}: `simulator` must have SolverOptions(throw=False): one "
                "environment that fails must not end the others"
            )
        self.simulator, self.actuator = simulator, actuator
        self.horizon = check_count(f"{owner}: `horizon`", horizon, 1)
        self.substeps = check_count(f"{owner}: `substeps`", substeps, 1)
        self.frame = check_choice(f"{owner}: `frame`", frame, FRAMES)
        self._randomization = Randomization(owner, simulator, randomize, self.scales)
        self._stop: SafetyStop | None = None

    @abstractmethod
    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw the random quantities of a start, for one environment."""

    @abstractmethod
    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """State and tools of the starts with the random quantities `drawn`, [B, ...].

        The method may add quantities of the start to `drawn` that rewards need.
        """

    @abstractmethod
    def features(self, env: EnvState) -> Mapping[str, Tensor]:
        """Name -> observed quantity [B, n], in the order of the observation."""

    @abstractmethod
    def reward(self, env: EnvState) -> Tensor:
        """Reward [B] for reaching a state, at least `worst`."""

    @abstractmethod
    def success(self, env: EnvState) -> Tensor:
        """Return whether the task is done in a state [B]; success needs `holds` such states."""

    def scripted(self, env: EnvState) -> Tensor:  # a task may have none
        """Actions [B, A] of a hand-made policy, which shows that the task can be done.

        Raises:
            InvalidInput: If the task has no scripted policy.
        """
        raise InvalidInput(f"{self.name}: it has no scripted policy")

    def frame_of(self, state: State, drawn: Mapping[str, Tensor]) -> Frame | None:
        """The frame of the task at a start; None for the world frame."""
        return None

    def goals(self, env: EnvState) -> Tensor | None:
        """Points [B, g, 3] that pictures of the task mark; None without such points."""
        return env.drawn.get("goal")

    def terminal(self, env: EnvState) -> Tensor:
        """Return whether an episode ends before its horizon [B]: if the simulation failed."""
        return env.failed

    def sample(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw a start, and physical parameters if they are randomized."""
        return self.draw(generator) | self._randomization.draw(generator)

    def initial(self, generator: torch.Generator, n: int) -> EnvState:
        """Starts of n environments, one drawn after the other."""
        return self.start([self.sample(generator) for _ in range(n)])

    def start(self, draws: list[dict[str, Tensor]]) -> EnvState:
        """Starts with the random quantities drawn for each environment."""
        drawn = {name: torch.stack([d[name] for d in draws]) for name in draws[0]}
        with torch.no_grad():
            state, tools = self.place(drawn)
            frame = self.frame_of(state, drawn) if self.frame == "task" else None
        if frame is not None:
            drawn |= frame
        count = len(draws)
        return EnvState(
            state,
            tools,
            drawn,
            elapsed=cpu.zeros(count, dtype=torch.int64),
            failed=cpu.zeros(count, dtype=torch.bool),
            blocked=cpu.zeros(count, dtype=torch.bool),
            held=cpu.zeros(count, dtype=torch.int64),
        )

    def transition(
        self, env: EnvState, actions: Tensor, parameters: Parameters | None = None
    ) -> EnvState:
        """The state after `substeps` time steps.

        An infeasible prescribed motion is stopped: its time step is repeated with all prescribed
        motion held, and the remaining time steps of the transition are held too. Derivatives of
        these steps with respect to the action are zero; derivatives with respect to the state and
        to parameters are kept. An environment whose simulation fails stays at the last state that
        it reached, without a graph.

        Args:
            env: State before the transition.
            actions: Actions in the frame of the task, float64 [B, A], clipped to -1 .. 1.
            parameters: Parameters of the simulation; None means the parameters of the scene.
        """
        add_steps(len(env))
        state = env.state
        failed = blocked = torch.zeros_like(env.failed)
        parameters = self._randomization.parameters(env.drawn, parameters)
        controls, tools = self.actuator.act(
            env.tools, state, self.in_world(env, actions.clamp(-1, 1)), self.substeps
        )
        stopped, fails = [False] * len(env), False
        for control in controls:
            state = self._safety.step(state, control, parameters, stopped)
            failed = failed | failures(state)
            fails = bool(failed.any())
            if fails:
                state = where(failed, state.detach(), state)
        if any(stopped):
            blocked = cpu.tensor(stopped, dtype=torch.bool)
        if fails or any(stopped):
            tools = {name: _cut(t, failed | blocked) for name, t in tools.items()}
        after = EnvState(state, tools, env.drawn, env.elapsed + 1, failed, blocked, env.held)
        with torch.no_grad():
            done = self.success(after) & ~failed
        return replace(after, held=(env.held + 1) * done)

    def outcome(self, env: EnvState) -> Tensor:
        """Reward [B] with the charges for failure.

        The reward of a blocked motion is `worst`; the reward of a failed simulation is `worst`
        times the number of its transition and all remaining transitions.
        """
        reward = self.reward(env)
        if not bool((env.failed | env.blocked).any()):
            return reward
        left = (self.horizon - env.elapsed).clamp(min=0)
        charge = self.worst * torch.where(env.failed, 1 + left, 1)
        return torch.where(env.failed | env.blocked, charge.to(reward), reward)

    def succeeded(self, env: EnvState) -> Tensor:
        """Return whether the task was done in each of the last `holds` transitions [B]."""
        return env.held >= self.holds

    def sensed(self, env: EnvState) -> Mapping[str, Tensor]:
        """Name -> observed quantity [B, n] that a policy receives: all features, by default."""
        return self.features(env)

    def observation(self, env: EnvState) -> Tensor:
        """Observation of a policy, float64 [B, O]: all `sensed` quantities, concatenated."""
        return torch.cat(list(self.sensed(env).values()), dim=-1)

    def in_world(self, env: EnvState, actions: Tensor) -> Tensor:
        """Actions [B, A] in world axes."""
        starts = self.actuator.vectors
        if "frame_axes" not in env.drawn or not starts:
            return actions
        if self._vectors is None:
            self._vectors = cpu.tensor(
                [[s, s + 1, s + 2] for s in starts], dtype=torch.int64
            ).flatten()
        vectors = actions[:, self._vectors].reshape(len(actions), -1, 3)
        turned = vectors_out_of(env.drawn, vectors).flatten(1)
        return actions.index_copy(1, self._vectors, turned)

    _vectors: Tensor | None = None

    @property
    def _safety(self) -> SafetyStop:
        if self._stop is None or self._stop.simulator is not self.simulator:
            self._stop = SafetyStop(self.simulator)
        return self._stop

    @property
    def action_size(self) -> int:
        """A, the length of an action."""
        return self.actuator.size

    @property
    def first_action(self) -> tuple[float, ...]:
        """Action from which plans and policies begin to learn, between -1 and 1, [A].

        It should move something that counts: where nothing is touched, rewards have no gradient. It
        is zero unless a task has another one.
        """
        return (0.0,) * self.action_size

    @property
    def observation_slices(self) -> dict[str, slice]:
        """Name of an observed quantity -> its slice of an observation."""
        sizes = {n: f.shape[-1] for n, f in self.sensed(self.example()).items()}
        ends = cpu.tensor(list(sizes.values()), dtype=torch.int64).cumsum(0).tolist()
        return {
            n: slice(end - size, end) for (n, size), end in zip(sizes.items(), ends, strict=True)
        }

    def example(self) -> EnvState:
        """A start of one environment, as an example of all shapes."""
        return self.initial(cpu.generator().manual_seed(0), 1)


def graded(distance: Tensor, tolerance: float | Tensor, length: float | Tensor) -> Tensor:
    """Reward [B] between -1 and 1, with a gradient everywhere that is largest near success.

    The reward is s(4 (1 - d/t)) - tanh(d/l) with the logistic function s.

    Args:
        distance: d, the distance from success [m], [B].
        tolerance: t, the distance at which a task counts as done [m], a number or [B].
        length: l, the length over which rewards distinguish distances [m], a number or [B].
    """
    near = torch.sigmoid(4.0 - (4.0 / tolerance) * distance)
    return near - torch.tanh(distance / length)


def failures(state: State) -> Tensor:
    """Environments whose last step failed [B]."""
    report: Any = state.report
    return cpu.tensor([status != "converged" for status in report.status], dtype=torch.bool)


def lengths(vectors: Tensor) -> Tensor:
    """Lengths [...] of vectors [..., n]; the gradient of zero vectors is zero."""
    # Not `torch.sqrt`, which starts all threads even for a few float64 numbers.
    norms: Tensor = torch.linalg.vector_norm(vectors, dim=-1)
    return norms


def _cut(tensor: Tensor, mask: Tensor) -> Tensor:
    return torch.where(mask.reshape(-1, *[1] * (tensor.dim() - 1)), tensor.detach(), tensor)
