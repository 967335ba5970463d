"""Small sheets in dry frictional contact at their vertices, in known cases of the law."""

from dataclasses import dataclass

import numpy as np
import torch
from differences import directions, mismatch
from scenes import F64, grid, material, tensor_noise

import diffcloth_torch as dc

DT = 0.01
BODIES = {
    "plane": (lambda **k: dc.RigidBody.plane(2.0, **k), 0.0, (1.3, 0.02, 0.03, 0.2)),
    "sphere": (lambda **k: dc.RigidBody.sphere(0.4, **k), 0.4, (1.3, 0.02, 0.03, 0.2)),
    "capsule": (lambda **k: dc.RigidBody.capsule(0.2, 0.3, **k), 0.2, (0.7, 0.7, 0.03, 0.1)),
    "box": (lambda **k: dc.RigidBody.box((0.34, 0.29, 0.4), **k), 0.2, (1.3, 0.02, 0.03, 0.2)),
}
# Friction and velocity of the sheet for which most vertices stick or slip, or some take off.
CASES = {
    "sticking": (1.0, (0.0, 0.0, -0.1)),
    "slipping": (0.2, (1.2, 0.7, -0.1)),
    "taking_off": (0.3, (0.3, 0.1, 0.5)),
}

AIR = ("normal_drag", "tangential_drag", "air_density")


@dataclass(frozen=True)
class Step:
    """One step, and its inputs by name: "state.", "control." and "parameters." fields."""

    sim: dc.Simulator
    state: dc.State
    inputs: dict[str, torch.Tensor]

    def __call__(self, changes=None):
        values = {**self.inputs, **(changes or {})}
        parts = {"state": {}, "control": {}, "parameters": {}}
        for name, tensor in values.items():
            kind, field = name.split(".")
            parts[kind][field] = tensor
        return self.sim.step(
            self.state.replace(**parts["state"]),
            dc.Control(**parts["control"]),
            self.sim.default_parameters().replace(**parts["parameters"]),
        )


def on_body(kind, case, *, moving=True, scheme="projective", tolerance=1e-11, drag=0.0, **options):
    """A step of a sheet with a pin and a soft pin on a body with a rotated frame."""
    make, top, turn = BODIES[kind]
    friction, velocity = CASES[case]
    vertices, faces = grid(6, 6, seed=3)
    body = make(
        motion="kinematic",
        pose=[0.01, -0.02, 0.0, *turn],
        friction=friction,
        thickness=0.02,
        nodal_contact=True,
    )
    cloth = dc.Cloth(
        vertices + np.array([0.0, 0.0, top + 0.0099]),
        faces,
        rest_positions=vertices,
        material=material(faces, drag=drag, friction=friction),
        pins={"corner": [0]},
        soft_pins={"free": [35]},
        pin_stiffness=2.0,
    )
    sim = dc.Simulator(
        dc.Scene([cloth], [body], gravity=(0.4, -0.3, -9.81)),
        DT,
        scheme=scheme,
        contact=dc.ContactOptions(self_contact=False),
        solver=dc.SolverOptions(tolerance=tolerance, **options),
    )
    state = sim.initial_state()
    with torch.no_grad():
        for _ in range(3):
            state = sim.step(state)
    velocities = torch.tensor(velocity, dtype=F64) + 0.05 * tensor_noise((36, 3), 1.0)
    state = state.replace(velocities=velocities)
    poses = state.body_poses.clone()
    if moving:
        poses[0] += torch.tensor([4e-3, -3e-3, 5e-3, 0.02, 0.004, -0.006, 0.01], dtype=F64)
    inputs = {
        "state.positions": state.positions,
        "state.velocities": state.velocities,
        "state.body_poses": state.body_poses,
        "control.body_poses": poses,
        "control.forces": tensor_noise((36, 3), 0.002, 5),
        "control.pins": state.positions[[0]] + 5e-4,
        "control.soft_pins": state.soft_pin_targets + 0.01,
    }
    # Thickness only decides which vertices touch.
    left_out = {"thickness"} if drag else {"thickness", *AIR}
    for name, value in vars(sim.default_parameters()).items():
        if isinstance(value, torch.Tensor) and name not in left_out:
            inputs[f"parameters.{name}"] = value
    return Step(sim, state, inputs)


def stacked(elastic="newton", friction=0.3, tolerance=1e-10):
    """A sheet falls onto another sheet and slides over it; there are no pins or bodies."""
    edge = 0.1
    lower, faces = grid(5, 5, seed=1, jitter=0.05)
    upper = lower + np.array([0.3 * edge, 0.1 * edge, 0.8 * edge])
    cloths = [
        dc.Cloth(v, faces, rest_positions=lower, material=material(faces, k, friction=friction))
        for k, v in enumerate((lower, upper))
    ]
    sim = dc.Simulator(
        dc.Scene(cloths, gravity=(0.0, 0.0, 0.0)),
        DT,
        scheme="projective",
        solver=dc.SolverOptions(tolerance=tolerance, elastic=elastic),
    )
    state = sim.initial_state()
    velocities = 0.1 * tensor_noise((50, 3), 1.0, 4)
    velocities[25:] += torch.tensor([1.0, 0.3, -2.0], dtype=F64)
    state = state.replace(velocities=velocities)
    inputs = {"state.positions": state.positions, "state.velocities": state.velocities}
    for name in ("friction", "stretch", "density", "damping", "rest_positions"):
        inputs[f"parameters.{name}"] = getattr(sim.default_parameters(), name)
    return Step(sim, state, inputs)


def assert_gradients_are_those_of_differences(value, inputs, sizes, generator, most=1e-5):
    """Compare the gradient of a function of named inputs with central differences.

    Args:
        value: Function from a table of changed inputs to a scalar.
        inputs: Name -> tensor.
        sizes: Name -> step of the differences.
        generator: Random generator of the directions.
        most: Largest relative error.
    """
    leaves = {name: tensor.detach().clone().requires_grad_() for name, tensor in inputs.items()}
    gradients = torch.autograd.grad(value(leaves), list(leaves.values()))
    for (name, tensor), gradient in zip(inputs.items(), gradients, strict=True):
        for direction in directions(tensor, generator):

            def along(moved, name=name):
                with torch.no_grad():
                    return value({name: moved}).item()

            error = mismatch(along, tensor, gradient, direction, sizes[name], 1e-6)
            assert error < most, (name, error)


def counts(state):
    """Numbers of vertices that take off, stick and slip."""
    table = state.report.counts
    return table["taking_off"], table["sticking"], table["slipping"]
