"""Checkpoints of trainings, fits and optimizations: damage of any kind, and full disks."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import pickle
import random
import resource
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from short_tasks import CONFIGS

import diffcloth_torch as dc
from diffcloth_torch import envs
from diffcloth_torch.checkpoint import read_checkpoint, write_checkpoint
from diffcloth_torch.cli import main
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.learn import Trainer, TrainerOptions
from diffcloth_torch.learn.trainer import record_of

F64 = torch.float64
CONTENT = {"a": torch.arange(6.0), "b": [1, 2.5, "text", None, True], "c": {"d": torch.eye(3)}}


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "file.pt"
    write_checkpoint(path, "thing", CONTENT)
    return path


def test_content_comes_back(file):
    found = read_checkpoint("test", file, "thing")
    assert torch.equal(found["a"], CONTENT["a"])
    assert found["b"] == CONTENT["b"]
    assert [f.name for f in file.parent.iterdir()] == ["file.pt"]


def test_torch_reads_the_content_too(file):
    assert torch.load(file, weights_only=True)["b"] == CONTENT["b"]


def test_any_changed_byte_is_found(file):
    data = file.read_bytes()
    generator = random.Random(0)
    places = [*range(len(data) - 200, len(data)), *generator.sample(range(len(data)), 300)]
    for place in places:
        changed = bytearray(data)
        changed[place] ^= 1 << generator.randrange(8)
        file.write_bytes(changed)
        with pytest.raises(InvalidInput, match=r"^test: .*file\.pt"):
            read_checkpoint("test", file, "thing")


def test_any_length_but_the_whole_is_refused(file):
    data = file.read_bytes()
    for length in [*range(100), *random.Random(1).sample(range(len(data)), 100), len(data) - 1]:
        file.write_bytes(data[:length])
        with pytest.raises(InvalidInput, match="no complete checkpoint"):
            read_checkpoint("test", file, "thing")
    file.write_bytes(data + b"\0")
    with pytest.raises(InvalidInput, match="no complete checkpoint"):
        read_checkpoint("test", file, "thing")


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (b'{"format": 2, "kind": "thing", "version": "9.1"}', "format 2 of diffcloth_torch 9.1"),
        (b'{"format": 1, "kind": "other", "version": "9.1"}', "of a thing, got one of a other"),
        (b'{"format": 1e400, "kind": "thing", "version": "9.1"}', "must be an integer"),
        (b'{"format": ' + b"1" * 400 + b', "kind": "thing", "version": ""}', "must be an integer"),
        (b'{"format": null, "kind": "thing", "version": ""}', "must be an integer"),
        (b'{"kind": "thing"}', "must have the keys format, kind, version"),
        (b"null", "must have the keys"),
        (b"[" * 4000, "is damaged"),
        (b"[" * 5000, "its digest differs"),  # longer than any record
        (b"\xff", "is damaged"),
    ],
)
def test_records_of_other_versions_and_strange_ones(file, record, message):
    body = file.read_bytes().partition(b'{"format"')[0]
    digest = hashlib.sha256(body + record).digest()
    file.write_bytes(body + record + digest + len(record).to_bytes(4, "little") + b"diffclth")
    with pytest.raises(InvalidInput, match=message):
        read_checkpoint("test", file, "thing")


class Runs:
    """An object whose unpickling would make a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_no_code_in_a_file_runs(tmp_path):
    write_checkpoint(tmp_path / "file.pt", "thing", Runs(tmp_path / "made"))
    with pytest.raises(InvalidInput, match="damaged, its content raises UnpicklingError"):
        read_checkpoint("test", tmp_path / "file.pt", "thing")
    torch.save([Runs(tmp_path / "made")], tmp_path / "motion.pt")
    with pytest.raises(InvalidInput, match="holds no trajectory"):
        dc.Trajectory.load(tmp_path / "motion.pt")
    assert not (tmp_path / "made").exists()
    pickle.loads(pickle.dumps(Runs(tmp_path / "made")))
    assert (tmp_path / "made").exists()


