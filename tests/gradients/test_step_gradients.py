"""The gradient of one step, with respect to every input, against central differences."""

import ipctk
import numpy as np
import pytest
import scenes
import torch
from differences import directions, mismatch

import diffcloth_torch as dc
from diffcloth_torch.geometry.poses import transform
from diffcloth_torch.model.quantities import PARAMETERS

F64 = torch.float64

FREE, CONTACT = 1e-6, 1e-5  # relative error

# Steps of the differences: far above rounding, far below the length scale of contact geometry.
STEPS = {
    "state.positions": 1e-5,
    "state.velocities": 2e-3,
    "state.body_poses": 1e-5,
    "state.soft_pin_targets": 1e-4,
    "control.pins": 2e-5,
    "control.soft_pins": 1e-4,
    "control.body_poses": 1e-5,
    "control.forces": 1e-4,
    "control.wind": 1e-3,
    "parameters.gravity": 1e-1,
    "parameters.rest_positions": 1e-5,
    "parameters.thickness": 1e-5,
    "parameters.slip_velocity": 1e-4,
    "parameters.barrier_distance": 1e-5,
    "parameters.poisson": 1e-3,
    "parameters.damping": 1e-5,
    "parameters.friction": 1e-3,
    "parameters.normal_drag": 1e-2,
    "parameters.tangential_drag": 1e-2,
}
RELATIVE_STEP = 2e-3  # for all other inputs
# Inputs that differences must not make negative.
NON_NEGATIVE = (
    "parameters.thickness",
    "parameters.damping",
    "parameters.friction",
    "parameters.normal_drag",
    "parameters.tangential_drag",
)

CONTACT_PARAMETERS = (
    "parameters.friction",
    "parameters.thickness",
    "parameters.barrier_stiffness",
    "parameters.barrier_distance",
    "parameters.slip_velocity",
)
# Inputs whose gradient vanishes in a regime; all other gradients must not vanish.
ZERO = dict.fromkeys(("hanging", "curved", "hinge", "woven", "woven_flat"), CONTACT_PARAMETERS)


OUTPUTS = ("positions", "velocities", "body_forces")


def make_loss(case, seed=0, weights=(1.0, scenes.DT, 0.01), outputs=OUTPUTS):
    """Loss by random cotangents of outputs, weighted to comparable size.

    The loss is a function of the change of the outputs; this avoids cancellation in differences.
    """
    with torch.no_grad():
        reference = case.step()
    g = torch.Generator().manual_seed(seed)
    before = [getattr(reference, name) for name in outputs]
    cotangents = [
        w * torch.randn(t.shape, dtype=F64, generator=g)
        for w, t in zip(weights, before, strict=True)
    ]

    def loss(state):
        after = [getattr(state, name) for name in outputs]
        return sum(((a - b) * c).sum() for a, b, c in zip(after, before, cotangents, strict=True))

    return loss


def gradients(case, loss):
    leaves = {name: t.clone().requires_grad_() for name, t in case.inputs().items()}
    found = torch.autograd.grad(loss(case.step(leaves)), list(leaves.values()), allow_unused=True)
    return dict(zip(leaves, found, strict=True))


def check(case, rtol, *, zero=(), weights=(1.0, scenes.DT, 0.01), only=None, outputs=OUTPUTS):
    """Compare the gradient with respect to every input of a case with differences."""
    loss = make_loss(case, weights=weights, outputs=outputs)
    found = gradients(case, loss)
    generator = torch.Generator().manual_seed(1)
    problems = []
    for name, tensor in case.inputs().items():
        gradient = found[name]
        if only is not None and name not in only:
            continue
        if gradient is None:
            # A value replaced by the control is no input of the step.
            assert name == "state.soft_pin_targets"
            assert "soft_pins" in case.control
            continue
        if zero is not None and (name in zero) != (not gradient.any()):
            problems.append(f"{name}: gradient {'not ' if name in zero else ''}zero")
        step = STEPS.get(name, RELATIVE_STEP * tensor.abs().max().item())
        forward = name in NON_NEGATIVE and tensor.min().item() < 10 * step

        def f(value, name=name):
            with torch.no_grad():
                return loss(case.step({name: value})).item()

        for d in directions(tensor, generator):
            error = mismatch(
                f, tensor, gradient, d.abs() if forward else d, step, rtol, forward=forward
            )
            if not error <= rtol:
                problems.append(f"{name}: relative error {error:.1e}")
    assert not problems, "\n".join(problems)


# --- The regimes have the contact that their names state -----------------------------------------


