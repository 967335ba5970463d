"""Objects in files load, including files of 0.1; names are imported at their first use."""

import importlib
import pickle
import pickletools
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from processes import run_python

import diffcloth_torch as dc
from diffcloth_torch import saved, saved_0_1

SAVED = Path(__file__).parent / "data" / "saved_0_1"  # written by data/save_records.py
KINDS = "['ContactPoints', 'Control', 'Parameters', 'State']\n"
SHOW = "print(sorted({type(value).__name__ for value in saved.values()}))"


def load_pickle():
    return pickle.loads(SAVED.with_suffix(".pkl").read_bytes())


def records(load):
    """Records of a file without its simulator."""
    return {name: value for name, value in load().items() if name != "simulator"}


def test_importing_the_package_imports_no_torch():
    assert run_python("import sys, diffcloth_torch; print('torch' in sys.modules)") == "False\n"


@pytest.mark.parametrize(
    "imports",
    [
        "import torch, diffcloth_torch",
        "import diffcloth_torch as dc, torch; dc.Material()",
        "from diffcloth_torch import State; import torch",
        "from diffcloth_torch.sim.records.state import State; import torch",
    ],
)
@pytest.mark.quick("import torch*", "from diffcloth_torch import*")
def test_torch_loads_records_of_0_1(imports):
    load = f"saved = torch.load({str(SAVED.with_suffix('.pt'))!r}, weights_only=True)"
    assert run_python(f"{imports}\n{load}\n{SHOW}") == KINDS


@pytest.mark.parametrize(
    "imports",
    [pytest.param("", id="nothing"), pytest.param("import diffcloth_torch\n", id="package")],
)
@pytest.mark.quick("nothing")
def test_a_pickle_of_0_1_loads_where_nothing_else_is_imported(imports):
    load = f"saved = pickle.load(open({str(SAVED.with_suffix('.pkl'))!r}, 'rb'))\n"
    drop = "saved.pop('simulator').step(saved['state'])\n"
    assert run_python(f"{imports}import pickle\n{load}{drop}{SHOW}") == KINDS


def test_the_table_has_the_module_of_each_saved_class():
    for name, module in saved._MODULES.items():
        cls = getattr(importlib.import_module(f"diffcloth_torch.{module}"), name)
        assert (cls.__module__, cls.__name__) == (f"diffcloth_torch.{module}", name)
    for module, names in saved_0_1.MODULES.items():
        there = importlib.import_module(f"diffcloth_torch.{module}")
        assert all(getattr(there, name) is saved._class(name) for name in names)


def globals_of(data: bytes) -> set[str]:
    """Names that a pickle of protocol 2 refers to, except torch's."""
    names = (arg for op, arg, _ in pickletools.genops(data) if op.name == "GLOBAL")
    return {name for name in names if not name.startswith(("torch", "collections", "_codecs"))}


def test_files_name_no_module_of_a_class():
    """A simulator and its records: a class without `saved` would add its module."""
    whole = load_pickle()
    whole["trajectory"] = list(dc.Trajectory([whole["state"]]))
    ours = {f"diffcloth_torch.saved restore{kind}" for kind in ("", "_array", "_slice")}
    assert globals_of(pickle.dumps(whole, protocol=2)) == ours


def test_a_file_of_a_later_format_is_refused():
    data = pickle.dumps(dc.Material(), protocol=2)
    restore, arguments = saved._reduce(dc.Material())
    with pytest.raises(dc.InvalidInput, match=r"format 1 at most .* got 'Material' of format 2"):
        restore(arguments[0], saved.FORMAT + 1, arguments[2])
    with pytest.raises(dc.InvalidInput, match="got 'Velvet' of format 1"):
        restore("Velvet", 1, {})
    assert pickle.loads(data).stretch == dc.Material().stretch


def test_a_class_outside_of_the_table_is_refused():
    with pytest.raises(TypeError, match="State needs its module in the table"):
        saved.saved(type("State", (), {}))


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_every_protocol_loads(protocol):
    whole = load_pickle()
    again = pickle.loads(pickle.dumps(whole, protocol=protocol))
    assert {name: type(value) for name, value in again.items()} == {
        name: type(value) for name, value in whole.items()
    }


