"""Fits that are saved, loaded and pickled, and how they print."""

from __future__ import annotations

import copy
import pickle
import warnings
from functools import partial

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.checkpoint import write_checkpoint

F64 = torch.float64
RNG = np.random.default_rng(3)
MOMENTS = torch.linspace(0.1, 2.0, 20, dtype=F64)
SEEN = 2.0 * torch.exp(-1.5 * MOMENTS) + 0.01 * torch.from_numpy(RNG.standard_normal(20))
FREE = {
    "a": dc.Variable(1.0, bounds=(0.1, 10.0), prior=(2.0, 0.5)),
    "b": dc.Variable(1.0, scale="log"),
    "twice": dc.Tie("a", 2.0),
    "kept": dc.Variable(0.5, free=False),
}


def decay(parameters, values, factor=1.0):
    found = 0.5 * values["twice"] * torch.exp(-values["b"] * factor * MOMENTS)
    return {"early": ((found - SEEN) / 0.01)[:10], "late": ((found - SEEN) / 0.01)[10:]}


def kept_out(parameters, values):
    return decay(parameters, values)["late"]


@pytest.fixture(scope="module")
def found():
    joint = dc.Prior({"b": 1.5}, [[0.2]])
    return dc.fit(FREE, decay, priors=[joint], starts=2, hold_out=kept_out, covariance="robust")


def same(a, b):
    assert repr(a) == repr(b)
    assert a.intervals == b.intervals
    assert a.blocks == b.blocks
    assert a.held_out == b.held_out
    assert a.noise_model == b.noise_model
    np.testing.assert_array_equal(a.covariance, b.covariance)
    np.testing.assert_array_equal(a.residuals, b.residuals)
    assert [start.apart for start in a.starts] == [start.apart for start in b.starts]
    assert [trial.cost for trial in a.history] == [trial.cost for trial in b.history]
    for name, value in a.values.items():
        assert torch.equal(value, b.values[name]), name


@pytest.mark.parametrize("way", ["file", "pickle"])
def test_a_fit_comes_back_without_its_functions(found, way, tmp_path):
    if way == "file":
        found.save(tmp_path / "fit.pt")
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # warnings of the fit are not repeated
            back = dc.Fit.load(tmp_path / "fit.pt")
    else:
        back = pickle.loads(pickle.dumps(found))
    same(found, back)
    predicted = back.predict(lambda p, v: v["twice"] * v["kept"])
    torch.testing.assert_close(predicted.value, found.values["a"])
    assert back.information(kept_out) == found.information(kept_out)
    finer = partial(decay, factor=0.999)
    one = back.step_bias(finer, max_evaluations=1)
    assert torch.equal(one["b"], found.step_bias(finer, max_evaluations=1)["b"])
    for refused in (
        lambda: back.profile("b"),
        lambda: back.report(tmp_path / "fit.html"),
        lambda: back.step_bias(finer),
    ):
        with pytest.raises(dc.InvalidInput, match="a fit from a file has no residuals"):
            refused()


def test_a_fit_from_a_file_takes_its_residuals_again(found, tmp_path):
    found.save(tmp_path / "fit.pt")
    back = dc.Fit.load(tmp_path / "fit.pt", decay, kept_out)
    assert back.profile("b").interval == found.profile("b").interval
    with pytest.raises(dc.InvalidInput, match="`residuals` must be those of the last stage"):
        dc.Fit.load(tmp_path / "fit.pt", partial(decay, factor=1.1))
    with pytest.raises(dc.InvalidInput, match="`hold_out` needs `residuals`"):
        dc.Fit.load(tmp_path / "fit.pt", hold_out=kept_out)
    with pytest.raises(TypeError, match="`residuals` must be a function, got float"):
        dc.Fit.load(tmp_path / "fit.pt", 1.0)


def test_copies_keep_the_functions(found):
    for other in (copy.copy(found), copy.deepcopy(found)):
        same(found, other)
        assert other.compared == found.compared


def test_a_fit_by_an_optimizer_of_torch_and_one_that_failed_at_a_start(tmp_path):
    def residuals(parameters, values):
        if float(values["x"].detach()) > 2.0:
            raise dc.SimulationError("too fast")
        return (values["x"] - torch.tensor([1.0, 1.1, 0.9], dtype=F64)) / 0.1

    method = partial(torch.optim.Adam, lr=0.1)
    free = {"x": dc.Variable(1.5, bounds=(0.0, 10.0))}
    made = dc.fit(free, residuals, method=method, starts=3, max_evaluations=5, covariance="white")
    assert any(np.isinf(start.cost) for start in made.starts)
    made.save(tmp_path / "fit.pt")
    same(made, dc.Fit.load(tmp_path / "fit.pt"))
    same(made, pickle.loads(pickle.dumps(made)))


