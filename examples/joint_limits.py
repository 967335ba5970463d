"""An arm lifts a sheet, if its motor can: limits of its effort and speed, and its friction.

    python examples/joint_limits.py

Four motors of one arm are a batch of four environments: strong, slow, stiff with friction, and too
weak. The weak arm rests at the angle at which its effort limit balances the weight, and has a
gradient by this limit.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch

import diffcloth_torch as dc

F64 = torch.float64
STEPS = 150  # time steps of 10 ms

ARM = """
<robot name="arm">
  <link name="stand"/>
  <link name="boom">
    <inertial><origin xyz="0.15 0 0"/><mass value="0.4"/>
      <inertia ixx="1e-4" iyy="3e-3" izz="3e-3" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.15 0 0"/><geometry><box size="0.3 0.03 0.03"/></geometry></collision>
  </link>
  <joint name="lift" type="revolute"><parent link="stand"/><child link="boom"/>
    <axis xyz="0 -1 0"/><limit lower="-2" upper="2" effort="3" velocity="4"/>
    <dynamics damping="0.1"/></joint>
</robot>"""

with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "arm.urdf"
    path.write_text(ARM)
    arm = dc.Robot.load(path, stiffness=60.0, damping=1.0, name="arm")
sheet = dc.Cloth.grid(
    (8, 8),
    0.2,
    pose=[0.31, 0, -0.12, 0.7071, 0, 0.7071, 0],  # upright, below the tip
    material=dc.Material(stretch=200, bending=1e-4, density=0.4, damping=0.01),
    name="sheet",
)
top = sheet.vertices[:, 2] > sheet.vertices[:, 2].max() - 1e-3
grip = dc.Attachment(
    ("sheet", [int(i) for i in top.nonzero()[0]]),
    ("arm/boom", [[0.31, float(y), -0.02] for y in sheet.vertices[top, 1]]),
    stiffness=100.0,
)
scene = dc.Scene([sheet], robots=[arm], attachments=[grip])
simulator = dc.Simulator(scene, dt=0.01)

motors = ("as in the file", "slow", "with friction", "weak")
limits = torch.tensor([[3.0], [3.0], [3.0], [0.5]], dtype=F64, requires_grad=True)
parameters = simulator.default_parameters().replace(
    joint_effort_limits=limits,
    joint_velocity_limits=torch.tensor([[4.0], [1.0], [4.0], [4.0]], dtype=F64),
    joint_friction=torch.tensor([[0.0], [0.0], [1.0], [0.0]], dtype=F64),
)
up = simulator.control(joint_positions={"lift": 1.0})
state = simulator.initial_state(len(motors))
angles = [state.joint_positions[:, 0]]
fastest = torch.zeros(len(motors), dtype=F64)
for _ in range(STEPS):
    state = simulator.step(state, up, parameters)
    angles.append(state.joint_positions[:, 0].detach())
    fastest = torch.maximum(fastest, state.joint_velocities[:, 0].detach().abs())
state.joint_positions.sum().backward()

print("motor           angle [rad]  effort [N m]  fastest [rad/s]  d angle / d limit")
columns = zip(motors, angles[-1], state.joint_efforts[:, 0], fastest, limits.grad, strict=True)
for motor, angle, effort, speed, slope in columns:
    print(f"{motor:15} {angle:11.3f} {effort:13.3f} {speed:16.2f} {slope.item():18.3f}")
