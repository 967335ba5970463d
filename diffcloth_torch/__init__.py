"""Cloth in intersection-free frictional contact, as one differentiable step in PyTorch.

    import diffcloth_torch as dc

    scene = dc.Scene(cloths=[dc.Cloth.grid((24, 24), pins={"edge": range(24)})])
    sim = dc.Simulator(scene, dt=0.01)
    state = sim.step(sim.initial_state())

Units are SI, z is up, quaternions are (w, x, y, z), and everything is float64 on the CPU.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if find_spec("diffcloth_torch._core") is None:
    # Python searches the current folder first: in a clone it finds the sources, and not the
    # installed package.
    raise ImportError(
        f"{Path(__file__).parent} holds the sources of diffcloth_torch without a core that was "
        "compiled for this Python: start Python in another folder to import an installed package, "
        "or run  pip install -e .  where the sources are"
    )

from diffcloth_torch.operations import called

if TYPE_CHECKING:
    from diffcloth_torch import envs, fabrics, learn, robots
    from diffcloth_torch.errors import (
        AddedMassWarning,
        BarrierStartWarning,
        CorrelatedResidualsWarning,
        InfeasibleMotion,
        IntersectingState,
        InvalidInput,
        MeshBiasWarning,
        ModelErrorWarning,
        NoiseWarning,
        NotConverged,
        SimulationError,
        StepBiasWarning,
        TurnedTooFar,
        WorkerError,
    )
    from diffcloth_torch.model.attachment import Attachment
    from diffcloth_torch.model.cloth import Cloth
    from diffcloth_torch.model.deforming_body import DeformingBody
    from diffcloth_torch.model.materials import Material
    from diffcloth_torch.model.options import ContactOptions, SolverOptions
    from diffcloth_torch.model.rigid_body import RigidBody
    from diffcloth_torch.model.robot import Robot
    from diffcloth_torch.model.scene import Scene
    from diffcloth_torch.optimize import residuals
    from diffcloth_torch.optimize.descent import Descent, descend
    from diffcloth_torch.optimize.evaluation import Evaluation
    from diffcloth_torch.optimize.fit import Fit, Stage, fit
    from diffcloth_torch.optimize.variables import Prior, Tie, Variable
    from diffcloth_torch.sim.half_step import at_half_step
    from diffcloth_torch.sim.records.contact_points import ContactPoints
    from diffcloth_torch.sim.records.controls import Control, Parameters
    from diffcloth_torch.sim.records.report import Report
    from diffcloth_torch.sim.records.state import State, stack, where
    from diffcloth_torch.sim.records.trajectory import Trajectory
    from diffcloth_torch.sim.simulator import Simulator
    from diffcloth_torch.tasks.task import LoadedConfig
    from diffcloth_torch.viewers.look import Camera
    from diffcloth_torch.viewers.render import render
    from diffcloth_torch.viewers.show import show

__all__ = [
    "AddedMassWarning",
    "Attachment",
    "BarrierStartWarning",
    "Camera",
    "Cloth",
    "ContactOptions",
    "ContactPoints",
    "Control",
    "CorrelatedResidualsWarning",
    "DeformingBody",
    "Descent",
    "Evaluation",
    "Fit",
    "InfeasibleMotion",
    "IntersectingState",
    "InvalidInput",
    "Material",
    "MeshBiasWarning",
    "ModelErrorWarning",
    "NoiseWarning",
    "NotConverged",
    "Parameters",
    "Prior",
    "Report",
    "RigidBody",
    "Robot",
    "Scene",
    "SimulationError",
    "Simulator",
    "SolverOptions",
    "Stage",
    "State",
    "StepBiasWarning",
    "Tie",
    "Trajectory",
    "TurnedTooFar",
    "Variable",
    "WorkerError",
    "at_half_step",
    "build_info",
    "descend",
    "envs",
    "fabrics",
    "fit",
    "learn",
    "load_config",
    "render",
    "residuals",
    "robots",
    "show",
    "stack",
    "where",
]

# `import *` reads all of these names, and must not fail without an extra.
if find_spec("gymnasium") is None:
    __all__.remove("envs")
    __all__.remove("learn")


# Imported on first use: torch takes seconds to import, and `diffcloth --help` should not wait.
_HOMES = {
    "errors": (
        "AddedMassWarning",
        "BarrierStartWarning",
        "CorrelatedResidualsWarning",
        "InfeasibleMotion",
        "IntersectingState",
        "InvalidInput",
        "MeshBiasWarning",
        "ModelErrorWarning",
        "NoiseWarning",
        "NotConverged",
        "SimulationError",
        "StepBiasWarning",
        "TurnedTooFar",
        "WorkerError",
    ),
    "model.attachment": ("Attachment",),
    "model.cloth": ("Cloth",),
    "model.deforming_body": ("DeformingBody",),
    "model.materials": ("Material",),
    "model.options": ("ContactOptions", "SolverOptions"),
    "model.rigid_body": ("RigidBody",),
    "model.robot": ("Robot",),
    "model.scene": ("Scene",),
    "optimize.descent": ("Descent", "descend"),
    "optimize.evaluation": ("Evaluation",),
    "optimize.fit": ("Fit", "Stage", "fit"),
    "optimize.variables": ("Prior", "Tie", "Variable"),
    "sim.half_step": ("at_half_step",),
    "sim.records.contact_points": ("ContactPoints",),
    "sim.records.controls": ("Control", "Parameters"),
    "sim.records.report": ("Report",),
    "sim.simulator": ("Simulator",),
    "sim.records.state": ("State", "stack", "where"),
    "sim.records.trajectory": ("Trajectory",),
    "viewers.look": ("Camera",),
    "viewers.render": ("render",),
    "viewers.show": ("show",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def build_info() -> dict[str, Any]:
    """Describe the build of the C++ core: libraries, compiler and options."""
    from diffcloth_torch import _core

    return dict(_core.build_info())


@called("load_config")
def load_config(
    path: str | Path | Mapping[str, Any], assignments: Iterable[str] = ()
) -> LoadedConfig:
    """Read a configuration of the command line, and build its scene, simulator and task.

    >>> scene, simulator, task = dc.load_config("configs/drape.yaml", ["simulation.steps=50"])
    >>> controller = task.controller(task.actions())
    >>> states = simulator.rollout(task.initial_state(), controller, steps=task.steps)

    Args:
        path: YAML file; or its content as a dict, in which file names are relative to the current
            folder.
        assignments: "key=value" each, as after `--set`.

    Returns:
        The scene, its simulator and the task.

    Raises:
        InvalidInput: If the file, a key or a value is not accepted.
        IntersectingState: If surfaces of the scene intersect or touch.
    """
    from diffcloth_torch.files import as_path
    from diffcloth_torch.tasks.registry import load_document, load_task
    from diffcloth_torch.tasks.task import LoadedConfig

    given: Any = assignments
    changes: list[Any] = [*given] if isinstance(given, Iterable) else [None]
    if isinstance(given, str) or not all(isinstance(change, str) for change in changes):
        raise TypeError(
            f'load_config: `assignments` must be a list of "key=value", got {assignments!r}'
        )
    if isinstance(path, Mapping):
        task = load_document(path, changes)
    else:
        task = load_task(as_path("load_config: `path`", path), changes)
    return LoadedConfig(task.scene, task.simulator, task)


def __dir__() -> list[str]:
    return [*__all__, *(name for name in globals() if name.startswith("__")), "__version__"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        # Only the package's metadata has the version, which is read on first use.
        from importlib.metadata import version

        return version("diffcloth-torch")
    if name in ("envs", "fabrics", "learn", "robots"):
        return import_module(f"diffcloth_torch.{name}")
    if name == "residuals":
        return import_module("diffcloth_torch.optimize.residuals")
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import_module("diffcloth_torch.sim")  # reads saved objects
    value = getattr(import_module(f"diffcloth_torch.{_HOME_OF[name]}"), name)
    globals()[name] = value  # later uses bypass this function
    return value


if "torch" in sys.modules:
    import_module("diffcloth_torch.sim")  # reads saved objects
