"""Pieces of a training in other processes, on Ray and under torchrun: the same bits."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest
import torch
from processes import await_that, lives

from diffcloth_torch import envs
from diffcloth_torch.errors import InvalidInput, WorkerError
from diffcloth_torch.learn import Jobs, Processes, Ranks, RayActors, Trainer, TrainerOptions

MAKE = functools.partial(envs.make, "FoldCloth", size=6, horizon=5, opens_at=-1.0, reach=0.06)
OPTIONS = TrainerOptions(horizon=4, first_action=(0.0, 0.0, 0.1, 0.9) * 2)


def train(workers, updates=2, make=MAKE):
    trainer = Trainer(make, OPTIONS, num_envs=4, chunk=2, workers=workers)
    logs = [trainer.update() for _ in range(updates)]
    return trainer.policy.state_dict(), logs


@pytest.fixture(scope="module")
def here():
    return train(None)


def assert_same(found, expected):
    assert found[1] == expected[1]
    for name, tensor in expected[0].items():
        assert torch.equal(tensor, found[0][name]), name


def test_processes_have_the_same_bits(here):
    workers = Processes(2)
    try:
        assert_same(train(workers), here)
    finally:
        workers.close()


@pytest.mark.slow
def test_jobs_of_any_executor_have_the_same_bits(here):
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        assert_same(train(Jobs(pool)), here)
        assert_same(train(pool), here)
        with pytest.raises(ZeroDivisionError):
            Jobs(pool).map(divide, [1, 0])


def divide(number):
    return 1 / number


def dies_in_its_first_worker(path, main, num_envs):
    """Make environments, but kill the first worker process that calls this function."""
    if os.getpid() != main and not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return MAKE(num_envs=num_envs)


def dying(folder):
    return functools.partial(dies_in_its_first_worker, folder / "died", os.getpid())


@pytest.mark.slow
def test_a_process_that_dies_in_an_update_changes_no_bit(here, tmp_path):
    workers = Processes(2)
    try:
        assert_same(train(workers, make=dying(tmp_path)), here)
        assert (tmp_path / "died").exists()
    finally:
        workers.close()


def die_once(path_and_number):
    path, number = path_and_number
    if number == 1 and not path.exists():
        path.touch()
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die(_):
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_unfinished_pieces_of_a_dead_process_are_repeated(tmp_path):
    workers = Processes(2)
    try:
        items = [(tmp_path / "died", k) for k in range(4)]
        assert workers.map(die_once, items) == [0, 1, 2, 3]
        assert (tmp_path / "died").exists()
        with pytest.raises(WorkerError, match="Processes: piece 0 of 1 was given up after 4"):
            workers.map(die, [0])
    finally:
        workers.close()


class TwoArgumentsError(Exception):
    """An error that cannot be unpickled, because its pickle has one argument of two."""

    def __init__(self, what, where):
        super().__init__(f"{what} in {where}")


def fail(item):
    raise TwoArgumentsError("no cloth", item)


def test_an_error_of_a_piece_is_reported_for_any_class():
    workers = Processes(1)
    try:
        with pytest.raises(RuntimeError, match="raised TwoArgumentsError: no cloth in 3"):
            workers.map(fail, [3])
        with pytest.raises(ZeroDivisionError):
            workers.map(divide, [0])
    finally:
        workers.close()


ACTORS = """
import sys
from diffcloth_torch.learn import RayActors
from test_workers import note_and_sleep
RayActors(1).map(note_and_sleep, [sys.argv[1]])
"""


def note_and_sleep(path):
    part = Path(f"{path}.part")
    part.write_text(str(os.getpid()))
    part.rename(path)
    time.sleep(1000)


@pytest.mark.filterwarnings("ignore")
class TestRay:
    @pytest.mark.slow
    def test_actors_end_with_the_driver(self, ray, tmp_path):
        script = tmp_path / "driver.py"
        script.write_text(ACTORS)
        file = tmp_path / "pid"
        driver = subprocess.Popen(
            [sys.executable, script, file], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        await_that(file.exists)
        driver.kill()
        driver.wait()
        await_that(lambda: not lives(int(file.read_text())))

    @pytest.fixture(scope="class")
    def ray(self):
        with pytest.MonkeyPatch.context() as patch:
            # Set before the import; otherwise Ray's processes disagree. The cluster serves only
            # this test.
            patch.setenv("RAY_AUTH_MODE", os.environ.get("RAY_AUTH_MODE", "disabled"))
            # Ray's processes import this file.
            for folder in Path(__file__).parents[:2]:
                patch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
            ray = pytest.importorskip("ray")
            yield ray
            ray.shutdown()

    @pytest.mark.slow
    def test_an_actor_that_dies_in_an_update_changes_no_bit(self, ray, here, tmp_path):
        workers = RayActors(2)
        try:
            assert_same(train(workers, make=dying(tmp_path)), here)
            assert (tmp_path / "died").exists()
        finally:
            workers.close()

    @pytest.mark.slow
    def test_an_actor_killed_between_updates_changes_no_bit(self, ray, here):
        workers = RayActors(2)
        try:
            trainer = Trainer(MAKE, OPTIONS, num_envs=4, chunk=2, workers=workers)
            logs = [trainer.update()]
            ray.kill(workers.actors[0], no_restart=False)
            logs.append(trainer.update())
            assert_same((trainer.policy.state_dict(), logs), here)
        finally:
            workers.close()

    @pytest.mark.slow
    def test_an_actor_that_dies_again_and_again_ends_the_work(self, ray):
        workers = RayActors(1)
        try:
            with pytest.raises(WorkerError, match="RayActors: piece 0 of 1 was given up after 4"):
                workers.map(die, [0])
        finally:
            workers.close()

    @pytest.mark.slow
    def test_an_actor_that_stops_ends_the_work_at_the_deadline(self, ray):
        workers = RayActors(1, deadline=600.0)
        workers.map(str, [1])
        workers._deadline = 1.0  # the actor has started
        with pytest.raises(WorkerError, match="piece 1 of 2 did not end within the deadline of"):
            workers.map(time.sleep, [0, 1000])
        with pytest.raises(InvalidInput, match="have been closed"):
            workers.map(str, [1])

    @pytest.mark.slow
    def test_ray_has_the_cores_that_actors_occupy(self, ray):
        ray.shutdown()
        workers = RayActors(2, cores=1.5)
        try:
            assert workers.map(str, [1, 2, 3]) == ["1", "2", "3"]
            assert ray.cluster_resources()["CPU"] == 3
        finally:
            workers.close()


SCRIPT = """
import hashlib, sys
sys.path[:0] = {folders!r}
import torch
from test_workers import MAKE, InvalidInput, TrainerOptions, Trainer, fail, train
from diffcloth_torch.learn import Ranks
workers = Ranks()
state, logs = train(workers)
assert workers.size == 2
digest = hashlib.sha256(b"".join(t.numpy().tobytes() for t in state.values())).hexdigest()
# In one piece: both ranks write to one pipe.
sys.stdout.write("bits " + digest + "\\n")
sys.stdout.flush()
def refuse(number):
    if number == 1:
        raise ValueError("one refuses")
    return number
