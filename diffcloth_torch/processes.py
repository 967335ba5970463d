"""Worker processes on this machine: pieces of work with a deadline, repeated if a worker dies.

Executors of `concurrent.futures` wait forever for a worker that has stopped, and leave their
workers behind if this process is killed. The workers of a `Pool` end with this process, see
`worker`.
"""

from __future__ import annotations

import contextlib
import multiprocessing.connection
import os
import pickle
import signal
import socket
import struct
import subprocess
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from multiprocessing import spawn
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from diffcloth_torch.errors import WorkerError

__all__ = ["DEADLINE", "LARGEST_WORKERS", "LONGEST_DEADLINE", "Pool"]

A = TypeVar("A")
B = TypeVar("B")

DEADLINE = 3600.0
"""Default of the longest time of a piece [s]."""

LONGEST_DEADLINE = 1e7
"""Largest accepted deadline [s], four months."""

LARGEST_WORKERS = 4096
"""Largest accepted number of processes or actors: more than the cores of any machine."""

_REPEATS = 3  # of a piece whose worker died or stopped
_LONGEST_START = 600.0  # seconds until a worker has imported the main module
_BOOT = """import sys
sys.path.insert(0, {path!r})
from diffcloth_torch.worker import main
main{arguments}
"""


class _Process:
    """A worker process, and the piece that it computes.

    Attributes:
        piece: Index of the piece; None if there is none.
        ready: True if the process has started.
    """

    def __init__(self, deadline: float) -> None:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            # Messages are larger than the buffer of a socket: a worker that has stopped must not
            # block this process.
            limit = struct.pack("ll", *divmod(int(1e6 * deadline) + 1, 1_000_000))
            for option in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
                ours.setsockopt(socket.SOL_SOCKET, option, limit)
            arguments = theirs.fileno(), os.getpid(), int(_is_main_thread())
            path = str(Path(__file__).parents[1])
            flags = subprocess._args_from_interpreter_flags()  # type: ignore[attr-defined]
            code = _BOOT.format(path=path, arguments=arguments)
            # Ctrl-C reaches all processes of a terminal, but only this one ends its workers, which
            # inherit the mask.
            mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
            try:
                self._process = subprocess.Popen(
                    [os.fsdecode(spawn.get_executable()), *flags, "-c", code],
                    stdin=subprocess.DEVNULL,
                    pass_fds=[theirs.fileno()],
                )
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, mask)
            self.connection = Connection(ours.detach())
        self.piece: int | None = None
        self.ready = False
        self.since = time.monotonic()
        self._deadline = deadline
        preparation = spawn.get_preparation_data("worker")
        preparation["authkey"] = bytes(preparation["authkey"])
        self.connection.send_bytes(pickle.dumps(preparation))

    @property
    def is_idle(self) -> bool:
        """Return whether the process waits for a piece."""
        return self.ready and self.piece is None

    @property
    def seconds_left(self) -> float:
        """Time until the deadline of the piece."""
        longest = self._deadline if self.ready else _LONGEST_START
        return self.since + longest - time.monotonic()

    def take(self, piece: int, message: bytes) -> None:
        """Begin a piece."""
        self.piece, self.since = piece, time.monotonic()
        self.connection.send_bytes(message)

    def end(self) -> int:
        """Kill a running process; return its exit code, or minus the signal that ended it."""
        self.connection.close()
        self._process.kill()
        return self._process.wait()

    def fate(self) -> str:
        """End the process, and return the reason for its missing answer."""
        if self.seconds_left <= 0:
            self.end()
            if not self.ready:
                return f"its process did not start within {_LONGEST_START:g} s"
            return f"it did not end within its deadline of {self._deadline:g} s"
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)  # the connection closes before the process has ended
        code = self.end()
        if code >= 0:
            return f"its process ended with the exit code {code}"
        return f"its process was ended by {signal.Signals(-code).name}"


