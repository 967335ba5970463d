"""Gradients through attachments, in every scheme and coupling that supports attachments."""

import numpy as np
import pytest
import scenes
import torch
from differences import directions, mismatch
from test_many_losses import assert_same, at_once, in_a_loop, random_cotangents
from test_step_gradients import check

import diffcloth_torch as dc

F64 = torch.float64
FREE = 1e-6
SCHEMES = {
    "coupled": {"scheme": "coupled"},
    "split": {"scheme": "split"},
    "split_elastic": {"scheme": "split", "metric": "elastic"},
    "split_mass": {"scheme": "split", "metric": "mass"},
    "projective": {"scheme": "projective"},
}


def sheet(name, offset, seed):
    vertices, faces = scenes.grid(4, 4, seed=seed)
    return dc.Cloth(vertices + offset, faces, material=scenes.material(faces, seed), name=name)


def simulator(cloths, attachments, bodies=(), scheme="coupled", metric=None):
    scene = dc.Scene(cloths, bodies, gravity=(0.4, -0.3, -9.81), attachments=attachments)
    contact = {} if scheme == "projective" else {"barrier_distance": 0.01}
    if scheme != "projective":
        contact |= {"barrier_stiffness": 20.0, "slip_velocity": 0.02}
    return dc.Simulator(
        scene,
        scenes.DT,
        scheme=scheme,
        contact=dc.ContactOptions(**contact),
        solver=dc.SolverOptions(tolerance=scenes.TOLERANCE, metric=metric),
    )


def moving(sim):
    state = sim.initial_state()
    noise = scenes.tensor_noise(state.positions.shape, 0.01, 1)
    velocities = scenes.tensor_noise(state.positions.shape, 1.0, 2)
    return state.replace(positions=state.positions + noise, velocities=velocities)


def picked(**options):
    """A sheet that targets pull at vertices and at points of faces, partly released."""
    attachments = [
        dc.Attachment(("sheet", [0, 3]), stiffness=[80.0, 50.0], name="corners"),
        dc.Attachment(
            ("sheet", [[9, 10, 13], [5, 6, 10]], [[0.2, 0.3, 0.5], [0.6, 0.1, 0.3]]),
            stiffness=120.0,
            rest_length=[0.05, 0.0],
            name="faces",
        ),
    ]
    sim = simulator([sheet("sheet", [0, 0, 0], 0)], attachments, **options)
    state = moving(sim)
    near = torch.stack([state.positions[k] for k in (0, 3, 10, 6)])
    control = {
        "attachments": near + scenes.tensor_noise((4, 3), 0.03, 7),
        "attachment_weights": torch.tensor([0.9, 0.4, 0.7, 0.5], dtype=F64),
    }
    return scenes.Case(sim, state, control)


def sewn(**options):
    """Two sheets seamed at vertices and at a point of a face; one sheet is held."""
    cloths = [sheet("left", [0, 0, 0], 0), sheet("right", [0.45, 0.02, 0.05], 3)]
    attachments = [
        dc.Attachment(("left", [3, 7, 11]), ("right", [0, 4, 8]), stiffness=60.0, name="seam"),
        dc.Attachment(
            ("left", [10, 11, 14], [0.3, 0.3, 0.4]),
            ("right", 12),
            stiffness=90.0,
            rest_length=0.3,
            name="strut",
        ),
        dc.Attachment(("left", 0), ("left", 15), stiffness=40.0, rest_length=0.3, name="fold"),
    ]
    sim = simulator(cloths, attachments, **options)
    weights = torch.tensor([0.95, 0.5, 0.8, 0.9, 0.6], dtype=F64)
    return scenes.Case(sim, moving(sim), {"attachment_weights": weights})


def held(**options):
    """A sheet held by points of a box that moves on a given path, and of a plane."""
    box = dc.RigidBody.box(
        (0.1, 0.15, 0.2), motion="kinematic", pose=[0.2, 0.1, 0.4, 1, 0.1, 0.2, 0.3], name="hand"
    )
    plane = dc.RigidBody.plane(
        0.3, motion="kinematic", pose=[0.1, 0.1, -0.3, 1, 0.02, 0.03, 0.4], name="floor"
    )
    attachments = [
        dc.Attachment(
            ("sheet", [5, 6]), ("hand", [[0.03, 0.04, -0.09], [0, 0, -0.3]]), stiffness=70.0
        ),
        dc.Attachment(("sheet", 15), ("floor", [0.1, 0.05, 0.0]), stiffness=30.0, rest_length=0.2),
    ]
    sim = simulator([sheet("sheet", [0, 0, 0], 0)], attachments, [box, plane], **options)
    state = moving(sim)
    poses = state.body_poses + scenes.tensor_noise((2, 7), 0.01, 8)
    return scenes.Case(sim, state, {"body_poses": poses})


