"""Worker processes: order, deaths, deadlines, and that none is left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time

import pytest
from processes import PATIENCE, await_that, children, lives

from diffcloth_torch.errors import WorkerError
from diffcloth_torch.processes import Pool
from diffcloth_torch.worker import note_progress


@pytest.fixture
def pool():
    with_two = Pool("pool", 2, 120.0)
    yield with_two
    with_two.close()


def work(item):
    kind, value, folder = item
    if kind == "wait for":
        await_that((folder / value).exists)
    if kind in ("die", "die once", "stop once") and (kind == "die" or not (folder / kind).exists()):
        (folder / kind).touch()
        os.kill(os.getpid(), signal.SIGSTOP if kind == "stop once" else signal.SIGKILL)
    if kind == "exit":
        os._exit(3)
    if kind == "sleep":
        time.sleep(1000)
    if kind == "progress":
        for _ in range(18):
            time.sleep(1.0)
            note_progress()
    if kind == "raise":
        raise value
    if kind == "touch":
        (folder / value).touch()
    return os.getpid() if kind == "pid" else value


def test_results_are_in_the_order_of_the_items(pool, tmp_path):
    """The first item ends after the second one, in another process."""
    items = [("wait for", "a", tmp_path), ("touch", "a", tmp_path), ("", 3, tmp_path)]
    assert list(pool.map(work, items)) == ["a", "a", 3]
    assert list(pool.map(work, [])) == []


def test_large_pieces_and_results_pass(pool):
    data = os.urandom(3_000_000)
    assert list(pool.map(work, [("", data, None)] * 3)) == [data] * 3


def test_an_error_of_a_piece_is_raised_with_its_traceback(pool):
    with pytest.raises(ZeroDivisionError) as caught:
        list(pool.map(work, [("", 0, None), ("raise", ZeroDivisionError("at 3"), None)]))
    assert "in work" in str(caught.value.__cause__)
    assert list(pool.map(work, [("", 1, None)])) == [1]  # the pool still works


def test_a_piece_of_a_process_that_dies_is_repeated(pool, tmp_path):
    items = [("", 1, tmp_path), ("die once", 2, tmp_path), ("", 3, tmp_path)]
    assert list(pool.map(work, items)) == [1, 2, 3]
    assert (tmp_path / "die once").exists()


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (
            "die",
            "pool: piece 1 of 2 was given up after 4 attempts: its process was ended by SIGKILL",
        ),
        ("exit", "its process ended with the exit code 3"),
    ],
)
def test_a_piece_whose_processes_die_ends_in_a_sentence(pool, tmp_path, kind, message):
    with pytest.raises(WorkerError, match=message):
        list(pool.map(work, [("", 1, tmp_path), (kind, 2, tmp_path)]))


@pytest.mark.slow
def test_a_process_that_stops_is_replaced_at_the_deadline(tmp_path):
    pool = Pool("pool", 1, 15.0)  # on a loaded machine, importing this file needs seconds
    try:
        assert list(pool.map(work, [("stop once", 5, tmp_path)])) == [5]
    finally:
        pool.close()


def test_a_process_that_stops_again_and_again_ends_in_a_sentence(tmp_path):
    pool = Pool("pool", 1, 0.3)
    try:
        with pytest.raises(WorkerError, match=r"did not end within its deadline of 0\.3 s"):
            list(pool.map(work, [("sleep", 0, tmp_path)]))
    finally:
        pool.close()


@pytest.mark.slow
def test_progress_begins_the_deadline_anew(tmp_path):
    pool = Pool("pool", 1, 15.0)  # the piece needs 18 s
    try:
        assert list(pool.map(work, [("progress", 7, tmp_path)])) == [7]
    finally:
        pool.close()


@pytest.mark.slow
def test_a_stopped_process_does_not_block_the_one_that_sends(tmp_path):
    """The piece is larger than the buffer of a socket."""
    pool = Pool("pool", 1, 15.0)
    try:
        (pid,) = pool.map(work, [("pid", 0, tmp_path)])
        os.kill(pid, signal.SIGSTOP)
        assert list(pool.map(len, [bytes(3_000_000)])) == [3_000_000]
        assert not lives(pid)
    finally:
        pool.close()


def test_an_idle_process_that_died_is_replaced(pool, tmp_path):
    (pid,) = pool.map(work, [("pid", 0, tmp_path)])
    os.kill(pid, signal.SIGKILL)
    await_that(lambda: not lives(pid))
    assert list(pool.map(work, [("", 4, tmp_path)])) == [4]


def test_close_ends_the_processes(tmp_path):
    pool = Pool("pool", 2, 120.0)
    pids = list(pool.map(work, [("pid", 0, tmp_path)] * 8))
    assert len(set(pids)) <= 2
    assert all(os.getsid(pid) == os.getsid(0) for pid in pids)
    pool.close()
    assert not any(map(lives, pids))


# Two workers: one has its own worker, the other is stopped; a forked process keeps all connections
# open.
SCRIPT = """
import os, signal, sys, time
from pathlib import Path
from diffcloth_torch.processes import Pool

