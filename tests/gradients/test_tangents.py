"""Tangents of a step against its gradients, <u, J v> = <J^T u, v>, and against differences.

The core computes both: each input of a step has a tangent, each output a cotangent.
"""

from functools import cache

import core_steps
import numpy as np
import pytest
import scenes
import test_attachment_gradients as attachments
import test_body_gradients
import torch
from bodies import coupled_scenes
from bodies import test_core_gradients as mechanisms
from core_steps import check_pairs, directions, inputs_of, outputs_of, tape_of
from projective import nodal_scenes

import diffcloth_torch as dc
from diffcloth_torch.geometry.poses import transform


def regime(name, scheme="coupled", metric=None, friction_iterations=2, elastic="newton"):
    case = scenes.regime(name, scheme, metric, friction_iterations)
    if elastic != "newton":
        solver = dc.SolverOptions(
            tolerance=scenes.TOLERANCE, metric=metric, elastic=elastic, max_iterations=1000
        )
        sim = dc.Simulator(
            case.sim.scene, case.sim.dt, scheme=scheme, contact=case.sim.contact, solver=solver
        )
        case = case.where(sim=sim)
    return inputs_of(case.sim, case.step)


def with_origins(name, scheme="coupled"):
    """Friction counts motion from elsewhere than the start."""
    core, inputs = regime(name, scheme)
    case = scenes.regime(name, scheme)
    vertices = [inputs["positions"][0]]
    for body, pose in zip(case.sim.scene.bodies, inputs["body_poses"][0], strict=True):
        vertices.append(transform(np.array(body.vertices), pose))
    origins = np.concatenate(vertices)[None]
    return core, inputs | {"friction_origins": origins + scenes.noise(origins.shape, 1e-4, 3)}


def attached(make, scheme):
    case = make(**attachments.SCHEMES[scheme])
    return inputs_of(case.sim, case.step)


def on_body(name):
    case = test_body_gradients.resting(name, moving=True)
    return inputs_of(case.sim, case.step)


def hanging_at_a_box():
    sim, weights = attachments.hanging_at_free_box()
    state = attachments.moving(sim)
    targets = torch.zeros(1, 3, dtype=torch.float64)
    control = dc.Control(attachment_weights=weights, attachments=targets)
    return inputs_of(sim, lambda: sim.step(state, control))


def at_nodes(kind, case, scheme="projective", solver=None):
    step = nodal_scenes.on_body(kind, case, scheme=scheme, **(solver or {}))
    return inputs_of(step.sim, step)


def at_pairs(friction):
    step = nodal_scenes.stacked(friction=friction)
    return inputs_of(step.sim, step)


def with_joints(name):
    scene, arrays = mechanisms.CASES[name]()
    return scene.core, arrays


def with_a_robot(base):
    sim, state = coupled_scenes.in_contact("monolithic", base)
    parameters = coupled_scenes.parameters(sim)
    return inputs_of(sim, lambda: sim.step(state, coupled_scenes.control(sim), parameters))


METRICS = ["energy", "elastic", "mass", "identity"]
STEPS = {
    **{f"coupled-{name}": (regime, name) for name in scenes.REGIMES},
    **{
        f"coupled-{name}-{k}": (regime, name, "coupled", None, k)
        for name in ("sliding", "landing", "folded", "pushing")
        for k in (1, 3, 4)
    },
    **{
        f"split-{metric}-{name}": (regime, name, "split", metric)
        for name in ("curved", "pinned", "folded_thick", "pushing", "woven_pinned")
        for metric in METRICS
    },
    **{
        f"split-{metric}-{name}-projective": (regime, name, "split", metric, 3, "projective")
        for name in ("hanging", "pinned", "woven_pinned")
        for metric in ("energy", "elastic")
    },
    **{
        f"projective-{name}": (regime, name, "projective")
        for name in ("hanging", "curved", "hinge", "woven")
    },
    **{f"{make.__name__}-{scheme}": (attached, make, scheme) for make, scheme in attachments.CASES},
    **{
        f"origins-{scheme}-{name}": (with_origins, name, scheme)
        for scheme in ("coupled", "split")
        for name in ("pushing", "stacked")
    },
    **{
        f"nodes-{kind}-{case}": (at_nodes, kind, case)
        for kind in nodal_scenes.BODIES
        for case in nodal_scenes.CASES
    },
    **{
        f"nodes-split-{metric}-{elastic}": (
            *(at_nodes, "box", "slipping", "split"),
            {"metric": metric, "elastic": elastic},
        )
        for metric in METRICS
        for elastic in ("newton", "projective")
    },
    **{f"pairs-{friction}": (at_pairs, friction) for friction in (0.05, 2.0)},
    **{f"joints-{name}": (with_joints, name) for name in mechanisms.CASES},
    "hanging_at_a_box": (hanging_at_a_box,),
    **{f"on-{name}": (on_body, name) for name in test_body_gradients.SMOOTH},
    **{f"robot-{base}": (with_a_robot, base) for base in ("fixed", "floating", "kinematic")},
}


@cache
def taken(name):
    """Core, inputs and outputs of a step, with a tape."""
    make, *arguments = STEPS[name]
    core, inputs = make(*arguments)
    result = core.forward(inputs, True, 2)
    assert result["message"] == [""]
    return core, inputs, result


@pytest.mark.parametrize("name", STEPS)
def test_tangents_are_the_transpose_of_gradients(name):
    # GMRES ends at a residual of 1e-12 of the right side, the other solves at rounding.
    tolerance = 3e-11 if name.startswith("nodes") else 1e-11
    moved = check_pairs(*taken(name), tolerance)
    assert {"positions", "velocities"} <= moved


