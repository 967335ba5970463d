"""The core of an environment: a task as pure functions of its state.

Nothing here knows of gymnasium. All functions take batches, of which the environments do not depend
on each other, and all but drawing a start are differentiable.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import check_count
from diffcloth_torch.envs.actuators import Actuator, Tools
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.operations import operation
from diffcloth_torch.sim.records.controls import Parameters
from diffcloth_torch.sim.records.state import State, where
from diffcloth_torch.sim.simulator import Simulator

__all__ = ["EnvState", "Task", "lengths"]


@dataclass(frozen=True, eq=False)
class EnvState:
    """What a batch of environments is at one time.

    Attributes:
        state: Of the simulation.
        tools: What the actuator keeps: positions of pickers and what they hold.
        drawn: What was drawn for the start, and what follows from it, such as a goal.
        elapsed: Transitions since the start, int64 [B].
        failed: Whether the last transition failed, so that the state is where it ended, [B].
    """

    state: State
    tools: Tools
    drawn: dict[str, Tensor]
    elapsed: Tensor
    failed: Tensor

    def __len__(self) -> int:
        return len(self.elapsed)

    def detach(self) -> EnvState:
        """The same without a graph."""
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
            choose(a.elapsed, b.elapsed),
            choose(a.failed, b.failed),
        )

    def _map(self, change: Callable[[Tensor], Tensor], state: State) -> EnvState:
        return EnvState(
            state,
            {name: change(t) for name, t in self.tools.items()},
            {name: change(t) for name, t in self.drawn.items()},
            self.elapsed,
            self.failed,
        )


class Task(ABC):
    """What is to be done in a scene: where it starts, how tools act, and what counts.

    Attributes:
        name: Its name in `make` and, with "diffcloth/" before and "-v0" behind, in gymnasium.
        simulator: The scene, shared by all environments.
        actuator: What actions move.
        horizon: Transitions after which an episode ends.
        substeps: Time steps of a transition.
    """

    name: ClassVar[str]

    def __init__(
        self, simulator: Simulator, actuator: Actuator, *, horizon: int, substeps: int
    ) -> None:
        if not isinstance(getattr(self, "name", None), str):
            raise InvalidInput(f"{type(self).__name__}: a task must have a `name`")
        if simulator.solver.throw:
            raise InvalidInput(
                f"{operation(self.name)}: `simulator` must have SolverOptions(throw=False): one "
                "environment that fails must not end the others"
            )
        self.simulator, self.actuator = simulator, actuator
        self.horizon = check_count(f"{operation(self.name)}: `horizon`", horizon, 1)
        self.substeps = check_count(f"{operation(self.name)}: `substeps`", substeps, 1)

    @abstractmethod
    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw what differs from start to start, for one environment."""

    @abstractmethod
    def place(self, drawn: dict[str, Tensor]) -> tuple[State, Tools]:
        """The scene and the tools for what was drawn for each environment, [B, ...].

        It may add to `drawn` what rewards need of the start.
        """

    @abstractmethod
    def features(self, env: EnvState) -> Mapping[str, Tensor]:
        """Name -> what is observed [B, n], in the order of the observation."""

    @abstractmethod
    def reward(self, env: EnvState) -> Tensor:
        """Reward [B] of having come to a state."""

    @abstractmethod
    def success(self, env: EnvState) -> Tensor:
        """Whether the task is done [B]."""

    def scripted(self, env: EnvState) -> Tensor:  # a task may have none
        """Actions [B, A] of a policy made by hand, which shows that the task can be done.

        Raises:
            InvalidInput: If the task has none.
        """
        raise InvalidInput(f"{self.name}: it has no scripted policy")

    def terminal(self, env: EnvState) -> Tensor:
        """Whether an episode ends before its horizon [B]: where a step failed."""
        return env.failed

    def initial(self, generator: torch.Generator, n: int) -> EnvState:
        """Starts of n environments, one drawn after the other."""
        return self.start([self.draw(generator) for _ in range(n)])

    def start(self, draws: list[dict[str, Tensor]]) -> EnvState:
        """Starts for what was drawn for each environment."""
        drawn = {name: torch.stack([d[name] for d in draws]) for name in draws[0]}
        with torch.no_grad():
            state, tools = self.place(drawn)
        count = len(draws)
        return EnvState(
            state,
            tools,
            drawn,
            cpu.zeros(count, dtype=torch.int64),
            cpu.zeros(count, dtype=torch.bool),
        )

    def transition(
        self, env: EnvState, actions: Tensor, parameters: Parameters | None = None
    ) -> EnvState:
        """The state after `substeps` time steps.

        What failed stays at the last state that it reached, without a graph.

        Args:
            env: The state before it.
            actions: Between -1 and 1, others are clipped, float64 [B, A].
            parameters: Of the simulation; None takes those of the scene.
        """
        state = env.state
        failed = torch.zeros_like(env.failed)
        controls, tools = self.actuator.act(env.tools, state, actions.clamp(-1, 1), self.substeps)
        for control in controls:
            state = self.simulator.step(state, control, parameters)
            failed = failed | failures(state)
            if bool(failed.any()):
                state = where(failed, state.detach(), state)
        if bool(failed.any()):
            tools = {name: _cut(t, failed) for name, t in tools.items()}
        return EnvState(state, tools, env.drawn, env.elapsed + 1, failed)

    def observation(self, env: EnvState) -> Tensor:
        """What a policy sees, float64 [B, O]: all features, one behind the other."""
        return torch.cat(list(self.features(env).values()), dim=-1)

    @property
    def action_size(self) -> int:
        """A, the length of an action."""
        return self.actuator.size

    @property
    def observation_slices(self) -> dict[str, slice]:
        """Name of a feature -> its place in an observation."""
        sizes = {n: f.shape[-1] for n, f in self.features(self.example()).items()}
        ends = cpu.tensor(list(sizes.values()), dtype=torch.int64).cumsum(0).tolist()
        return {
            n: slice(end - size, end) for (n, size), end in zip(sizes.items(), ends, strict=True)
        }

    def example(self) -> EnvState:
        """A start of one environment, which shows the shapes of everything."""
        return self.initial(cpu.generator().manual_seed(0), 1)


def failures(state: State) -> Tensor:
    """Environments whose last step failed [B]."""
    report: Any = state.report
    return cpu.tensor([status != "converged" for status in report.status], dtype=torch.bool)


def lengths(vectors: Tensor) -> Tensor:
    """Lengths [...] of vectors [..., n]; those that are zero have no gradient."""
    # No square root of torch: for a few numbers of float64 it wakes all threads.
    norms: Tensor = torch.linalg.vector_norm(vectors, dim=-1)
    return norms


def _cut(tensor: Tensor, mask: Tensor) -> Tensor:
    return torch.where(mask.reshape(-1, *[1] * (tensor.dim() - 1)), tensor.detach(), tensor)
