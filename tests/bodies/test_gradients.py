"""Gradients of a whole chain of steps with cloth, body and robot in contact with friction."""

import coupled_scenes
import pytest
import torch
from coupled_scenes import BASES, COUPLINGS, F64
from differences import difference

pytestmark = pytest.mark.filterwarnings("ignore::diffcloth_torch.AddedMassWarning")

# Length of the perturbation of each input; for parameters, relative to their values.
SCALES = {
    "state": {
        "positions": 2e-5,
        "velocities": 1e-2,
        "body_poses": 1e-4,
        "body_velocities": 1e-2,
        "joint_positions": 1e-4,
        "joint_velocities": 1e-2,
        "base_poses": 2e-5,
        "base_velocities": 1e-2,
    },
    "control": {
        "forces": 1e-4,
        "soft_pins": 1e-4,
        "body_wrenches": 1e-3,
        "joint_positions": 1e-4,
        "joint_velocities": 1e-2,
        "joint_efforts": 1e-2,
        "base_wrenches": 1e-2,
        "base_poses": 2e-5,
    },
    "cloth": {"stretch": 0.1, "density": 0.1, "friction": 0.1, "barrier_stiffness": 0.05},
    "bodies": {
        "body_mass": 0.1,
        "body_center": 1e-4,
        "body_inertia": 0.1,
        "link_mass": 0.1,
        "link_center": 1e-4,
        "link_inertia": 0.1,
        "joint_stiffness": 0.1,
        "joint_damping": 0.1,
        "joint_viscosity": 0.1,
        "joint_armature": 0.1,
        "joint_effort_limits": 0.1,
        "joint_velocity_limits": 0.1,
        "joint_friction": 0.1,
        "joint_slip_rates": 0.1,
    },
}
# Inputs without effect: the fingers slide, and forces on a base that does not float are refused.
NOTHING = {
    "fixed": {
        "state": ("base_velocities",),
        "control": ("base_wrenches", "base_poses"),
        "bodies": ("link_center", "link_inertia"),
    },
    "kinematic": {"control": ("base_wrenches",), "bodies": ("link_inertia",)},
    "floating": {"control": ("base_poses",)},
}
ADDED = ("body_center", "link_center")

# Smaller derivatives, such as by velocities of links that are prescribed in the next step, are
# below the noise of the solves.
RESOLVED = 1e-6
# Steps of the difference quotients relative to the lengths in SCALES; the best result counts.
SWEEP = (1e-3, 2e-4, 4e-5, 5e-3, 8e-6)

SLOW = pytest.mark.slow
CASES = [(c, b) for c in COUPLINGS for b in (*BASES, "kinematic")]


class Chain:
    """The weighted end of a rollout, as a function of inputs of one kind."""

    def __init__(self, coupling, base, steps):
        self.sim, self.start = coupled_scenes.in_contact(coupling, base)
        self.steps = steps
        self.given = {
            "state": self.start,
            "control": coupled_scenes.control(self.sim),
            "cloth": coupled_scenes.parameters(self.sim),
        }
        with torch.no_grad():
            self.end = self._roll(self.given)
        g = torch.Generator().manual_seed(7)
        self.weights = {
            name: scale * torch.randn(getattr(self.end, name).shape, dtype=F64, generator=g)
            for name, scale in {
                "positions": 1.0,
                "velocities": 0.01,
                "body_poses": 1.0,
                "body_velocities": 0.01,
                "body_forces": 0.01,
                "joint_positions": 1.0,
                "joint_velocities": 0.01,
                "joint_efforts": 0.01,
                "base_poses": 1.0,
                "base_velocities": 0.01,
            }.items()
        }

    def _roll(self, given):
        controls = coupled_scenes.controls(
            self.sim, given["control"], self.steps, coupled_scenes.WARM_UP
        )
        return self.sim.rollout(given["state"], controls, given["cloth"])[-1]

    def inputs(self, kind, base):
        names = [n for n in SCALES[kind] if n not in NOTHING[base].get(kind, ())]
        return {name: getattr(self.given[owner(kind)], name) for name in names}

    def loss(self, kind, inputs):
        changed = self.given[owner(kind)].replace(**inputs)
        end = self._roll({**self.given, owner(kind): changed})
        return sum(
            (weight * (getattr(end, name) - getattr(self.end, name))).sum()
            for name, weight in self.weights.items()
        )

    def direction(self, kind, name, x, generator):
        d = SCALES[kind][name] * torch.randn(x.shape, dtype=F64, generator=generator)
        if name in ("body_inertia", "link_inertia"):
            moments = x.diagonal(dim1=-2, dim2=-1)
            return d * (moments[..., :, None] * moments[..., None, :]).sqrt()
        return d if owner(kind) != "cloth" or name in ADDED else d * x

    def mismatch(self, kind, inputs, names, seed=0):
        """Error of the derivative along one direction of all `names`, against its terms."""
        leaves = {n: x.clone().requires_grad_() for n, x in inputs.items() if n in names}
        gradients = torch.autograd.grad(
            self.loss(kind, {**inputs, **leaves}), list(leaves.values())
        )
        g = torch.Generator().manual_seed(seed)
        d = {name: self.direction(kind, name, inputs[name], g) for name in leaves}
        terms = torch.stack(
            [(gradient * d[n]).sum() for n, gradient in zip(leaves, gradients, strict=True)]
        )
        assert terms.all()

        def value(t):
            moved = {n: inputs[n] + t * d[n] for n in leaves}
            with torch.no_grad():
                return self.loss(kind, {**inputs, **moved}).item()

        zero, one = torch.zeros((), dtype=F64), torch.ones((), dtype=F64)
        best = float("inf")
        for step in SWEEP:
            found = difference(value, zero, one, step)
            size = max(float(terms.norm()), RESOLVED)
            best = min(best, abs(found - float(terms.sum())) / size)
            if best < 1e-6:
                break
        return best


