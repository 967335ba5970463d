"""Continuation from files of 0.1, which data/save_checkpoints.py wrote."""

import functools
import json
import tarfile
import zipfile
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner

import diffcloth_torch as dc
from diffcloth_torch import envs
from diffcloth_torch.cli import main
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.learn import Trainer, TrainerOptions

ARCHIVE = Path(__file__).parent / "data" / "checkpoints_0_1.tar.xz"


@pytest.fixture
def files(tmp_path):
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path


def resume(command, folder, *arguments):
    return CliRunner().invoke(main, [command, "--resume", str(folder), *arguments])


def read_json(path):
    return json.loads(path.read_text())


def apg(task, rate=0.004, **options):
    make = functools.partial(envs.make, task, size=4, horizon=2, **options)
    chosen = TrainerOptions("apg", horizon=1, hidden=(2,), learning_rate=rate, init_std=0.05)
    return Trainer(make, chosen, num_envs=1)


def changed(file, change):
    """Change the content of a file of 0.1."""
    content = torch.load(file, weights_only=True)
    change(content)
    torch.save(content, file)


def test_a_trajectory_loads_and_goes_on(files):
    states = dc.Trajectory.load(files / "trajectory.pt")
    assert states.positions.shape == (2, 9, 3)
    assert states.time.tolist() == pytest.approx([0.01, 0.02])
    simulator = dc.Simulator(dc.Scene([dc.Cloth.grid((3, 3), 0.1, name="sheet")]), 0.01)
    after = simulator.step(states[-1])
    fallen = (states.positions[0] - after.positions)[:, 2]
    torch.testing.assert_close(fallen, torch.full_like(fallen, 9.81 * 0.01**2 * (2 + 3)))


class TestTrainer:
    def test_a_policy_and_its_optimizer_load(self, files):
        file = files / "train" / "policy.pt"
        kept = torch.load(file, weights_only=True)
        trainer = apg("TwoCloths")
        trainer.load(file)
        assert (trainer.steps, trainer.updates) == (1, 1)
        for name, tensor in trainer.policy.state_dict().items():
            assert torch.equal(tensor, kept["policy"][name]), name
        moments = trainer._actor_steps.state_dict()["state"]
        assert torch.equal(moments[0]["exp_avg"], kept["optimizers"][0]["state"][0]["exp_avg"])
        # Episodes begin anew.
        assert trainer._places[0][0].elapsed.tolist() == [0]
        trainer.update()
        assert (trainer.steps, trainer.updates) == (2, 2)

    def test_a_policy_of_other_observations_is_refused(self, files):
        trainer = apg("FoldCloth", 2e-3)
        message = r"learned from other observations of FoldCloth: \{.*\}, which are \{'positions'"
        with pytest.raises(InvalidInput, match=message):
            trainer.load(files / "fold.pt")
        assert trainer.updates == 0

    def test_other_options_are_refused(self, files):
        with pytest.raises(InvalidInput, match="was written with other options"):
            apg("TwoCloths", 0.005).load(files / "train" / "policy.pt")

    def test_a_changed_byte_is_found(self, files):
        file = files / "train" / "policy.pt"
        with zipfile.ZipFile(file) as archive:
            entry = max(archive.infolist(), key=lambda each: each.file_size)
        data = bytearray(file.read_bytes())
        data[data.index(entry.filename.encode()) + 2000] ^= 1
        file.write_bytes(data)
        with pytest.raises(InvalidInput, match=r"policy\.pt.* was changed since it was written"):
            apg("TwoCloths").load(file)

    def test_a_file_that_was_cut_off_is_refused(self, files):
        file = files / "train" / "policy.pt"
        file.write_bytes(file.read_bytes()[:-1])
        with pytest.raises(InvalidInput, match="is no complete checkpoint: it was cut off"):
            apg("TwoCloths").load(file)