def contact_slip(case, after):
    """Tangential displacement over the step of the vertices above the box, relative to it [m]."""
    box = case.sim.scene.bodies[0]
    start, end = case.state.body_poses[0].numpy(), after.body_poses[0].numpy()
    half = np.array(box.vertices).max(axis=0)
    inverse = [np.linalg.inv(_matrix(pose)) for pose in (start, end)]
    local = [
        x.numpy() @ m[:3, :3].T + m[:3, 3]
        for x, m in zip((case.state.positions, after.positions), inverse, strict=True)
    ]
    reach = 0.01 + case.sim.default_parameters().thickness.max().item()
    touching = (np.abs(local[1][:, :2]) < half[:2]).all(axis=1)
    touching &= local[1][:, 2] < half[2] + reach
    return np.linalg.norm((local[1] - local[0])[touching, :2], axis=1)


def _matrix(pose):
    columns = transform(np.vstack([np.eye(3), np.zeros(3)]), pose)
    result = np.eye(4)
    result[:3, :3] = (columns[:3] - columns[3]).T
    result[:3, 3] = columns[3]
    return result


def test_regimes_stick_and_slide_as_named():
    case = scenes.regime("sticking")
    after = case.step()
    slip = contact_slip(case, after)
    limit = case.sim.default_parameters().slip_velocity.item() * scenes.DT
    assert len(slip) >= 4
    assert 1e-5 < slip.max() < limit
    for name in ("sliding", "separating", "thick"):
        case = scenes.regime(name)
        slip = contact_slip(case, case.step())
        assert len(slip) >= 4
        assert slip.min() > case.sim.default_parameters().slip_velocity.item() * scenes.DT


@pytest.mark.parametrize("name", [n for n in scenes.REGIMES if n not in (*ZERO, "leaving")])
def test_contact_acts(name):
    """Bodies, or cloths without bodies, have contact, also before the step: friction acts too."""
    case = scenes.regime(name)
    after = case.step()
    assert after.report.converged
    assert after.report.contact_count >= (1 if name == "poking" else 20)
    if len(after.body_forces):
        assert after.body_forces.abs().max() > 1e-2
        tangential = after.body_forces.sum(dim=0)[:2].norm()
        assert tangential > 1e-3
    frozen = case.where(parameters={"friction": torch.zeros((), dtype=F64)}).step()
    assert (frozen.positions - after.positions).abs().max() > 1e-6  # [m]


def test_separating_contacts_leave():
    case = scenes.regime("separating")
    after = case.step()
    v = case.state.velocities
    still = case.where(state=case.state.replace(velocities=torch.zeros_like(v))).step()
    assert 0 < after.report.contact_count < still.report.contact_count


def test_landing_and_leaving_have_contact_at_one_end_only():
    for name, before, after in (("landing", False, True), ("leaving", True, False)):
        case = scenes.regime(name)
        still = torch.zeros_like(case.state.velocities)
        weightless = {"gravity": torch.zeros(3, dtype=F64)}
        start = case.where(
            state=case.state.replace(velocities=still), control={}, parameters=weightless
        ).step()
        assert (start.body_forces.abs().max() > 0) == before
        assert (case.step().report.contact_count > 0) == after


def test_a_pinned_vertex_is_in_contact():
    case = scenes.regime("pinned")
    after = case.step()
    frame = np.linalg.inv(_matrix(after.body_poses[0].numpy()))
    pin = frame[:3, :3] @ after.positions[14].numpy() + frame[:3, 3]
    half = np.array(case.sim.scene.bodies[0].vertices).max(axis=0)
    assert (np.abs(pin[:2]) < half[:2]).all()
    assert 0 < pin[2] - half[2] < 0.95 * case.sim.default_parameters().barrier_distance.item()


def test_free_flight_is_free():
    for name in ZERO:
        assert scenes.regime(name).step().report.contact_count == 0


@pytest.mark.parametrize("name", ["pushing", "stacked"])
def test_some_edges_in_contact_are_nearly_parallel(name):
    """The mollifier of edge-edge contacts acts on these edges."""
    case = scenes.regime(name)
    after = case.step()
    assembly = case.sim._assembly
    bodies = [
        transform(np.array(b.vertices), pose)
        for b, pose in zip(case.sim.scene.bodies, after.body_poses.numpy(), strict=True)
    ]
    x = np.concatenate([after.positions.numpy(), *bodies])
    rest = np.concatenate([assembly.rest_positions, assembly.body_vertices])
    faces = np.concatenate([assembly.faces, assembly.body_faces + len(assembly.vertices)])
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges = np.unique(ends, axis=0)
    u = x[edges[:, 1]] - x[edges[:, 0]]
    length_sq = ((rest[edges[:, 1]] - rest[edges[:, 0]]) ** 2).sum(axis=1)
    q = (np.cross(u[:, None], u[None]) ** 2).sum(axis=-1) / (length_sq[:, None] * length_sq)
    parameters = case.sim.default_parameters()
    reach = parameters.barrier_distance.item() + parameters.thickness.mean().item()
    found = [
        (i, j)
        for i, j in np.argwhere((q < 1e-3) & (q > 1e-6))
        if i < j
        and not set(edges[i]) & set(edges[j])
        and edges[i, 0] < len(assembly.vertices)
        and ipctk.edge_edge_distance(*x[edges[i]], *x[edges[j]]) < (0.95 * reach) ** 2
    ]
    assert found


