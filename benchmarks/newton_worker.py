"""One scene with Newton's differentiable cloth (`newton` 1.x on `warp`), on the processor.

`benchmarks.peers` runs this file as a script in the environment with Newton, and passes a scene as
JSON. The script does not import this package, so the two may be in separate environments.

`SolverSemiImplicit` is Newton's only differentiable cloth solver: explicit substeps, forces of
triangles and hinges, and penalties for contact of particles with shapes, in single precision.
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

PENALTY = 100.0  # of contact [N/m]; a sheet of 24 x 24 sinks in by .02 mm
FEWEST_SUBSTEPS, MOST_SUBSTEPS = 16, 512
LONGEST = 1.5  # of the rest length of an edge


@wp.kernel
def add_weighted(
    positions: wp.array[wp.vec3], weights: wp.array[wp.vec3], loss: wp.array[wp.float32]
):
    i = wp.tid()
    wp.atomic_add(loss, 0, wp.dot(positions[i], weights[i]))


class Rollout:
    """All frames of a scene, recorded for backward."""

    def __init__(self, scene: dict[str, Any], substeps: int) -> None:
        self.dt = scene["dt"] / substeps
        self.count = scene["frames"] * substeps
        vertices = np.array(scene["vertices"])
        faces = np.array(scene["faces"])
        builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=(0.0, 0.0, -scene["gravity"]))
        builder.default_particle_radius = 0.0
        builder.add_cloth_mesh(
            pos=wp.vec3(),
            rot=wp.quat_identity(),
            scale=1.0,
            vel=wp.vec3(),
            vertices=[wp.vec3(*v) for v in vertices],
            indices=faces.reshape(-1).tolist(),
            density=scene["density"],
            tri_ke=scene["stretch"],
            tri_ka=scene["stretch"],
            tri_kd=0.0,
            tri_drag=0.0,
            tri_lift=0.0,
            edge_ke=scene["hinge"],
            edge_kd=0.0,
        )
        slip = scene["friction"] * scene["density"] * scene["gravity"] / len(vertices)
        shape = newton.ModelBuilder.ShapeConfig(
            ke=PENALTY,
            kd=scene["contact_damping"],
            kf=slip / scene["slip_velocity"],
            mu=scene["friction"],
        )
        self.touches = scene["body"] is not None
        if scene["body"] == "plane":
            builder.add_ground_plane(cfg=shape)
        elif self.touches:
            center, radius = scene["body"]
            builder.add_shape_sphere(
                -1,
                xform=wp.transform(wp.vec3(*center), wp.quat_identity()),
                radius=radius,
                cfg=shape,
            )
        self.model = builder.finalize(requires_grad=True)
        self.model.soft_contact_ke = shape.ke
        self.model.soft_contact_kd = shape.kd
        self.model.soft_contact_kf = shape.kf
        self.model.soft_contact_mu = shape.mu
        if scene["pinned"]:
            flags = self.model.particle_flags.numpy()
            flags[scene["pinned"]] &= ~int(newton.ParticleFlags.ACTIVE)
            self.model.particle_flags.assign(flags)
        self.solver = newton.solvers.SolverSemiImplicit(self.model)
        self.solver.enable_tri_contact = False
        self.control = self.model.control()
        self.states = [self.model.state() for _ in range(self.count + 1)]
        self.contacts: list[Any] = [None] * self.count
        if self.touches:
            self.pipeline = newton.CollisionPipeline(
                self.model, broad_phase="explicit", soft_contact_gap=0.1, requires_grad=True
            )
            self.contacts = [self.pipeline.contacts() for _ in range(self.count)]
        self.weights = wp.array(np.array(scene["weights"]), dtype=wp.vec3)

    def forward(self, velocities: np.ndarray) -> wp.array:
        """Loss after all frames for these initial velocities."""
        self.states[0].particle_qd.assign(velocities.astype(np.float32))
        for k in range(self.count):
            self.states[k].clear_forces()
            if self.touches:
                self.pipeline.collide(self.states[k], self.contacts[k])
            self.solver.step(
                self.states[k], self.states[k + 1], self.control, self.contacts[k], self.dt
            )
        loss = wp.zeros(1, dtype=wp.float32, requires_grad=True)
        end = self.states[-1].particle_q
        wp.launch(add_weighted, dim=len(end), inputs=[end, self.weights, loss])
        return loss

    def positions(self, frame: int, substeps: int) -> np.ndarray:
        return self.states[frame * substeps].particle_q.numpy()


def stable_substeps(scene: dict[str, Any]) -> int:
    """The fewest substeps, a power of two, that stretch no edge beyond LONGEST."""
    corners = np.array(scene["faces"])
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])

    def lengths(x: np.ndarray) -> np.ndarray:
        return np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=-1)

    rest = lengths(np.array(scene["vertices"]))
    substeps = FEWEST_SUBSTEPS
    while substeps <= MOST_SUBSTEPS:
        rollout = Rollout(scene, substeps)
        rollout.forward(np.array(scene["velocities"]))
        frames = [rollout.positions(k, substeps) for k in range(1, scene["frames"] + 1)]
        if all((lengths(x) < LONGEST * rest).all() for x in frames):  # false for NaN
            return substeps
        substeps *= 2
    raise SystemExit(f"unstable with {MOST_SUBSTEPS} substeps")


def main() -> None:
    wp.config.quiet = True
    wp.init()
    scene = json.loads(sys.stdin.read())
    velocities = np.array(scene["velocities"])
    substeps = stable_substeps(scene)
    rollout = Rollout(scene, substeps)
    forward, backward = [], []
    for _ in range(scene["repeats"] + 1):  # the first one compiles
        tape = wp.Tape()
        start = time.process_time()
        with tape:
            loss = rollout.forward(velocities)
        forward.append(time.process_time() - start)
        start = time.process_time()
        tape.backward(loss)
        backward.append(time.process_time() - start)
        gradient = rollout.states[0].particle_qd.grad.numpy().astype(float)
        tape.zero()
    frames = [rollout.positions(k, substeps).tolist() for k in range(scene["frames"] + 1)]
    differences = []
    for direction in scene["directions"]:
        d = np.array(direction)
        slopes = []
        for step in scene["difference_steps"]:
            ends = [rollout.forward(velocities + sign * step * d).numpy()[0] for sign in (1, -1)]
            slopes.append((float(ends[0]) - float(ends[1])) / (2 * step))
        differences.append(slopes)
    result = {
        "version": newton.__version__,
        "substeps": substeps,
        "forward": 1e3 * median(forward[1:]) / scene["frames"],
        "backward": 1e3 * median(backward[1:]) / scene["frames"],
        "slopes": [float((gradient * np.array(d)).sum()) for d in scene["directions"]],
        "differences": differences,
        "frames": frames,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