def test_a_policy_names_the_axes_that_it_has_learned_in(tmp_path):
    """0.1 had world axes alone; for a task without its own frame both frames are equal."""
    apg("PushCube", frame="world").save(tmp_path / "world.pt")
    with pytest.raises(InvalidInput, match=r"of the world: make the task with frame='world'"):
        apg("PushCube").load(tmp_path / "world.pt")
    apg("TwoCloths", frame="world").save(tmp_path / "world.pt")
    apg("TwoCloths").load(tmp_path / "world.pt")


class TestTraining:
    def test_a_training_continues(self, files):
        folder = files / "train"
        kept = read_json(folder / "train.json")["evaluations"]
        assert [each["updates"] for each in kept] == [0, 1]
        result = resume("train", folder)
        assert result.exit_code == 0, result.output
        found = read_json(folder / "train.json")
        assert found["evaluations"][:2] == kept
        assert [each["updates"] for each in found["evaluations"]] == [0, 1, 2]
        assert found["config"]["trainer"]["learning_rate"] == 0.004
        assert "nothing is left to do" in resume("train", folder).output  # now in today's format

    def test_a_training_without_a_policy_begins_anew(self, files):
        folder = files / "train"
        (folder / "policy.pt").unlink()
        result = resume("train", folder)
        assert result.exit_code == 0, result.output
        found = read_json(folder / "train.json")["evaluations"]
        assert [each["updates"] for each in found] == [0, 1, 2]

    def test_a_policy_of_a_task_with_other_observations_is_refused(self, files):
        folder = files / "train"
        (files / "fold.pt").replace(folder / "policy.pt")
        document = read_json(folder / "resume.json")
        document["config"]["environment"]["name"] = "FoldCloth"
        (folder / "resume.json").write_text(json.dumps(document))
        before = {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}
        result = resume("train", folder)
        assert result.exit_code == 2
        assert "learned from other observations of FoldCloth" in result.output
        after = {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}
        assert after == before


class TestFit:
    def test_a_fit_continues_with_its_evaluations(self, files):
        kept = torch.load(files / "fit" / "evaluations" / "start_0.pt", weights_only=True)
        seconds = [r["seconds"] for r in kept["records"] if r["kind"] == "residuals"]
        result = resume("fit", files / "fit")
        assert result.exit_code == 0, result.output
        again = torch.load(files / "fit" / "evaluations" / "start_0.pt", weights_only=True)
        found = [r["seconds"] for r in again["records"] if r["kind"] == "residuals"]
        assert found[: len(seconds)] == seconds
        assert len(found) > len(seconds)
        assert resume("fit", files / "fit").exit_code == 0  # now in today's format

    def test_a_fit_of_another_simulation_is_refused(self, files):
        def differ(content):
            content["records"][0]["found"][0] += 1e-9

        changed(files / "fit" / "evaluations" / "start_0.pt", differ)
        result = resume("fit", files / "fit")
        assert result.exit_code == 2
        assert "`residuals` are not what they were when the fit was interrupted" in result.output


def test_an_optimization_goes_on(files):
    kept = read_json(files / "optimize" / "metrics.json")
    assert kept["iterations"] == 1
    result = resume("optimize", files / "optimize")
    assert result.exit_code == 0, result.output
    found = read_json(files / "optimize" / "metrics.json")
    assert (found["iterations"], found["initial_loss"]) == (2, kept["initial_loss"])
    assert found["history"][0]["cpu_seconds"] is None
    assert found["history"][1]["cpu_seconds"] > 0


@pytest.mark.parametrize(
    ("command", "folder", "message"),
    [
        ("fit", "train", "must be of `diffcloth fit`, got one of train"),
        ("train", "fit", "must be of `diffcloth train`, got one of fit"),
        ("optimize", "fit", "must be of `diffcloth optimize`, got one of fit"),
        ("train", "optimize", "is no complete checkpoint"),
    ],
)
def test_a_folder_of_another_command_is_refused(files, command, folder, message):
    result = resume(command, files / folder)
    assert result.exit_code == 2
    assert message in result.output
