"""Forces on cloths: they balance momentum, agree with each other, and have exact gradients."""

import numpy as np
import pytest
import scenes
import torch
from differences import directions, mismatch
from test_step_gradients import CONTACT, check

import diffcloth_torch as dc

F64 = torch.float64
SCHEMES = [("coupled", None), ("split", "energy"), ("split", "mass"), ("split", "elastic")]
# Springs act at the final positions in these schemes; in "mass" and "elastic", at the end of the
# elastic stage.
WITH_SPRINGS = SCHEMES[:2]
WITHOUT_SOFT_PINS = ("folded", "folded_thick", "sphere")


def spring_forces(case, after):
    """Forces of the soft pins on their vertices [N], shape [Q, 3]."""
    sim = case.sim
    soft = torch.from_numpy(sim._assembly.soft_pins.astype(np.int64))
    stiffness = case.inputs().get("parameters.pin_stiffness", torch.zeros(1, dtype=F64))
    starts = torch.from_numpy(sim._assembly.cloth_vertex_start[1:].astype(np.int64))
    owner = torch.bucketize(soft, starts, right=True)
    per_pin = stiffness.expand(len(starts))[owner][:, None]
    return per_pin * (after.soft_pin_targets - after.positions[soft])


def balances():
    for name in scenes.REGIMES:
        for scheme in SCHEMES:
            if scheme in WITH_SPRINGS or name in WITHOUT_SOFT_PINS:
                yield pytest.param(name, *scheme, id="-".join([name, *filter(None, scheme)]))


@pytest.mark.parametrize(("name", "scheme", "metric"), list(balances()))
def test_forces_change_the_momentum(name, scheme, metric):
    """In a vacuum; tests/physics/test_air.py and the fuzz test include air."""
    case = scenes.regime(name, scheme, metric)
    case = case.where(parameters={**case.parameters, "air_density": torch.zeros((), dtype=F64)})
    after, tensors, sim = case.step(), case.inputs(), case.sim
    masses = sim.vertex_masses(sim.default_parameters().replace(**case.parameters))[:, None]
    change = (masses * (after.velocities - case.state.velocities)).sum(0) / sim.dt
    parts = [
        masses * tensors["parameters.gravity"],
        after.contact_forces,
        after.pin_forces,
        spring_forces(case, after),
    ]
    if "control.forces" in tensors:
        parts.append(tensors["control.forces"])
    total = sum(part.sum(0) for part in parts)
    size = sum(float(part.abs().sum()) for part in parts)
    # The solver's residual, as a velocity, is below its tolerance.
    assert (change - total).abs().max() < 1e-9 * size


@pytest.mark.parametrize("name", scenes.REGIMES)
def test_cloths_bodies_and_pairs_feel_the_same_contact(name):
    after = scenes.regime(name).step()
    on_all = after.contact_forces.sum(0) + after.body_forces.sum(0)
    size = float(after.contact_forces.abs().sum()) + 1e-12
    assert on_all.abs().max() < 1e-12 * size + 1e-15
    contacts = after.report.contacts
    assert sum(contacts[pair].count for pair in contacts) == after.report.contact_count


HOLDING = ("hanging", "curved", "pinned", "held")
TOUCHING = ("sticking", "sliding", "pinned", "folded", "dragged", "sphere")


@pytest.mark.quick(
    "coupled-*-held",
    "coupled-*-sliding",
    "split-energy-*-sphere",
    "split-mass-*-hanging",
    "split-energy-*-curved",
)
@pytest.mark.parametrize(
    ("output", "name"),
    [
        *(("pin_forces", name) for name in HOLDING),
        *(("contact_forces", name) for name in TOUCHING),
    ],
)
@pytest.mark.parametrize(("scheme", "metric"), SCHEMES[:3])
def test_gradients_of_forces(output, name, scheme, metric):
    case = scenes.regime(name, scheme, metric)
    assert getattr(case.step(), output).any()
    check(case, CONTACT, zero=None, weights=(1.0,), outputs=(output,))


@pytest.mark.parametrize("coupling", ["monolithic", "rigid_to_cloth"])
def test_gradients_of_forces_with_a_body_that_they_move(coupling):
    """A box lies on a sheet whose corners are pinned."""
    vertices, faces = scenes.grid(5, 5)
    cloth = dc.Cloth(vertices, faces, material=scenes.material(faces), pins={"c": [0, 4, 20, 24]})
    pose = [0.01, 0.02, 0.056, 1, 0.01, 0.02, 0.1]
    box = dc.RigidBody.box(0.1, motion="dynamic", mass=2.0, pose=pose)
    sim = dc.Simulator(
        dc.Scene([cloth], [box]),
        scenes.DT,
        coupling=coupling,
        contact=dc.ContactOptions(
            barrier_distance=0.01, barrier_stiffness=20.0, slip_velocity=0.02
        ),
        solver=dc.SolverOptions(tolerance=1e-11),
    )
    with torch.no_grad():
        start = sim.initial_state()
        down = torch.tensor([[0.1, 0.0, -0.4, 0.0, 0.0, 0.0]], dtype=F64)
        state = sim.rollout(start.replace(body_velocities=down), steps=3)[-1]
    spin = state.body_velocities + 0.1 * scenes.tensor_noise(state.body_velocities.shape, 1.0)
    masses = sim.vertex_masses()[:, None]
    after = sim.step(state.replace(body_velocities=spin))
    change = (masses * (after.velocities - state.velocities)).sum(0) / sim.dt
    total = (masses * sim.default_parameters().gravity).sum(0)
    total = total + after.contact_forces.sum(0) + after.pin_forces.sum(0)
    torch.testing.assert_close(change, total, rtol=1e-7, atol=1e-7)
    on_all = after.contact_forces.sum(0) + after.body_forces.sum(0)
    assert after.contact_forces.any()
    assert on_all.abs().max() < 1e-10

    generator = torch.Generator().manual_seed(3)
    weights = [
        torch.randn(t.shape, dtype=F64, generator=generator)
        for t in (after.contact_forces, after.pin_forces)
    ]
    inputs = {
        "body_velocities": (spin, 1e-3),
        "positions": (state.positions, 1e-5),
        "body_mass": (sim.default_parameters().body_mass, 1e-3),
        "friction": (sim.default_parameters().friction, 1e-3),
    }

    def loss(name, value):
        fields = {"body_velocities": spin}
        physical = sim.default_parameters()
        if name in ("body_velocities", "positions"):
            fields[name] = value
        else:
            physical = physical.replace(**{name: value})
        end = sim.step(state.replace(**fields), None, physical)
        return (end.contact_forces * weights[0]).sum() + (end.pin_forces * weights[1]).sum()

    for name, (tensor, size) in inputs.items():
        leaf = tensor.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(loss(name, leaf), leaf)
        # In `rigid_to_cloth` the box's solve does not depend on the cloth, nor on its own mass.
        assert gradient.any() or (name == "body_mass" and coupling == "rigid_to_cloth")
        for d in directions(tensor, generator):

            def along(moved, name=name):
                with torch.no_grad():
                    return loss(name, moved).item()

            assert mismatch(along, tensor, gradient, d, size, CONTACT) < CONTACT, name
