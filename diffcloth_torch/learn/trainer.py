"""Policy optimization by gradients through the simulation: APG, SHAC and SAPO.

References:
    SHAC: Xu, Makoviychuk, Narang, Ramos, Matusik, Garg, Macklin, "Accelerated Policy Learning with
    Parallel Differentiable Simulation", ICLR 2022. APG is SHAC without a critic.
    SAPO: Xing, Luk, Oh, "Stabilizing Reinforcement Learning in Differentiable Multiphysics
    Simulation", ICLR 2025: SHAC with entropy and several critics.
"""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checkpoint import (
    check_generator,
    check_like,
    check_optimizer,
    check_structure,
    read_checkpoint,
    refusing_damage,
    write_checkpoint,
)
from diffcloth_torch.checks import check_count, check_shape
from diffcloth_torch.envs.env import EnvState, Task
from diffcloth_torch.envs.gym import begins_anew
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.files import as_path
from diffcloth_torch.learn.action_steps import fit_moved_actions
from diffcloth_torch.learn.adam import TensorAdam
from diffcloth_torch.learn.evaluation import evaluate_starts, follow, noise_of_success
from diffcloth_torch.learn.fine_tuning import Kept, TrustRegion, for_fine_tuning
from diffcloth_torch.learn.options import TrainerOptions
from diffcloth_torch.learn.policy import TRAINER, Policy, begin_at, file_to_write
from diffcloth_torch.learn.rollouts import (
    MakeEnv,
    Piece,
    Rollout,
    roll_out,
    roll_out_remotely,
    threads_of_torch,
)
from diffcloth_torch.learn.starts import episode_seeds, purpose_seed
from diffcloth_torch.learn.workers import Ranks, Workers, check_workers, pickled
from diffcloth_torch.memory import check_memory
from diffcloth_torch.sim.records.state import State

__all__ = ["Trainer", "record_of", "restore"]

_SCALED = 10  # updates after which the scale of observations is fixed, with `action_step`
_DRAWN = 0.2  # standard deviation of the noise of drawn plans, common and of each knot