class Pool:
    """Worker processes, which end with `close`, and in every case with this process."""

    def __init__(self, name: str, count: int, deadline: float) -> None:
        """Prepare to start processes.

        Args:
            name: Name of the pool in messages.
            count: Number of processes.
            deadline: Longest time of a piece, or between two of its calls of
                `worker.note_progress` [s].
        """
        self._name, self._count, self._deadline = name, count, deadline
        self._processes: list[_Process] = []
        weakref.finalize(self, _end, self._processes)

    def map(self, function: Callable[[A], B], items: Sequence[A]) -> Iterator[B]:
        """Yield results in the order of the items.

        Raises:
            WorkerError: If the processes of a piece die or miss its deadline repeatedly.
        """
        work = _Work(self._name, function, items)
        try:
            for k in range(len(items)):
                while k not in work.answers:
                    self._advance(work)
                value, error, text = work.answers.pop(k)
                if error is not None:
                    raise error from (RuntimeError(f"in a worker:\n{text}") if text else None)
                yield value
        finally:
            # The remaining pieces are not needed.
            self._end([p for p in self._processes if p.piece is not None])

    def close(self) -> None:
        """End the processes."""
        self._end(list(self._processes))

    def _end(self, processes: list[_Process]) -> None:
        for process in processes:
            self._processes.remove(process)
        _end(processes)

    def _advance(self, work: _Work) -> None:
        """Assign pieces, and wait for a message or for a deadline."""
        busy = sum(process.piece is not None for process in self._processes)
        while len(self._processes) < min(self._count, busy + len(work.waiting)):
            self._processes.append(_Process(self._deadline))
        for process in [p for p in self._processes if p.is_idle]:
            if work.waiting:
                message = work.message(work.waiting[0])
                piece = work.waiting.popleft()
                take = partial(_Process.take, piece=piece, message=message)
                self._guarded(process, work, take)
        awaited = [p for p in self._processes if not p.is_idle]
        left = min((p.seconds_left for p in awaited), default=0.0)
        ready = multiprocessing.connection.wait([p.connection for p in awaited], max(left, 0.0))
        for process in awaited:
            if process.connection in ready:
                self._guarded(process, work, partial(_receive, work))
            elif process.seconds_left <= 0:
                self._lose(process, work)

    def _guarded(
        self, process: _Process, work: _Work, exchange: Callable[[_Process], None]
    ) -> None:
        try:
            exchange(process)
        except (EOFError, OSError):
            self._lose(process, work)

    def _lose(self, process: _Process, work: _Work) -> None:
        self._processes.remove(process)
        work.lose(process.piece, process.fate())


class _Work:
    """The pieces of a call of `map`.

    Attributes:
        waiting: Indices of pieces without a process.
        answers: Index of a piece -> its result, its error and the traceback of the error.
    """

    def __init__(self, name: str, function: Callable[[Any], Any], items: Sequence[Any]) -> None:
        self._name, self._function, self._items = name, function, items
        self.waiting = deque(range(len(items)))
        self.answers: dict[int, tuple[Any, Exception | None, str]] = {}
        self._losses: dict[int | None, int] = {}

    def message(self, piece: int) -> bytes:
        """Return the bytes of a piece for a worker."""
        return pickle.dumps((self._function, self._items[piece]))

    def lose(self, piece: int | None, fate: str) -> None:
        """Repeat a piece whose process was lost, or give up; None for a process without a piece."""
        self._losses[piece] = self._losses.get(piece, 0) + 1
        is_last = self._losses[piece] > _REPEATS
        if piece is None:
            if is_last:
                raise WorkerError(
                    f"{self._name}: no process could start, in {_REPEATS + 1} attempts: {fate}; a "
                    'script that starts processes needs `if __name__ == "__main__":`'
                )
        elif is_last:
            text = f"piece {piece} of {len(self._items)} was given up after {_REPEATS + 1} attempts"
            self.answers[piece] = None, WorkerError(f"{self._name}: {text}: {fate}"), ""
        else:
            self.waiting.appendleft(piece)


def _receive(work: _Work, process: _Process) -> None:
    answer = pickle.loads(process.connection.recv_bytes())
    process.since = time.monotonic()
    process.ready = True
    if answer is not None:
        assert process.piece is not None
        work.answers[process.piece] = answer
        process.piece = None


def _end(processes: list[_Process]) -> None:
    while processes:
        processes.pop().end()


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
