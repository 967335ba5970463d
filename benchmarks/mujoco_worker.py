"""One scene with MuJoCo's flex, forward.

`benchmarks.forward_peers` runs this file as a script in the environment with MuJoCo, and passes a
scene as JSON. The script does not import this package, so the two may be in separate environments.

Settings follow MuJoCo's documentation for cloth (Modeling, Deformables): the integrator `discrete`
with steps of about 2 ms, Newton's method with a tolerance of 1e-6, elasticity of a shell, and
damping of 2 ms, the minimum of the recommended range. `ipc` selects the mode without intersections,
which has no friction.
"""

from __future__ import annotations

import json
import sys
import time
from statistics import median
from typing import Any

import mujoco
import numpy as np

SUBSTEPS = 8  # of a frame: 2.1 ms each
DAMPING = 0.002  # [s]


def numbers(values: Any) -> str:
    return " ".join(f"{value:.9g}" for value in np.ravel(values))


def model(scene: dict[str, Any]) -> mujoco.MjModel:
    """A shell of the same stiffness per length and of the same bending stiffness."""
    thickness = np.sqrt(12 * scene["bending"] / scene["stretch"])
    young = scene["stretch"] / thickness
    friction = f'friction="{scene["friction"]:g} 0 0"'
    body = ""
    if scene["body"] == "plane":
        body = f'<geom type="plane" size="4 4 1" {friction}/>'
    elif scene["body"]:
        center, radius = scene["body"]
        body = f'<geom type="sphere" size="{radius:g}" pos="{numbers(center)}" {friction}/>'
    pins = f'<pin id="{" ".join(map(str, scene["pinned"]))}"/>' if scene["pinned"] else ""
    rest, faces = np.array(scene["rest"]), np.array(scene["faces"])
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco>
      <option timestep="{scene["dt"] / SUBSTEPS:.9g}" gravity="0 0 {-scene["gravity"]:g}"
              integrator="discrete" solver="Newton" tolerance="1e-6">
        <flag ipc="{"enable" if scene["ipc"] else "disable"}"/>
      </option>
      <size memory="1G"/>
      <worldbody>
        {body}
        <flexcomp name="cloth" type="direct" dim="2" mass="{scene["mass"]:.9g}"
                  radius="{scene["radius"]:g}" point="{numbers(rest)}"
                  element="{" ".join(map(str, faces.ravel()))}">
          {pins}
          <contact condim="3" selfcollide="{"auto" if scene["folds"] else "none"}" {friction}/>
          <elasticity young="{young:.9g}" poisson="0" thickness="{thickness:.9g}"
                      elastic2d="both" damping="{DAMPING:g}"/>
        </flexcomp>
      </worldbody>
    </mujoco>""")


def main() -> None:
    scene = json.loads(sys.stdin.read())
    made = model(scene)
    data = mujoco.MjData(made)
    rest, start = np.array(scene["rest"]), np.array(scene["vertices"])
    free = np.setdiff1d(np.arange(len(rest)), scene["pinned"])
    if made.nq != 3 * len(free):
        raise SystemExit(f"expected three slides for each free vertex, got {made.nq} coordinates")

    def run() -> list[np.ndarray]:
        mujoco.mj_resetData(made, data)
        data.qpos[:] = (start - rest)[free].ravel()
        data.qvel[:] = np.array(scene["velocities"])[free].ravel()
        positions = []
        for _ in range(scene["frames"]):
            for _ in range(SUBSTEPS):
                mujoco.mj_step(made, data)
            mujoco.mj_kinematics(made, data)
            mujoco.mj_flex(made, data)
            positions.append(data.flexvert_xpos.copy())
        return positions

    seconds = []
    for _ in range(scene["repeats"] + 1):
        begin = time.process_time()
        positions = run()
        seconds.append(time.process_time() - begin)
    result = {
        "version": mujoco.__version__,
        "substeps": SUBSTEPS,
        "forward": 1e3 * median(seconds[1:]) / scene["frames"],
        "frames": [scene["vertices"], *(x.tolist() for x in positions)],
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