def test_folders_and_pipes_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe"):
        with pytest.raises(InvalidInput, match="must be a regular file"):
            read_checkpoint("test", path, "thing")


class TestDisk:
    """A file that cannot be written ends in a sentence, and the older one stays."""

    @pytest.fixture
    def full(self):
        """A disk on which files may have 1 KiB."""
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1024, before[1]))
        yield
        resource.setrlimit(resource.RLIMIT_FSIZE, before)

    @pytest.fixture
    def read_only(self):
        """A folder that may not be written, and a user who may not: the superuser may."""
        folder = Path(tempfile.mkdtemp())
        write_checkpoint(folder / "file.pt", "thing", CONTENT)
        folder.chmod(0o555)
        before = os.geteuid()
        if before == 0:
            os.seteuid(65534)
        yield folder / "file.pt"
        os.seteuid(before)
        shutil.rmtree(folder)

    def assert_kept(self, file, data):
        assert file.read_bytes() == data
        assert [f.name for f in file.parent.iterdir()] == ["file.pt"]

    def test_a_full_disk_keeps_the_older_file(self, file, full):
        data = file.read_bytes()
        with pytest.raises(OSError, match=r"file\.pt cannot be written: File too large"):
            write_checkpoint(file, "thing", CONTENT)
        self.assert_kept(file, data)

    def test_a_read_only_folder_keeps_the_older_file(self, read_only):
        data = read_only.read_bytes()
        with pytest.raises(PermissionError, match=r"file\.pt cannot be written: Permission denied"):
            write_checkpoint(read_only, "thing", CONTENT)
        self.assert_kept(read_only, data)

    def test_a_folder_in_the_place_of_the_file(self, tmp_path):
        (tmp_path / "file.pt").mkdir()
        with pytest.raises(IsADirectoryError, match=r"file\.pt cannot be written: Is a directory"):
            write_checkpoint(tmp_path / "file.pt", "thing", CONTENT)
        assert [f.name for f in tmp_path.iterdir()] == ["file.pt"]


# --- content with the right digest that nobody has written ---------------------------------------

HUGE = 10**400
STRANGE = [
    None, HUGE, -1, -(10**30), 0, float("nan"), float("inf"), 1e300, "text", "", [], {}, True,
    b"bytes", (), [None], {"a": 1}, torch.zeros(0), torch.zeros(2, 3, dtype=torch.int64),
    torch.full((3,), float("nan"), dtype=F64), functools.reduce(lambda x, _: [x], range(300), 0),
]  # fmt: skip


def mutated(value, generator):
    """A copy that differs in one place: a key, a length, a shape, a type or a number."""
    containers = isinstance(value, dict | list | tuple) and len(value) > 0
    if containers and generator.random() < 0.85:
        keys = list(value) if isinstance(value, dict) else range(len(value))
        key = generator.choice(list(keys))
        copy = dict(value) if isinstance(value, dict) else list(value)
        chance = generator.random()
        if chance < 0.1:
            del copy[key]
        elif chance < 0.15 and isinstance(copy, dict):
            copy["other"] = 1
        elif chance < 0.15:
            copy.append(copy[key])
        else:
            copy[key] = mutated(value[key], generator)
        return tuple(copy) if isinstance(value, tuple) else copy
    if isinstance(value, torch.Tensor) and generator.random() < 0.6:
        other = value.clone().flatten()
        if len(other) and generator.random() < 0.5:
            number = torch.tensor(generator.choice([-1e30, 1e30, np.nan, 2.0]))
            other[generator.randrange(len(other))] = number.to(other.dtype)
            return other.reshape(value.shape)
        return generator.choice([value[..., None], other[:-1], value.to(torch.float16)])
    if isinstance(value, dc.State) and generator.random() < 0.7:
        name = generator.choice(["positions", "velocities", "body_poses", "time", "report"])
        return value.replace(**{name: mutated(getattr(value, name), generator)})
    return generator.choice(STRANGE)


