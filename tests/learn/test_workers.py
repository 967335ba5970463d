"""Pieces of a training in other processes, on Ray and under torchrun: the same bits."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from diffcloth_torch import envs
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.learn import Processes, Ranks, RayActors, Trainer, TrainerOptions

MAKE = functools.partial(envs.make, "FoldCloth", size=6, horizon=5, opens_at=-1.0, reach=0.06)
OPTIONS = TrainerOptions(horizon=4, first_action=(0.0, 0.0, 0.1, 0.9) * 2)


def train(workers, updates=2):
    trainer = Trainer(MAKE, OPTIONS, num_envs=4, chunk=2, workers=workers)
    logs = [trainer.update() for _ in range(updates)]
    return trainer.policy.state_dict(), logs


@pytest.fixture(scope="module")
def here():
    return train(None)


def assert_same(found, expected):
    assert found[1] == expected[1]
    for name, tensor in expected[0].items():
        assert torch.equal(tensor, found[0][name]), name


def test_processes(here):
    workers = Processes(2)
    try:
        assert_same(train(workers), here)
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


def test_what_a_process_that_dies_did_not_finish_is_made_again(tmp_path):
    workers = Processes(2)
    try:
        items = [(tmp_path / "died", k) for k in range(4)]
        assert workers.map(die_once, items) == [0, 1, 2, 3]
        assert (tmp_path / "died").exists()
        with pytest.raises(RuntimeError, match="terminated abruptly"):
            workers.map(die, [0])
    finally:
        workers.close()


@pytest.mark.filterwarnings("ignore")
class TestRay:
    @pytest.fixture(scope="class")
    def ray(self):
        # Before the import, or Ray's processes disagree about it: a cluster of this test alone.
        os.environ.setdefault("RAY_AUTH_MODE", "disabled")
        ray = pytest.importorskip("ray")
        yield ray
        ray.shutdown()

    def test_same_bits_also_where_an_actor_is_killed(self, ray, here):
        workers = RayActors(2)
        try:
            assert_same(train(workers), here)
            trainer = Trainer(MAKE, OPTIONS, num_envs=4, chunk=2, workers=workers)
            logs = [trainer.update()]
            ray.kill(workers.actors[0], no_restart=False)
            logs.append(trainer.update())
            assert_same((trainer.policy.state_dict(), logs), here)
        finally:
            workers.close()


SCRIPT = """
import hashlib, sys
sys.path.insert(0, {folder!r})
import torch
from test_workers import train
from diffcloth_torch.learn import Ranks
workers = Ranks()
state, logs = train(workers)
assert workers.size == 2
print("bits", hashlib.sha256(b"".join(t.numpy().tobytes() for t in state.values())).hexdigest())
def refuse(number):
    if number == 1:
        raise ValueError("one refuses")
    return number
try:
    workers.map(refuse, [0, 1, 2])
except ValueError as error:
    print("all", error)
workers.close()
"""


def test_ranks_of_torchrun(tmp_path, here):
    import hashlib

    script = tmp_path / "job.py"
    script.write_text(SCRIPT.format(folder=str(Path(__file__).parent)))
    result = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2",
         "--master-port", "0", "--standalone", str(script)],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    bits = hashlib.sha256(b"".join(t.numpy().tobytes() for t in here[0].values())).hexdigest()
    assert result.stdout.split("\n").count(f"bits {bits}") == 2
    assert result.stdout.count("all one refuses") == 2


def test_ranks_need_a_job():
    with pytest.raises(InvalidInput, match="under torchrun"):
        Ranks()


def test_what_cannot_be_sent_is_refused():
    with pytest.raises(InvalidInput, match="can be pickled"):
        Trainer(lambda num_envs: MAKE(num_envs=num_envs), OPTIONS, workers=Processes(1))
    with pytest.raises(InvalidInput, match="`count`"):
        Processes(0)