# --- Gradients -----------------------------------------------------------------------------------


COUPLED, ELASTIC = ("coupled", None), ("split", "elastic")
MASS, IDENTITY = ("split", "mass"), ("split", "identity")
ENERGY = ("split", "energy")
QUICK = [
    ("hanging", COUPLED, 2),
    ("curved", ELASTIC, 2),
    ("hinge", IDENTITY, 2),
    ("sticking", COUPLED, 2),
    ("sliding", COUPLED, 1),
    ("sliding", IDENTITY, 2),
    ("sliding", ELASTIC, 2),
    ("sliding", ENERGY, 2),
    ("separating", MASS, 1),
    ("landing", COUPLED, 2),
    ("leaving", COUPLED, 1),
    ("thick", COUPLED, 2),
    ("pushing", COUPLED, 3),
    ("pinned", MASS, 2),
    ("pinned", ELASTIC, 2),
    ("held", COUPLED, 2),
    ("folded", ELASTIC, 2),
    ("folded", ENERGY, 2),
    ("folded_thick", COUPLED, 2),
    ("stacked", COUPLED, 2),
    ("dragged", COUPLED, 2),
    ("poking", COUPLED, 2),
    ("woven", COUPLED, 2),
    ("woven_flat", ELASTIC, 2),
    ("woven_pinned", COUPLED, 2),
    ("woven_pinned", ENERGY, 2),
    ("woven_pinned", MASS, 1),
    ("woven_stacked", COUPLED, 2),
    ("woven_stacked", ELASTIC, 2),
]
ALL = [
    (name, scheme, iterations)
    for name in scenes.REGIMES
    for scheme in (COUPLED, ENERGY, ELASTIC, MASS, IDENTITY)
    for iterations in (1, 2)
    # Without contact at the end, only the friction of the first solve acts.
    if name != "leaving" or (scheme, iterations) == (COUPLED, 1)
]
SLOW = [case for case in ALL if case not in QUICK]


def identify(value):
    return "-".join(filter(None, value)) if isinstance(value, tuple) else str(value)


@pytest.mark.quick(
    "hanging-*",
    "curved-*",
    "hinge-*",
    "sliding-coupled-*",
    "sliding-split-energy-*",
    "separating-*",
    "pinned-split-elastic-*",
    "held-*",
    "folded-*",
    "stacked-*",
    "poking-*",
    "woven-*",
    "woven_pinned-split-mass-*",
)
@pytest.mark.parametrize(
    ("name", "scheme", "iterations"),
    [*QUICK, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)],
    ids=identify,
)
def test_every_gradient_is_that_of_the_step(name, scheme, iterations):
    case = scenes.regime(name, *scheme, iterations)
    free = name in ZERO
    zero = ZERO.get(name, ())
    if name == "landing" and iterations == 1:
        zero = ("parameters.friction",)  # no contact at the start to lag friction at
    if not free and name != "sticking":
        # Sliding friction does not depend on the slip velocity; the schemes differ in who slides.
        slip = gradients(case, make_loss(case))["parameters.slip_velocity"]
        zero += () if slip.any() else ("parameters.slip_velocity",)
    check(case, FREE if free else CONTACT, zero=zero)


