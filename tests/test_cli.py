"""The command line: its files, messages and exit status."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

import diffcloth_torch as dc
from diffcloth_torch.checkpoint import write_checkpoint
from diffcloth_torch.cli import main
from diffcloth_torch.config.documents import read_document
from diffcloth_torch.config.train_schema import TrainConfig
from diffcloth_torch.config.validation import validate
from diffcloth_torch.sim.simulator import Simulator
from diffcloth_torch.tasks.registry import check_document, read_config

CONFIGS = Path(__file__).parent.parent / "configs"

SHEET = """
task: drape
simulation: {dt: 0.01, steps: 3}
scene:
  cloths:
    - name: sheet
      shape: {kind: grid, rows: 4, columns: 4}
      pins: {corner: {vertices: [0]}}
output: {viewers: [meshes]}
"""

SMALL_HIT = [
    "--set=scene.cloths.sheet.shape={kind: grid, rows: 4, columns: 4}",
    "--set=simulation.steps=4",
    # Close enough that the push makes contact.
    "--set=scene.bodies.cuboid.pose={position: [0, -0.03, 0.95]}",
    "--set=actions.linear=[[0, 0.75, 0.35]]",
    "--set=actions.angular=[[0.8, 0, 0]]",
    "--set=loss.steps=1",
    "--set=optimizer.iterations=2",
    "--set=optimizer.checkpoint_every=null",
    "--set=output.viewers=[meshes]",
]


@pytest.fixture
def call(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sheet.yaml").write_text(SHEET, encoding="utf-8")

    def run(*arguments):
        return CliRunner().invoke(main, [str(a) for a in arguments])

    return run


def test_run_writes_metrics_and_meshes(call, tmp_path):
    result = call("run", "sheet.yaml")
    assert result.exit_code == 0, result.output
    folder = tmp_path / "results" / "sheet"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["steps"] == metrics["converged_steps"] == 3
    assert [step["time"] for step in metrics["per_step"]] == pytest.approx([0.01, 0.02, 0.03])
    assert metrics["error"] is None
    assert metrics["config"]["simulation"]["steps"] == 3
    assert len(list((folder / "meshes").glob("*.obj"))) == 4


def test_set_and_out_are_used(call, tmp_path):
    result = call(
        "run", "sheet.yaml", "--set", "simulation.steps=5", "--set", "output.every=5", "--out", "x"
    )
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / "x/metrics.json").read_text())["steps"] == 5
    assert len(list((tmp_path / "x/meshes").glob("*.obj"))) == 2


def test_saved_states_are_exported(call, tmp_path):
    result = call("run", "sheet.yaml", "--save", "states.pt")
    assert result.exit_code == 0, result.output
    states = dc.Trajectory.load("states.pt")
    result = call("export", "states.pt", "states.npz")
    assert result.exit_code == 0, result.output
    assert result.stdout == "4 states of states.pt are in states.npz\n"
    with np.load("states.npz") as arrays:
        np.testing.assert_array_equal(arrays["positions/sheet"], states.positions)
    result = call("export", "states.pt", "states.npz")
    assert result.exit_code == 2
    assert "states.npz exists already: --overwrite replaces it" in one_sentence(result)
    assert call("export", "states.pt", "states.npz", "--overwrite").exit_code == 0


def test_a_single_environment_of_a_batch_is_exported(call):
    simulator = Simulator(dc.Scene([dc.Cloth.grid(2, 2, name="sheet")]), 0.01)
    states = simulator.rollout(simulator.initial_state(2), steps=2)
    states.save("batch.pt")
    assert "a batch of 2" in one_sentence(call("export", "batch.pt", "states.glb"))
    result = call("export", "batch.pt", "states.glb", "--environment", "1")
    assert result.exit_code == 0, result.output
    assert Path("states.glb").read_bytes()[:4] == b"glTF"
    assert "must be in 0 .. 1, got 2" in one_sentence(
        call("export", "batch.pt", "other.glb", "--environment", "2")
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        pytest.param(["--save", "states.h5"], "--save must end in .pt, .npz, .pvd", id="ending"),
        pytest.param(["--save", "none/states.pt"], "there is no folder none", id="folder"),
        pytest.param(["--save", "old.pt"], "old.pt exists already", id="existing"),
    ],
)
def test_a_file_for_states_is_checked_before_the_run(call, tmp_path, arguments, message):
    (tmp_path / "old.pt").write_text("kept")
    result = call("run", "sheet.yaml", *arguments)
    assert result.exit_code == 2
    assert message in one_sentence(result)
    assert not (tmp_path / "results").exists()
    assert (tmp_path / "old.pt").read_text() == "kept"


def test_optimize_writes_metrics_actions_and_a_curve(call, tmp_path):
    result = call("optimize", CONFIGS / "hit_cloth.yaml", *SMALL_HIT, "--out", "out")
    assert result.exit_code == 0, result.output
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert len(metrics["losses"]) == 2
    assert metrics["best_loss"] == min(metrics["losses"])
    assert len(metrics["per_step_of_best"]) == 4
    assert (tmp_path / "out/loss.png").stat().st_size > 1000
    saved = torch.load(tmp_path / "out/actions.pt")
    with np.load(tmp_path / "out/actions.npz") as arrays:
        for name in ("linear", "angular"):
            np.testing.assert_array_equal(saved["best"][name].numpy(), arrays[name])
    assert len(list((tmp_path / "out/meshes").glob("*.obj"))) == 5


def test_a_task_without_a_loss_cannot_be_optimized(call):
    result = call("optimize", "sheet.yaml")
    assert result.exit_code == 2
    assert "tasks that have are hit_cloth" in result.stderr


def one_sentence(result):
    assert "Traceback" not in result.output
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        pytest.param("simulation.stps=3", "no key `stps`", id="unknown-key"),
        pytest.param("simulation.dt=-1", "`simulation.dt` must be greater than 0", id="range"),
        pytest.param("scene.cloths.sheet.pins.corner.vertices=[99]", "99", id="in-the-package"),
        pytest.param("nonsense", "key=value", id="no-assignment"),
    ],
)
def test_bad_input_ends_with_2_and_one_sentence(call, assignment, message):
    result = call("run", "sheet.yaml", "--set", assignment)
    assert result.exit_code == 2
    assert message in one_sentence(result)


def test_a_missing_configuration_ends_with_2(call):
    result = call("run", "nowhere.yaml")
    assert result.exit_code == 2
    assert one_sentence(result) == "Error: nowhere.yaml: there is no such file"


def test_a_failed_simulation_ends_with_1_and_keeps_its_results(call, tmp_path, monkeypatch):
    real = Simulator.step
    taken = []

    def step(self, *args):
        if len(taken) == 2:
            raise dc.InfeasibleMotion("the bodies close on the cloth")
        taken.append(1)
        return real(self, *args)

    monkeypatch.setattr(Simulator, "step", step)
    result = call("run", "sheet.yaml", "--out", "out")
    assert result.exit_code == 1
    assert "close on the cloth (after step 2)" in one_sentence(result)
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["steps"] == 2
    assert metrics["error"] == "the bodies close on the cloth"
    assert len(list((tmp_path / "out/meshes").glob("*.obj"))) == 3


def test_debug_shows_the_error_itself(call):
    result = call("run", "nowhere.yaml", "--debug")
    assert isinstance(result.exception, dc.InvalidInput)


def test_info_names_the_build(call):
    result = call("info")
    assert result.exit_code == 0
    assert "drape, hit_cloth" in result.output
    for name in dc.build_info():
        assert f"core: {name}" in result.output


def test_the_module_runs():
    command = [sys.executable, "-m", "diffcloth_torch", "--help"]
    shown = subprocess.run(command, check=True, capture_output=True, text=True)
    assert shown.stdout.startswith("Usage: diffcloth ")


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        pytest.param(["--help"], 0, id="help"),
        pytest.param(["optimize", "--help"], 0, id="help-of-a-command"),
        pytest.param(["run", "x.yaml", "--sett", "y"], 2, id="misspelled"),
    ],
)
def test_commands_without_simulation_import_no_torch(arguments, code):
    """Importing torch needs seconds."""
    script = (
        "import sys\n"
        "from diffcloth_torch.cli import main\n"
        f"try: main({arguments!r})\n"
        "except SystemExit as end: code = end.code\n"
        "print(code, sorted({'torch', 'numpy'} & set(sys.modules)))"
    )
    command = [sys.executable, "-c", script]
    shown = subprocess.run(command, check=True, capture_output=True, text=True)
    assert shown.stdout.splitlines()[-1] == f"{code} []"


def test_the_commands_import_nothing_that_only_pictures_need():
    code = (
        "import sys; import diffcloth_torch.cli.run, diffcloth_torch.cli.optimize; "
        "heavy = {'pyvista', 'matplotlib', 'trimesh', 'imageio'} & set(sys.modules); "
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


# --- existing results ---------------------------------------------------------------------------


def test_results_are_not_overwritten_unless_told(call, tmp_path):
    assert call("run", "sheet.yaml").exit_code == 0
    file = tmp_path / "results/sheet/metrics.json"
    before = file.read_bytes()
    again = call("run", "sheet.yaml", "--set", "simulation.steps=2")
    assert again.exit_code == 2
    assert "--overwrite replaces" in one_sentence(again)
    assert file.read_bytes() == before

    (file.parent / "loss.png").write_bytes(b"of an earlier run")
    (file.parent / "notes.txt").write_text("not ours")
    told = call("run", "sheet.yaml", "--set", "simulation.steps=2", "--overwrite")
    assert told.exit_code == 0, told.output
    assert json.loads(file.read_text())["steps"] == 2
    names = {path.name for path in file.parent.iterdir()}
    assert names == {"metrics.json", "meshes", "notes.txt"}


def test_a_refused_configuration_overwrites_nothing(call, tmp_path):
    assert call("run", "sheet.yaml").exit_code == 0
    wrong = call("run", "sheet.yaml", "--overwrite", "--set", "simulation.dt=-1")
    assert wrong.exit_code == 2
    assert (tmp_path / "results/sheet/metrics.json").is_file()


def test_metrics_hold_defaults_as_they_were_used(call, tmp_path):
    assert call("run", "sheet.yaml").exit_code == 0
    used = json.loads((tmp_path / "results/sheet/metrics.json").read_text())["used"]
    cloth = dc.Cloth.grid(4, 4, pins={"corner": [0]})
    simulator = dc.Simulator(dc.Scene([cloth]), 0.01)
    parameters = simulator.default_parameters()
    assert used["contact"]["barrier_distance"] == parameters.barrier_distance.item()
    assert used["contact"]["barrier_stiffness"] == parameters.barrier_stiffness.item()
    assert used["contact"]["friction_iterations"] == dc.ContactOptions().friction_iterations
    assert used["solver"] == vars(dc.SolverOptions())
    assert used["bending_models"] == {"sheet": cloth.bending_model}
    assert used["parameters"]["stretch"] == parameters.stretch.tolist()
    assert used["parameters"]["gravity"] == [0.0, 0.0, -9.81]


# --- interruptions ------------------------------------------------------------------------------


class Interrupt:
    """Ctrl-C before a step, taken by itself or in a rollout."""

    def __init__(self, monkeypatch, before):
        taken = []

        def interrupted(real):
            def step(*args, **kwargs):
                taken.append(1)
                if len(taken) == before + 1:  # once: the resumed run completes all its steps
                    raise KeyboardInterrupt
                return real(*args, **kwargs)

            return step

        for name in ("step", "_next"):
            monkeypatch.setattr(Simulator, name, interrupted(getattr(Simulator, name)))


def results(folder):
    """Results that two runs share to the bit; times are omitted."""
    metrics = json.loads((folder / "metrics.json").read_text())
    with np.load(folder / "actions.npz") as arrays:
        actions = {name: arrays[name].tobytes() for name in arrays.files}
    steps = [{**step, "seconds": 0} for step in metrics["per_step_of_best"]]
    names = ("losses", "best_loss", "best_iteration", "minimum_distance", "steps", "failures")
    meshes = [path.read_bytes() for path in sorted((folder / "meshes").iterdir())]
    return actions, steps, {name: metrics[name] for name in names}, meshes


@pytest.mark.parametrize(
    ("before", "finished"),
    [pytest.param(1, 0, id="in-iteration-0"), pytest.param(9, 2, id="in-iteration-2")],
)
def test_an_interrupted_optimization_goes_on_with_the_same_bits(
    call, tmp_path, monkeypatch, before, finished
):
    arguments = ["optimize", CONFIGS / "hit_cloth.yaml", *SMALL_HIT]
    more = "--set=optimizer.iterations=4"
    whole = call(*arguments, more, "--out", "whole")
    assert whole.exit_code == 0, whole.output

    Interrupt(monkeypatch, before)
    broken = call(*arguments, more, "--out", "broken")
    assert broken.exit_code == 130
    assert f"in iteration {finished}: broken has {finished} finished" in broken.stderr
    assert "diffcloth optimize --resume broken" in broken.stderr

    resumed = call("optimize", "--resume", "broken")
    assert resumed.exit_code == 0, resumed.output
    assert results(tmp_path / "broken") == results(tmp_path / "whole")


def test_a_finished_optimization_takes_more_iterations(call, tmp_path):
    arguments = ["optimize", CONFIGS / "hit_cloth.yaml", *SMALL_HIT]
    assert call(*arguments, "--set=optimizer.iterations=3", "--out", "whole").exit_code == 0
    assert call(*arguments, "--out", "parts").exit_code == 0
    more = call("optimize", "--resume", "parts", "--set", "optimizer.iterations=3")
    assert more.exit_code == 0, more.output
    assert results(tmp_path / "parts") == results(tmp_path / "whole")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        pytest.param(["--resume", "nowhere"], "must hold what `diffcloth optimize`", id="none"),
        pytest.param(["--resume", "broken"], "is no complete checkpoint", id="bytes"),
        pytest.param(
            ["--resume", "good", "--set", "simulation.dt=1"],
            "the key must be in optimizer or output",
            id="other-section",
        ),
    ],
)
def test_a_bad_resumption_is_refused(call, tmp_path, arguments, message):
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/resume.pt").write_bytes(b"no such thing")
    (tmp_path / "good").mkdir()
    saved = {"config": {}, "source": "x.yaml", "start": {}, "found": None}
    write_checkpoint(tmp_path / "good/resume.pt", "optimize", saved)
    result = call("optimize", *arguments)
    assert result.exit_code == 2
    assert message in one_sentence(result)


def test_resume_takes_the_rest_from_its_folder(call):
    result = call("optimize", "sheet.yaml", "--resume", "x", "--out", "y")
    assert result.exit_code == 2
    assert "--resume takes these from its DIRECTORY: --out, CONFIG" in result.stderr
    assert "Missing argument 'CONFIG'" in call("optimize").stderr


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_a_configuration_comes_back_from_its_record(path):
    if path.stem.startswith("train_"):  # of `diffcloth train`, with a separate schema
        config = validate(TrainConfig, read_document(path), path)
        assert validate(TrainConfig, config.model_dump(mode="json"), path) == config
        return
    config = read_config(path)
    assert check_document(config.model_dump(mode="json"), path) == config


def test_an_interrupted_run_keeps_its_steps(call, tmp_path, monkeypatch):
    Interrupt(monkeypatch, 2)
    result = call("run", "sheet.yaml", "--out", "out")
    assert result.exit_code == 130
    assert "Interrupted after step 2 of 3: out/metrics.json" in result.stderr
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["steps"] == 2
    assert metrics["error"] == "interrupted after step 2"


# --- one process a folder ------------------------------------------------------------------------


@pytest.mark.parametrize("way", ["run", "optimize", "resume"])
def test_a_folder_in_use_is_refused_with_its_holder(call, tmp_path, way):
    arguments = [CONFIGS / "hit_cloth.yaml", *SMALL_HIT, "--out", "out", "--overwrite"]
    if way == "resume":
        assert call("optimize", *arguments).exit_code == 0
    names = sorted(f.name for f in tmp_path.rglob("*"))
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, tmp_path / "out"], stdout=subprocess.PIPE, text=True
    )
    with holder:
        assert holder.stdout.readline() == "held\n"
        refused = call("optimize", "--resume", "out") if way == "resume" else call(way, *arguments)
        holder.kill()
    assert refused.exit_code == 2
    assert f"out is in use by process {holder.pid} on " in one_sentence(refused)
    # The lock ends with the process, and its file with the next one that uses the folder.
    assert (tmp_path / "out/.lock").exists()
    command = ["optimize", "--resume", "out"] if way == "resume" else [way, *arguments]
    result = call(*command)
    assert result.exit_code == 0, result.output
    assert not (tmp_path / "out/.lock").exists()
    assert not list(tmp_path.rglob("*.part"))
    if way == "resume":
        assert sorted(f.name for f in tmp_path.rglob("*")) == names


HOLD = """
import sys, time
from pathlib import Path
from diffcloth_torch.lock import locked
with locked("hold", Path(sys.argv[1])):
    Path(sys.argv[1], "metrics.json.part").touch()  # as one that is killed while it writes
    print("held", flush=True)
    time.sleep(1000)
