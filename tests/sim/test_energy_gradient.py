"""The gradient of each part of the energy by every input, and its relation to forces."""

from functools import cache

import numpy as np
import pytest
import scenes
import torch
from differences import directions

import diffcloth_torch as dc
from diffcloth_torch import _core
from diffcloth_torch.model.quantities import PARAMETERS, STATE, STORING
from diffcloth_torch.robots import GRIPPER

F64 = torch.float64
STORED = ("stretch", "bending", "soft_pins", "contact")

# The inputs that each part depends on.
SHAPE = {"state.positions", "parameters.rest_positions"}
DEPENDS = {
    "stretch": SHAPE | {"parameters.stretch"},
    "bending": SHAPE | {"parameters.bending", "parameters.poisson"},
    "soft_pins": {"state.positions", "state.soft_pin_targets", "parameters.pin_stiffness"},
    "contact": SHAPE
    | {"parameters.thickness", "parameters.barrier_stiffness", "parameters.barrier_distance"},
    "gravity": SHAPE | {"parameters.density", "parameters.gravity"},
}
OF_WOVEN_CLOTH = {
    "stretch": {"parameters.stretch_weft", "parameters.stretch_shear"},
    "bending": {"parameters.bending_weft", "parameters.bending_twill"},
}
OF_BODIES = {
    "contact": {"state.body_poses", "state.base_poses", "state.joint_positions"},
    "gravity": {
        "state.body_poses",
        "state.base_poses",
        "state.joint_positions",
        "parameters.body_mass",
        "parameters.body_center",
        "parameters.link_mass",
        "parameters.link_center",
    },
}

# Steps of the differences in units of the input; for all other inputs, relative to the largest
# value.
STEPS = {
    "state.positions": 1e-5,
    "state.soft_pin_targets": 1e-4,
    "state.body_poses": 1e-5,
    "state.base_poses": 1e-5,
    "state.joint_positions": 1e-5,
    "parameters.rest_positions": 1e-5,
    "parameters.thickness": 1e-5,
    "parameters.barrier_distance": 1e-5,
    "parameters.poisson": 1e-3,
    "parameters.body_center": 1e-4,
    "parameters.link_center": 1e-4,
}
RELATIVE_STEP = 2e-3
HANDLED = {"handled": "floating", "handled_fixed": "fixed", "handled_kinematic": "kinematic"}
NON_NEGATIVE = ("parameters.thickness", "parameters.body_mass")
_CENTRAL = ((-2, 1 / 12), (-1, -2 / 3), (1, 2 / 3), (2, -1 / 12))
_FORWARD = ((0, -25 / 12), (1, 4), (2, -3), (3, 4 / 3), (4, -1 / 4))


@cache
def handled(base="floating"):
    """A dynamic box just over a cloth, and a gripper around its edge."""
    vertices, faces = scenes.grid(5, 5, edge=0.06, seed=3)
    vertices = scenes.turned(vertices - vertices.mean(axis=0), (0.3, 1, 0), 0.04)
    cloth = dc.Cloth(
        vertices,
        faces,
        material=scenes.material(faces, thickness=0.001),
        soft_pins={"rim": [0, 1, 5]},
        pin_stiffness=60.0,
    )
    box = dc.RigidBody.box(
        [0.07, 0.09, 0.05],
        motion="dynamic",
        mass=0.05,
        pose=[-0.02, 0.01, 0.033, 1, 0.02, 0.02, 0.2],
        thickness=0.002,
    )
    wall = dc.RigidBody.box(0.1, motion="kinematic", pose=[0, 0.03, -0.062, 1.1, 0.02, 0.03, 0])
    edge = vertices[np.argmax(vertices[:, 0])]
    hand = dc.Robot.load(
        GRIPPER,
        base=base,
        pose=[edge[0] + 0.061, 0.013, edge[2] + 0.001, 0.5, -0.5, -0.5, 0.5],
        joint_positions=0.035,
        actuation=("position", "pd") if base == "kinematic" else "pd",
        stiffness=400.0,
        damping=3.0,
    )
    contact = dc.ContactOptions(barrier_distance=0.012, barrier_stiffness=60.0)
    sim = dc.Simulator(
        dc.Scene([cloth], [wall, box], [hand], gravity=(0.4, -0.3, -9.81)), 0.01, contact=contact
    )
    state = sim.initial_state()
    noise = scenes.tensor_noise(state.positions.shape, 2e-3, 1)
    return sim, state.replace(
        positions=state.positions + noise,
        velocities=noise,
        body_velocities=scenes.tensor_noise(state.body_velocities.shape, 0.3, 2),
        base_velocities=scenes.tensor_noise(state.base_velocities.shape, 0.3, 3),
        joint_velocities=scenes.tensor_noise(state.joint_velocities.shape, 0.1, 4),
        soft_pin_targets=state.soft_pin_targets + 0.01,
    )


