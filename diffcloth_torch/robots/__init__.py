"""Robots of the package, or of optional packages: paths for `Robot.load`.

`GRIPPER` is a palm with two fingers that slide towards each other; on a floating or kinematic base
it has eight degrees of freedom. `panda()` finds the Franka Emika Panda in the extra `robots`.
"""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

__all__ = ["GRIPPER", "panda"]

GRIPPER = Path(__file__).with_name("gripper.urdf")
"""Written by scripts/make_gripper.py, which defines its sizes."""

_PANDA = "robots/panda_description/urdf/panda.urdf"


def __dir__() -> list[str]:
    return [*__all__, *(name for name in globals() if name.startswith("__"))]


def panda() -> tuple[Path, Path]:
    """Return the URDF file of the Panda, and the `mesh_root` with which to load it.

    With all joints as near to zero as their limits allow, its fingers touch; this start is open:

    >>> path, root = dc.robots.panda()
    >>> start = {"panda_joint4": -1.5, "panda_joint6": 1.5, "panda_finger_joint1": 0.02}
    >>> robot = dc.Robot.load(path, mesh_root=root, joint_positions=start)

    Raises:
        ImportError: If the extra `robots` is not installed.
    """
    try:
        found = files("example-robot-data") or []
    except PackageNotFoundError:
        found = []
    for file in found:
        if file.as_posix().endswith(f"/{_PANDA}"):
            path = Path(str(file.locate())).resolve()
            return path, path.parents[len(Path(_PANDA).parts) - 1]
    raise ImportError("the Panda needs the extra `robots`: pip install 'diffcloth-torch[robots]'")