CASES = [
    *((picked, scheme) for scheme in SCHEMES),
    *((sewn, scheme) for scheme in SCHEMES),
    (held, "coupled"),
]
IDS = [f"{make.__name__}-{scheme}" for make, scheme in CASES]


@pytest.mark.quick("picked-coupled", "picked-projective", "sewn-split_mass", "held-*")
@pytest.mark.parametrize(("make", "scheme"), CASES, ids=IDS)
def test_every_input_matches_differences(make, scheme):
    case = make(**SCHEMES[scheme])
    check(case, FREE if make is not sewn else 3 * FREE, zero=None)


@pytest.mark.parametrize(("make", "scheme"), CASES, ids=IDS)
def test_attachments_have_gradients(make, scheme):
    case = make(**SCHEMES[scheme])
    names = [*(f"control.{k}" for k in case.control), "parameters.attachment_stiffness"]
    leaves = {name: case.inputs()[name].clone().requires_grad_() for name in names}
    after = case.step(leaves)
    for g in torch.autograd.grad((after.positions**3).sum(), list(leaves.values())):
        rows = g.reshape(len(g), -1)
        assert (rows != 0).any(dim=1).all()


@pytest.mark.parametrize("make", [picked, sewn, held])
def test_two_losses_at_once_are_a_loop(make):
    case = make()
    leaves = {n: t.clone().requires_grad_() for n, t in case.inputs().items()}
    after = case.step(leaves)
    outputs, values = [after.positions, after.velocities], list(leaves.values())
    cotangents = random_cotangents(outputs, 2)
    assert_same(
        at_once(outputs, values, cotangents, allow_unused=True),
        in_a_loop(outputs, values, cotangents),
        leaves,
    )


@pytest.mark.parametrize("scheme", ["split", "split_elastic", "projective"])
def test_attachments_act_beside_contact_at_nodes(scheme):
    table = dc.RigidBody.box(
        (1.0, 1.0, 0.2),
        motion="kinematic",
        pose=[0.15, 0.15, -0.1, 1, 0, 0, 0],
        friction=0.3,
        nodal_contact=True,
    )
    attachments = [
        dc.Attachment(
            ("sheet", [9, 10, 13], [0.2, 0.3, 0.5]), stiffness=60.0, rest_length=0.05, name="p"
        ),
        dc.Attachment(("sheet", 0), ("sheet", 15), stiffness=4.0, rest_length=0.2),
    ]
    sim = simulator([sheet("sheet", [0, 0, 0.001], 0)], attachments, [table], **SCHEMES[scheme])
    state = sim.initial_state()
    control = {
        "attachments": state.positions[[10]] + torch.tensor([0.02, 0.03, 0.1]),
        "attachment_weights": torch.tensor([0.7, 0.6], dtype=F64),
    }
    state = scenes.settled(sim, state, 4, dc.Control(**control))
    assert state.positions[10, 2] > 0.01
    only = [*(f"control.{k}" for k in control), "parameters.attachment_stiffness"]
    only += ["state.positions", "state.velocities"]
    check(scenes.Case(sim, state, control), 1e-5, zero=None, only=only)


def free_box():
    return dc.RigidBody.box(
        (0.1, 0.15, 0.2),
        motion="dynamic",
        mass=0.3,
        pose=[0.15, 0.1, 0.4, 1, 0.1, 0.2, 0.3],
        name="box",
    )


PICKER = dc.Attachment(("box", [0.05, 0.0, 0.1]), stiffness=50.0, name="picker")


def hanging_at_free_box():
    """A sheet sewn to a free box at three points, one of which has a rest length."""
    attachments = [
        dc.Attachment(
            ("sheet", [5, 6]), ("box", [[0.03, 0.04, -0.1], [0, 0, -0.3]]), stiffness=70.0
        ),
        dc.Attachment(("sheet", 15), ("box", [0, 0.1, -0.1]), stiffness=30.0, rest_length=0.2),
        PICKER,
    ]
    sim = simulator([sheet("sheet", [0, 0, 0], 0)], attachments, [free_box()])
    return sim, torch.tensor([0.9, 0.8, 0.95, 0.7], dtype=F64)