def case(name):
    """A simulator and a state in a regime."""
    if name in HANDLED:
        return handled(HANDLED[name])
    regime = scenes.regime(name)
    return regime.sim, regime.state


def inputs(sim, state):
    """All tensors of a state and of its parameters by name."""
    owners = {"state": state, "parameters": sim.default_parameters()}
    return {
        f"{owner}.{name}": tensor.detach()
        for owner, record in owners.items()
        for name, tensor in vars(record).items()
        if isinstance(tensor, torch.Tensor) and tensor.numel()
    }


def parts_of(sim, state, values):
    """All parts with some inputs replaced."""
    own = {"state": {}, "parameters": {}}
    for name, tensor in values.items():
        owner, field = name.split(".")
        own[owner][field] = tensor
    return sim.energy(
        state.replace(**own["state"]),
        parameters=sim.default_parameters().replace(**own["parameters"]),
        parts=True,
    )


def gradients(sim, state, part, names=None):
    given = inputs(sim, state)
    leaves = {
        n: t.clone().requires_grad_() for n, t in given.items() if names is None or n in names
    }
    found = torch.autograd.grad(
        parts_of(sim, state, leaves)[part], list(leaves.values()), allow_unused=True
    )
    return dict(zip(leaves, found, strict=True))


REGIMES = {
    "hanging": {"contact"},  # parts that are zero
    "curved": {"contact"},
    "hinge": {"contact"},
    "sticking": (),
    "thick": (),
    "poking": (),
    "sphere": {"soft_pins"},
    "folded": (),
    "folded_thick": (),
    "stacked": (),
    "woven": {"contact"},
    "woven_stacked": (),
    **dict.fromkeys(HANDLED, ()),
}


def dependencies(name, part):
    state = case(name)[1]
    if part in REGIMES[name]:
        return set()
    found = DEPENDS[part] | OF_BODIES.get(part, set()) if name in HANDLED else DEPENDS[part]
    if part == "contact" and len(state.body_poses):
        found = found | {"state.body_poses"}
    if name == "hinge":
        found = found - {"parameters.poisson"}
    if name.startswith("woven"):
        found = found | OF_WOVEN_CLOTH.get(part, set())
    return found


def slopes(sim, state, name, tensor, d, step, stencil):
    with torch.no_grad():
        points = [(w, parts_of(sim, state, {name: tensor + k * step * d})) for k, w in stencil]
    return {p: sum(w * float(at[p]) for w, at in points) / step for p in points[0][1]}


