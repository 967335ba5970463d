"""Every public function and method, with accepted arguments, on one small scene.

`names()` lists the public surface; `CALLS` has a call for each name.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from short_tasks import SHEET, write_config

import diffcloth_torch as dc
from diffcloth_torch.optimize import residuals

F64 = torch.float64
HOMES = {
    "": dc,
    "envs.": dc.envs,
    "fabrics.": dc.fabrics,
    "learn.": dc.learn,
    "robots.": dc.robots,
    "residuals.": residuals,
}
# Names without a call, and the reason.
WITHOUT_CALL = {
    "learn.Ranks": "needs a group of processes",
    "learn.Ranks.close": "likewise",
    "learn.Ranks.map": "likewise",
    "learn.Ranks.require_same": "likewise",
    "learn.RayActors": "needs a cluster",
    "learn.RayActors.close": "likewise",
    "learn.RayActors.map": "likewise",
    "learn.record": "needs the extra `data`",
    "learn.Policy.export": "needs the extra `onnx`",
    "learn.Processes.close": "ends processes",
    "learn.Processes.map": "starts processes, which share no defaults with this one",
    "learn.Workers": "is a protocol",
    "learn.Workers.map": "likewise",
}


def names() -> list[str]:
    """Functions, classes and their methods, as "Cloth", "Cloth.grid" or "envs.make"."""
    found = []
    for prefix, home in HOMES.items():
        for name in home.__all__:
            value = getattr(home, name)
            if inspect.isclass(value) and not issubclass(value, BaseException):
                found += [prefix + name, *(f"{prefix}{name}.{m}" for m in methods(value))]
            elif inspect.isfunction(value):
                found.append(prefix + name)
    return sorted(found)


def methods(owner: type) -> list[str]:
    """Public methods of a class, and `__getitem__`, that a module of the package defines."""
    found = []
    for name in dir(owner):
        if name.startswith("_") and name != "__getitem__":
            continue
        static = inspect.getattr_static(owner, name)
        function = getattr(static, "__func__", static)
        home = next(base for base in owner.__mro__ if name in vars(base))
        if inspect.isfunction(function) and home.__module__.startswith("diffcloth_torch"):
            found.append(name)
    return found


@dataclass
class Call:
    """A function and its arguments."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()
    keywords: dict[str, Any] = field(default_factory=dict)

    def __call__(self) -> Any:
        return self.function(*self.arguments, **self.keywords)


def call(function: Callable[..., Any], *arguments: Any, **keywords: Any) -> Call:
    return Call(function, arguments, keywords)


def quiet(alias: Callable[[], Any]) -> Callable[[], Any]:
    """An alias without the warning of its name."""

    def result() -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            return alias()

    return result


def f64(values: Any) -> torch.Tensor:
    """A tensor of a caller who names its device and type."""
    return torch.tensor(values, dtype=F64, device="cpu")


class Inline(Executor):
    """An executor of this process."""

    def submit(self, function, /, *arguments, **keywords):
        future: Future[Any] = Future()
        future.set_result(function(*arguments, **keywords))
        return future


