"""Batches of environments for gymnasium, in torch tensors that keep their graph."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import check_choice, check_count, check_shape, float_tensor
from diffcloth_torch.envs.env import EnvState, Task
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.memory import check_memory
from diffcloth_torch.operations import operation
from diffcloth_torch.sim.records.controls import Parameters

__all__ = ["ClothVectorEnv"]

_AUTORESETS = (AutoresetMode.SAME_STEP.value, AutoresetMode.DISABLED.value)
_RENDER_MODES = ("rgb_array",)
_PICTURE = (480, 360)  # width and height [pixels]
_LARGEST_SEED = 2**64 - 1
_FLAGS = ("success", "failed", "blocked", "elapsed")  # entries of "final_info"
_FLOAT = torch.float32  # type of observations and rewards; float64 inside


class ClothVectorEnv(VectorEnv[Any, Any, Any]):
    """A task in several environments that step together; observations and rewards have gradients.

    Observations and rewards are float32 tensors [B, O] and [B]. They keep the graph of actions that
    need a gradient, through as many steps as have been taken since `clear_grad`; where nothing
    needs one there is no graph. `info` has "success", "failed", "blocked" and "elapsed", [B] each,
    and "obs_before_reset", the observation at the end of the step. A task succeeds if it was done
    in the last `Task.holds` steps.

    A prescribed motion that is infeasible is blocked, as by a safety stop: `info["blocked"]`. Its
    reward is `Task.worst`, and the derivative by the action is zero. An episode ends at the horizon
    of the task (`truncated`), or if the simulation fails (`terminated`, with `info["failed"]`): the
    reward is then `Task.worst` for this step and each remaining step, without a gradient.
    With `AutoresetMode.SAME_STEP` a new episode begins in the step that ends one: the step returns
    the observation of the new start, and `info["final_obs"]` is the observation of the end, with
    its graph, if `info["_final_obs"]` is true. With `AutoresetMode.DISABLED`, a new episode is
    started by `reset(options={"reset_mask": ended})`.

    Environment i draws its starts from random numbers that depend only on the seed and on i.

    Attributes:
        task: The task.
        parameters: Parameters of the simulation, for gradients and for variation; None for the
            parameters of the scene.
        env_state: The present state, with its graph.
    """

    metadata: dict[str, Any]
    env_state: EnvState

    def __init__(
        self,
        task: Task,
        num_envs: int = 1,
        *,
        seed: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
    ) -> None:
        """Prepare the environments; `reset` starts them.

        Args:
            task: The task.
            num_envs: B, the number of environments.
            seed: Seed of the first `reset` without a seed.
            autoreset_mode: SAME_STEP or DISABLED.
            render_mode: "rgb_array" for pictures by `render`, by the extra "viewer"; None for none.

        Raises:
            InvalidInput: If an argument is not accepted.
        """
        owner = operation("ClothVectorEnv")
        given: object = task
        if not isinstance(given, Task):
            kind = given.__name__ if isinstance(given, type) else type(given).__name__
            raise TypeError(f"{owner}: `task` must be a Task, got {kind}")
        self.num_envs = check_count(f"{owner}: `num_envs`", num_envs, 1)
        if isinstance(autoreset_mode, AutoresetMode):
            autoreset_mode = autoreset_mode.value
        check_choice(f"{owner}: `autoreset_mode`", autoreset_mode, _AUTORESETS)
        self.render_mode = check_render_mode(owner, render_mode)
        self.metadata = {
            "autoreset_mode": AutoresetMode(autoreset_mode),
            "render_modes": list(_RENDER_MODES),
            "render_fps": round(1 / (task.simulator.dt * task.substeps)),
        }
        self._snapshots: Any = None
        self.task = task
        self.parameters: Parameters | None = None
        with torch.no_grad():
            size = _tried(task)
            each = task.example().state.nbytes
        check_memory(f"{owner}: `num_envs`", self.num_envs, each, "a state")
        self.single_observation_space = Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (task.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._first_seed = None if seed is None else _checked_seed(f"{owner}: `seed`", seed)
        self._generators: list[torch.Generator] | None = None

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: Of all environments, or one for each; None goes on with the numbers drawn so far.
            options: "reset_mask": booleans [B], of the environments that begin anew; the others go
                on.

        Returns:
            Observations [B, O] and information.
        """
        mask = self._reset_mask(options)
        if seed is not None or self._generators is None:
            self._generators = self._seeded(self._first_seed if seed is None else seed)
        if mask is None:
            self.env_state = self._started(range(self.num_envs))
        else:
            self.env_state = self._with_starts(self.env_state, mask)
        return self._observe(self.env_state), self._info(self.env_state)

    def step(self, actions: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Make a transition in all environments.

        Args:
            actions: [B, A], between -1 and 1; others are clipped.

        Returns:
            Observations [B, O], rewards [B], terminated [B], truncated [B] and information.

        Raises:
            InvalidInput: If the actions have another shape or are not finite, or nothing was reset.
            SimulationError: If a reward is not finite.
        """
        self._require_start("step")
        after = self.task.transition(self.env_state, self._actions(actions), self.parameters)
        reward = self.task.outcome(after)
        _check_rewards(self.task, reward, after)
        observation = self._observe(after)
        terminated = self.task.terminal(after)
        truncated = (after.elapsed >= self.task.horizon) & ~terminated
        info = self._info(after)
        info["obs_before_reset"] = observation
        ended = terminated | truncated
        same_step = self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
        if same_step and bool(ended.any()):
            final = {name: info[name] for name in _FLAGS}
            info |= {"final_obs": observation, "_final_obs": ended}
            info |= {"final_info": final, "_final_info": ended}
            after = self._with_starts(after, ended)
            observation = self._observe(after)
        self.env_state = after
        return observation, reward.to(_FLOAT), terminated, truncated, info

    def scripted_actions(self) -> Tensor:
        """Actions of the policy made by hand, for the present state, [B, A]."""
        self._require_start("scripted_actions")
        with torch.no_grad():
            return self.task.scripted(self.env_state).to(_FLOAT)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Pictures [height, width, 3] of the present state of each environment.

        None without a render mode.

        Raises:
            InvalidInput: If nothing was reset, or pyvista is not installed.
        """
        if self.render_mode is None:
            return None
        self._require_start("render")
        state = self.env_state.state.detach()
        if self._snapshots is None:
            # Only pictures need the packages of the viewers.
            from diffcloth_torch.viewers.look import Camera
            from diffcloth_torch.viewers.snapshots import Snapshots

            scene = self.task.simulator.scene
            self._snapshots = Snapshots(scene, state[0], size=_PICTURE, camera=Camera())
        return tuple(self._snapshots.image(state[i]) for i in range(self.num_envs))

    def close_extras(self, **_: Any) -> None:
        """Free the window of pictures."""
        if self._snapshots is not None:
            self._snapshots.close()
            self._snapshots = None

    def clear_grad(self) -> None:
        """Cut the graph of the present state: gradients of later rewards end here."""
        self._require_start("clear_grad")
        self.env_state = self.env_state.detach()

    def initialize_trajectory(self) -> Tensor:
        """Cut the graph, and return the observation [B, O] of the present state."""
        self.clear_grad()
        return self._observe(self.env_state)

    def generator_states(self) -> list[Tensor]:
        """States of the generators of starts, for `resume`."""
        return [generator.get_state() for generator in self._generators or []]

    def resume(self, env_state: EnvState, generator_states: Sequence[Tensor]) -> Tensor:
        """Continue from a saved state and saved generators; return the observation [B, O]."""
        known: object = env_state
        if not isinstance(known, EnvState):
            raise TypeError(f"resume: `env_state` must be an EnvState, got {type(known).__name__}")
        states: Any = generator_states
        if not isinstance(states, Sequence):
            raise TypeError(
                f"resume: `generator_states` must be a list, got {type(states).__name__}"
            )
        for i, state in enumerate(states):
            if not isinstance(state, Tensor) or state.dtype != torch.uint8 or not state.is_cpu:
                raise TypeError(
                    f"resume: `generator_states[{i}]` must be the state of a generator, got "
                    f"{type(state).__name__}"
                )
        for name, given in (("env_state", env_state), ("generator_states", generator_states)):
            if len(given) != self.num_envs:
                raise InvalidInput(
                    f"resume: `{name}` must be of {self.num_envs} environments, got {len(given)}"
                )
        self._generators = [cpu.generator() for _ in generator_states]
        for generator, state in zip(self._generators, generator_states, strict=True):
            generator.set_state(state)
        self.env_state = env_state
        return self._observe(env_state)

    def _require_start(self, owner: str) -> None:
        if self._generators is None:
            raise InvalidInput(f"{owner}: call reset() first")

    def _seeded(self, seed: object) -> list[torch.Generator]:
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        count = self.num_envs
        if isinstance(seed, Sequence) and not isinstance(seed, str):
            if len(seed) != count:
                raise InvalidInput(f"reset: `seed` must have {count} numbers, got {len(seed)}")
            keys = [[_checked_seed(f"reset: `seed[{i}]`", s)] for i, s in enumerate(seed)]
        else:
            first = _checked_seed("reset: `seed`", seed)
            keys = [[first, i] for i in range(count)]
        words = [np.random.SeedSequence(key).generate_state(1, np.uint64)[0] for key in keys]
        return [cpu.generator().manual_seed(int(word >> np.uint64(1))) for word in words]

    def _started(self, environments: Sequence[int]) -> EnvState:
        generators = self._generators or []
        return self.task.start([self.task.sample(generators[i]) for i in environments])

    def _with_starts(self, env: EnvState, mask: Tensor) -> EnvState:
        """New starts where the mask is true."""
        chosen = mask.nonzero()[:, 0].tolist()
        if not chosen:
            return env
        # Only the generators of ended environments draw, so environments stay independent.
        fresh = self._started(chosen)
        rows = cpu.zeros(self.num_envs, dtype=torch.int64)
        rows[chosen] = cpu.arange(len(chosen))
        return EnvState.where(mask, fresh.rows(rows), env)

    def _observe(self, env: EnvState) -> Tensor:
        return self.task.observation(env).to(_FLOAT)

    def _info(self, env: EnvState) -> dict[str, Any]:
        success = self.task.succeeded(env)
        return {
            "success": success,
            "failed": env.failed,
            "blocked": env.blocked,
            "elapsed": env.elapsed,
        }

    def _actions(self, given: Any) -> Tensor:
        actions = float_tensor("step: `actions`", given)
        check_shape("step: `actions`", actions.shape, [(self.num_envs, self.task.action_size)])
        if not bool(torch.isfinite(actions).all()):
            row = int((~torch.isfinite(actions)).any(dim=-1).nonzero()[0])
            raise InvalidInput(
                f"step: `actions` must be finite, those of environment {row} are not"
            )
        return actions

    def _reset_mask(self, options: dict[str, Any] | None) -> Tensor | None:
        given: object = {} if options is None else options
        if not isinstance(given, Mapping):
            raise TypeError(f"reset: `options` must be a dict, got {type(given).__name__}")
        unknown = set(options or {}) - {"reset_mask"}
        if unknown:
            raise InvalidInput(f"reset: `options` must have only reset_mask, got {sorted(unknown)}")
        if not options or options["reset_mask"] is None:
            return None
        try:
            mask = cpu.as_tensor(options["reset_mask"])
        except (TypeError, ValueError, RuntimeError) as error:
            raise TypeError(f"reset: `reset_mask` must be booleans: {error}") from error
        if mask.dtype != torch.bool or mask.shape != (self.num_envs,) or not mask.is_cpu:
            raise InvalidInput(
                f"reset: `reset_mask` must be booleans [{self.num_envs}] on the CPU, "
                f"got {mask.dtype} {list(mask.shape)} on {mask.device}"
            )
        if self._generators is None:
            raise InvalidInput("reset: `reset_mask` needs environments that have begun")
        return mask


def _tried(task: Task) -> int:
    """Test the functions of a task on one start; return the size of its observations."""
    example = task.example()
    features: Any = task.features(example)
    if not isinstance(features, Mapping):
        raise InvalidInput(
            f"{task.name}: `features` must be a mapping of names to tensors, got "
            f"{type(features).__name__}"
        )
    for name, feature in features.items():
        _check(task, f"features[{name!r}]", feature, [1, -1], torch.is_floating_point)
    _check(task, "reward", task.reward(example), [1], torch.is_floating_point)
    for name in ("success", "terminal"):
        _check(task, name, getattr(task, name)(example), [1], lambda t: t.dtype == torch.bool)
    if type(task).scripted is not Task.scripted:
        actions = task.scripted(example)
        _check(task, "scripted", actions, [1, task.action_size], torch.is_floating_point)
    return int(task.observation(example).shape[-1])


def _check(
    task: Task, name: str, value: object, shape: list[int], is_kind: Callable[[Tensor], bool]
) -> None:
    """Require a finite tensor of a shape, of which -1 is any length, and of a kind."""
    words = "booleans" if name in ("success", "terminal") else "finite floats"
    text = str(["B", *shape[1:]]).replace("'", "").replace("-1", "n")
    right = (
        isinstance(value, Tensor)
        and len(value.shape) == len(shape)
        and all(n in (-1, m) for n, m in zip(shape, value.shape, strict=True))
        and is_kind(value)
        and bool(torch.isfinite(value).all())
    )
    if not right:
        got = type(value).__name__
        if isinstance(value, Tensor):
            got = f"{value.dtype} {list(value.shape)} for B = 1"
            got += "" if bool(torch.isfinite(value).all()) else " with NaN or infinity"
        raise InvalidInput(f"{task.name}: `{name}` must give {words} {text}, got {got}")


def _check_rewards(task: Task, reward: Tensor, env: EnvState) -> None:
    """Require rewards of at least `worst`, except at an end that charges remaining steps."""
    right = (reward >= task.worst) & (reward < math.inf)
    if bool(right.all()):
        return
    wrong = ~(right | env.failed | task.terminal(env))
    if bool(wrong.any()):
        row = int(wrong.nonzero()[0])
        raise SimulationError(
            f"{task.name}: the reward of environment {row} is {float(reward[row].detach())}; it "
            f"must be finite, and at least the `worst` of the task, {task.worst}",
            environments=wrong.nonzero()[:, 0].tolist(),
        )


def check_render_mode(owner: str, mode: str | None) -> str | None:
    """Check a render mode."""
    if mode is None:
        return None
    return check_choice(f"{owner}: `render_mode`", mode, _RENDER_MODES)


def register(name: str) -> None:
    """Register a task for `gymnasium.make` and `make_vec` as "diffcloth/NAME-v0"."""
    gymnasium.register(
        f"diffcloth/{name}-v0",
        entry_point="diffcloth_torch.envs:make_single",
        vector_entry_point="diffcloth_torch.envs:make",
        kwargs={"task": name},
    )


def begins_anew(name: str, env: ClothVectorEnv) -> ClothVectorEnv:
    """Require environments that begin anew in the step in which they end."""
    mode = env.metadata["autoreset_mode"]
    if mode is not AutoresetMode.SAME_STEP:
        raise InvalidInput(
            f"{name} must begin anew in the step in which it ends: "
            f'autoreset_mode "SameStep", got {mode.value!r}'
        )
    return env


def _checked_seed(name: str, seed: object) -> int:
    return check_count(name, seed, 0, _LARGEST_SEED)
