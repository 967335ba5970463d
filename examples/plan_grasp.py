"""Plan a grasp with pytorch-kinematics, carry it out, and improve the plan by its gradient.

    python examples/plan_grasp.py                    (needs the extra `robots`)

A Panda grasps the edge of a cloth on a table. Inverse kinematics find joints that move its hand
there; the Jacobian moves the hand along a straight line. The end of this line is optimized, so that
the middle of the cloth reaches a goal. Gradients flow through the simulation and the plan.
"""

from __future__ import annotations

import pytorch_kinematics as pk
import torch

import diffcloth_torch as dc

F64 = torch.float64
DT, CLOSING, LIFTING = 0.02, 8, 12  # [s], and steps
GRASP = [0.5356, 0.0, 0.6260]  # position of the hand, 0.11 m behind the tips of its fingers [m]
FORWARD = [0.5, 0.5, 0.5, 0.5]  # the fingers point along x, one above the other
GOAL = [0.65, 0.02, 0.65]  # for the middle of the cloth, which starts at [0.68, 0, 0.626]
ROUGHLY = [0.0, -0.3, 0.0, -2.0, 0.0, 3.4, -0.6]  # joints to start the search from [rad]


def load(arm: list[float]) -> dc.Robot:
    """Load the Panda with its arm at some joints and the fingers open."""
    path, root = dc.robots.panda()
    joints = {f"panda_joint{i + 1}": q for i, q in enumerate(arm)}
    modes = dict.fromkeys(joints, "position")
    return dc.Robot.load(
        path,
        mesh_root=root,
        joint_positions=joints | {"panda_finger_joint1": 0.01},
        actuation=modes | {"panda_finger_joint1": "pd"},
        stiffness=400,
        damping=15,
        friction=0.8,
        name="panda",
    )


def reach(serial: pk.SerialChain, position: list[float]) -> list[float]:
    """Joints that bring the hand to a position, pointing forward."""
    pose = {"pos": torch.tensor(position, dtype=F64), "rot": torch.tensor(FORWARD, dtype=F64)}
    goal = pk.Transform3d(**pose, dtype=F64)
    start = torch.tensor([ROUGHLY], dtype=F64)
    search = pk.PseudoInverseIK(
        serial, retry_configs=start, max_iterations=100, pos_tolerance=1e-6, rot_tolerance=1e-6
    )
    found = search.solve(goal)
    assert found.converged_any.all()
    return found.solutions[0, 0].tolist()


def follow(serial: pk.SerialChain, arm: torch.Tensor, way: torch.Tensor) -> list[torch.Tensor]:
    """Joints along a straight path [3] of the hand without rotation; one row for each step."""
    rows = [arm]
    velocity = torch.cat([way / LIFTING, torch.zeros(3, dtype=F64)])
    for _ in range(LIFTING):
        jacobian = serial.jacobian(rows[-1])[0]
        rows.append(rows[-1] + torch.linalg.pinv(jacobian) @ velocity)
    return rows[1:]


serial = pk.SerialChain(load(ROUGHLY).chain, "panda_hand", dtype=F64)
grasp = reach(serial, GRASP)

cloth = dc.Cloth.grid(
    (8, 8),
    0.1,
    pose=[0.68, 0, 0.626, 1, 0, 0, 0],
    material=dc.Material(stretch=200, bending=1e-4, density=0.2, thickness=8e-4, friction=0.8),
)
table = dc.RigidBody.box([0.3, 0.36, 0.62], pose=[0.81, 0, 0.31, 1, 0, 0, 0], friction=0.3)
simulator = dc.Simulator(dc.Scene([cloth], [table], [load(grasp)]), DT)
names = [f"panda/{name}" for name in serial.get_joint_parameter_names()]


def carry_out(variables: dict[str, torch.Tensor]) -> list[dc.State]:
    """Close the fingers, then move the hand along the path."""
    arm = torch.tensor(grasp, dtype=F64)
    plan = [arm] * CLOSING + follow(serial, arm, variables["way"])
    closing = {"panda/panda_finger_joint1": torch.tensor(-20.0, dtype=F64)}
    controls = [
        dc.Control(joint_positions=dict(zip(names, row, strict=True)), joint_efforts=closing)
        for row in plan
    ]
    return simulator.rollout(simulator.initial_state(), controls)


def distance(states: list[dc.State]) -> torch.Tensor:
    """Final distance of the middle of the cloth from the goal [m]."""
    middle = states[-1].positions.mean(dim=0)
    return (middle - torch.tensor(GOAL, dtype=F64)).norm()


if __name__ == "__main__":
    way = torch.tensor([0.0, 0.0, 0.03], dtype=F64, requires_grad=True)
    adam = torch.optim.Adam([way], lr=0.01)
    found = dc.descend(carry_out, distance, {"way": way}, adam, iterations=6)
    for k, loss in enumerate(found.metrics()["losses"]):
        print(f"{k}: {1000 * loss:.1f} mm from the goal")