def owner(kind):
    """Name of the step's argument that holds inputs of this kind."""
    return "cloth" if kind == "bodies" else kind


@pytest.mark.quick(
    "monolithic-fixed-5-state",
    "monolithic-floating-5-state",
    "monolithic-kinematic-5-state",
    "rigid_to_cloth-fixed-5-state",
    "rigid_to_cloth-floating-5-state",
    "rigid_to_cloth-kinematic-5-state",
    "cloth_to_rigid-fixed-5-state",
    "cloth_to_rigid-floating-5-state",
    "cloth_to_rigid-kinematic-5-state",
)
@pytest.mark.parametrize("kind", list(SCALES))
@pytest.mark.parametrize(
    ("coupling", "base", "steps"),
    [
        *((coupling, base, 5) for coupling, base in CASES),
        *(pytest.param(coupling, base, 20, marks=SLOW) for coupling, base in CASES),
    ],
)
def test_the_gradient_of_a_chain_is_that_of_differences(coupling, base, steps, kind):
    """All inputs of a kind are perturbed at once: any wrong part of the gradient shows."""
    chain = Chain(coupling, base, steps)
    inputs = chain.inputs(kind, base)
    assert chain.mismatch(kind, inputs, list(inputs)) < 1e-5


@SLOW
@pytest.mark.parametrize(("coupling", "base"), CASES)
@pytest.mark.parametrize("kind", list(SCALES))
def test_the_gradient_by_each_input_is_that_of_differences(coupling, base, kind):
    chain = Chain(coupling, base, 5)
    inputs = chain.inputs(kind, base)
    errors = {name: chain.mismatch(kind, inputs, [name]) for name in inputs}
    assert not {name: error for name, error in errors.items() if not error < 1e-5}


@pytest.mark.parametrize(("coupling", "base"), [(c, "fixed") for c in COUPLINGS])
def test_the_stiffness_of_each_pair_has_its_gradient(coupling, base):
    chain = Chain(coupling, base, 3)
    given = chain.given["cloth"]
    count = len(chain.sim.surfaces)
    steps = torch.arange(count**2, dtype=F64).reshape(count, count) / count**2
    stiffness = given.barrier_stiffness * (0.9 + 0.2 * steps)
    chain.given["cloth"] = given.replace(barrier_stiffness=stiffness)
    inputs = {"barrier_stiffness": stiffness}
    leaf = stiffness.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(chain.loss("cloth", {"barrier_stiffness": leaf}), leaf)
    names = chain.sim.surfaces
    touching = {(names[i], names[j]) for i, j in gradient.nonzero().tolist() if i < j}
    fingers = "hand/left_finger", "hand/right_finger"
    assert touching == {fingers, *(("cloth0", other) for other in ("box", *fingers))}
    assert torch.equal(gradient, gradient.T)
    # Perturb only entries of touching pairs, where every term counts.
    chain.direction = lambda kind, name, x, g: (
        0.05 * x * (gradient != 0) * torch.randn(x.shape, dtype=F64, generator=g)
    )
    for seed in range(3):
        assert chain.mismatch("cloth", inputs, list(inputs), seed) < 1e-5


@pytest.mark.parametrize(("coupling", "base"), CASES)
def test_everything_touches_and_rubs_along_the_whole_chain(coupling, base):
    """Premise of the other tests: without contact and friction they would prove little."""
    sim, start = coupled_scenes.in_contact(coupling, base)
    controls = coupled_scenes.controls(sim, coupled_scenes.control(sim), 15, coupled_scenes.WARM_UP)
    for state in sim.rollout(start, controls, coupled_scenes.parameters(sim)):
        wrenches = sim.contact_wrenches(state)
        for name in ("box", "hand/left_finger", "hand/right_finger"):
            assert wrenches[name][:3].norm() > 3e-3
            assert wrenches[name][:2].norm() > 1e-3