@pytest.mark.quick(
    "hanging", "hinge", "thick", "sphere", "folded_thick", "woven", "handled", "handled_kinematic"
)
@pytest.mark.parametrize("name", REGIMES)
def test_every_part_has_its_gradient_by_every_input(name):
    sim, state = case(name)
    found = {part: gradients(sim, state, part) for part in DEPENDS}
    generator = torch.Generator().manual_seed(1)
    problems = []
    for part, of_part in found.items():
        nonzero = {n for n, g in of_part.items() if g is not None and g.any()}
        if nonzero != dependencies(name, part):
            problems.append(f"{part}: {nonzero ^ dependencies(name, part)}")
    for key, tensor in inputs(sim, state).items():
        largest = tensor.abs().max().item()
        step = STEPS.get(key, RELATIVE_STEP * largest)
        asked = [p for p in DEPENDS if found[p][key] is not None and found[p][key].any()]
        forward = key in NON_NEGATIVE and tensor.min() == 0
        for d in directions(tensor, generator) if asked else ():
            d = d.abs() if forward else d
            errors = dict.fromkeys(asked, np.inf)
            for factor in (1.0, 0.25, 4.0, 0.0625, 16.0, 1 / 64):
                s = slopes(
                    sim, state, key, tensor, d, factor * step, _FORWARD if forward else _CENTRAL
                )
                for part in asked:
                    terms = found[part][key] * d
                    # A direction may miss all entries on which a part depends.
                    scale = float(terms.norm() or found[part][key].norm())
                    error = abs(s[part] - float(terms.sum())) / scale
                    errors[part] = min(errors[part], error)
                if max(errors.values()) < 1e-6:
                    break
            problems += [f"{p} by {key}: {e:.1e}" for p, e in errors.items() if not e < 1e-6]
    assert not problems, "\n".join(problems)


@pytest.mark.parametrize("name", ["folded", "handled"])
def test_inputs_outside_of_the_storing_ones_store_nothing(name):
    """An input of a new potential must not be left out of the gradient by its row."""
    sim, state = case(name)
    assert set(_core.input_names) > STORING
    before = sim.energy(state, parts=True)
    given = inputs(sim, state)
    core = {f"state.{n}": q.core for n, q in STATE.items()}
    core |= {f"parameters.{n}": q.core for n, q in PARAMETERS.items()}
    others = set(_core.input_names) - STORING
    changed = {n: 1.5 * t for n, t in given.items() if core[n] in others}
    changed |= {n: 2.0 * t for n, t in given.items() if n.endswith("velocities")}
    assert len(changed) >= 6
    after = parts_of(sim, state, changed)
    for part in STORED:
        assert after[part].item() == pytest.approx(before[part].item(), rel=1e-12, abs=1e-20)


# --- One operation -------------------------------------------------------------------------------


class Spy:
    """A core that counts its calls."""

    def __init__(self, core):
        self.core, self.calls = core, []

    def __getattr__(self, name):
        self.calls.append(name)
        return getattr(self.core, name)


@pytest.mark.parametrize("parts", [False, True])
def test_all_parts_go_back_in_one_call(parts, monkeypatch):
    sim, state = case("folded")
    spy = Spy(sim._engine.core)
    monkeypatch.setattr(sim._engine, "core", spy)
    x = state.positions.clone().requires_grad_()
    energy = sim.energy(state.replace(positions=x), parts=parts)
    (sum(energy.values()) if parts else energy).backward()
    assert spy.calls == ["stored_energy", "energy_backward"]


@pytest.mark.parametrize("name", ["folded", "handled"])
def test_values_do_not_depend_on_gradients(name):
    sim, state = case(name)
    x = state.positions.clone().requires_grad_()
    with_graph = sim.energy(state.replace(positions=x), parts=True)
    with torch.no_grad():
        without = sim.energy(state.replace(positions=x), parts=True)
    assert all(torch.equal(with_graph[n], without[n]) for n in without)
    assert all(e.requires_grad for e in with_graph.values())
    assert not any(e.requires_grad for e in without.values())
    assert not sim.energy(state).requires_grad


def test_the_gradient_of_the_total_is_the_sum_of_those_of_the_parts():
    sim, state = case("handled")
    leaves = {n: t.clone().requires_grad_() for n, t in inputs(sim, state).items()}
    parts = parts_of(sim, state, leaves)
    total = torch.autograd.grad(
        sum(parts.values()), list(leaves.values()), allow_unused=True, materialize_grads=True
    )
    found = [gradients(sim, state, part) for part in parts]
    for name, gradient in zip(leaves, total, strict=True):
        own = [g[name] for g in found if g[name] is not None]
        torch.testing.assert_close(
            gradient, sum(own, torch.zeros_like(gradient)), rtol=1e-12, atol=1e-12
        )