"""


@pytest.mark.parametrize("name", ["resume.pt", "metrics.json", "actions.npz", "events"])
def test_an_obstacle_in_the_place_of_results_is_refused(call, tmp_path, name):
    (tmp_path / "out").mkdir()
    if name == "events":
        (tmp_path / "out/events").touch()
    else:
        (tmp_path / "out" / name).mkdir()
    result = call("optimize", CONFIGS / "hit_cloth.yaml", "--out", "out", "--overwrite")
    assert result.exit_code == 2
    assert "move it away" in one_sentence(result)


@pytest.mark.parametrize("out", ["file/out", "/proc/out", "file"])
def test_a_folder_that_cannot_be_made_is_refused(call, tmp_path, out):
    (tmp_path / "file").touch()
    result = call("run", "sheet.yaml", "--out", out)
    assert result.exit_code == 2
    assert "Traceback" not in result.output
    assert "cannot be written" in result.stderr or "is a file" in result.stderr


def test_a_full_disk_ends_in_a_sentence_and_keeps_older_files(call, tmp_path):
    arguments = [CONFIGS / "hit_cloth.yaml", *SMALL_HIT, "--set=output.viewers=[]"]
    assert call("optimize", *arguments, "--out", "out").exit_code == 0
    before = {f.name: f.read_bytes() for f in (tmp_path / "out").iterdir()}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))  # bytes of a file
    try:
        more = call("optimize", "--resume", "out", "--set", "optimizer.iterations=3")
        other = call("optimize", *arguments, "--out", "other")
        page = call("run", *arguments, "--viewer", "web", "--out", "page")
        mesh = call("run", *arguments, "--viewer", "meshes", "--out", "mesh")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    for result in (more, other):
        assert result.exit_code == 2, result.output
        assert "resume.pt cannot be written: File too large" in one_sentence(result)
    for result, name in ((page, "page/animation.html"), (mesh, "mesh/meshes/frame_0000.obj")):
        assert result.exit_code == 2, result.output
        assert f"{name} cannot be written: File too large" in one_sentence(result)
    assert {f.name: f.read_bytes() for f in (tmp_path / "out").iterdir()} == before
    assert not list((tmp_path / "other").iterdir())
    assert not list((tmp_path / "page").iterdir())


# --- actions of another run ---------------------------------------------------------------------


def test_the_actions_of_a_run_start_another(call, tmp_path):
    arguments = [CONFIGS / "hit_cloth.yaml", *SMALL_HIT]
    assert call("optimize", *arguments, "--out", "first").exit_code == 0
    file = tmp_path / "first/actions.npz"
    for command, out in (("run", "played"), ("optimize", "second")):
        result = call(command, *arguments, "--actions", file, "--out", out)
        assert result.exit_code == 0, result.output
    first = json.loads((tmp_path / "first/metrics.json").read_text())
    second = json.loads((tmp_path / "second/metrics.json").read_text())
    assert second["initial_loss"] == first["best_loss"] < first["initial_loss"]
    mesh = "meshes/frame_0004.obj"
    assert (tmp_path / "played" / mesh).read_bytes() == (tmp_path / "first" / mesh).read_bytes()


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        pytest.param({"linear": np.zeros((1, 3))}, "must hold linear [1, 3], angular", id="name"),
        pytest.param(
            {"linear": np.zeros((2, 3)), "angular": np.zeros((1, 3))}, "linear [2, 3]", id="shape"
        ),
        pytest.param(
            {"linear": np.full((1, 3), np.nan), "angular": np.zeros((1, 3))}, "finite", id="nan"
        ),
        pytest.param(
            {"linear": np.zeros((1, 3), int), "angular": np.zeros((1, 3))}, "float64", id="dtype"
        ),
        pytest.param(None, "is not an `actions.npz`", id="bytes"),
    ],
)
def test_actions_must_fit(call, tmp_path, arrays, message):
    file = tmp_path / "actions.npz"
    file.write_bytes(b"no such thing") if arrays is None else np.savez(file, **arrays)
    arguments = [CONFIGS / "hit_cloth.yaml", *SMALL_HIT, "--actions", file, "--out", "out"]
    result = call("optimize", *arguments)
    assert result.exit_code == 2
    assert message in one_sentence(result)
    assert not (tmp_path / "out").exists()


def test_actions_need_a_task_that_has_some(call, tmp_path):
    np.savez(tmp_path / "a.npz", linear=np.zeros((1, 3)))
    result = call("run", "sheet.yaml", "--actions", "a.npz")
    assert "the task 'drape' has no actions" in one_sentence(result)


def pretend(file, shape, dtype="<f8"):
    """Write an .npz whose arrays claim a shape and hold nothing."""
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (63 - (10 + len(header)) % 64) + b"\n"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as entries:
        for name in ("linear", "angular"):
            data = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
            entries.writestr(f"{name}.npy", data)


@pytest.mark.parametrize(
    ("shape", "dtype", "message"),
    [
        pytest.param("(10**9, 3)", "<f8", "is not an", id="expression"),
        pytest.param("(1000000000000, 3)", "<f8", "got linear [1000000000000, 3]", id="shape"),
        pytest.param("(1, 3)", "|S2000000000", "must be finite and float64", id="dtype"),
        pytest.param("(1, 3)", "<f8", "is not an `actions.npz`", id="empty"),
    ],
)
def test_actions_that_claim_more_than_there_is_take_no_memory(
    call, tmp_path, shape, dtype, message
):
    pretend(tmp_path / "a.npz", shape, dtype)
    arguments = [CONFIGS / "hit_cloth.yaml", *SMALL_HIT, "--actions", "a.npz", "--out", "out"]
    assert message in one_sentence(call("optimize", *arguments))


@pytest.mark.parametrize("command", ["run", "optimize"])
def test_actions_on_a_pipe_are_refused(call, tmp_path, command):
    """The pipe has no writer: reading would wait forever."""
    os.mkfifo(tmp_path / "pipe.npz")
    arguments = [CONFIGS / "hit_cloth.yaml", *SMALL_HIT, "--actions", "pipe.npz", "--out", "out"]
    result = call(command, *arguments)
    assert result.exit_code == 2
    assert "pipe.npz: must be a regular file" in one_sentence(result)


# --- obstacles in the place of results ------------------------------------------------------------


@pytest.fixture
def no_work(monkeypatch):
    def fail(*arguments, **keywords):
        pytest.fail("a step was taken before the refusal")

    monkeypatch.setattr(Simulator, "step", fail)
    monkeypatch.setattr(Simulator, "_next", fail)  # of rollouts


@pytest.mark.parametrize("name", ["metrics.json", "actions.npz", "loss.png", "resume.pt.part"])
@pytest.mark.usefixtures("no_work")
def test_a_folder_named_like_a_result_is_refused_before_the_work(call, tmp_path, name):
    (tmp_path / "out" / name).mkdir(parents=True)
    for command in ("run", "optimize"):
        arguments = [CONFIGS / "hit_cloth.yaml", *SMALL_HIT, "--out", "out", "--overwrite"]
        result = call(command, *arguments)
        assert result.exit_code == 2
        assert f"out/{name} is a folder, in the place of a file" in one_sentence(result)


@pytest.mark.parametrize("name", ["meshes", "animation_frames"])
@pytest.mark.usefixtures("no_work")
def test_a_file_named_like_a_folder_of_results_is_refused_before_the_work(call, tmp_path, name):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text("mine")
    result = call("run", "sheet.yaml", "--out", "out", "--overwrite")
    assert result.exit_code == 2
    assert f"out/{name} must be a folder" in one_sentence(result)
    assert (tmp_path / "out" / name).read_text() == "mine"


@pytest.mark.parametrize("name", ["actions.pt", "loss.png", "metrics.json"])
def test_a_folder_in_resumed_results_is_refused_before_the_work(call, tmp_path, name, monkeypatch):
    arguments = [CONFIGS / "hit_cloth.yaml", *SMALL_HIT, "--set=optimizer.iterations=1"]
    assert call("optimize", *arguments, "--out", "out").exit_code == 0
    (tmp_path / "out" / name).unlink()
    (tmp_path / "out" / name).mkdir()
    monkeypatch.setattr(Simulator, "_next", lambda *_: pytest.fail("it went on"))
    result = call("optimize", "--resume", "out", "--set", "optimizer.iterations=2")
    assert result.exit_code == 2
    assert f"out/{name} is a folder" in one_sentence(result)


@pytest.mark.parametrize("scheme", ["projective", "coupled"])
def test_metrics_are_written_where_there_is_no_barrier(call, tmp_path, scheme):
    arguments = [f"--set=simulation.scheme={scheme}", "--set=simulation.contact.self_contact=false"]
    result = call("run", "sheet.yaml", *arguments, "--out", "out")
    assert result.exit_code == 0, result.output
    used = json.loads((tmp_path / "out/metrics.json").read_text())["used"]
    assert used["contact"]["barrier_distance"] is None
