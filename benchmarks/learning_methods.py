"""Methods of the benchmark of learning: each learns a policy, or none, for a task.

`zero`, `random` and `script` learn nothing; `replay` repeats the actions of one scripted episode.
`imitate` is `dc.learn.imitate` of the script, with the settings of `configs/train_TASK.yaml`.
`transfer` is the policy of `imitate` at another size. `plan` is `dc.learn.plan`.

`apg`, `moves`, `shac` and `sapo` are `dc.learn.Trainer`. `moves` is APG with steps of actions
(`action_step`), with equal options for all tasks. `apg` has the options of `OWN` on three tasks.
`ppo` and `sac` are those of Stable-Baselines3, on the CPU, with their usual options except for the
number of steps between updates and the initial noise. These six begin at the first action of the
task, and return the policy after the last update.

Methods that learn from rewards use soft grasps, which have gradients, in tasks with pickers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.environments import roll_out
from diffcloth_torch import envs
from diffcloth_torch.config.documents import read_document
from diffcloth_torch.learn import Plans, Policy, Trainer, TrainerOptions, imitate, load_policy, plan

UNLEARNED = ("zero", "random", "script", "replay")
FIRST_ORDER, FREE = ("apg", "moves", "shac", "sapo"), ("ppo", "sac")
FROM_REWARDS = (*FREE, *FIRST_ORDER)  # with a budget of environment steps
METHODS = (*UNLEARNED, "imitate", "transfer", *FROM_REWARDS, "plan")

SOFT = {"opens_at": -1.0, "reach": 0.06}  # grasps with gradients
PICKERS = ("FoldCloth", "FoldClothDiagonal", "SpreadCloth", "DropCloth", "FlingCloth")
NUM_ENVS = 4
COMMON: dict[str, Any] = {"betas": (0.9, 0.99), "init_std": 0.05, "target_entropy": -2.0}
APG: dict[str, Any] = {"discount": 1.0, "learning_rate": 4e-3}
# Late actions move a fold little, and one scale of Adam for each tensor changes them little.
FOLD: dict[str, Any] = {
    "learning_rate": 3e-4, "plan_learning_rate": 2e-2, "plan_knots": 12, "scale": "tensor",
}  # fmt: skip
OWN: dict[str, tuple[int, dict[str, Any]]] = {
    "FoldCloth": (2, FOLD),
    "LiftCloth": (2, {}),
    "PushCube": (4, {"learning_rate": 3e-3}),
}
"""Number of environments, and options of `apg`."""
MOVES: dict[str, Any] = {
    "discount": 1.0, "learning_rate": 2e-3, "plan_learning_rate": 1e-2, "plan_knots": 12,
    "action_step": 0.05, "draws": 16, "init_std": 0.02, "hidden": (128, 128),
}  # fmt: skip
NUM_MOVED = 8  # environments of `moves`
WITH_CRITIC: dict[str, Any] = {"discount": 0.99, "learning_rate": 2e-3}
_CONFIGS = Path(__file__).parents[1] / "configs"
_REPLAYED = 20_000  # seed of the episode that is replayed

Acts = Callable[[envs.ClothVectorEnv], Callable[[int], torch.Tensor]]
"""A function of environments that returns the actions [B, A] of each step as a function."""


@dataclass(frozen=True)
class Job:
    """A method with a seed for a task.

    Attributes:
        task: Name of the task.
        size: Vertices along a side.
        method: One of `METHODS`.
        seed: Seed of the method and of the starts of its evaluation.
        budget: Environment steps of a method of `FROM_REWARDS`, otherwise 0.
        trained_at: Size at which the policy of `transfer` was trained.
        changed: `rounds` and `episodes` of `imitate`, `episodes` of `plan`, if not the usual ones.
        policies: Folder of the policies of `imitate`.
    """

    task: str
    size: int
    method: str
    seed: int
    budget: int
    trained_at: int
    changed: Mapping[str, int]
    policies: Path

    @property
    def key(self) -> tuple[str, int, str, int, int]:
        """Values that identify the row of the job."""
        return self.task, self.size, self.method, self.seed, self.budget

    @property
    def options(self) -> dict[str, Any]:
        """Options of the task for this method, except the size."""
        learns = self.method in (*FROM_REWARDS, "plan")
        return SOFT if learns and self.task in PICKERS else {}

    @property
    def make(self) -> Callable[..., envs.ClothVectorEnv]:
        """Function that makes the environments."""
        return partial(envs.make, self.task, size=self.size, **self.options)

    @property
    def policy_file(self) -> Path:
        """File of the policy that is imitated, or transferred."""
        return self.policies / f"{self.task}-{self.trained_at}-{self.seed}.pt"

    @cached_property
    def horizon(self) -> int:
        """Steps of an episode."""
        return self.make(num_envs=1).task.horizon


def learned(job: Job) -> Acts | Plans:
    """Learn with the method of a job; `plan` returns plans for some starts instead of actions."""
    if job.method in UNLEARNED:
        return partial(_unlearned, job)
    if job.method in FIRST_ORDER:
        return _first_order(job)
    if job.method in FREE:
        return _free(job)
    return {"imitate": _imitated, "transfer": _transferred, "plan": _planned}[job.method](job)


def _unlearned(job: Job, env: envs.ClothVectorEnv) -> Callable[[int], torch.Tensor]:
    shape = env.num_envs, env.task.action_size
    noise = torch.Generator().manual_seed(job.seed)
    script: list[torch.Tensor] = []
    if job.method == "replay":
        one = job.make(num_envs=1, autoreset_mode="Disabled")
        script = roll_out(one, lambda _: one.scripted_actions(), _REPLAYED + job.seed)[2]
    return {
        "zero": lambda _: torch.zeros(shape),
        "random": lambda _: 2 * torch.rand(shape, generator=noise) - 1,
        "script": lambda _: env.scripted_actions(),
        "replay": lambda k: script[k].expand(shape),
    }[job.method]


def _imitated(job: Job) -> Acts:
    return _policy_acts(_imitation_of(job))


def _imitation_of(job: Job) -> Policy:
    make = replace(job, size=job.trained_at).make
    policy = imitate(make, "scripted", seed=job.seed, **(stage_of(job.task) | job.changed))
    job.policies.mkdir(parents=True, exist_ok=True)
    policy.save(job.policy_file)
    return policy


def stage_of(task: str) -> dict[str, int]:
    """Rounds, episodes and iterations of the imitation of the script, by the configuration."""
    for path in sorted(_CONFIGS.glob("train_*.yaml")):
        document = read_document(path)
        if document["environment"]["name"] != task:
            continue
        for stage in document.get("stages", []):
            if (stage["kind"], stage.get("teacher")) == ("imitate", "scripted"):
                return {n: v for n, v in stage.items() if n not in ("kind", "teacher")}
    raise ValueError(f"{_CONFIGS} must have a file of {task} with a stage that imitates the script")


def _transferred(job: Job) -> Acts:
    """Read the policy of `imitate`; learn it where there is no file, with the same bits."""
    exists = job.policy_file.exists()
    return _policy_acts(load_policy(job.policy_file) if exists else _imitation_of(job))


def _policy_acts(policy: Policy) -> Acts:
    return lambda env: lambda _: policy(env.initialize_trajectory())


def _planned(job: Job) -> Plans:
    given = {name: value for name, value in job.changed.items() if name != "rounds"}
    return plan(job.make, seed=job.seed, **given)


def _first_order(job: Job) -> Acts:
    found, num_envs = trainer_of(job)
    updates = max(-(-job.budget // (num_envs * found.horizon)) - found.draws, 1)
    options = TrainerOptions(**(vars(found) | {"decay_updates": updates}))
    trainer = Trainer(job.make, options, num_envs=num_envs)
    for _ in range(updates):
        trainer.update()
    return _policy_acts(trainer.policy)


def trainer_of(job: Job) -> tuple[TrainerOptions, int]:
    """Options of a trainer for a job, and its number of environments."""
    env = job.make(num_envs=1)
    common = COMMON | {"first_action": env.task.first_action, "seed": job.seed}
    whole = {"algorithm": "apg", "horizon": env.task.horizon}
    if job.method == "moves":
        return TrainerOptions(**(common | MOVES | whole)), NUM_MOVED
    if job.method != "apg":  # half episodes: a critic estimates the value of the rest
        half = {"algorithm": job.method, "horizon": env.task.horizon // 2}
        return TrainerOptions(**(common | WITH_CRITIC | half)), NUM_ENVS
    num_envs, own = OWN.get(job.task, (NUM_ENVS, {}))
    return TrainerOptions(**(common | APG | own | whole)), num_envs


def _free(job: Job) -> Acts:
    from stable_baselines3 import PPO, SAC

    from diffcloth_torch.envs.stable_baselines import StableBaselinesEnv

    env = job.make(num_envs=NUM_ENVS, seed=job.seed)
    first = np.asarray(env.task.first_action, dtype=np.float32)

    class Begun(StableBaselinesEnv):
        def step_async(self, actions: Any) -> None:
            super().step_async(np.clip(actions + first, -1, 1))

    # With the usual 2048 steps and deviation of 1, PPO changes little in so few steps.
    own: dict[str, Any] = {"n_steps": 64, "policy_kwargs": {"log_std_init": -1.0}}
    if job.method == "sac":
        own = {"learning_starts": 400, "gradient_steps": -1}
    kind: Any = {"ppo": PPO, "sac": SAC}[job.method]
    model = kind("MlpPolicy", Begun(env), seed=job.seed, device="cpu", **own)
    model.learn(job.budget)

    def act(env: envs.ClothVectorEnv) -> torch.Tensor:
        seen = env.initialize_trajectory().numpy()
        actions = model.predict(seen, deterministic=True)[0]
        return torch.from_numpy(np.clip(actions + first, -1, 1))

    return lambda env: lambda _: act(env)
