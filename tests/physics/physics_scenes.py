"""Meshes, scenes and judges shared by the tests of the laws of physics."""

import itertools

import numpy as np
import pytest
import torch

from diffcloth_torch.autograd.core_function import as_array

F64 = torch.float64
WEIGHTLESS = (0.0, 0.0, 0.0)


def tensor(values):
    return torch.as_tensor(np.asarray(values), dtype=F64)


def strip(cells, rows, length, width, *, alternating=False):
    """Flat strip along x from 0 to `length`, centered in y; vertex [i, j] is i * rows + j.

    All diagonals have one direction, or alternate.
    """
    x, y = np.linspace(0, length, cells + 1), np.linspace(-width / 2, width / 2, rows)
    vertices = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((cells + 1, rows))], axis=-1)
    faces = []
    for i in range(cells):
        for j in range(rows - 1):
            a, b = i * rows + j, (i + 1) * rows + j
            other_way = alternating and (i + j) % 2 == 1
            faces += (
                [[a, b, a + 1], [b, b + 1, a + 1]]
                if other_way
                else [[a, b, b + 1], [a, b + 1, a + 1]]
            )
    return vertices.reshape(-1, 3), np.array(faces)


def jittered_sheet(cells, size, seed=0, share=0.2):
    """Flat square sheet with inner vertices displaced in the plane, in general position."""
    vertices, faces = strip(cells, cells + 1, size, size)
    inside = (np.abs(vertices[:, 0] - size / 2) < 0.499 * size) & (
        np.abs(vertices[:, 1]) < 0.499 * size
    )
    noise = np.random.default_rng(seed).uniform(-share, share, (len(vertices), 2)) * size / cells
    vertices[inside, :2] += noise[inside]
    return vertices, faces


def lumped_masses(vertices, faces, density):
    """A third of the mass of each adjacent face [kg]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    masses = np.zeros(len(vertices))
    for k in range(3):
        np.add.at(masses, faces[:, k], density * area / 3)
    return masses


def settle(sim, state, control=None, *, steps=60, speed=1e-9):
    """Step until nothing moves; a large dt of implicit Euler is a damped search for rest."""
    for _ in range(steps):
        state = sim.step(state, control)
        if state.velocities.abs().max() < speed:
            return state
    raise AssertionError(f"still moving at {state.velocities.abs().max():.3g} m/s")


def rotation(axis, angle):
    """Rotation matrix about an axis by an angle [rad]."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def quaternion(axis, angle):
    axis = np.asarray(axis) / np.linalg.norm(axis)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])