try:
    workers.map(refuse, [0, 1, 2])
except ValueError as error:
    sys.stdout.write("all " + str(error) + "\\n")
    sys.stdout.flush()
try:
    workers.map(fail, [0, 1])
except RuntimeError as error:
    sys.stdout.write("told " * ("TwoArgumentsError" in str(error)) + "\\n")
    sys.stdout.flush()
try:
    Trainer(MAKE, TrainerOptions(seed=workers.rank), num_envs=2, chunk=1, workers=workers).update()
except InvalidInput as error:
    sys.stdout.write("ranks " * ("must be the same in all processes" in str(error)) + "\\n")
    sys.stdout.flush()
workers.close()
"""


@pytest.mark.slow
def test_ranks_of_torchrun_have_the_same_bits(tmp_path, here):
    import hashlib

    script = tmp_path / "job.py"
    script.write_text(SCRIPT.format(folders=[str(f) for f in Path(__file__).parents[:2]]))
    result = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2",
         "--master-port", "0", "--standalone", str(script)],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    bits = hashlib.sha256(b"".join(t.numpy().tobytes() for t in here[0].values())).hexdigest()
    assert result.stdout.split("\n").count(f"bits {bits}") == 2
    assert result.stdout.count("all one refuses") == 2
    assert result.stdout.count("told ") == 2
    assert result.stdout.count("ranks ") == 2


WAITING = """
import os, sys, time
from pathlib import Path
from diffcloth_torch.learn import Ranks
workers = Ranks()
Path(sys.argv[1], f"{workers.rank}.part").write_text(str(os.getpid()))
Path(sys.argv[1], f"{workers.rank}.part").rename(Path(sys.argv[1], str(workers.rank)))
workers.map(time.sleep, [1000, 1000])
"""


@pytest.mark.slow
def test_ranks_end_with_their_agent(tmp_path):
    script = tmp_path / "job.py"
    script.write_text(WAITING)
    files = [tmp_path / "0", tmp_path / "1"]
    agent = subprocess.Popen(
        [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2",
         "--master-port", "0", "--standalone", str(script), str(tmp_path)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    await_that(lambda: all(file.exists() for file in files))
    agent.kill()
    agent.wait()
    await_that(lambda: not any(lives(int(file.read_text())) for file in files))


def test_ranks_need_a_job():
    with pytest.raises(InvalidInput, match="under torchrun"):
        Ranks()


class _SecondRank(Ranks):
    """The second of two ranks, whose first has other options or weights."""

    def __init__(self):
        self.rank, self.size = 1, 2

    def _gather(self, value):
        return [b"other", value]


def test_an_update_needs_the_same_options_and_weights_in_all_ranks():
    trainer = Trainer(MAKE, OPTIONS, num_envs=2, chunk=1, workers=_SecondRank())
    with pytest.raises(InvalidInput, match="options and weights must be the same in all processes"):
        trainer.update()
    assert trainer.updates == 0


def test_objects_that_cannot_be_pickled_are_refused():
    with pytest.raises(InvalidInput, match="can be pickled"):
        Trainer(lambda num_envs: MAKE(num_envs=num_envs), OPTIONS, workers=Processes(1))
    for workers in (2, Processes):
        with pytest.raises(TypeError, match="`workers` must have `map`"):
            Trainer(MAKE, OPTIONS, workers=workers)
    with pytest.raises(TypeError, match="`options` must be TrainerOptions, got int"):
        Trainer(MAKE, 3)
    with pytest.raises(TypeError, match="`make_env` must be a function"):
        Trainer(3, OPTIONS)
    with pytest.raises(InvalidInput, match="`count`"):
        Processes(0)
    with pytest.raises(InvalidInput, match="`count` must be at most 4096"):
        Processes(10**9)
    for deadline in (0.0, 1e30):
        with pytest.raises(InvalidInput, match="`deadline` must be between 0 and 1e"):
            Processes(1, deadline=deadline)