@pytest.mark.parametrize("name", ["coupled-pinned", "split-elastic-pinned", "robot-floating"])
def test_forgotten_factors_change_no_bit_of_tangents(name):
    core, inputs, result = taken(name)
    names, tangents = directions(inputs)
    fresh = core.forward(inputs, True, 1)
    arguments = (inputs, tape_of(fresh), fresh["kept"], tangents, len(names), 1)
    kept = core.tangent(*arguments)
    core.forget_factors()
    found = core.tangent(*arguments)
    for out in outputs_of(result):
        np.testing.assert_array_equal(found[out], kept[out])


@pytest.mark.parametrize("name", ["coupled-pinned", "split-elastic-folded_thick"])
def test_several_directions_have_the_bits_of_single_ones(name):
    core, inputs, result = taken(name)
    names, tangents = directions(inputs)
    tape, kept = tape_of(result), result["kept"]
    together = core.tangent(inputs, tape, kept, tangents, len(names), 3)
    for k, of in enumerate(names):
        alone = core.tangent(inputs, tape, kept, {of: tangents[of][k : k + 1]}, 1, 1)
        for out in outputs_of(result):
            np.testing.assert_array_equal(together[out][k], alone[out][0])


def test_environments_share_tangents_or_have_their_own():
    core, inputs, _ = taken("coupled-pinned")
    batch = {name: np.concatenate([values] * 3) for name, values in inputs.items()}
    batch["velocities"] += scenes.noise(batch["velocities"].shape, 0.05, 4)
    batch["gravity"] = inputs["gravity"]
    result = core.forward(batch, True, 2)
    tape, kept = tape_of(result), result["kept"]
    own = np.zeros((2, *batch["velocities"].shape))
    own[:, 1:] = scenes.noise(own[:, 1:].shape, 1.0, 5)
    tangents = {"velocities": own, "gravity": np.zeros((2, *inputs["gravity"].shape))}
    tangents["gravity"][1] = [1.0, 2.0, 3.0]
    found = [core.tangent(batch, tape, kept, tangents, 2, threads) for threads in (1, 4)]
    for e in range(3):
        one = {n: v if len(v) == 1 else v[e : e + 1] for n, v in batch.items()}
        single = core.forward(one, True, 1)
        given = {"velocities": own[:, e : e + 1], "gravity": tangents["gravity"]}
        alone = core.tangent(one, tape_of(single), single["kept"], given, 2, 1)
        for out in outputs_of(result):
            for threads in found:
                np.testing.assert_array_equal(threads[out][:, e], alone[out][:, 0])
    assert not found[0]["positions"][0, 0].any()


DIFFERENCES = {  # of each input; the tolerance of the steps is 1e-11 m/s
    "coupled-sticking": {"velocities": 1e-4, "body_targets": 1e-6, "friction": 1e-4},
    "coupled-curved": {"rest_positions": 1e-6, "damping": 1e-6, "pin_targets": 1e-6},
    "split-elastic-folded_thick": {"thickness": 1e-8, "stretch": 1e-2, "positions": 1e-7},
    "robot-floating": {"coordinate_targets": 1e-6, "velocities": 1e-5},
}


@pytest.mark.parametrize("name", DIFFERENCES)
def test_tangents_are_central_differences(name):
    core, inputs, result = taken(name)
    for of, size in DIFFERENCES[name].items():
        move = scenes.noise(inputs[of].shape, 1.0, 7)
        ends = [
            core.forward({**inputs, of: inputs[of] + s * size * move}, False, 1) for s in (1, -1)
        ]
        found = core.tangent(inputs, tape_of(result), result["kept"], {of: move[None]}, 1, 1)
        for out in outputs_of(result):
            change = (ends[0][out] - ends[1][out]) / (2 * size)
            largest = max(np.abs(change).max(initial=0.0), 1e-3)
            np.testing.assert_allclose(
                found[out][0], change, rtol=0, atol=1e-4 * largest, err_msg=f"{of}: {out}"
            )


@pytest.mark.parametrize("name", ["coupled-curved", "coupled-thick", "hanging_at_a_box"])
def test_tangents_of_energies_are_the_transpose_of_gradients(name):
    core, inputs, _ = taken(name)
    names, tangents = directions(inputs)
    parts = list(core.stored_energy(inputs))
    cotangents = {part: np.eye(len(parts))[:, k : k + 1] for k, part in enumerate(parts)}
    forward = core.energy_tangent(inputs, tangents, len(names), 2)
    backward = core.energy_backward(inputs, cotangents, len(parts), names, 2)
    for k, of in enumerate(names):
        alone = core.energy_tangent(inputs, {of: tangents[of][k : k + 1]}, 1, 1)
        for l, part in enumerate(parts):
            others = (backward[of][l] * tangents[of][k]).ravel()
            assert (
                abs(forward[part][k, 0] - others.sum())
                <= core_steps.TOLERANCE * np.abs(others).sum()
            )
            assert alone[part][0, 0] == forward[part][k, 0]
    assert all(np.abs(forward[part]).max() > 0 for part in ("stretch", "bending"))


def test_bad_tangents_are_refused():
    core, inputs, result = taken("coupled-hanging")
    tape, kept = tape_of(result), result["kept"]
    for tangents, message in (
        ({"speed": np.zeros((1, 1, 3))}, "unknown input speed"),
        ({"gravity": np.zeros((2, 1, 3))}, "that of `gravity` must have 1 directions"),
        ({"gravity": np.zeros((1, 1, 4))}, "that of `gravity` must have 1 directions"),
        ({"velocities": np.zeros((1, 2, *inputs["velocities"].shape[1:]))}, "of `velocities`"),
    ):
        with pytest.raises(ValueError, match=message):
            core.tangent(inputs, tape, kept, tangents, 1, 1)