class Judge:
    """The IPC Toolkit's verdict on states and on motions between them."""

    def __init__(self, sim, free_links=(), passing=()):
        """Judge the scene of a simulator.

        `free_links` names the links ("robot/link") that forces move; `passing` pairs of links that
        do not collide. Prescribed surfaces may overlap each other.
        """
        ipctk = pytest.importorskip("ipctk")
        self._ipctk, self._sim = ipctk, sim
        start = sim.initial_state()
        faces, first = [], 0
        for count, item in self._meshes():
            faces.append(item.faces + first)
            first += count
        faces = np.concatenate(faces).astype(np.int32)
        points = self.points(start)
        self.mesh = ipctk.CollisionMesh(points, ipctk.edges(faces), faces)
        self.mesh.can_collide = self._filter(len(start.positions), free_links, passing)

    def _meshes(self):
        """Number of vertices and mesh of each surface."""
        scene = self._sim.scene
        links = [mesh for robot in scene.robots for mesh in robot.surfaces if mesh is not None]
        return [(len(item.vertices), item) for item in [*scene.cloths, *scene.bodies, *links]]

    def _filter(self, cloth_count, free_links, passing):
        """Filter of pairs: no rigid surface with itself, nor two prescribed surfaces."""
        scene = self._sim.scene
        counts = [count for count, _ in self._meshes()][len(scene.cloths) :]
        names = self._sim.surfaces[len(scene.cloths) :]
        rigid = np.repeat(np.arange(len(names)), counts)
        dynamic = {
            name
            for name, body in zip(scene.body_names, scene.bodies, strict=True)
            if body.motion == "dynamic"
        }
        free = [name in dynamic or name in free_links for name in names]
        alone = -1 - np.arange(cloth_count + len(rigid))  # a separate patch for each vertex

        def patches(of_surface):
            """Filter with one patch per value >= 0 of a surface; -1: one patch per vertex."""
            labels = np.concatenate([np.full(cloth_count, -1), np.asarray(of_surface)[rigid]])
            labels = np.where(labels < 0, alone - alone.min(), len(alone) + labels)
            return self._ipctk.make_vertex_patches_filter(labels.astype(np.int32))

        held = len(names)
        allowed = patches([k if is_free else held for k, is_free in enumerate(free)])
        for pair in passing:
            allowed = allowed & patches([0 if name in pair else -1 for name in names])
        return allowed

    def points(self, state):
        """Vertices of cloths, bodies and links of a state."""
        parts = [state.positions.detach().numpy()]
        for body, pose in zip(self._sim.scene.bodies, state.body_poses.numpy(), strict=True):
            parts.append(body.vertices @ matrix(pose[3:]).T + pose[:3])
        if self._sim.scene.robots:
            meshes = [mesh for robot in self._sim.scene.robots for mesh in robot.surfaces]
            frames = self._sim.link_poses(state).values()
            for mesh, frame in zip(meshes, frames, strict=True):
                if mesh is not None:
                    turn = frame[:3, :3].detach().numpy()
                    parts.append(mesh.vertices @ turn.T + frame[:3, 3].detach().numpy())
        return np.concatenate(parts)

    def placed(self, path):
        """Vertices of all meshes on a solver path, which has four points for each smooth body."""
        scene, first = self._sim.scene, sum(len(cloth.vertices) for cloth in self._sim.scene.cloths)
        rigid = [(body.vertices, body.contact_surface) for body in scene.bodies]
        for robot in scene.robots:
            links = zip(robot.surfaces, robot.contact_surfaces, strict=True)
            rigid += [(mesh.vertices, touching) for mesh, touching in links if mesh is not None]
        parts = [path[:, :first]]
        for vertices, (frame, _, radius) in rigid:
            own = path[:, first : first + len(frame)]
            first += len(frame)
            if radius > 0:
                edges = (frame[1:] - frame[0]).T
                shares = np.linalg.solve(edges, (vertices - frame[0]).T)
                own = own[:, :1] + np.einsum("ev,kei->kvi", shares, own[:, 1:] - own[:, :1])
            parts.append(own)
        assert first == path.shape[1]
        return np.concatenate(parts, axis=1)

    def is_free(self, state):
        return not self._ipctk.has_intersections(self.mesh, self.points(state))

    def is_free_path(self, path):
        """Return whether straight motions between a path's configurations are collision-free."""
        return all(itertools.starmap(self._is_free_motion, itertools.pairwise(path)))

    def _is_free_motion(self, a, b, depth=6):
        # Both collision detections are conservative in different cases (Tight Inclusion at tiny
        # gaps, additive CCD in fast motion), and both less so in short motions.
        ipctk = self._ipctk
        if any(
            ipctk.is_step_collision_free(self.mesh, a, b, narrow_phase_ccd=ccd)
            for ccd in (
                ipctk.AdditiveCCD(max_iterations=1_000, conservative_rescaling=0.99),
                ipctk.TightInclusionCCD(max_iterations=1_000),
            )
        ):
            return True
        if depth == 0 or ipctk.has_intersections(self.mesh, b):
            return False
        middle = 0.5 * (a + b)
        return self._is_free_motion(a, middle, depth - 1) and self._is_free_motion(
            middle, b, depth - 1
        )


def free_links(scene):
    """Names of the links that forces move: beyond a joint under force, or on a floating base."""
    names = set()
    for name, robot in zip(scene.robot_names, scene.robots, strict=True):
        m = robot.mechanism
        moves = np.full(m.link_count, m.base == "floating")
        for link in m.order[1:]:
            moves[link] |= moves[m.parent[link]] or (m.dof[link] >= 0 and m.forced[m.dof[link]])
        names |= {f"{name}/{m.link_names[i]}" for i in np.flatnonzero(moves)}
    return names


def joined_links(scene):
    """Pairs of names of links connected by a moving or a fixed joint."""
    return [
        (f"{name}/{a}", f"{name}/{b}")
        for name, robot in zip(scene.robot_names, scene.robots, strict=True)
        for a, b in robot.mechanism.adjacent_links
    ]


def judge_attempt(task, actions):
    """Judge all states and paths of an attempt: errors, and the number of steps with contact."""
    sim = task.simulator
    judge = Judge(sim, free_links(task.scene), joined_links(task.scene))
    state = task.initial_state()
    wrong = [] if judge.is_free(state) else ["the start intersects"]
    touched = 0
    with torch.no_grad():
        controller = task.controller(actions)
        for k in range(task.steps):
            control = controller(k, state)
            path = sim.path(state, control).numpy()
            if not judge.is_free_path(path):
                wrong.append(f"the path of step {k} crosses something")
            state = sim.step(state, control)
            if not judge.is_free(state):
                wrong.append(f"the state after step {k} intersects")
            touched += state.report.contact_count > 0
    return wrong, touched


def matrix(q):
    """Rotation matrix of a quaternion wxyz."""
    w, u = q[0] / np.linalg.norm(q), np.asarray(q[1:]) / np.linalg.norm(q)
    k = np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])
    return np.eye(3) + 2 * w * k + 2 * k @ k


def solver_path(sim, state, control=None):
    """Every accepted iterate of a step, all surfaces [iterates, vertices, 3].

    This is not part of the public interface; the judge needs the path because the guarantee covers
    it.
    """
    inputs, _ = sim._inputs(state, control, None)
    return sim._core.path({name: as_array(value) for name, value in inputs.items()})