def bits(value):
    """All numbers and texts of a content, for comparison."""
    if isinstance(value, torch.Tensor):
        return [str(value.dtype), tuple(value.shape), value.numpy().tobytes()]
    if isinstance(value, dict):
        return [[key, bits(entry)] for key, entry in value.items()]
    if isinstance(value, list | tuple):
        return [bits(entry) for entry in value]
    return bits(vars(value)) if isinstance(value, dc.State | dc.Report) else repr(value)


def refusal(function, *arguments, **options):
    """Message of the `InvalidInput` that a call raises; empty without an error."""
    try:
        function(*arguments, **options)
    except InvalidInput as error:
        return str(error)
    return ""


COUNTS = pytest.mark.parametrize("count", [20, pytest.param(200, marks=pytest.mark.slow)])


class TestTrainer:
    OPTIONS = TrainerOptions("sapo", horizon=2, hidden=(8,), critic_epochs=1, critic_batches=1)
    MAKE = functools.partial(envs.make, "FoldCloth", size=4, horizon=5)

    def trainer(self):
        return Trainer(self.MAKE, self.OPTIONS, num_envs=2, chunk=1)

    @COUNTS
    def test_changes_are_refused_or_harmless(self, tmp_path, count):
        generator = random.Random(2)
        file = tmp_path / "policy.pt"
        first = self.trainer()
        first.update()
        content = record_of(first)
        other = self.trainer()
        before = bits(record_of(other))
        refused = 0
        for _ in range(count):
            write_checkpoint(file, "trainer", mutated(content, generator))
            data = file.read_bytes()
            message = refusal(other.load, file)
            if message:
                refused += 1
                assert message.startswith(f"Trainer.load: {file}")
                assert bits(record_of(other)) == before
            else:
                # Other numbers in the right places: the training continues or raises its reason.
                with contextlib.suppress(InvalidInput, dc.SimulationError):
                    other.update()
                other = self.trainer()
            assert file.read_bytes() == data
        assert refused > 0.7 * count
        write_checkpoint(file, "trainer", content)
        other.load(file)

    @pytest.mark.parametrize("counts", [[5, 1], [4, 2], [-4, -1], [4.0, 1], [4]])
    def test_steps_and_updates_must_fit(self, tmp_path, counts):
        trainer = self.trainer()
        trainer.update()
        content = record_of(trainer)
        assert content["counts"] == [4, 1]
        write_checkpoint(tmp_path / "policy.pt", "trainer", content | {"counts": counts})
        with pytest.raises(InvalidInput, match="counts"):
            trainer.load(tmp_path / "policy.pt")
        assert (trainer.steps, trainer.updates) == (4, 1)


POINTS = torch.linspace(0, 1, 9, dtype=F64)


def residuals(parameters, values):
    """Residuals of a line; its slope must not be negative."""
    if values["slope"] < 0:
        raise dc.SimulationError("a negative slope")
    return values["slope"] * POINTS + values["offset"] - 2 * POINTS - 1