@pytest.mark.parametrize("output", range(3), ids=["positions", "velocities", "body_forces"])
def test_a_single_output_has_its_gradient(output):
    """Single outputs: the error of a small output cannot hide behind a large one."""
    case = scenes.regime("pinned", "coupled", None, 2)
    weights = [0.0, 0.0, 0.0]
    weights[output] = 1.0
    check(
        case,
        CONTACT,
        weights=weights,
        only=(
            "state.positions",
            "state.body_poses",
            "control.pins",
            "control.body_poses",
            "parameters.friction",
            "parameters.barrier_stiffness",
            "parameters.thickness",
            "parameters.density",
        ),
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hanging", "sticking", "pushing", "folded"])
def test_every_entry_passes_gradcheck(name):
    case = scenes.regime(name)
    names = ("state.positions", "state.velocities", "state.body_poses", "control.forces")
    inputs = {k: t.clone().requires_grad_() for k, t in case.inputs().items() if k in names}

    def outputs(*tensors):
        after = case.step(dict(zip(inputs, tensors, strict=True)))
        return after.positions, scenes.DT * after.velocities, 0.01 * after.body_forces

    assert torch.autograd.gradcheck(outputs, list(inputs.values()), eps=3e-7, atol=1e-7, rtol=1e-5)


def test_coarser_parameters_get_the_sums_of_finer_ones():
    """[] and [C] of every material against [F], pair friction against one value."""
    case = scenes.regime("stacked")
    sim, loss = case.sim, make_loss(case)
    faces = [len(cloth.faces) for cloth in sim.scene.cloths]
    uniform = {
        "stretch": 280.0, "bending": 1e-3, "poisson": 0.2, "density": 0.3, "damping": 0.001,
        "normal_drag": 1.2, "tangential_drag": 0.1,
    }  # fmt: skip
    groups = torch.cat([torch.full((n,), c) for c, n in enumerate(faces)])

    def found(shape):
        values = {k: torch.full(shape, v, dtype=F64) for k, v in uniform.items()}
        return gradients(case.where(parameters=values), loss)

    scalar, cloth, face = found(()), found((2,)), found((sum(faces),))
    for name in uniform:
        key = f"parameters.{name}"
        sums = torch.stack([face[key][groups == c].sum() for c in range(2)])
        assert (sums != 0).all()
        torch.testing.assert_close(cloth[key], sums, rtol=1e-9, atol=0)
        torch.testing.assert_close(scalar[key], sums.sum(), rtol=1e-9, atol=1e-16)

    pair = gradients(case.where(parameters={"friction": torch.full((2, 2), 0.5, dtype=F64)}), loss)[
        "parameters.friction"
    ]
    one = gradients(case.where(parameters={"friction": torch.tensor(0.5, dtype=F64)}), loss)
    torch.testing.assert_close(one["parameters.friction"], pair.sum(), rtol=1e-9, atol=1e-16)
    assert pair[0, 1] == pair[1, 0] != 0

    both = gradients(
        case.where(parameters={"pin_stiffness": torch.tensor([50.0, 50.0], dtype=F64)}), loss
    )["parameters.pin_stiffness"]
    one = gradients(case.where(parameters={"pin_stiffness": torch.tensor(50.0, dtype=F64)}), loss)
    torch.testing.assert_close(one["parameters.pin_stiffness"], both.sum(), rtol=1e-9, atol=1e-16)
    assert both.all()


def test_a_parameter_of_zero_has_its_gradient():
    """Without damping, bending, friction and drag, their gradients are one-sided."""
    case = scenes.regime("pushing", "coupled", "mass", 2)
    names = ("damping", "bending", "friction", "normal_drag", "tangential_drag")
    check(
        case.where(parameters={name: torch.zeros((), dtype=F64) for name in names}),
        CONTACT,
        only=[f"parameters.{name}" for name in names if name != "bending"],
    )


def test_the_length_and_sign_of_a_quaternion_do_not_matter():
    case = scenes.regime("pushing")
    poses = case.control["body_poses"]
    other = poses.clone()
    other[:, 3:] *= -2.0
    loss = make_loss(case)
    name = "control.body_poses"
    gradient = gradients(case, loss)[name]
    scaled = gradients(case.where(control={**case.control, "body_poses": other}), loss)[name]
    torch.testing.assert_close(scaled[:, :3], gradient[:, :3], rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(-2.0 * scaled[:, 3:], gradient[:, 3:], rtol=1e-8, atol=1e-9)
    assert abs(float((gradient[0, 3:] * poses[0, 3:]).sum())) < 1e-12 * float(gradient.norm())


@pytest.mark.parametrize(("name", "largest"), [("curved", 1e-2), ("sticking", 3e-2)])
def test_taylor_remainder_is_of_second_order(name, largest):
    """Over more than three decades, along one direction in all inputs."""
    case = scenes.regime(name)
    loss = make_loss(case)
    inputs = case.inputs()
    g = torch.Generator().manual_seed(3)
    # Units of the inputs, by which the solution changes comparably.
    unit = {k: STEPS.get(k, RELATIVE_STEP * t.abs().max().item()) for k, t in inputs.items()}
    d = {
        k: 20.0 * unit[k] * torch.randn(t.shape, dtype=F64, generator=g) for k, t in inputs.items()
    }
    d["parameters.thickness"] = d["parameters.thickness"].abs()
    d["parameters.damping"] = d["parameters.damping"].abs()
    found = gradients(case, loss)
    slope = sum(float((found[k] * d[k]).sum()) for k in d if found[k] is not None)
    sizes = largest * 100 ** -np.linspace(0.0, 2.0, 9)
    remainders = []
    for size in sizes:
        with torch.no_grad():
            change = loss(case.step({k: t + size * d[k] for k, t in inputs.items()})).item()
        remainders.append(abs(change - size * slope))
    above = np.array(remainders) > 1e-15  # rounding of the loss
    assert above[:7].all()
    order = np.polyfit(np.log(sizes[above]), np.log(np.array(remainders)[above]), 1)[0]
    assert order == pytest.approx(2.0, abs=0.1), remainders


def test_a_body_that_only_turns_has_a_gradient_beyond_one_portion():
    """The path is cut in portions of ten degrees; the gradient knows only its ends."""
    case = scenes.regime("poking")
    a, b = case.state.body_poses[0, 3:], case.control["body_poses"][0, 3:]
    cosine = float((a @ b).abs() / (a.norm() * b.norm()))
    assert np.degrees(2 * np.arccos(cosine)) > 20


def test_a_cloth_elsewhere_changes_no_derivative_by_the_rest_shape():
    """A corner presses a face of the cloth: its weight is the mean area of that cloth's faces."""
    case = scenes.poking()
    (cloth,), (box,) = case.sim.scene.cloths, case.sim.scene.bodies
    elsewhere = dc.Cloth.grid(3, 3, size=(0.3, 0.3), pose=[9, 0, 0, 1, 0, 0, 0])
    both = scenes.simulator([elsewhere, cloth], [box])
    start, generator = both.initial_state(), torch.Generator().manual_seed(3)
    state = start.replace(
        positions=torch.cat([start.positions[:9], case.state.positions]),
        velocities=torch.cat([start.velocities[:9], case.state.velocities]),
        body_poses=case.state.body_poses,
    )
    weights, direction = torch.randn(2, 36, 3, dtype=F64, generator=generator)
    found = []
    for sim, begin in ((case.sim, case.state), (both, state)):
        rest = sim.default_parameters().rest_positions

        def loss(own, sim=sim, begin=begin, rest=rest):
            given = sim.default_parameters().replace(rest_positions=torch.cat([rest[:-36], own]))
            after = sim.step(begin, dc.Control(**case.control), given)
            return (weights * (after.positions[-36:] - case.state.positions)).sum()

        own = rest[-36:].clone().requires_grad_()
        value = loss(own)
        (gradient,) = torch.autograd.grad(value, own)
        _, change = torch.func.jvp(loss, (rest[-36:],), (direction,))
        found.append((value, gradient, change))
    for alone, joined in zip(*found, strict=True):
        torch.testing.assert_close(joined, alone, rtol=1e-7, atol=1e-9)


def test_friction_iterations_change_the_step():
    """Premise: tests of gradients through friction iterations need an effect of the iterations."""
    one, two, three = (scenes.regime("pushing", "coupled", "mass", k) for k in (1, 2, 3))
    values = one.inputs()
    x1, x2, x3 = (case.step(values).positions for case in (one, two, three))
    assert (x1 - x2).abs().max() > 1e-5
    assert 1e-7 < (x2 - x3).abs().max() < (x1 - x2).abs().max()


def test_a_landing_sheet_has_friction_in_the_same_step():
    """No contact at the start: the second solve lags friction at the end of the first."""
    one, two = (scenes.regime("landing", friction_iterations=k) for k in (1, 2))
    values = one.inputs()
    a, b = (case.step(values).contact_forces for case in (one, two))
    assert (a - b).abs().max() > 0.01 * a.abs().max()


def test_scenes_are_differentiable_in_everything():
    """These tests cover every input."""
    sim = scenes.regime("woven_pinned").sim
    parameters = {
        k for k, v in vars(sim.default_parameters()).items() if isinstance(v, torch.Tensor)
    }
    seen = {name for regime in scenes.REGIMES for name in scenes.regime(regime).inputs()}
    assert seen == {
        *(f"state.{name}" for name in scenes.STATE),
        *(f"control.{name}" for name in scenes.CONTROL),
        *(f"parameters.{name}" for name in parameters),
    }
    # tests/bodies/test_gradients.py covers bodies and robots in motion;
    # test_attachment_gradients.py covers attachments.
    elsewhere = {n for n, q in PARAMETERS.items() if {"K", "L", "J", "A"} & set(q.axes[-1])}
    assert parameters | elsewhere == set(PARAMETERS)