@pytest.mark.parametrize("name", ["folded", "handled"])
def test_a_batch_has_the_gradients_of_its_environments(name):
    sim, state = case(name)
    noise = scenes.tensor_noise(state.positions.shape, 2e-4, 7)
    states = [state, state.replace(positions=state.positions + noise)]
    names = ("state.positions", "state.body_poses", "parameters.barrier_stiffness")
    batch = dc.stack(states)
    shared = sim.default_parameters().barrier_stiffness.clone().requires_grad_()
    fields = {n: getattr(batch, n).clone().requires_grad_() for n in ("positions", "body_poses")}
    energy = sim.energy(
        batch.replace(**fields),
        parameters=sim.default_parameters().replace(barrier_stiffness=shared),
        parts=True,
    )["contact"]
    assert energy.shape == (2,)
    weights = torch.tensor([1.0, -3.0], dtype=F64)
    wanted = [*fields.values(), shared]
    found = torch.autograd.grad(energy, wanted, weights, allow_unused=True)
    alone = [gradients(sim, s, "contact", names) for s in states]
    for k, w in enumerate(weights):
        torch.testing.assert_close(
            found[0][k], w * alone[k]["state.positions"], rtol=1e-12, atol=1e-14
        )
        if len(state.body_poses):
            torch.testing.assert_close(
                found[1][k], w * alone[k]["state.body_poses"], rtol=1e-11, atol=1e-13
            )
    stiffness = sum(
        w * g["parameters.barrier_stiffness"] for w, g in zip(weights, alone, strict=True)
    )
    torch.testing.assert_close(found[2], stiffness, rtol=1e-12, atol=0)
    # An energy that does not depend on an environment has no gradient there.
    (one,) = torch.autograd.grad(
        sim.energy(batch.replace(positions=fields["positions"]))[1], fields["positions"]
    )
    assert not one[0].any()
    assert one[1].any()


@pytest.mark.parametrize("batch", [False, True])
def test_many_losses_go_back_at_once(batch, monkeypatch):
    sim, state = case("folded_thick")
    if batch:
        state = dc.stack([state, state])
    x = state.positions.clone().requires_grad_()
    thickness = sim.default_parameters().thickness.clone().requires_grad_()
    parts = torch.stack(
        list(
            sim.energy(
                state.replace(positions=x),
                parameters=sim.default_parameters().replace(thickness=thickness),
                parts=True,
            ).values()
        )
    )
    eye = torch.eye(parts.numel(), dtype=F64).reshape(-1, *parts.shape)
    one_by_one = [torch.autograd.grad(parts, (x, thickness), e, retain_graph=True) for e in eye]
    spy = Spy(sim._engine.core)
    monkeypatch.setattr(sim._engine, "core", spy)
    at_once = torch.autograd.grad(parts, (x, thickness), eye, is_grads_batched=True)
    assert all(
        torch.equal(a, torch.stack(b))
        for a, b in zip(at_once, zip(*one_by_one, strict=True), strict=True)
    )


@pytest.mark.parametrize("part", ["total", *STORED])
def test_second_derivatives_are_refused(part):
    sim, state = case("folded")
    x = state.positions.clone().requires_grad_()
    parts = sim.energy(state.replace(positions=x), parts=True)
    energy = sum(parts.values()) if part == "total" else parts[part]
    (gradient,) = torch.autograd.grad(energy, x, create_graph=True)
    with pytest.raises(RuntimeError, match=r"second derivatives of energy are not available"):
        gradient.sum().backward()


@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.jacrev, torch.func.jacfwd])
def test_transforms_find_the_gradient(transform):
    sim, state = case("folded")

    def energy(x):
        return sim.energy(state.replace(positions=x))

    x = state.positions.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(energy(x), x)
    found = transform(energy)(state.positions)
    torch.testing.assert_close(found, gradient, rtol=1e-11, atol=1e-12 * gradient.abs().max())