def free_box_alone():
    """Without possible contact, all forces on the body come from its attachment."""
    scene = dc.Scene([], [free_box()], gravity=(0.4, -0.3, -9.81), attachments=[PICKER])
    sim = dc.Simulator(scene, scenes.DT, solver=dc.SolverOptions(tolerance=scenes.TOLERANCE))
    return sim, torch.tensor([0.7], dtype=F64)


@pytest.mark.parametrize("make", [hanging_at_free_box, free_box_alone])
def test_a_free_body_has_gradients_by_everything(make):
    sim, weights = make()
    state = moving(sim).replace(body_velocities=scenes.tensor_noise((1, 6), 0.5, 9))
    control = {
        "attachments": torch.tensor([[0.2, 0.1, 0.6]], dtype=F64),
        "attachment_weights": weights,
    }
    names = ("positions", "velocities", "body_poses", "body_velocities")
    inputs = {name: getattr(state, name) for name in names} | control
    inputs["attachment_stiffness"] = sim.default_parameters().attachment_stiffness
    inputs["body_mass"] = sim.default_parameters().body_mass
    inputs = {name: tensor for name, tensor in inputs.items() if tensor.numel()}
    outputs = ("positions", "velocities", "body_poses", "body_velocities", "body_forces")
    # The second loss has forces only; their gradient differs from the gradient of positions.
    for scale in ((1.0, 0.01, 1.0, 0.01, 0.001), (0.0, 0.0, 0.0, 0.0, 1.0)):

        def step(values):
            given = state.replace(**{n: values[n] for n in names if n in values})
            parameters = sim.default_parameters().replace(
                attachment_stiffness=values["attachment_stiffness"], body_mass=values["body_mass"]
            )
            return sim.step(given, dc.Control(**{n: values[n] for n in control}), parameters)

        assert_matches_differences(step, inputs, outputs, scale)


def assert_matches_differences(step, inputs, outputs, scale):
    """Gradients of random cotangents of outputs, scaled, against differences."""
    with torch.no_grad():
        reference = step(inputs)
    g = torch.Generator().manual_seed(0)
    before = [getattr(reference, n) for n in outputs]
    cotangents = [
        w * torch.randn(t.shape, generator=g, dtype=F64) for w, t in zip(scale, before, strict=True)
    ]

    def loss(values):
        after = step(values)
        return sum(
            ((getattr(after, n) - t) * c).sum()
            for n, t, c in zip(outputs, before, cotangents, strict=True)
        )

    leaves = {n: t.clone().requires_grad_() for n, t in inputs.items()}
    found = torch.autograd.grad(loss(leaves), list(leaves.values()))
    generator = torch.Generator().manual_seed(1)
    problems = []
    for (name, tensor), gradient in zip(inputs.items(), found, strict=True):
        assert gradient.any(), name
        size = 2e-3 if name.endswith("velocities") else 1e-4 * float(tensor.abs().max())

        def f(value, name=name):
            with torch.no_grad():
                return loss({**inputs, name: value}).item()

        for d in directions(tensor, generator):
            error = mismatch(f, tensor, gradient, d, size, 3 * FREE)
            if not error <= 3 * FREE:
                problems.append(f"{name}: relative error {error:.1e}")
    assert not problems, "\n".join(problems)


@pytest.mark.parametrize("make", [picked, sewn, held])
def test_batches_are_their_environments(make):
    case = make()
    names = [*(f"control.{k}" for k in case.control), "parameters.attachment_stiffness"]
    values = case.inputs()
    rng = np.random.default_rng(0)
    batch = {
        n: torch.stack([values[n] * (1.0 - 0.01 * rng.random()) for _ in range(3)]) for n in names
    }
    state = dc.stack([case.state] * 3)
    control = {k: batch[f"control.{k}"] for k in case.control}
    parameters = case.sim.default_parameters().replace(
        attachment_stiffness=batch["parameters.attachment_stiffness"]
    )
    together = case.sim.step(state, dc.Control(**control), parameters)
    for i in range(3):
        alone = case.step({n: t[i] for n, t in batch.items()})
        assert torch.equal(together.positions[i], alone.positions)