class TestFit:
    # Residuals that a change makes large are a bad fit, and `fit` warns about it.
    @pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.CorrelatedResidualsWarning")
    @COUNTS
    def test_changes_of_evaluations_are_refused_or_harmless(self, tmp_path, count):
        generator = random.Random(3)
        variables = {"slope": dc.Variable(1.0), "offset": dc.Variable(0.0, scale="linear")}
        dc.fit(variables, residuals, resume=tmp_path)
        file = tmp_path / "start_0.pt"
        content = read_checkpoint("test", file, "fit")
        refused = 0
        for _ in range(count):
            write_checkpoint(file, "fit", mutated(content, generator))
            data = file.read_bytes()
            message = refusal(dc.fit, variables, residuals, resume=tmp_path)
            if message:
                refused += 1
                assert message.startswith("fit: `resume`")
                assert file.read_bytes() == data
            assert [f.name for f in tmp_path.iterdir()] == ["start_0.pt"]
        assert refused > 0.5 * count
        write_checkpoint(file, "fit", content)
        dc.fit(variables, residuals, resume=tmp_path)

    @pytest.mark.parametrize(
        ("kind", "rows", "message"),
        [
            ("residuals", slice(None, -1), "one number of residuals"),
            ("jacobian", (slice(None, -1), slice(None)), "one number of residuals"),
            ("jacobian", (slice(None), slice(None, -1)), "a column for each number"),
        ],
    )
    def test_records_must_fit_each_other(self, tmp_path, kind, rows, message):
        variables = {"slope": dc.Variable(1.0), "offset": dc.Variable(0.0, scale="linear")}
        dc.fit(variables, residuals, resume=tmp_path)
        content = read_checkpoint("test", tmp_path / "start_0.pt", "fit")
        record = next(r for r in content["records"] if r["kind"] == kind)
        record["found"] = record["found"][rows].clone()
        write_checkpoint(tmp_path / "start_0.pt", "fit", content)
        with pytest.raises(InvalidInput, match=message):
            dc.fit(variables, residuals, resume=tmp_path)


CONFIGURATIONS = {
    "train": """
task: train
environment: {name: FoldCloth, options: {size: 4, horizon: 5}}
trainer: {algorithm: apg, horizon: 2, hidden: [4]}
num_envs: 1
updates: 1
episodes: 1
viewers: []
""",
    "fit": """
task: identify
simulation: {dt: 0.02, steps: 1}
scene:
  cloths:
    - name: sheet
      shape: {kind: grid, rows: 2, columns: 2, size: 0.2}
      pins: {top: {vertices: [0, 1]}}
output: {viewers: []}
fit:
  variables: {stretch: {value: 4}}
  max_evaluations: 2
  trajectories:
    - {name: fall, steps: [1], noise: 1e-3, synthetic: {values: {stretch: 10}}}
""",
}


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
]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folders = {}
    for command in ("train", "fit", "optimize"):
        folder = tmp_path_factory.mktemp(command)
        arguments = [command, str(folder / "c.yaml"), "--out", str(folder / "out")]
        if command in CONFIGURATIONS:
            (folder / "c.yaml").write_text(CONFIGURATIONS[command])
        else:
            arguments[1] = str(CONFIGS / "hit_cloth.yaml")
            arguments += [*SMALL_HIT, "--set=output.viewers=[]"]
        result = CliRunner().invoke(main, arguments)
        assert result.exit_code == 0, result.output
        folders[command] = folder / "out"
    return folders


class TestCommands:
    """Behavior of `--resume` with arbitrary content of `resume.pt`."""

    @COUNTS
    @pytest.mark.parametrize("command", ["train", "fit", "optimize"])
    def test_changes_end_in_a_sentence_or_are_harmless(self, finished, command, count):
        generator = random.Random(4)
        file = finished[command] / "resume.pt"
        content = read_checkpoint("test", file, command)
        refused = 0
        for _ in range(count):
            write_checkpoint(file, command, mutated(content, generator))
            data = file.read_bytes()
            result = CliRunner().invoke(main, [command, "--resume", str(finished[command])])
            assert result.exception is None or isinstance(result.exception, SystemExit)
            assert result.exit_code in (0, 1, 2), result.output
            if result.exit_code:
                refused += 1
                assert len(result.stderr.strip().splitlines()) == 1, result.stderr
                assert file.read_bytes() == data
            names = {f.name for f in finished[command].rglob("*")}
            assert not {name for name in names if name.endswith((".part", ".lock"))}
        assert refused > 0.5 * count
        write_checkpoint(file, command, content)
        result = CliRunner().invoke(main, [command, "--resume", str(finished[command])])
        assert result.exit_code == 0, result.output