def test_an_input_edited_in_place_makes_backward_raise():
    sim, state = case("folded")
    x = state.positions.clone().requires_grad_()
    y = 1.0 * x
    energy = sim.energy(state.replace(positions=y))
    y.mul_(2.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        energy.backward()


def test_overlapping_surfaces_have_no_gradient_of_contact():
    cloth = dc.Cloth.grid(3, 3, 0.2, material=dc.Material(thickness=0.01), name="sheet")
    floor = dc.RigidBody.plane(1.0, pose=[0, 0, -0.02, 1, 0, 0, 0], name="floor")
    sim = dc.Simulator(dc.Scene([cloth], [floor]), 0.01)
    state = sim.initial_state()
    x = state.positions.clone()
    x[4, 2] = -0.018
    x.requires_grad_()
    parts = sim.energy(state.replace(positions=x), parts=True)
    assert torch.isinf(parts["contact"])
    with pytest.raises(dc.SimulationError, match=r"infinite energy.*'sheet'.*'floor'"):
        parts["contact"].backward(retain_graph=True)
    parts["stretch"].backward()
    assert x.grad.isfinite().all()


# --- Forces --------------------------------------------------------------------------------------


def test_the_gradient_is_minus_the_forces_of_a_step_without_friction():
    sim, state = case("handled")
    frictionless = sim.default_parameters().replace(friction=0.0)
    with torch.no_grad():
        after = sim.step(state, None, frictionless)
    x, poses = (t.clone().requires_grad_() for t in (after.positions, after.body_poses))
    contact = sim.energy(after.replace(positions=x, body_poses=poses), parts=True)["contact"]
    on_cloth, on_bodies = torch.autograd.grad(contact, (x, poses))
    assert after.contact_forces.abs().max() > 1e-3
    torch.testing.assert_close(-on_cloth, after.contact_forces, rtol=1e-9, atol=1e-9)
    forces = torch.stack(list(sim.contact_wrenches(after).values()))[: len(poses), :3]
    assert (forces.norm(dim=1) > 1e-3).all()
    torch.testing.assert_close(-on_bodies[:, :3], forces, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("soft", [False, True], ids=["pins", "soft_pins"])
def test_the_gradient_vanishes_at_an_equilibrium(soft):
    """The gradient vanishes at free vertices; at pins it is the holding force."""
    vertices, faces = scenes.grid(7, 7, edge=0.04, seed=5)
    held = {"corners": [0, 6, 42, 48]}
    cloth = dc.Cloth(
        vertices + np.array([0.0, 0.0, 0.005]),
        faces,
        material=dc.Material(stretch=300.0, bending=1e-4, damping=0.01, friction=0.0),
        pins=None if soft else held,
        soft_pins=held if soft else None,
        pin_stiffness=300.0,
    )
    ball = dc.RigidBody.sphere(0.05, pose=[0.12, 0.12, -0.047, 1, 0, 0, 0], friction=0.0)
    sim = dc.Simulator(dc.Scene([cloth], [ball]), 0.01, solver=dc.SolverOptions(tolerance=1e-10))
    end = sim.equilibrium(sim.initial_state())
    x = end.positions.clone().requires_grad_()
    state = end.replace(positions=x)
    parts = {
        n: torch.autograd.grad(e, x, retain_graph=True)[0]
        for n, e in sim.energy(state, parts=True).items()
        if e.requires_grad
    }
    (gradient,) = torch.autograd.grad(sim.energy(state), x)
    pinned = [] if soft else held["corners"]
    free = [i for i in range(len(x)) if i not in pinned]
    largest = max(g.abs().max() for g in parts.values())
    assert min(parts[n].abs().max() for n in ("stretch", "contact", "gravity")) > 1e-3
    assert gradient[free].abs().max() < 1e-10 * largest
    if not soft:
        torch.testing.assert_close(gradient[pinned], end.pin_forces, rtol=1e-6, atol=1e-8)