ROBOTS = {
    "position": {"actuation": "position"},
    "torque": {"actuation": "torque"},
    "floating": {"base": "floating", "actuation": "pd", "stiffness": 50.0, "damping": 1.0},
}


@pytest.mark.parametrize("kind", ROBOTS)
def test_links_have_gradients(kind):
    """Points on two links of a gripper with prescribed or force-driven joints."""
    hand = dc.Robot.load(
        dc.robots.GRIPPER,
        pose=[0, 0, 0.4, 1, 0.1, 0.2, 0.3],
        joint_positions=0.02,
        name="hand",
        **ROBOTS[kind],
    )
    attachments = [
        dc.Attachment(
            ("sheet", [5, 6]),
            ("hand/palm", [0.01, 0.0, -0.02]),
            stiffness=40.0,
            rest_length=[0, 0.2],
        ),
        dc.Attachment(("sheet", 15), ("hand/right_finger", [0.01, 0.02, -0.02]), stiffness=40.0),
    ]
    scene = dc.Scene([sheet("sheet", [0, 0, 0], 0)], robots=[hand], attachments=attachments)
    sim = dc.Simulator(scene, scenes.DT, solver=dc.SolverOptions(tolerance=scenes.TOLERANCE))
    state = moving(sim)
    control = {"attachment_weights": torch.tensor([0.9, 0.8, 0.7], dtype=F64)}
    if kind == "position":
        control["joint_positions"] = state.joint_positions - 0.003
    inputs = {"positions": state.positions, "velocities": state.velocities} | control
    outputs = ("positions", "velocities", "body_forces", "joint_positions", "joint_efforts")
    scale = (1.0, 0.01, 0.01, 1.0, 0.01)

    def step(values):
        given = state.replace(positions=values["positions"], velocities=values["velocities"])
        return sim.step(given, dc.Control(**{n: values[n] for n in control}))

    assert_matches_differences(step, inputs, outputs, scale)


@pytest.mark.parametrize("make", [sewn, held])
def test_the_energy_has_the_gradients_of_springs(make):
    """By positions, poses and stiffness, with all springs between points at weight one."""
    case = make()
    state, parameters = case.state, case.sim.default_parameters()
    inputs = {
        "positions": state.positions,
        "attachment_stiffness": parameters.attachment_stiffness,
    }
    if make is held:
        inputs["body_poses"] = state.body_poses

    def energy(values):
        given = dict(values)
        stiffer = parameters.replace(attachment_stiffness=given.pop("attachment_stiffness"))
        return case.sim.energy(state.replace(**given), parameters=stiffer, parts=True)[
            "attachments"
        ]

    leaves = {n: t.clone().requires_grad_() for n, t in inputs.items()}
    value = energy(leaves)
    found = torch.autograd.grad(value, list(leaves.values()))
    assert torch.allclose((found[1] * leaves["attachment_stiffness"]).sum(), value)
    generator = torch.Generator().manual_seed(1)
    for (name, tensor), gradient in zip(inputs.items(), found, strict=True):
        assert gradient.any(), name

        def f(changed, name=name):
            with torch.no_grad():
                return energy({**inputs, name: changed}).item()

        for d in directions(tensor, generator):
            assert mismatch(f, tensor, gradient, d, 1e-4, FREE) <= FREE, name


def test_the_energy_has_the_gradients_of_targets_and_weights():
    case = picked()
    inputs = {"positions": case.state.positions} | case.control

    def energy(values):
        control = dc.Control(**{n: t for n, t in values.items() if n != "positions"})
        state = case.state.replace(positions=values["positions"])
        return case.sim.energy(state, control=control, parts=True)["attachments"]

    leaves = {n: t.clone().requires_grad_() for n, t in inputs.items()}
    found = torch.autograd.grad(energy(leaves), list(leaves.values()))
    generator = torch.Generator().manual_seed(2)
    for (name, tensor), gradient in zip(inputs.items(), found, strict=True):
        assert gradient.any(), name

        def f(changed, name=name):
            with torch.no_grad():
                return energy({**inputs, name: changed}).item()

        for d in directions(tensor, generator):
            assert mismatch(f, tensor, gradient, d, 1e-4, FREE) <= FREE, name
