"""What the first version wrote still loads: imports, pickles, saved states."""

import importlib
import pickle
from pathlib import Path

import pytest
import torch
from processes import run_python

import diffcloth_torch as dc
from diffcloth_torch._moved import MOVED

SAVED = Path(__file__).parent / "data" / "first_version"  # by save.py there


def load_pickle():
    return pickle.loads(SAVED.with_suffix(".pkl").read_bytes())


@pytest.mark.parametrize("old", MOVED)
def test_an_old_path_is_the_module_at_the_new_one(old):
    new = importlib.import_module(MOVED[old])
    assert importlib.import_module(old) is new
    assert new.__name__ == new.__spec__.name == MOVED[old]
    # What is reached by attributes, as in dc.scene.Scene, is the same.
    parent, _, name = old.rpartition(".")
    assert getattr(importlib.import_module(parent), name) is new


def test_old_paths_stand_in_any_order_of_imports():
    code = (
        "from diffcloth_torch.io.ply import read_ply as a\n"
        "from diffcloth_torch.bodies import rotation as b\n"
        "from diffcloth_torch.geometry.ply import read_ply as c\n"
        "from diffcloth_torch.geometry import rotation as d\n"
        "from diffcloth_torch import mesh\n"
        "import diffcloth_torch.state as state\n"
        "import diffcloth_torch as dc\n"
        "print(a is c, b is d, mesh.Cloth is dc.Cloth, state.State is dc.State)"
    )
    assert run_python(code).split() == ["True"] * 4


def test_importing_the_package_imports_no_old_path():
    code = (
        "import sys, diffcloth_torch._moved as m; "
        "print([old for old in m.MOVED if old in sys.modules])"
    )
    assert run_python(code).strip() == "[]"


def test_a_name_that_never_was_is_refused():
    with pytest.raises(AttributeError, match="has no attribute 'meshs'"):
        _ = dc.meshs
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("diffcloth_torch.meshs")


@pytest.mark.parametrize("load", [load_pickle, lambda: torch.load(SAVED.with_suffix(".pt"))])
def test_states_controls_and_parameters_load(load):
    saved = load()
    assert type(saved["state"]) is dc.State
    assert type(saved["state"].report) is dc.Report
    assert type(saved["control"]) is dc.Control
    assert type(saved["parameters"]) is dc.Parameters
    assert saved["state"].report.converged is True
    assert saved["state"].report.counts == {}
    assert saved["batch"][1].report.counts == {}
    assert saved["parameters"].replace(stretch=2.0).stretch == 2.0
    for state, batch in ((saved["state"], ()), (saved["batch"], (2,))):
        assert torch.equal(state.body_velocities, torch.zeros(*batch, 1, 6, dtype=torch.float64))
        assert state.joint_positions.shape == (*batch, 0)
        assert state.base_poses.shape == (*batch, 0, 7)
    assert saved["control"].joint_positions is None
    assert saved["parameters"].body_mass is None


def test_a_simulator_loads_and_goes_on_from_saved_states(tmp_path):
    saved = load_pickle()
    simulator = saved["simulator"]
    assert type(simulator) is dc.Simulator
    assert type(simulator.scene) is dc.Scene
    assert (simulator.scheme, simulator.dt) == ("split", 0.01)
    assert simulator.coupling == "monolithic"
    assert simulator.solver.metric == "identity"
    assert simulator.contact.friction_iterations == 1
    (cloth,) = simulator.scene.cloths
    assert type(cloth) is dc.Cloth
    assert (cloth.material.stretch, cloth.material.friction) == (300.0, 0.3)
    assert cloth.pins["left"].tolist() == [0, 4]
    assert simulator.scene.bodies[0].motion == "kinematic"

    after = simulator.step(saved["state"], saved["control"], saved["parameters"])
    assert after.report.converged
    assert float(after.time) == pytest.approx(0.02)
    both = simulator.step(saved["batch"])
    assert both.report.converged.all()
    after.export(tmp_path / "after.obj", bodies=True)
    assert (tmp_path / "after.obj").is_file()


def test_what_is_saved_now_loads_again(tmp_path):
    saved = load_pickle()
    torch.save({name: saved[name] for name in ("state", "control")}, tmp_path / "again.pt")
    again = torch.load(tmp_path / "again.pt")
    assert torch.equal(again["state"].positions, saved["state"].positions)
    assert b"sim.state" in (tmp_path / "again.pt").read_bytes()