class Trainer:
    """Trainer of a policy in environments whose rewards have gradients.

    Environments are divided into chunks of a fixed size, and results are summed in the order of the
    chunks: updates have the same bits for any number of workers.

    Attributes:
        policy: The policy and its critics.
        options: Options; with `init`, completed by the bounds of fine-tuning.
        steps: Number of environment steps of rollouts so far.
        updates: Number of updates so far.
        held_out: Seeds of the starts at which the policy is checked; see `TrainerOptions`.
        undone: Number of checks that restored an earlier policy.
    """

    def __init__(
        self,
        make_env: MakeEnv,
        options: TrainerOptions | None = None,
        *,
        num_envs: int = 4,
        chunk: int | None = None,
        workers: Workers | None = None,
        threads: int = 1,
        init: Policy | None = None,
    ) -> None:
        """Create the networks, and begin episodes.

        Args:
            make_env: Function that makes environments with `autoreset_mode="SameStep"`:
                `functools.partial(dc.envs.make, "FoldCloth", size=12)`.
            options: Options of the training; None: the options of `init`, or else the defaults.
            num_envs: Number of environments in a rollout.
            chunk: Number of environments that step together; by default all. It must divide
                `num_envs`.
            workers: Workers that compute the rollouts of chunks; None: this process.
            threads: Number of threads of torch in an update, here and in each worker. The last bits
                of results depend on this number.
            init: Policy at whose weights training begins, with the same observations, actions,
                hidden layers and number of knots. Its algorithm, task, horizon and rates may
                differ. Updates are then bounded and checked by default: see `max_change` and
                `held_out` of `TrainerOptions`.

        Raises:
            InvalidInput: If an argument is not accepted.
        """
        if init is not None and not isinstance(init, Policy):
            raise TypeError(f"Trainer: `init` must be a Policy, got {type(init).__name__}")
        if options is None:
            options = TrainerOptions() if init is None else init.options
        self.options = options
        given: object = self.options
        if not isinstance(given, TrainerOptions):
            raise TypeError(
                f"Trainer: `options` must be TrainerOptions, got {type(given).__name__}"
            )
        if init is not None:
            self.options = for_fine_tuning(options)
        if not callable(make_env):
            raise TypeError(
                f"Trainer: `make_env` must be a function that makes environments, got {make_env!r}"
            )
        self._chunk = num_envs if chunk is None else check_count("Trainer: `chunk`", chunk, 1)
        check_count("Trainer: `num_envs`", num_envs, 1)
        if num_envs % self._chunk:
            raise InvalidInput(f"Trainer: `chunk` must divide {num_envs}, got {chunk}")
        check_workers("Trainer: `workers`", workers)
        self._make_env, self._workers = make_env, workers
        self._threads = check_count("Trainer: `threads`", threads, 1)
        self._pickled = (
            b"" if workers is None else pickled("Trainer: with `workers`, `make_env`", make_env)
        )
        self._env = begins_anew("Trainer: `make_env`", make_env(num_envs=self._chunk))
        self._count = num_envs
        each = self._env.task.example().state.nbytes
        check_memory("Trainer: `num_envs`", num_envs, each, "a state")
        horizon = self.options.horizon
        check_memory("TrainerOptions: `horizon`", horizon, self._chunk * each, "a step")
        o = self.options
        self._noise = cpu.generator().manual_seed(o.seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(o.seed)
            self.policy = Policy(self._env, o)
        if init is not None:
            begin_at("Trainer: `init`", self.policy, init)
        self._places = self._begin_all()
        plan = self.policy.actor.plan
        knots = [] if plan is None else [plan.knots]
        others = [p for p in self.policy.actor.parameters() if all(p is not k for k in knots)]
        groups = [{"params": others, "lr": o.learning_rate}]
        groups += [{"params": knots, "lr": o.plan_learning_rate}] if knots else []
        adam = TensorAdam if o.scale == "tensor" else torch.optim.Adam
        self._actor_steps = adam(groups, betas=o.betas)
        self._critic_steps = torch.optim.Adam(
            self.policy.critics.parameters(), lr=o.critic_learning_rate, betas=o.betas
        )
        self._temperature_steps = torch.optim.Adam(
            [self.policy.log_temperature], lr=o.temperature_learning_rate, betas=o.betas
        )
        self.steps = self.updates = self.undone = 0
        starts = episode_seeds(purpose_seed(o.seed, "undo"), o.held_out or 0)
        self.held_out: tuple[int, ...] = tuple(starts)
        self._kept: Kept | None = None
        self._former: list[Tensor] = []  # observations of the last rollouts [n, O]
        self._return = cpu.zeros(num_envs, dtype=torch.float32)

    @property
    def task(self) -> Task:
        """Task of the environments."""
        return self._env.task

    def act(self, observation: Tensor) -> Tensor:
        """Return actions [B, A] without noise."""
        given: object = observation
        if not isinstance(given, Tensor) or given.dtype != torch.float32 or not given.is_cpu:
            kind = given.dtype if isinstance(given, Tensor) else type(given).__name__
            raise TypeError(
                f"Trainer.act: `observation` must be a float32 tensor on the CPU, got {kind}"
            )
        check_shape("Trainer.act: `observation`", given.shape, [("B", self.policy.observations)])
        with torch.no_grad(), threads_of_torch(self._threads):
            actions: Tensor = self.policy(observation)
        return actions

    def update(self) -> dict[str, float]:
        """Compute a rollout of all environments, and update the policy and the critics.

        Returns:
            Values to log: "loss", "gradient_norm" before clipping, "reward" (mean of the rollout),
            "failed" (share of steps), "entropy" (of the policy, per number of an action),
            "critic_loss", "temperature" and, if episodes ended, their mean "return" and share of
            "success". With `action_step`, "gradient_norm" is the mean norm of the gradients of the
            environments by their actions. With `action_step` or `max_change` also "change", the
            change of actions by the update, and with `max_change` "step_share", the applied share
            of the update; after a check "held_out", the share of successes, and "undone", 1 if an
            earlier policy was restored.

        Raises:
            SimulationError: If a gradient is not finite.
        """
        with threads_of_torch(self._threads):
            return self._update()

    def _update(self) -> dict[str, float]:
        o, share = self.options, self.options.rate_share(self.updates)
        rates = o.learning_rate, o.plan_learning_rate
        for group, rate in zip(self._actor_steps.param_groups, rates, strict=False):
            group["lr"] = share * rate
        self._critic_steps.param_groups[0]["lr"] = share * o.critic_learning_rate
        if o.draws and not self.steps:
            self._draw_plan()
        if self.held_out and self._kept is None:
            self._checked(final=False)
        rollouts = self._rollouts()
        rows = _Rows(rollouts)
        log = {"loss": sum(r.loss for r in rollouts)}
        learns = not self.options.has_critic or self.updates >= self.options.critic_only
        seen = rows.seen.flatten(0, 1)
        scales = o.max_change is None or not float(self.policy.scale.count)
        if o.action_step is not None and scales and self.updates < _SCALED:
            self.policy.scale.see(seen)
        region = None if o.max_change is None else TrustRegion(self.policy, seen, o.max_change)
        if o.action_step is None:
            log["gradient_norm"] = self._step_actor(rollouts, learns)
        else:
            log |= self._move_actions(rollouts, rows.seen, learns, share * o.action_step)
        if region is not None:
            log["change"], log["step_share"] = region.limit()
        log["reward"] = float(rows.rewards.mean())
        log["failed"] = float(rows.failed.float().mean())
        log["entropy"] = float(rows.entropies.mean()) / self.task.action_size
        if self.options.has_critic:
            log["critic_loss"] = self._fit_critics(rows)
        if self.options.has_entropy:
            log["temperature"] = self.policy.temperature
            self._step_temperature(log["entropy"])
        if o.action_step is None and scales:
            self.policy.scale.see(seen)
        self._places = [(r.end, r.generators) for r in rollouts]
        self.steps += rows.rewards.numel()
        self.updates += 1
        log |= self._ended(rows)
        if self.held_out and self.updates % o.check_every == 0:
            log |= self._checked(final=False)
        return log

    def check(self) -> dict[str, float]:
        """Evaluate the policy at the held-out starts; restore the last good policy if it is worse.

        Called after the last update of a fine-tuning, it ensures that the final policy succeeds at
        these starts at least as often as the initial policy. `update` checks after every
        `check_every` updates, and then tolerates a fall of the success by two standard errors,
        which chance may cause.

        Returns:
            "held_out": the share of successes of the checked policy; "undone": 1 if an earlier
            policy with a larger share was restored. Empty without held-out starts.
        """
        return self._checked(final=True)

    def _checked(self, *, final: bool) -> dict[str, float]:
        if not self.held_out:
            return {}
        found = evaluate_starts(
            "Trainer.check", self._make_env, self.policy, self.held_out, workers=self._workers
        )
        success, kept, undone = found.success_rate, self._kept, False
        if kept is None or success >= kept.success:
            weights = Kept.weights_of(self.policy)
            steps = copy.deepcopy(self._actor_steps.state_dict())
            self._kept = Kept(self.updates, success, weights, steps)
        elif final or kept.success - success > noise_of_success(len(found), kept.success):
            kept.restore(self.policy, self._actor_steps)
            self.undone += 1
            undone = True
        return {"held_out": success, "undone": float(undone)}

    def evaluate(self, episodes: int = 8, seed: int = 0) -> tuple[float, float, list[State]]:
        """Evaluate the policy without noise.

        Args:
            episodes: Number of episodes.
            seed: Seed of the starts.

        Returns:
            Mean return, share of successes at the end, and the states of all episodes until the
            first episode ends.
        """
        check_count("Trainer.evaluate: `episodes`", episodes, 1)
        check_count("Trainer.evaluate: `seed`", seed, 0)
        each = self.task.horizon * self.task.example().state.nbytes
        check_memory("Trainer.evaluate: `episodes`", episodes, each, "an episode")
        env = self._make_env(num_envs=episodes)
        total, success, states = follow(env, self.act, seed)
        return float(total.mean()), float(success.float().mean()), states

    def _record(self) -> dict[str, Any]:
        return {
            "options": asdict(self.options),
            "task": self._described,
            "counts": [self.steps, self.updates],
            "undone": self.undone,
            "kept": None if self._kept is None else copy.deepcopy(vars(self._kept)),
            "former": [rows.clone() for rows in self._former],
            "return": self._return.clone(),
            "noise": self._noise.get_state(),
            "policy": {name: t.clone() for name, t in self.policy.state_dict().items()},
            "optimizers": [copy.deepcopy(o.state_dict()) for o in self._optimizers],
            "places": [
                ([getattr(e, field.name) for field in fields(e)], list(generators))
                for e, generators in self._places
            ],
        }

    def _load(self, owner: str, given: Any) -> None:
        """Check a record completely, then restore its state."""
        own = self._record()
        if isinstance(given, Mapping):  # files written before fine-tuning existed lack these
            given = {"undone": 0, "kept": None, "former": []} | dict(given)
        if not isinstance(given, Mapping) or given.keys() != own.keys():
            raise InvalidInput(f"{owner} must have the keys {', '.join(own)}")
        _require_task(owner, given["task"], own["task"])
        # Files of earlier versions lack newer options, which then have their defaults.
        if not isinstance(given["options"], dict) or (
            asdict(TrainerOptions()) | given["options"] != own["options"]
        ):
            raise InvalidInput(f"{owner} was written with other options")
        if given["places"] is None:  # a file of 0.1
            places = self._begin_all()
        else:
            places = self._checked_places(owner, given["places"])
        check_like(f"{owner}['counts']", given["counts"], own["counts"])
        steps, updates = given["counts"]
        rollouts = updates + (self.options.draws if steps else 0)
        if steps != rollouts * self.options.horizon * self._count:
            raise InvalidInput(
                f"{owner}['counts'] must be {self.options.horizon * self._count} steps for each "
                f"update and each draw, got {steps} steps and {updates} updates"
            )
        self._check_former(f"{owner}['former']", given["former"], updates)
        check_like(f"{owner}['return']", given["return"], own["return"])
        check_generator(f"{owner}['noise']", given["noise"])
        check_like(f"{owner}['policy']", dict(given["policy"]), own["policy"])
        check_like(f"{owner}['optimizers']", [None] * len(given["optimizers"]), [None] * 3)
        for k, optimizer in enumerate(self._optimizers):
            check_optimizer(f"{owner}['optimizers'][{k}]", given["optimizers"][k], optimizer)
        check_like(f"{owner}['undone']", given["undone"], 0)
        last_good: Kept | None = None
        if given["kept"] is not None:
            name = f"{owner}['kept']"
            if not self.held_out:
                raise InvalidInput(f"{name} must be None without held-out starts")
            last_good = Kept.checked(name, given["kept"], self.policy, self._actor_steps, updates)
        # All checks are done: the assignments below must not fail.
        self.policy.load_state_dict(given["policy"])
        for optimizer, kept in zip(self._optimizers, given["optimizers"], strict=True):
            optimizer.load_state_dict(kept)
        self.steps, self.updates = steps, updates
        self.undone, self._kept = given["undone"], copy.deepcopy(last_good)
        self._former = [rows.clone() for rows in given["former"]]
        self._return = given["return"].clone()
        self._noise.set_state(given["noise"])
        self._places = places

    def _check_former(self, owner: str, given: Any, updates: int) -> None:
        """Require the observations of the last rollouts."""
        o = self.options
        count = 0 if o.action_step is None else min(updates, o.retained_rollouts)
        like = cpu.zeros(o.horizon * self._count, self.policy.observations, dtype=torch.float32)
        check_like(owner, given, [like] * count)

    def _checked_places(self, owner: str, given: Any) -> list[tuple[EnvState, list[Tensor]]]:
        sizes = [len(generators) for _, generators in given]
        if sizes != [self._chunk] * len(self._places):
            raise InvalidInput(
                f"{owner} has chunks of {sizes} environments, "
                f"not {len(self._places)} of {self._chunk}"
            )
        places = []
        for k, (parts, generators) in enumerate(given):
            name = f"{owner}['places'][{k}]"
            place = EnvState(*parts)
            example, _ = self._places[k]
            for part in ("tools", "drawn"):
                check_structure(f"{name}: {part}", getattr(place, part), getattr(example, part))
            for part in ("elapsed", "failed", "blocked", "held"):
                check_like(f"{name}: {part}", getattr(place, part), getattr(example, part))
            if bool(((place.elapsed < 0) | (place.elapsed >= self.task.horizon)).any()):
                raise InvalidInput(f"{name}: elapsed must be below {self.task.horizon}")
            self.task.simulator.kinetic_energy(place.state)  # checks the state
            # Same call as in an update: fails if the number of environments in the report differs.
            everywhere = cpu.ones(self._chunk, dtype=torch.bool)
            EnvState.where(everywhere, place, example)
            for i, generator in enumerate(generators):
                check_generator(f"{name}: generator {i}", generator)
            places.append((place, list(generators)))
        return places

    def save(self, path: str | Path) -> None:
        """Write the state to a file, which replaces an older one completely or not at all.

        `torch.load` also reads the file with `weights_only=True`.

        Raises:
            InvalidInput: If the folder of the file does not exist.
            OSError: If the file cannot be written; an older one remains unchanged.
        """
        write_checkpoint(file_to_write("Trainer.save", path), TRAINER, self._record())

    def load(self, path: str | Path) -> None:
        """Continue from a file of `save`, with the same bits as without the interruption.

        Files of 0.1 have no states of environments: all episodes begin anew.

        Raises:
            InvalidInput: If `path` is no such file or is damaged, or if its task, options or chunks
                differ. The trainer then remains unchanged.
        """
        path = as_path("Trainer.load: `path`", path)
        if not path.is_file():
            raise InvalidInput(f"Trainer.load: `path` must be a file, got {str(path)!r}")
        kept = read_checkpoint("Trainer.load", path, TRAINER)
        with refusing_damage("Trainer.load", path):
            self._load("the trainer", kept)

    @property
    def _described(self) -> dict[str, Any]:
        """Description of the task, which must match on loading."""
        task = self.task
        sizes = {n: [s.start, s.stop] for n, s in task.observation_slices.items()}
        return {
            "name": task.name,
            "actions": task.action_size,
            "observations": sizes,
            "frame": task.frame if "frame_axes" in task.example().drawn else "world",
            "horizon": task.horizon,
            "substeps": task.substeps,
            "vertices": len(task.simulator.initial_state().positions),
        }

    @property
    def _optimizers(self) -> tuple[torch.optim.Optimizer, ...]:
        return self._actor_steps, self._critic_steps, self._temperature_steps

    @property
    def _chunks(self) -> range:
        return range(0, self._count, self._chunk)

    def _begin_all(self) -> list[tuple[EnvState, list[Tensor]]]:
        return [self._begin(range(k, k + self._chunk)) for k in self._chunks]

    def _begin(self, numbers: Sequence[int]) -> tuple[EnvState, list[Tensor]]:
        """Begin episodes of the environments of given numbers, each with its own seed."""
        words = [np.random.SeedSequence([self.options.seed, i]).generate_state(1) for i in numbers]
        self._env.reset(seed=[int(word[0]) for word in words])
        return self._env.env_state, self._env.generator_states()

    def _rollouts(self, learns: bool = True) -> list[Rollout]:
        """Compute rollouts of all chunks; without `learns`, also without noise and gradients."""
        pieces = self._pieces(learns)
        if self._workers is None:
            return [roll_out(self._env, piece) for piece in pieces]
        if isinstance(self._workers, Ranks):
            self._workers.require_same("options and weights", self._digest())
        return list(self._workers.map(roll_out_remotely, [(self._pickled, p) for p in pieces]))

    def _digest(self) -> bytes:
        """Compute a digest of all inputs of an update except the environments."""
        digest = hashlib.blake2b(repr((self.options, self._count, self._chunk)).encode())
        for tensor in self.policy.state_dict().values():
            digest.update(tensor.contiguous().numpy().tobytes())
        return digest.digest()

    def _pieces(self, learns: bool) -> list[Piece]:
        o = self.options
        sizes = (o.horizon, self._count, self.task.action_size)
        noise = (
            cpu.randn(*sizes, generator=self._noise, dtype=torch.float32)
            if learns
            else cpu.zeros(*sizes, dtype=torch.float32)
        )
        # Copies: the weights of pieces must not change with an update.
        weights = {name: t.clone() for name, t in self.policy.state_dict().items()}
        return [
            Piece(
                o,
                weights,
                start,
                generators,
                noise[:, k : k + self._chunk],
                1.0 / self._count,
                self._threads,
                learns,
            )
            for k, (start, generators) in zip(self._chunks, self._places, strict=True)
        ]

    def _step_actor(self, rollouts: Sequence[Rollout], learns: bool) -> float:
        for k, parameter in enumerate(self.policy.actor.parameters()):
            # Summed in the order of the chunks, for the same bits.
            gradient = torch.zeros_like(parameter)
            for rollout in rollouts:
                gradient += rollout.gradients[k]
            parameter.grad = gradient
        parameters = list(self.policy.actor.parameters())
        norm = torch.nn.utils.clip_grad_norm_(parameters, self.options.max_grad_norm)
        self._require_finite(norm)
        if learns:
            with cpu.DEVICE:  # device of the step counts of Adam
                self._actor_steps.step()
        return float(norm)

    def _require_finite(self, norm: Tensor) -> None:
        if not bool(torch.isfinite(norm)):
            raise SimulationError(
                f"Trainer.update: the gradient of update {self.updates} is not finite; a square "
                "root or a norm in a reward has no derivative at 0"
            )

    def _move_actions(
        self, rollouts: Sequence[Rollout], seen: Tensor, learns: bool, step: float
    ) -> dict[str, float]:
        """Move the actions of all environments, and fit the policy to the moved actions."""
        slopes = torch.cat([r.slopes for r in rollouts if r.slopes is not None], dim=1)
        norms = torch.linalg.vector_norm(slopes, dim=(0, 2))
        self._require_finite(norms.sum())
        log = {"gradient_norm": float(norms.mean()), "change": 0.0}
        if learns:
            log["change"] = fit_moved_actions(
                self.policy,
                seen,
                slopes,
                self._former,
                step,
                self.options.max_move,
                self.options.fit_iterations,
                self._actor_steps,
                self._noise,
            )
        self._former = [*self._former, seen.flatten(0, 1)][-self.options.retained_rollouts :]
        return log

    def _draw_plan(self) -> None:
        """Begin at the best of some plans near the first action, by their mean rewards."""
        assert self.policy.actor.plan is not None
        knots = self.policy.actor.plan.knots
        first = chosen = knots.detach().clone()
        best, steps = -math.inf, 0
        try:
            for k in range(self.options.draws):
                each, common = (
                    cpu.randn(*sizes, generator=self._noise, dtype=torch.float32)
                    for sizes in (knots.shape, (1, knots.shape[1]))
                )
                drawn = first + _DRAWN * (each + common) if k else first
                with torch.no_grad():
                    knots.copy_(drawn)
                rewards = _Rows(self._rollouts(learns=False)).rewards
                steps += rewards.numel()
                if float(rewards.mean()) > best:
                    best, chosen = float(rewards.mean()), drawn
        except BaseException:
            chosen, steps = first, 0
            raise
        finally:
            with torch.no_grad():
                knots.copy_(chosen)
            self.steps += steps

    def _fit_critics(self, rows: _Rows) -> float:
        o, policy = self.options, self.policy
        with torch.no_grad():
            # Minimum over critics: the policy would exploit states that one critic overestimates.
            values = policy.targets(policy.scale(rows.after)).amin(dim=0)
            rewards = rows.rewards + policy.temperature * rows.entropies
            goals = _lambda_returns(rows, rewards, values, o.discount, o.gae_lambda).flatten()
            seen = policy.scale(rows.seen).flatten(0, 1)
        losses = []
        for _ in range(o.critic_epochs):
            order = cpu.randperm(len(goals), generator=self._noise)
            for chosen in order.chunk(o.critic_batches):
                self._critic_steps.zero_grad()
                errors = (policy.critics(seen[chosen]) - goals[chosen]).square().mean(dim=-1)
                errors.sum().backward()
                with cpu.DEVICE:
                    self._critic_steps.step()
                losses.append(float(errors.detach().mean()))
        with torch.no_grad():
            pairs = zip(policy.targets.parameters(), policy.critics.parameters(), strict=True)
            for slow, fast in pairs:
                slow.lerp_(fast, o.tau)
        return sum(losses) / len(losses)

    def _step_temperature(self, entropy: float) -> None:
        """Raise the temperature if the entropy is below its target, otherwise lower it."""
        too_much = entropy - self.options.target_entropy
        self.policy.log_temperature.grad = cpu.tensor(
            too_much * self.policy.temperature, dtype=torch.float32
        )
        with cpu.DEVICE:
            self._temperature_steps.step()

    def _ended(self, rows: _Rows) -> dict[str, float]:
        """Compute mean return and share of successes of ended episodes; empty if there are none."""
        returns, successes = [], []
        for rewards, ended, success in zip(rows.rewards, rows.ended, rows.success, strict=True):
            self._return += rewards
            returns += self._return[ended].tolist()
            successes += success[ended].tolist()
            self._return[ended] = 0.0
        if not returns:
            return {}
        return {
            "return": sum(returns) / len(returns),
            "success": sum(successes) / len(successes),
        }


def record_of(trainer: Trainer) -> dict[str, Any]:
    """Return the state of a training, in types that `torch.load` reads."""
    return trainer._record()


def restore(trainer: Trainer, record: Any) -> None:
    """Continue from the record of another trainer, with the same bits.

    Raises:
        InvalidInput: If the record is of another training, or differs in structure from a record of
            `record_of`. The trainer then remains unchanged.
    """
    trainer._load("the trainer", record)


def _require_task(owner: str, given: Mapping[str, Any], own: Mapping[str, Any]) -> None:
    """Require the description of a task whose policy can be trained further."""
    if given == own:
        return
    if not {"name", "frame", "observations"} <= given.keys() or given["name"] != own["name"]:
        raise InvalidInput(f"{owner} is of {given}, not of {own}")
    if given["observations"] != own["observations"]:
        raise InvalidInput(
            f"{owner} has learned from other observations of {own['name']}: "
            f"{given['observations']}, which are {own['observations']} now; it must learn anew"
        )
    if given["frame"] != own["frame"]:
        raise InvalidInput(
            f"{owner} has learned from observations of {own['name']} in the axes of the "
            f"{given['frame']}: make the task with frame={given['frame']!r}"
        )
    raise InvalidInput(f"{owner} is of {given}, not of {own}")


class _Rows:
    """Rollouts of all chunks, concatenated over environments: [h, B, ...]."""

    def __init__(self, rollouts: Sequence[Rollout]) -> None:
        def all_of(name: str) -> Tensor:
            return torch.cat([getattr(r, name) for r in rollouts], dim=1)

        self.seen, self.after = all_of("seen"), all_of("after")
        self.rewards, self.entropies = all_of("rewards"), all_of("entropies")
        self.terminated, self.ended = all_of("terminated"), all_of("ended")
        self.failed, self.success = all_of("failed"), all_of("success")


def _lambda_returns(
    rows: _Rows, rewards: Tensor, values: Tensor, discount: float, trace: float
) -> Tensor:
    """Compute lambda returns [h, B], which average returns over all lengths of look-ahead.

    Args:
        rows: Rollouts, for the ends and terminations of episodes.
        rewards: Rewards of each step [h, B].
        values: Values of the states after each step [h, B].
        discount: Gamma.
        trace: Lambda.
    """
    from torchrl.objectives.value.functional import td_lambda_return_estimate

    # Rollouts end at the last step: its return is bootstrapped.
    ended = rows.ended.clone()
    ended[-1] = True
    result: Tensor = td_lambda_return_estimate(
        discount,
        trace,
        values[..., None],
        rewards[..., None],
        ended[..., None],
        rows.terminated[..., None],
        time_dim=0,
    )
    return result[..., 0]
