"""Steps with nodal contact, with pins coupled to other vertices by springs and by air drag."""

import pytest
import torch

import diffcloth_torch as dc

PINS = [0, 13, 20]
INPUTS = ("pins", "positions", "velocities", "stretch", "attachment_stiffness", "wind")
OUTPUTS = ("positions", "pin_forces", "contact_forces")


def a_step(scheme, count):
    """A sheet slides on a floor in wind, with a spring from a pin to a vertex far away."""
    material = dc.Material(
        stretch=300.0,
        bending=2e-4,
        density=0.15,
        friction=0.3,
        normal_drag=1.2,
        tangential_drag=0.05,
    )
    cloth = dc.Cloth.grid(
        count, count, (0.3, 0.25), pose=[0, 0, 0.003, 1, 0, 0, 0], material=material, name="sheet",
        pins={"held": PINS},
    )  # fmt: skip
    spring = dc.Attachment(
        ("sheet", [PINS[1]]), ("sheet", [count * count - 2]), stiffness=50.0, rest_length=0.02
    )
    nodal = {"nodal_contact": True} if scheme == "split" else {}
    floor = dc.RigidBody.plane(4.0, friction=0.3, **nodal)
    solver = dc.SolverOptions(tolerance=1e-11)
    return dc.Simulator(
        dc.Scene([cloth], [floor], attachments=[spring]),
        0.01, scheme=scheme, solver=solver,
    )  # fmt: skip


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("scheme", ["projective", "split"])
def test_derivatives_match_differences(scheme, name):
    sim = a_step(scheme, 7)
    generator = torch.Generator().manual_seed(3)

    def random(shape):
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    start, parameters = sim.initial_state(), sim.default_parameters()
    velocity = torch.tensor([0.3, 0.0, -0.3], dtype=torch.float64)
    start = start.replace(velocities=velocity + 0.1 * random(start.velocities.shape))
    values = {
        "pins": start.positions[PINS] + 0.002,
        "positions": start.positions,
        "velocities": start.velocities,
        "stretch": parameters.stretch,
        "attachment_stiffness": parameters.attachment_stiffness,
        "wind": torch.tensor([1.0, 0.5, -0.7], dtype=torch.float64),
    }
    sizes = {"pins": 0.01, "positions": 1e-3, "velocities": 0.1, "stretch": 100.0, "wind": 1.0}
    weights = [random(getattr(start, output).shape) for output in OUTPUTS]

    def outputs(value):
        given = {**values, name: value}
        control = sim.control(pins=given["pins"], wind=given["wind"])
        state = start.replace(positions=given["positions"], velocities=given["velocities"])
        chosen = {n: given[n] for n in ("stretch", "attachment_stiffness")}
        end = sim.step(state, control, parameters.replace(**chosen))
        assert end.report.counts["slipping"] > 10
        return torch.stack(
            [(w * getattr(end, o)).sum() for w, o in zip(weights, OUTPUTS, strict=True)]
        )

    at = values[name].detach().clone().requires_grad_()
    direction = sizes.get(name, 10.0) * random(at.shape)
    found = torch.autograd.grad(
        outputs(at), at, torch.eye(3, dtype=torch.float64), is_grads_batched=True
    )[0]
    backward = (found * direction).reshape(3, -1).sum(dim=1)
    _, forward = torch.func.jvp(outputs, (at.detach(),), (direction,))
    with torch.no_grad():
        step = 1e-6  # a change of 1e-8 m of the positions makes a vertex take off
        high, low = (outputs(at + s * step * direction) for s in (1, -1))
    differences = (high - low) / (2 * step)
    size = differences.abs()
    assert ((backward - differences).abs() < 1e-5 * size + 1e-7).all(), (backward, differences)
    assert ((forward - backward).abs() < 1e-9 * size + 1e-11).all(), (forward, backward)