class World:
    """Objects for the calls, made on first use and hence under the defaults of the call."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @cached_property
    def cloth(self):
        return dc.Cloth.grid(
            4,
            3,
            (0.3, 0.2),
            name="cloth",
            pins={"edge": range(3)},
            soft_pins={"end": [11]},
            pose=[0, 0, 0.6, 1, 0, 0, 0],
            material=dc.Material(normal_drag=0.5),
        )

    @cached_property
    def of_second_order(self):
        scene = dc.Scene([dc.Cloth.grid(3, 3)])
        self.second = dc.Simulator(scene, 0.01, integrator="second_order")  # kept alive
        return self.second.initial_state()

    @cached_property
    def robot(self):
        return dc.Robot.load(
            dc.robots.GRIPPER,
            name="hand",
            pose=[1, 0, 0.5, 0, 1, 0, 0],
            stiffness=50.0,
            damping=1.0,
        )

    @cached_property
    def scene(self):
        box = dc.RigidBody.box(
            0.1, name="box", motion="dynamic", mass=0.1, pose=[0, 0, 0.3] + 4 * [0.5]
        )
        seam = dc.Attachment(
            ("cloth", [11]), ("box", [0.05, 0.05, 0.05]), stiffness=5.0, name="seam"
        )
        floor = dc.RigidBody.plane(3.0, name="floor")
        return dc.Scene([self.cloth], [box, floor], [self.robot], attachments=[seam])

    @cached_property
    def sim(self):
        return dc.Simulator(self.scene, 0.01)

    @cached_property
    def start(self):
        return self.sim.initial_state()

    @cached_property
    def state(self):
        return self.sim.step(self.start)

    @cached_property
    def batch(self):
        return self.sim.step(self.sim.initial_state(2))

    @cached_property
    def states(self):
        return self.hung.rollout(self.hung.initial_state(), steps=3)

    @cached_property
    def hung(self):
        """A cloth alone, which has an equilibrium."""
        contact = dc.ContactOptions(self_contact=False)
        return dc.Simulator(dc.Scene([self.cloth]), 0.02, contact=contact)

    @cached_property
    def parameters(self):
        return self.sim.default_parameters()

    @cached_property
    def control(self):
        return self.sim.control(forces=np.full((12, 3), 1e-3), wind=[0.1, 0.0, 0.0])

    @cached_property
    def contacts(self):
        return self.sim.contacts(self.state)

    def make_env(self, num_envs=2):
        return dc.envs.make(
            "FoldCloth", num_envs=num_envs, size=5, horizon=3, opens_at=-1, reach=0.1
        )

    @cached_property
    def env(self):
        env = self.make_env()
        env.reset(seed=0)
        return env

    @cached_property
    def single(self):
        env = dc.envs.make_single("FoldCloth", size=5, horizon=3)
        env.reset(seed=0)
        return env

    @cached_property
    def env_state(self):
        return self.env.task.initial(torch.Generator(device="cpu").manual_seed(1), 2)

    @property
    def trainer(self):
        options = dc.learn.TrainerOptions(
            "sapo", horizon=2, hidden=(8,), critic_epochs=1, plan_knots=2
        )
        return dc.learn.Trainer(self.make_env, options, num_envs=2)

    @cached_property
    def plans(self):
        return dc.learn.Plans(
            actions=torch.full((2, 3, 8), 0.1, dtype=F64, device="cpu"),
            returns=torch.ones(2, dtype=F64, device="cpu"),
            success=torch.ones(2, dtype=torch.bool, device="cpu"),
            seeds=torch.arange(2, dtype=torch.int64, device="cpu"),
        )

    @cached_property
    def saved_plans(self):
        path = self.folder / "saved_plans.pt"
        self.plans.save(path)
        return path

    @cached_property
    def observation(self):
        return self.env._observe(self.env.env_state)

    def loss(self, states, _variables=None):
        return states[-1].positions.square().sum()

    def simulate(self, variables):
        gravity = variables["gravity"]
        return self.hung.rollout(
            self.hung.initial_state(), parameters=dc.Parameters(gravity=gravity), steps=2
        )

    @cached_property
    def variables(self):
        return {"gravity": f64([0.0, 0.0, -9.0]).requires_grad_()}

    @property
    def descent(self):
        return call(
            dc.descend,
            self.simulate,
            lambda states: states[-1].positions.square().sum(),
            {"gravity": f64([0.0, 0.0, -9.0]).requires_grad_()},
            partial(torch.optim.Adam, lr=0.1),
            iterations=2,
        )

    @cached_property
    def found(self):
        return self.descent()

    @cached_property
    def residual(self):
        seen = self.states.positions

        def residual(values):
            states = self.hung.rollout(self.hung.initial_state(), parameters=values, steps=3)
            return residuals.markers(states, seen, noise=1e-3)

        return residual

    @property
    def fitting(self):
        free = {
            "stretch": dc.Variable(500.0, scale="log"),
            "gravity": dc.Variable([0.0, 0.0, -9.0]),
        }
        return call(dc.fit, free, self.residual, max_evaluations=3)

    @cached_property
    def fit(self):
        return self.fitting()

    @cached_property
    def mesh(self):
        path = self.folder / "box.obj"
        box = dc.RigidBody.box(0.1)
        corners = [f"v {x} {y} {z}" for x, y, z in box.vertices.tolist()]
        faces = [f"f {a} {b} {c}" for a, b, c in (box.faces + 1).tolist()]
        path.write_text("\n".join(corners + faces) + "\n")
        return path

    @cached_property
    def saved(self):
        path = self.folder / "saved.pt"
        self.states.save(path)
        return path

    @cached_property
    def kept(self):
        """A trainer and its file."""
        trainer, path = self.trainer, self.folder / "kept.pt"
        trainer.update()
        trainer.save(path)
        return trainer, path

    def positions(self, robot):
        return f64([0.01] * len(robot.joint_names))


def fit_loading(w):
    path = w.folder / "kept_fit.pt"
    w.fit.save(path)
    return call(dc.Fit.load, path, w.residual)


def saving(w):
    path = w.folder / "trainer.pt"
    trainer = w.trainer
    trainer.save(path)
    return path


def record(kind, w):
    """Call that remakes a record of the package from its fields."""
    return call(kind, **{f.name: getattr(w, f.name) for f in fields(kind) if f.init})


CALLS: dict[str, Callable[[World], Call]] = {
    "Attachment": lambda w: call(dc.Attachment, ("a", [0, 1]), ("b", [0, 1]), stiffness=2.0),
    "Camera": lambda w: call(dc.Camera, 30.0, 20.0, zoom=1.5),
    "Camera.place": lambda w: call(dc.Camera().place, np.zeros(3), 1.0),
    "Cloth": lambda w: call(dc.Cloth, w.cloth.vertices, w.cloth.faces, name="cloth"),
    "Cloth.grid": lambda w: call(dc.Cloth.grid, (4, 3), (1.0, 2.0), pose=[0, 0, 1, 1, 0, 0, 0]),
    "Cloth.load": lambda w: call(dc.Cloth.load, w.mesh, scale=2.0, pose=[0, 0, 1, 1, 0, 0, 0]),
    "DeformingBody": lambda w: call(dc.DeformingBody, w.cloth.vertices, w.cloth.faces),
    "DeformingBody.load": lambda w: call(dc.DeformingBody.load, w.mesh, scale=2.0),
    "DeformingBody.grid": lambda w: call(dc.DeformingBody.grid, (3, 4), (2.0, 1.0)),
    "DeformingBody.material_axes": lambda w: call(
        dc.DeformingBody(w.cloth.vertices, w.cloth.faces).material_axes, "test"
    ),
    "State.to": lambda w: call(w.state.to, "cpu"),
    "Cloth.material_axes": lambda w: call(w.cloth.material_axes, "test"),
    "ContactOptions": lambda w: call(dc.ContactOptions, 1e-3, 1e4, 2, slip_velocity=1e-3),
    "ContactPoints": lambda w: record(dc.ContactPoints, w.contacts),
    "ContactPoints.of": lambda w: call(
        dc.ContactPoints.of, w.state.report.contacts.rows, w.sim.surfaces, batched=False
    ),
    "ContactPoints.on": lambda w: call(w.contacts.on, "cloth"),
    "Control": lambda w: call(dc.Control, pins=w.start.positions[:3]),
    "Control.replace": lambda w: call(w.control.replace, wind=f64([0.0, 1.0, 0.0])),
    "Descent": lambda w: record(dc.Descent, w.found),
    "Descent.metrics": lambda w: call(w.found.metrics),
    "Descent.record": lambda w: call(w.found.record),
    "Descent.restore": lambda w: call(dc.Descent.restore, w.found.record()),
    "Evaluation": lambda w: record(dc.Evaluation, w.found.best),
    "Evaluation.is_better_than": lambda w: call(w.found.best.is_better_than, w.found.first),
    "Evaluation.record": lambda w: call(w.found.best.record),
    "Fit": lambda w: record(dc.Fit, w.fit),
    "Fit.lines": lambda w: call(w.fit.lines),
    "Fit.load": fit_loading,
    "Fit.save": lambda w: call(w.fit.save, w.folder / "fit.pt"),
    "Fit.mesh_bias": lambda w: call(w.fit.mesh_bias, w.residual, order=2.0),
    "Fit.step_bias": lambda w: call(w.fit.step_bias, w.residual, max_evaluations=1),
    "Fit.information": lambda w: call(w.fit.information, w.residual),
    "Fit.predict": lambda w: call(w.fit.predict, lambda p: p.gravity),
    "Fit.profile": lambda w: call(w.fit.profile, "stretch"),
    "Prior": lambda w: call(dc.Prior, {"stretch": 500.0, "bending": 1e-4}, np.eye(2)),
    "Tie": lambda w: call(dc.Tie, "stretch", 1.2),
    "Fit.report": lambda w: call(w.fit.report, w.folder / "fit.html"),
    "Material": lambda w: call(dc.Material, 100.0, 1e-5, 0.3, density=0.2, stretch_weft=90.0),
    "Material.per_face": lambda w: call(dc.Material().per_face, "stretch"),
    "Parameters": lambda w: call(dc.Parameters, stretch=f64(100.0)),
    "Parameters.replace": lambda w: call(w.parameters.replace, stretch=f64(100.0)),
    "Report": lambda w: record(dc.Report, w.state.report),
    "Report.check_environments": lambda w: call(w.state.report.check_environments, "test", None),
    "Report.select": lambda w: call(w.batch.report.select, 1),
    "Report.stack": lambda w: call(dc.Report.stack, [w.state.report, w.state.report]),
    "Report.where": lambda w: call(dc.Report.where, mask(), w.batch.report, w.batch.report),
    "RigidBody": lambda w: call(dc.RigidBody, np.array(CORNERS), FACES, pose=[0, 0, 1, 1, 0, 0, 0]),
    "RigidBody.box": lambda w: call(dc.RigidBody.box, (0.1, 0.2, 0.3), friction=0.2),
    "RigidBody.capsule": lambda w: call(dc.RigidBody.capsule, 0.1, 0.3),
    "RigidBody.cylinder": lambda w: call(dc.RigidBody.cylinder, 0.1, 0.3, rings=3),
    "RigidBody.load": lambda w: call(dc.RigidBody.load, w.mesh, scale=2.0),
    "RigidBody.plane": lambda w: call(dc.RigidBody.plane, 3.0),
    "RigidBody.sphere": lambda w: call(dc.RigidBody.sphere, 0.1, subdivisions=1),
    "Robot": lambda w: call(
        dc.Robot,
        w.robot.mechanism,
        w.robot.surfaces,
        w.robot.viscosity,
        (w.robot.effort_limits, w.robot.velocity_limits, w.robot.joint_friction),
    ),
    "Robot.chain_positions": lambda w: call(w.robot.chain_positions, w.positions(w.robot)),
    "Robot.forward_kinematics": lambda w: call(
        w.robot.forward_kinematics, w.positions(w.robot), f64([0, 0, 1, 1, 0, 0, 0])
    ),
    "Robot.from_chain": lambda w: call(
        dc.Robot.from_chain, w.robot.chain, surfaces={}, limits=LIMITS, actuation="position"
    ),
    "Robot.load": lambda w: call(dc.Robot.load, dc.robots.GRIPPER, pose=[0, 0, 1, 1, 0, 0, 0]),
    "Scene": lambda w: call(dc.Scene, [w.cloth], [dc.RigidBody.plane(3.0)], gravity=[0, 0, -9]),
    "Simulator": lambda w: call(dc.Simulator, w.scene, 0.01, scheme="coupled"),
    "Simulator.contact_wrenches": lambda w: call(w.sim.contact_wrenches, w.state, w.parameters),
    "Simulator.contacts": lambda w: call(w.sim.contacts, w.state),
    "Simulator.control": lambda w: call(
        w.sim.control,
        pins={"edge": w.start.positions[:3] + 1e-3},
        forces=np.full((12, 3), 0.01),
        joint_positions={"left_finger_joint": 0.01},
        wind=[0.1, 0.0, 0.0],
    ),
    "Simulator.default_parameters": lambda w: call(w.sim.default_parameters),
    "Simulator.energy": lambda w: call(w.sim.energy, w.state, w.control, w.parameters, parts=True),
    "Simulator.equilibrium": lambda w: call(
        w.hung.equilibrium, w.hung.initial_state(), dc.Control(), w.hung.default_parameters()
    ),
    "Simulator.initial_state": lambda w: call(w.sim.initial_state, 2),
    "Simulator.kinetic_energy": lambda w: call(w.sim.kinetic_energy, w.state, w.parameters),
    "Simulator.link_poses": lambda w: call(w.sim.link_poses, w.state),
    "Simulator.link_velocities": lambda w: call(w.sim.link_velocities, w.state, w.parameters),
    "Simulator.momentum": lambda w: call(w.sim.momentum, w.state, w.parameters),
    "Simulator.parameters": lambda w: call(quiet(w.sim.parameters)),
    "Simulator.path": lambda w: call(w.sim.path, w.state, w.control, w.parameters),
    "Simulator.rollout": lambda w: call(
        w.sim.rollout, w.start, [w.control, None], w.parameters, checkpoint_every=1
    ),
    "Simulator.step": lambda w: call(w.sim.step, w.batch, w.control, w.parameters),
    "Simulator.vertex_masses": lambda w: call(w.sim.vertex_masses, w.parameters, batch_size=2),
    "SolverOptions": lambda w: call(dc.SolverOptions, 1e-5, 100),
    "Stage": lambda w: call(dc.Stage, w.loss, ["stretch"]),
    "State": lambda w: call(dc.State, *(getattr(w.start, name) for name in FIRST)),
    "State.__getitem__": lambda w: call(w.batch.__getitem__, [1, 0]),
    "State.clone": lambda w: call(w.state.clone),
    "State.detach": lambda w: call(w.state.detach),
    "State.export": lambda w: call(w.state.export, w.folder / "state.obj", bodies=True),
    "State.meshes": lambda w: call(w.batch.meshes),
    "State.replace": lambda w: call(w.state.replace, time=f64(1.0)),
    "Trajectory.__getitem__": lambda w: call(w.states.__getitem__, slice(1, None)),
    "Trajectory": lambda w: call(dc.Trajectory, list(w.states)),
    "Trajectory.at": lambda w: call(w.states.at, w.states.time),
    "Trajectory.detach": lambda w: call(w.states.detach),
    "Trajectory.load": lambda w: call(dc.Trajectory.load, w.saved),
    "Trajectory.save": lambda w: call(w.states.save, w.folder / "states.pt"),
    "Variable": lambda w: call(dc.Variable, 3.0, (1.0, 5.0), "log"),
    "at_half_step": lambda w: call(dc.at_half_step, w.of_second_order),
    "build_info": lambda w: call(dc.build_info),
    "descend": lambda w: w.descent,
    "fit": lambda w: w.fitting,
    "load_config": lambda w: call(
        dc.load_config, write_config(w.folder, SHEET), ["simulation.steps=3"]
    ),
    "render": lambda w: call(
        dc.render,
        w.scene,
        [w.state],
        w.folder / "picture.png",
        size=(64, 64),
        contact_forces=True,
    ),
    "show": lambda w: call(
        dc.show, w.scene, [w.start, w.state], w.folder / "page.html", color="strain"
    ),
    "stack": lambda w: call(dc.stack, [w.state, w.state]),
    "where": lambda w: call(dc.where, mask(), w.batch, w.state),
    "envs.Actuator": lambda w: call(type(w.env.task.actuator), w.cloth),
    "envs.Actuator.act": lambda w: acting(w, w.env.task.actuator),
    "envs.ClothEnv": lambda w: call(dc.envs.ClothEnv, w.env.task),
    "envs.ClothEnv.close": lambda w: call(w.single.close),
    "envs.ClothEnv.render": lambda w: call(w.single.render),
    "envs.ClothEnv.reset": lambda w: call(w.single.reset, seed=3),
    "envs.ClothEnv.scripted_action": lambda w: call(w.single.scripted_action),
    "envs.ClothEnv.step": lambda w: call(w.single.step, [0.1] * 8),
    "envs.ClothVectorEnv": lambda w: call(dc.envs.ClothVectorEnv, w.env.task, 2, seed=1),
    "envs.ClothVectorEnv.clear_grad": lambda w: call(begun(w).clear_grad),
    "envs.ClothVectorEnv.generator_states": lambda w: call(begun(w).generator_states),
    "envs.ClothVectorEnv.initialize_trajectory": lambda w: call(begun(w).initialize_trajectory),
    "envs.ClothVectorEnv.close_extras": lambda w: call(w.env.close_extras),
    "envs.ClothVectorEnv.render": lambda w: call(begun(w).render),
    "envs.ClothVectorEnv.reset": lambda w: call(
        w.env.reset, seed=3, options={"reset_mask": mask()}
    ),
    "envs.ClothVectorEnv.resume": lambda w: call(
        w.env.resume, w.env_state, begun(w).generator_states()
    ),
    "envs.ClothVectorEnv.scripted_actions": lambda w: call(begun(w).scripted_actions),
    "envs.ClothVectorEnv.step": lambda w: call(begun(w).step, [[0.1] * 8, [-0.1] * 8]),
    "envs.DepthCamera": lambda w: call(
        dc.envs.DepthCamera, [0.0, 0.0, 1.0], [0.0, 0.5, 0.0], width=32
    ),
    "envs.EnvState": lambda w: record(dc.envs.EnvState, w.env_state),
    "envs.EnvState.detach": lambda w: call(w.env_state.detach),
    "envs.EnvState.rows": lambda w: call(w.env_state.rows, torch.tensor([1], device="cpu")),
    "envs.EnvState.where": lambda w: call(dc.envs.EnvState.where, mask(), w.env_state, w.env_state),
    "envs.Pickers": lambda w: call(dc.envs.Pickers, w.cloth, 2, stiffness=40.0),
    "envs.Pickers.act": lambda w: acting(w, w.env.task.actuator),
    "envs.Pickers.start": lambda w: call(w.env.task.actuator.start, f64([[[0.0, 0.0, 0.1]] * 2])),
    "envs.Task": lambda w: call(type(w.env.task), size=5),
    "envs.Task.draw": lambda w: call(w.env.task.draw, torch.Generator("cpu").manual_seed(2)),
    "envs.Task.example": lambda w: call(w.env.task.example),
    "envs.Task.features": lambda w: call(w.env.task.features, w.env_state),
    "envs.Task.frame_of": lambda w: call(
        w.env.task.frame_of, w.env_state.state, dict(w.env_state.drawn)
    ),
    "envs.Task.in_world": lambda w: call(w.env.task.in_world, w.env_state, f64([[0.1] * 8] * 2)),
    "envs.Task.initial": lambda w: call(
        w.env.task.initial, torch.Generator("cpu").manual_seed(2), 2
    ),
    "envs.Task.observation": lambda w: call(w.env.task.observation, w.env_state),
    "envs.Task.outcome": lambda w: call(w.env.task.outcome, w.env_state),
    "envs.Task.place": lambda w: call(w.env.task.place, dict(w.env_state.drawn)),
    "envs.Task.reward": lambda w: call(w.env.task.reward, w.env_state),
    "envs.Task.sample": lambda w: call(w.env.task.sample, torch.Generator("cpu").manual_seed(2)),
    "envs.Task.scripted": lambda w: call(w.env.task.scripted, w.env_state),
    "envs.Task.sensed": lambda w: call(w.env.task.sensed, w.env_state),
    "envs.Task.start": lambda w: call(
        w.env.task.start, [w.env.task.draw(torch.Generator("cpu").manual_seed(2))]
    ),
    "envs.Task.goals": lambda w: call(w.env.task.goals, w.env_state),
    "envs.Task.succeeded": lambda w: call(w.env.task.succeeded, w.env_state),
    "envs.Task.success": lambda w: call(w.env.task.success, w.env_state),
    "envs.Task.terminal": lambda w: call(w.env.task.terminal, w.env_state),
    "envs.Task.transition": lambda w: call(
        w.env.task.transition, w.env_state, f64([[0.1] * 8] * 2)
    ),
    "envs.Velocities": lambda w: call(dc.envs.Velocities, {"edge": [0, 1]}, dt=0.01, speed=0.1),
    "envs.Velocities.act": lambda w: call(
        dc.envs.Velocities({"edge": [0, 1, 2]}, dt=0.01, speed=0.1).act,
        {},
        w.batch,
        f64([[0.1] * 3] * 2),
        2,
    ),
    "envs.make": lambda w: call(dc.envs.make, "FoldCloth", 2, size=5),
    "envs.make_single": lambda w: call(dc.envs.make_single, "FoldCloth", size=5),
    "fabrics.Measurement": lambda w: call(dc.fabrics.Measurement, *MEASURED),
    "fabrics.material": lambda w: call(dc.fabrics.material, next(iter(dc.fabrics.MEASUREMENTS))),
    "learn.Episodes": lambda w: call(
        dc.learn.Episodes, w.observation[:, 0], *[mask()] * 4, steps=6, seeds=(1, 2)
    ),
    "learn.Jobs": lambda w: call(dc.learn.Jobs, Inline()),
    "learn.Jobs.map": lambda w: call(dc.learn.Jobs(Inline()).map, float, ["1", "2"]),
    "learn.Plans": lambda w: call(dc.learn.Plans, **vars(w.plans)),
    "learn.Plans.load": lambda w: call(dc.learn.Plans.load, w.saved_plans),
    "learn.Plans.save": lambda w: call(w.plans.save, w.folder / "plans.pt"),
    "learn.Policy": lambda w: call(seeded, dc.learn.Policy, w.env, dc.learn.TrainerOptions()),
    "learn.Policy.act": lambda w: call(
        w.kept[0].policy.act, w.observation, torch.full_like(w.env.scripted_actions(), 0.1)
    ),
    "learn.Policy.forward": lambda w: call(w.kept[0].policy.forward, w.observation),
    "learn.Policy.save": lambda w: call(w.kept[0].policy.save, w.folder / "policy.pt"),
    "learn.PolicySizes": lambda w: call(dc.learn.PolicySizes, 7, 3, 6),
    "learn.PolicySizes.of": lambda w: call(dc.learn.PolicySizes.of, w.env),
    "learn.Processes": lambda w: call(dc.learn.Processes, 1),
    "learn.Trainer": lambda w: call(dc.learn.Trainer, w.make_env, num_envs=2),
    "learn.Trainer.act": lambda w: call(w.kept[0].act, w.observation),
    "learn.Trainer.check": lambda w: call(w.kept[0].check),
    "learn.Trainer.evaluate": lambda w: call(w.kept[0].evaluate, 2, 1),
    "learn.Trainer.load": lambda w: call(w.kept[0].load, w.kept[1]),
    "learn.Trainer.save": lambda w: call(w.kept[0].save, w.folder / "again.pt"),
    "learn.Trainer.update": lambda w: call(w.trainer.update),
    "learn.TrainerOptions": lambda w: call(dc.learn.TrainerOptions, "apg", 4),
    "learn.TrainerOptions.rate_share": lambda w: call(dc.learn.TrainerOptions().rate_share, 3),
    "learn.evaluate": lambda w: call(dc.learn.evaluate, w.make_env, "scripted", 2, 1),
    "learn.load_policy": lambda w: call(dc.learn.load_policy, w.kept[1]),
    "learn.imitate": lambda w: call(
        dc.learn.imitate, w.make_env, "scripted", 1, 2, 1, iterations=2
    ),
    "learn.plan": lambda w: call(dc.learn.plan, w.make_env, 2, 1, 2, 1, 3),
    "robots.panda": lambda w: call(dc.robots.panda),
    "residuals.extrapolated": lambda w: call(
        residuals.extrapolated, w.residual, w.residual, ratio=2.0
    ),
    "residuals.markers": lambda w: call(
        residuals.markers, w.states, np.zeros((3, 12, 3)), np.ones((3, 12)), noise=0.1
    ),
    "residuals.outline": lambda w: call(
        residuals.outline,
        w.states,
        [RING] * 3,
        w.cloth.faces,
        center=[0.0, 0.0],
        directions=8,
    ),
    "residuals.point_cloud": lambda w: call(
        residuals.point_cloud, w.states, [np.zeros((2, 3))] * 3, noise=0.1
    ),
}
CORNERS = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
FACES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
FIRST = ("positions", "velocities", "body_poses", "soft_pin_targets", "body_forces", "time")
RING = np.array([[0.3, 0.3], [-0.3, 0.3], [-0.3, -0.3], [0.3, -0.3]])
MEASURED = tuple(next(iter(dc.fabrics.MEASUREMENTS.values())))
LIMITS = {"left_finger_joint": (-0.1, 0.1), "right_finger_joint": (-0.1, 0.1)}


def mask():
    return torch.tensor([True, False], device="cpu")


def begun(w):
    env = w.make_env()
    env.reset(seed=0)
    return env


def seeded(function, *arguments):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return function(*arguments)


def acting(w, actuator):
    actions = f64([[0.1] * actuator.size] * 2)
    return call(actuator.act, w.env_state.tools, w.env_state.state, actions, 2)
