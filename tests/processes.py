"""Threads of torch and processes of Python, for tests that need separate ones."""

import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

PATIENCE = 120.0  # seconds, for a machine under load


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Context with a number of threads for torch and for steps."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def run_python(code: str, **options) -> str:
    """Output of a script, which must succeed, with options of `subprocess.run`."""
    result = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        capture_output=True,
        text=True,
        check=False,
        **options,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def lives(pid: int) -> bool:
    """Return whether a process runs; an ended process may be a zombie until its parent waits."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state not in "ZX"


def children(pid: int) -> list[int]:
    """Processes that a process has started and that run."""
    try:
        text = "".join(f.read_text() for f in Path(f"/proc/{pid}/task").glob("*/children"))
    except (FileNotFoundError, ProcessLookupError):
        return []
    return [child for child in map(int, text.split()) if lives(child)]


def await_that(condition: Callable[[], bool], seconds: float = PATIENCE) -> None:
    """Wait until a condition holds, and fail after a generous time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)