_IMPORT = r"from diffcloth_torch\.([\w.]+) import ([^()]+?|\([^)]*\))\n"


def test_names_are_found_in_the_listed_modules():
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


def same(a, b):
    """Return whether two records have the same numbers."""
    if isinstance(a, torch.Tensor):
        return torch.equal(a.nan_to_num(), b.nan_to_num())
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if hasattr(a, "__dict__"):
        return type(a) is type(b) and same(vars(a), vars(b))
    return a == b or a != a


@pytest.mark.parametrize(
    "load", [load_pickle, lambda: torch.load(SAVED.with_suffix(".pt"), weights_only=True)]
)
def test_records_of_0_1_are_complete(load):
    loaded = records(load)
    state, batch = loaded["state"], loaded["batch"]
    assert type(state.report) is dc.Report
    assert state.report.converged is True
    assert state.report.criterion == "unknown"
    assert state.report.cpu_seconds != state.report.cpu_seconds  # not a number: not known
    assert batch.report.cpu_seconds.isnan().all()
    assert state.report.contacts["sheet", "box"].count > 0
    assert batch.batch_size == 2
    assert loaded["parameters"].replace(stretch=2.0).stretch == 2.0
    assert loaded["contacts"].mask.any()
    assert list(state.meshes()) == [
        "sheet",
        "box",
        "ball",
        "hand/palm",
        "hand/left_finger",
        "hand/right_finger",
    ]


def test_a_simulator_of_0_1_goes_on_from_saved_states(tmp_path):
    loaded = load_pickle()
    simulator = loaded["simulator"]
    assert (simulator.scheme, simulator.coupling, simulator.dt) == ("coupled", "monolithic", 0.01)
    assert simulator.solver.tolerance == 1e-7
    assert simulator.contact.friction_iterations == 1
    cloth, (box, ball) = simulator.scene.cloths[0], simulator.scene.bodies
    assert cloth.material.friction == 0.3
    assert cloth.pins["left"].tolist() == [0, 4]
    assert (box.motion, ball.motion, ball.smooth) == ("kinematic", "dynamic", True)
    after = simulator.step(loaded["state"], loaded["control"], loaded["parameters"])
    assert after.report.converged
    assert float(after.time) == pytest.approx(0.02)
    assert simulator.step(loaded["batch"]).report.converged.all()
    after.export(tmp_path / "after.obj", bodies=True)
    assert (tmp_path / "after.obj").is_file()


def test_saved_objects_load_again(tmp_path):
    before = records(load_pickle)
    torch.save(before, tmp_path / "again.pt")
    after = torch.load(tmp_path / "again.pt", weights_only=True)
    assert all(same(before[name], after[name]) for name in before)


@pytest.mark.parametrize("weights_only", [True, False])
def test_a_simulator_loads_again_and_steps_with_the_same_bits(tmp_path, weights_only):
    loaded = load_pickle()
    torch.save(loaded["simulator"], tmp_path / "simulator.pt")
    again = torch.load(tmp_path / "simulator.pt", weights_only=weights_only)
    ends = [sim.step(loaded["state"]).positions for sim in (loaded["simulator"], again)]
    assert torch.equal(*ends)


@pytest.mark.parametrize("writable", [True, False])
def test_arrays_and_slices_load_as_they_were(writable):
    array = np.array([[1.5, -2.0], [0.0, 1e-300]]).T  # in another order in memory
    array.setflags(write=writable)
    given = {"a": [array], "b": (slice(1, None, 2), array.astype(np.int32))}
    again = pickle.loads(pickle.dumps(saved._plain(given), protocol=2))
    assert again["a"][0].flags.writeable is writable
    np.testing.assert_array_equal(again["a"][0], array, strict=True)
    assert again["b"][0] == slice(1, None, 2)
    assert again["b"][1].dtype == np.int32


def test_an_array_in_a_file_has_numbers():
    for dtype, shape, text in (("O", (1,), "AAAAAAAAAAA="), ("<f8", (2,), "AAAAAAAAAAA=")):
        with pytest.raises(dc.InvalidInput, match="load: the file must hold arrays of numbers"):
            saved.restore_array(dtype, shape, text, False)
    with pytest.raises(dc.InvalidInput, match="arrays of numbers"):
        saved.restore_array("<f8", (1,), "?", False)
