"""Steps of the core on named arrays, and their derivatives by named inputs."""

from collections.abc import Callable

import numpy as np
import scenes
import torch

TOLERANCE = 1e-11
OUTPUTS = (
    "positions",
    "velocities",
    "body_forces",
    "contact_forces",
    "pin_forces",
    "coordinates",
)


class Spy:
    """A core that records the inputs of its last step."""

    def __init__(self, core):
        self.core, self.inputs = core, {}

    def __getattr__(self, name):
        return getattr(self.core, name)

    def forward(self, inputs, *rest):
        self.inputs = {name: np.array(values) for name, values in inputs.items()}
        return self.core.forward(inputs, *rest)


def inputs_of(sim, step: Callable[[], object]):
    """The core, and its inputs during a call of step(), including the rest shape."""
    spy = Spy(sim._engine.core)
    sim._engine.core = spy
    try:
        with torch.no_grad():
            step()
    finally:
        sim._engine.core = spy.core
    rest = sim.default_parameters().rest_positions.detach().numpy()[None]
    return spy.core, {"rest_positions": rest, **spy.inputs}


def tape_of(result):
    return {name: values for name, values in result.items() if name.startswith("tape_")}


def outputs_of(result):
    return {name: result[name] for name in OUTPUTS if name in result}


def directions(inputs):
    """One tangent per input, zero for the others: names and tangents [K, 1, ..]."""
    names = [name for name, values in inputs.items() if values.size]
    tangents = {}
    for k, name in enumerate(names):
        tangents[name] = np.zeros((len(names), *inputs[name].shape))
        tangents[name][k] = scenes.noise(inputs[name].shape, 1.0, 10 + k)
    return names, tangents


def losses(result):
    """One cotangent per output, zero for the others."""
    outputs = {name: values for name, values in outputs_of(result).items() if values.size}
    cotangents = {
        name: np.zeros((len(outputs), *values.shape)) for name, values in outputs_of(result).items()
    }
    for k, (name, values) in enumerate(outputs.items()):
        cotangents[name][k] = scenes.noise(values.shape, 1.0, 50 + k)
    return list(outputs), cotangents


def check_pairs(core, inputs, result, tolerance=TOLERANCE):
    """<u, J v> = <J^T u, v> for each input alone and each output alone.

    A pair may be off by the rounding of its own sum, and by the effect of the solution's rounding
    on the output: this effect is bounded by the input with the largest effect per cloth motion.

    Returns:
        The outputs that change with some input.
    """
    names, tangents = directions(inputs)
    outputs, cotangents = losses(result)
    tape, kept = tape_of(result), result["kept"]
    forward = core.tangent(inputs, tape, kept, tangents, len(names), 2)
    backward = core.backward(inputs, tape, kept, cotangents, len(outputs), names, 2)
    motion = np.abs(forward["positions"]).max(axis=(1, 2, 3))
    for m, out in enumerate(outputs):
        products = cotangents[out][m] * forward[out]
        sizes = np.abs(products).reshape(len(names), -1).sum(axis=1)
        gain = max(s / x for s, x in zip(sizes, motion, strict=True) if x > 0)
        for k, of in enumerate(names):
            others = backward[of][m] * tangents[of][k]
            scale = max(sizes[k], np.abs(others).sum(), gain * motion[k])
            error = abs(products[k].sum() - others.sum())
            assert error <= tolerance * scale, (of, out, error / scale)
    return {out for out in outputs if np.abs(forward[out]).max() > 0}