def test_files_that_are_no_fit_are_refused(found, tmp_path):
    path = tmp_path / "fit.pt"
    write_checkpoint(path, "training", {})
    with pytest.raises(dc.InvalidInput, match=r"Fit.load: .* of a fit result, got one of a train"):
        dc.Fit.load(path)
    write_checkpoint(path, "fit result", {"variables": {}})
    with pytest.raises(dc.InvalidInput, match=r"Fit.load: .*the content must have the keys"):
        dc.Fit.load(path)
    found.save(path)
    content = bytearray(path.read_bytes())
    content[200] ^= 1
    path.write_bytes(content)
    with pytest.raises(dc.InvalidInput, match="was changed since it was written"):
        dc.Fit.load(path)


def test_shapes_that_do_not_fit_are_refused(found, tmp_path):
    path = tmp_path / "fit.pt"
    found.save(path)
    content = torch.load(path, weights_only=True)
    content["ends"][0]["jacobian"] = content["ends"][0]["jacobian"][:, :1]
    write_checkpoint(path, "fit result", content)
    with pytest.raises(dc.InvalidInput, match=r"start 0\['jacobian'\] must be a tensor \[20, 2\]"):
        dc.Fit.load(path)


def test_a_tie_by_a_function_is_refused_by_name(tmp_path):
    free = {"x": dc.Variable(1.5), "y": dc.Tie("x", lambda x: x**2)}
    made = dc.fit(free, lambda p, v: v["y"][None] - torch.ones(3, dtype=F64), covariance="white")
    with pytest.raises(dc.InvalidInput, match="the tie of 'y' must be by a factor"):
        made.save(tmp_path / "fit.pt")
    assert not list(tmp_path.iterdir())


def test_values_print_six_digits(found):
    b = float(found.values["b"])
    assert f"'b': {b:.6g}" in repr(found.values)
    many = dc.fit(
        {"x": dc.Variable(np.ones((2, 3))), "y": dc.Variable(np.ones(30))},
        lambda p, v: torch.cat([v["x"].flatten(), v["y"]]) / 10 - 1.23456789,
    )
    text = repr(many.values)
    assert "[[12.3457, 12.3457, 12.3457], " in text
    assert "'y': [30] numbers from 12.3457 to 12.3457" in text


def test_undetermined_variables_are_named_in_a_sentence():
    free = {"stretch": dc.Variable(300.0), "bending": dc.Variable(1e-4)}
    seen = torch.tensor([1.0, 1.1, 0.9], dtype=F64)
    made = dc.fit(free, lambda p: p.stretch / 300 - seen + 0 * p.bending, covariance="white")
    first, second = made.lines()
    assert first.startswith("stretch 300, between ")
    assert second == "bending 0.0001, which the observations do not tell"
    assert second in repr(made)
    assert str(made.unidentifiable[0]) == "+1.00 bending (not seen in the observations at all)"


def test_the_page_names_held_out_frames_and_the_size_of_distances(tmp_path):
    cloth = dc.Cloth.grid(2, 2, 0.1)
    sim = dc.Simulator(dc.Scene([cloth]), 0.01, contact=dc.ContactOptions(self_contact=False))
    start = sim.initial_state()
    seen = sim.rollout(start, steps=3).positions.numpy()
    seen = seen + 1e-3 * np.random.default_rng(0).standard_normal(seen.shape)

    def residuals(parameters):
        states = sim.rollout(start, parameters=parameters, steps=3)
        return {"fall": dc.residuals.markers(states, seen, noise=1e-3)}

    free = {"gravity": dc.Variable([0.0, 0.0, -9.0])}
    made = dc.fit(free, residuals, hold_out=residuals, covariance="white")
    made.report(tmp_path / "fit.html")
    text = (tmp_path / "fit.html").read_text()
    assert "Fitted: fall (markers)" in text
    assert "Kept out of the fit: fall (markers)" in text
    assert "sqrt(3) times as much, 1.73 mm, for a distance" in text
