"""Saved states load, those of the first version too; names are imported when asked for."""

import importlib
import pickle
import re
from pathlib import Path

import pytest
import torch
from processes import run_python

import diffcloth_torch as dc
from diffcloth_torch._saved import _NOW

SAVED = Path(__file__).parent / "data" / "first_version"  # by save.py there


def load_pickle():
    return pickle.loads(SAVED.with_suffix(".pkl").read_bytes())


def test_importing_the_package_imports_no_torch():
    assert run_python("import sys, diffcloth_torch; print('torch' in sys.modules)") == "False\n"


LOADED = "print(sorted({type(value).__name__ for value in saved.values()}))"
KINDS = "['Control', 'Parameters', 'State']\n"


@pytest.mark.parametrize(
    "imports",
    [
        "import torch, diffcloth_torch",
        "import diffcloth_torch, torch",
        # One of our modules imports torch, before those of states are there.
        "import diffcloth_torch as dc; dc.Material(); import torch",
        "from diffcloth_torch.tasks.registry import load_task; import torch",
        # Whoever asks whether torch is there does not import it yet.
        "import diffcloth_torch, importlib.util; importlib.util.find_spec('torch'); import torch",
    ],
)
def test_states_load_as_soon_as_torch_and_the_package_are_imported(imports):
    """With nothing else asked of the package, in either order of the imports."""
    load = f"saved = torch.load({str(SAVED.with_suffix('.pt'))!r}, weights_only=True)"
    assert run_python(f"{imports}\n{load}\n{LOADED}") == KINDS


def test_torch_is_found_by_its_own_finder_afterwards():
    code = (
        "import diffcloth_torch, sys\n"
        "before = len(sys.meta_path)\n"
        "import torch, importlib.util, inspect\n"
        "print(before - len(sys.meta_path), torch.__spec__.origin == torch.__file__,\n"
        "      'import' in inspect.getsource(torch),\n"
        "      importlib.util.find_spec('torch') is torch.__spec__)"
    )
    assert run_python(code) == "1 True True True\n"


@pytest.mark.parametrize("imports", ["", "import diffcloth_torch\n"])
def test_a_pickle_loads_where_nothing_else_is_imported(imports):
    load = f"saved = pickle.load(open({str(SAVED.with_suffix('.pkl'))!r}, 'rb'))\n"
    drop = "saved.pop('simulator').step(saved['state'])\n"
    assert run_python(f"{imports}import pickle\n{load}{drop}{LOADED}") == KINDS


def test_old_paths_have_the_classes_of_today():
    for old, new in _NOW.items():
        there = importlib.import_module(f"diffcloth_torch.{old}")
        module = importlib.import_module(f"diffcloth_torch.{new}")
        for name in module.__all__:
            assert getattr(there, name) is getattr(module, name)
        with pytest.raises(AttributeError):
            _ = there.nothing


_IMPORT = r"from diffcloth_torch\.([\w.]+) import ([^()]+?|\([^)]*\))\n"


def test_names_are_found_where_they_are_said_to_be():
    """The table of homes, the imports that type checkers see and the public names agree."""
    source = Path(dc.__file__).read_text()
    block = source[source.index("if TYPE_CHECKING") : source.index("__all__ = ")]
    seen = {
        (module, name)
        for module, names in re.findall(
            r"from diffcloth_torch\.([\w.]+) import ([^()]+?|\([^)]*\))\n", block
        )
        for name in re.findall(r"\w+", names)
    }
    homes = {(home, name) for home, names in dc._HOMES.items() for name in names}
    modules = {("optimize", "residuals")}
    assert seen - {("tasks.task", "LoadedConfig")} - modules == homes
    others = {"build_info", "envs", "fabrics", "learn", "load_config", "residuals", "robots"}
    assert {name for _, name in homes} | others == set(dc.__all__)
    for name in dc.__all__:
        assert getattr(dc, name) is not None


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
