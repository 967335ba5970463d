"""One scene with Newton's Vertex Block Descent (`newton` 1.x on `warp`), on the processor, forward.

`benchmarks.forward_peers` runs this file as a script in the environment with Newton, and passes a
scene as JSON. The script does not import this package, so the two may be in separate environments.

Settings follow Newton's cloth examples: ten substeps per frame and ten iterations (`cloth_hanging`,
`cloth_bending`); distances of self-contact, stiffness and damping of contact as in `cloth_twist`,
whose sheet has the same size and weight. A frame is captured once and then launched.
"""

from __future__ import annotations

import json
import sys
import time
from statistics import median
from typing import Any

import newton
import numpy as np
import warp as wp

SUBSTEPS = 10  # even, so that a frame ends in the state buffer in which it began
ITERATIONS = 10
MARGIN, GAP = 0.002, 0.0015  # of self-contact [m]
CONTACT_STIFFNESS, CONTACT_DAMPING = 1e3, 1e-1


class Rollout:
    def __init__(self, scene: dict[str, Any]) -> None:
        self.dt = scene["dt"] / SUBSTEPS
        builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=(0.0, 0.0, -scene["gravity"]))
        builder.add_cloth_mesh(
            pos=wp.vec3(),
            rot=wp.quat_identity(),
            scale=1.0,
            vel=wp.vec3(),
            vertices=[wp.vec3(*v) for v in scene["rest"]],
            indices=np.array(scene["faces"]).reshape(-1).tolist(),
            density=scene["density"],
            # Lame's constants: without contraction across, the modulus along is the stretch.
            tri_ke=scene["stretch"] / 2,
            tri_ka=0.0,
            tri_kd=0.0,
            edge_ke=scene["edge_hinge"],
            edge_kd=0.0,
            particle_radius=scene["radius"],
        )
        shape = newton.ModelBuilder.ShapeConfig(
            ke=CONTACT_STIFFNESS, kd=CONTACT_DAMPING, mu=scene["friction"]
        )
        if scene["body"] == "plane":
            builder.add_ground_plane(cfg=shape)
        elif scene["body"]:
            center, radius = scene["body"]
            place = wp.transform(wp.vec3(*center), wp.quat_identity())
            builder.add_shape_sphere(-1, xform=place, radius=radius, cfg=shape)
        builder.color(include_bending=True)
        self.model = builder.finalize()
        self.model.soft_contact_ke = CONTACT_STIFFNESS
        self.model.soft_contact_kd = CONTACT_DAMPING
        self.model.soft_contact_mu = scene["friction"]
        if scene["pinned"]:
            flags = self.model.particle_flags.numpy()
            flags[scene["pinned"]] &= ~int(newton.ParticleFlags.ACTIVE)
            self.model.particle_flags = wp.array(flags)
        self.solver = newton.solvers.SolverVBD(
            self.model,
            iterations=ITERATIONS,
            particle_enable_self_contact=True,
            particle_self_contact_margin=MARGIN,
            particle_self_contact_gap=GAP,
        )
        self.pipeline = newton.CollisionPipeline(self.model)
        self.contacts = self.pipeline.contacts()
        self.control = self.model.control()
        self.states = [self.model.state(), self.model.state()]
        self.start = [np.array(scene[key], np.float32) for key in ("vertices", "velocities")]
        self.reset()
        with wp.ScopedCapture() as capture:
            self.substeps()
        self.graph = capture.graph

    def reset(self) -> None:
        for state in self.states:
            state.particle_q.assign(self.start[0])
            state.particle_qd.assign(self.start[1])

    def substeps(self) -> None:
        before, after = self.states
        self.solver.rebuild_bvh(before)
        for _ in range(SUBSTEPS):
            before.clear_forces()
            self.pipeline.collide(before, self.contacts)
            self.solver.step(before, after, self.control, self.contacts, self.dt)
            before, after = after, before

    def run(self, frames: int) -> list[np.ndarray]:
        self.reset()
        positions = []
        for _ in range(frames):
            wp.capture_launch(self.graph)
            positions.append(self.states[0].particle_q.numpy())
        return positions


def main() -> None:
    wp.config.quiet = True
    wp.init()
    scene = json.loads(sys.stdin.read())
    rollout = Rollout(scene)
    seconds = []
    for _ in range(scene["repeats"] + 1):  # the first one compiles
        begin = time.process_time()
        positions = rollout.run(scene["frames"])
        seconds.append(time.process_time() - begin)
    result = {
        "version": newton.__version__,
        "substeps": SUBSTEPS,
        "forward": 1e3 * median(seconds[1:]) / scene["frames"],
        "frames": [scene["vertices"], *(x.tolist() for x in positions)],
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
