"""From a mesh of your own through contact to a gradient.

python examples/own_mesh.py shirt.obj
"""

import sys

import torch

import diffcloth_torch as dc

# The mesh, in meters, falls onto a floor that is as far below it as the barrier reaches, and slides
# along x until friction stops it.
cloth = dc.Cloth.load(sys.argv[1], material=dc.Material(stretch=300, friction=0.4), name="cloth")
low, high = cloth.vertices.min(axis=0), cloth.vertices.max(axis=0)
x, y = (low + high)[:2] / 2
gap = dc.Simulator(dc.Scene([cloth]), dt=0.01).default_parameters().barrier_distance.item()
floor = dc.RigidBody.plane(10 * (high - low).max(), pose=[x, y, low[2] - gap, 1, 0, 0, 0])
simulator = dc.Simulator(dc.Scene([cloth], [floor]), dt=0.01)

start = simulator.initial_state()
throw = torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64, requires_grad=True)  # [m/s]
friction = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
states = simulator.rollout(
    start.replace(velocities=throw.expand_as(start.positions)),
    parameters=simulator.default_parameters().replace(friction=friction),
    steps=20,
)

end = states[-1]
loss = (end.positions - start.positions)[:, 0].mean()  # how far it got [m]
loss.backward()
print(f"{end.report.contact_count} contacts, {loss.item():.4f} m")
print(f"gradient: throw {throw.grad[0].item():.4f}, friction {friction.grad.item():.4f}")