def note(name):
    part = Path(sys.argv[1], name + ".part")
    part.write_text(str(os.getpid()))
    part.rename(Path(sys.argv[1], name))

def work(name):
    if name == "outer":
        list(Pool("inner", 1, 1e4).map(work, ["inner"]))
    note(name)
    if name == "stopped":
        os.kill(os.getpid(), signal.SIGSTOP)
    time.sleep(1e4)

def hold():
    if os.fork() == 0:
        note("forked")
        time.sleep(1e4)

if __name__ == "__main__":
    # Shells ignore the interrupt in background jobs, and nohup ignores SIGHUP; both are inherited.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    note("main")
    import threading
    pool = Pool("pool", 2, 1e4)
    threading.Timer(1.0, hold).start()
    try:
        list(pool.map(work, ["outer", "stopped"]))
    except KeyboardInterrupt:
        print("interrupted")
"""


def started(tmp_path, names):
    """A main process of the script, and the process ids of its workers."""
    script = tmp_path / "main.py"
    script.write_text(textwrap.dedent(SCRIPT))
    with (tmp_path / "output").open("w") as output:
        main = subprocess.Popen(
            [sys.executable, script, tmp_path], stdout=output, stderr=subprocess.STDOUT
        )
    await_that(lambda: all((tmp_path / name).exists() for name in names))
    return main, {name: int((tmp_path / name).read_text()) for name in names}


@pytest.mark.parametrize("number", ["SIGTERM", "SIGKILL", "SIGHUP", "SIGABRT"])
def test_processes_end_with_the_one_that_started_them(tmp_path, number):
    main, pids = started(tmp_path, ["forked", "inner", "stopped"])
    try:
        main.send_signal(signal.Signals[number])
        main.wait(PATIENCE)
        await_that(lambda: not lives(pids["inner"]) and not lives(pids["stopped"]))
        assert lives(pids["forked"])  # which held the connections
    finally:
        os.kill(pids["forked"], signal.SIGKILL)


def test_processes_end_while_they_start(tmp_path):
    """The main process is killed as soon as it has begun to start its processes."""
    main, _ = started(tmp_path, ["main"])
    await_that(lambda: len(children(main.pid)) == 2)
    pids = children(main.pid)
    main.kill()
    main.wait(PATIENCE)
    await_that(lambda: not any(map(lives, pids)))


def test_an_interrupt_ends_the_processes(tmp_path):
    main, pids = started(tmp_path, ["forked", "inner", "stopped"])
    try:
        for pid in (main.pid, pids["inner"]):  # a terminal sends the interrupt to all
            os.kill(pid, signal.SIGINT)
        assert main.wait(PATIENCE) == 0
        assert (tmp_path / "output").read_text() == "interrupted\n"
        await_that(lambda: not lives(pids["inner"]) and not lives(pids["stopped"]))
    finally:
        os.kill(pids["forked"], signal.SIGKILL)


def test_a_script_without_a_guard_is_refused(tmp_path):
    script = tmp_path / "main.py"
    script.write_text(
        "from diffcloth_torch.processes import Pool\n"
        "pool = Pool('pool', 1, 60.0)\n"
        "print(list(pool.map(abs, [-1])))\n"
    )
    result = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, check=False, timeout=PATIENCE
    )
    assert result.returncode == 1
    assert "pool: no process could start, in 4 attempts" in result.stderr
    assert '`if __name__ == "__main__":`' in result.stderr
