"""Cloth in intersection-free frictional contact, as one differentiable step in PyTorch.

    import diffcloth_torch as dc

    scene = dc.Scene(cloths=[dc.Cloth.grid(24, 24, pins={"edge": range(24)})])
    sim = dc.Simulator(scene, dt=0.01)
    state = sim.step(sim.initial_state())

Units are SI, z is up, quaternions are (w, x, y, z), and everything is float64 on the CPU.
"""

from collections.abc import Iterable
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if find_spec("diffcloth_torch._core") is None:
    # Python looks into the current folder first: in a clone it finds the sources, and not what
    # `pip install .` has put elsewhere.
    raise ImportError(
        f"{Path(__file__).parent} holds the sources of diffcloth_torch without a core that was "
        "compiled for this Python: start Python in another folder to import an installed package, "
        "or run  pip install -e .  where the sources are"
    )

from diffcloth_torch import robots
from diffcloth_torch._moved import MOVED, find_old_modules
from diffcloth_torch.errors import (
    AddedMassWarning,
    IgnoredLimitsWarning,
    InfeasibleMotion,
    IntersectingState,
    InvalidInput,
    NotConverged,
    SimulationError,
)
from diffcloth_torch.files import as_path
from diffcloth_torch.model.cloth import Cloth
from diffcloth_torch.model.materials import Material
from diffcloth_torch.model.options import ContactOptions, SolverOptions
from diffcloth_torch.model.rigid_body import RigidBody
from diffcloth_torch.model.robot import Robot
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.sim.controls import Control, Parameters
from diffcloth_torch.sim.report import Report
from diffcloth_torch.sim.simulator import Simulator
from diffcloth_torch.sim.state import State, stack, where
from diffcloth_torch.viewers.render import render

if TYPE_CHECKING:
    from diffcloth_torch.tasks.task import LoadedConfig

__all__ = [
    "AddedMassWarning",
    "Cloth",
    "ContactOptions",
    "Control",
    "IgnoredLimitsWarning",
    "InfeasibleMotion",
    "IntersectingState",
    "InvalidInput",
    "Material",
    "NotConverged",
    "Parameters",
    "Report",
    "RigidBody",
    "Robot",
    "Scene",
    "SimulationError",
    "Simulator",
    "SolverOptions",
    "State",
    "build_info",
    "load_config",
    "render",
    "robots",
    "stack",
    "where",
]


def build_info() -> dict[str, Any]:
    """Say what the C++ core was built with: libraries, compiler and options."""
    from diffcloth_torch import _core

    return dict(_core.build_info())


def load_config(path: str | Path, assignments: Iterable[str] = ()) -> "LoadedConfig":
    """Read a configuration of the command line, and build what it describes.

    >>> scene, simulator, task = dc.load_config("configs/drape.yaml", ["simulation.steps=50"])
    >>> controller = task.controller(task.actions())
    >>> states = simulator.rollout(task.initial_state(), controller, steps=task.steps)

    Args:
        path: YAML file.
        assignments: "key=value" each, as after `--set`.

    Returns:
        What is simulated, its simulator, and the task.

    Raises:
        InvalidInput: If the file, a key or a value is not accepted.
        IntersectingState: If surfaces of the scene intersect or touch.
    """
    from diffcloth_torch.tasks.registry import load_task
    from diffcloth_torch.tasks.task import LoadedConfig

    changes: list[Any] = [*assignments]
    if isinstance(assignments, str) or not all(isinstance(change, str) for change in changes):
        raise TypeError(
            f'load_config: `assignments` must be a list of "key=value", got {assignments!r}'
        )
    task = load_task(as_path("load_config: `path`", path), changes)
    return LoadedConfig(task.scene, task.simulator, task)


def __dir__() -> list[str]:
    return [*__all__, *(name for name in globals() if name.startswith("__")), "__version__"]


def __getattr__(name: str) -> Any:
    # The version stands in the package's metadata alone, which is read when it is asked for.
    if name == "__version__":
        return version("diffcloth-torch")
    if f"{__name__}.{name}" in MOVED:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


find_old_modules()
