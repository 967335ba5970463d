"""Environments for learning: tasks with cloth, in batches, with gradients.

>>> import diffcloth_torch as dc
>>> env = dc.envs.make("FoldCloth", num_envs=8, size=12)
>>> observation, info = env.reset(seed=0)
>>> observation, reward, terminated, truncated, info = env.step(actions)

Importing this module also registers the environments in gymnasium:
`gymnasium.make("diffcloth/FoldCloth-v0")` makes one environment with NumPy arrays, and
`gymnasium.make_vec("diffcloth/FoldCloth-v0", num_envs=8)` makes several, with tensors.
"""

from __future__ import annotations

from inspect import signature
from typing import Any

from diffcloth_torch.checks import check_choice
from diffcloth_torch.envs.actuators import Actuator, Pickers, Velocities
from diffcloth_torch.envs.depth_camera import DepthCamera
from diffcloth_torch.envs.drop_cloth import DropCloth
from diffcloth_torch.envs.env import EnvState, Task
from diffcloth_torch.envs.fold_cloth import FoldCloth, FoldClothDiagonal
from diffcloth_torch.envs.hands import GraspCloth, LiftCloth
from diffcloth_torch.envs.hang_cloth import HangCloth
from diffcloth_torch.envs.hit_cloth import HitCloth
from diffcloth_torch.envs.push_cube import PushCube
from diffcloth_torch.envs.spread_cloth import FlingCloth, SpreadCloth
from diffcloth_torch.envs.two_cloths import TwoCloths
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.operations import called

try:
    from diffcloth_torch.envs.gym import ClothVectorEnv, register
    from diffcloth_torch.envs.single import ClothEnv
except ModuleNotFoundError as error:
    if error.name != "gymnasium":
        raise
    raise ImportError(
        "environments need gymnasium: run  pip install 'diffcloth-torch[envs]'"
    ) from error

__all__ = [
    "TASKS",
    "Actuator",
    "ClothEnv",
    "ClothVectorEnv",
    "DepthCamera",
    "EnvState",
    "Pickers",
    "Task",
    "Velocities",
    "make",
    "make_single",
]

TASKS: dict[str, type[Task]] = {
    task.name: task
    for task in (
        FoldCloth,
        FoldClothDiagonal,
        SpreadCloth,
        DropCloth,
        FlingCloth,
        LiftCloth,
        HangCloth,
        PushCube,
        GraspCloth,
        TwoCloths,
        HitCloth,
    )
}
"""Name -> task."""

_OF_BATCH = ("seed", "autoreset_mode", "render_mode")


@called("make")
def make(task: str | Task, num_envs: int = 1, **options: Any) -> ClothVectorEnv:
    """Make environments of a task.

    Args:
        task: Name of one of `TASKS`, or a task of your own.
        num_envs: Number of environments that step together.
        **options: `seed`, `autoreset_mode` and `render_mode` as for `ClothVectorEnv`. The other
            options are passed to a task given by name: `size`, `horizon`, `substeps`,
            `observation`, `camera`, `material`, `contact`, `solver`, `frame`, `randomize`, and
            options of the task.

    Raises:
        InvalidInput: If a name or value is not accepted.
    """
    batch = {name: options.pop(name) for name in _OF_BATCH if name in options}
    return ClothVectorEnv(_task("make", task, options, _OF_BATCH), num_envs, **batch)


@called("make_single")
def make_single(task: str | Task, *, render_mode: str | None = None, **options: Any) -> ClothEnv:
    """Make one environment of a task with NumPy arrays, as `gymnasium.make` does.

    Args:
        task: Name of one of `TASKS`, or a task of your own.
        render_mode: "rgb_array" for pictures by `render`; None for none.
        **options: Options of a task given by name, as for `make`.

    Raises:
        InvalidInput: If a name or value is not accepted.
    """
    return ClothEnv(_task("make_single", task, options), render_mode=render_mode)


def _task(
    owner: str, task: str | Task, options: dict[str, Any], others: tuple[str, ...] = ()
) -> Task:
    """The given task, or the task with the given name and options."""
    if isinstance(task, str):
        check_choice(f"{owner}: `task`", task, tuple(TASKS))
        accepted = _options(TASKS[task])
        for name in options:
            check_choice(f"{owner}: an option of {task}", name, (*accepted, *others))
        return TASKS[task](**options)
    given: Any = task
    if not isinstance(given, Task):
        kind = given.__name__ if isinstance(given, type) else type(given).__name__
        raise TypeError(f"{owner}: `task` must be a name or a Task, got {kind}")
    if options:
        raise InvalidInput(f"{owner}: {', '.join(options)} cannot be given with a task of your own")
    return given


def _options(task: type[Task]) -> list[str]:
    """Names of the options of a task, including options that it passes to its base class."""
    names: list[str] = []
    for kind in task.__mro__:
        parameters = signature(kind).parameters.values()
        names += [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.name not in names]
        if not any(p.kind is p.VAR_KEYWORD for p in parameters):
            break
    return names


for _name in TASKS:
    register(_name)
