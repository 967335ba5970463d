"""A worker process of `processes.Pool`: it computes pieces, and ends with its parent process.

The module imports the standard library alone: a worker watches its parent before it imports torch,
which takes seconds.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import pickle
import signal
import threading
import time
import traceback
from multiprocessing import spawn
from multiprocessing.connection import Connection

__all__ = ["end_with_parent", "main", "note_progress", "portable"]

_PAUSE = 0.2  # seconds between two looks at the parent
_BETWEEN_SIGNS = 0.5  # seconds between two signs of progress
_PARENT_DIED = 1  # exit code
_PR_SET_PDEATHSIG = 1  # linux/prctl.h

_parent: Connection | None = None  # of this process, if it is a worker
_last_sign = 0.0


def end_with_parent(parent: int, *, by_signal: bool = False) -> None:
    """End this process soon after its parent process has ended, however the parent ended.

    A thread compares the number of the parent process. A pipe to the parent would not do: a process
    that the parent forks holds the pipe open.

    Args:
        parent: Number of the parent process.
        by_signal: Whether the kernel sends SIGKILL, too, which ends even a process that is stopped.
            The kernel sends it when the thread ends that started this process, so that this must
            be the main thread of the parent.
    """
    if by_signal:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGKILL))
    if os.getppid() != parent:  # it ended before
        os._exit(_PARENT_DIED)
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_PAUSE)
    os._exit(_PARENT_DIED)


def note_progress() -> None:
    """Begin the deadline of the piece of this worker anew; in other processes it does nothing."""
    global _last_sign
    if _parent is not None and time.monotonic() > _last_sign + _BETWEEN_SIGNS:
        _last_sign = time.monotonic()
        _parent.send_bytes(pickle.dumps(None))


def portable(error: Exception) -> Exception:
    """The error, or its text if it cannot be pickled and read again."""
    try:
        copy = pickle.loads(pickle.dumps(error))
    except Exception:  # any that a class with arguments of its own raises
        copy = None
    if type(copy) is type(error):
        return error
    text = "".join(traceback.format_exception(error))
    return RuntimeError(f"a worker raised {type(error).__qualname__}: {error}\n{text}")


def main(descriptor: int, parent: int, by_signal: int) -> None:
    """Compute the pieces that arrive, until the parent closes the connection or ends.

    Args:
        descriptor: File descriptor of the connection to the parent.
        parent: Number of the parent process.
        by_signal: See `end_with_parent`.
    """
    global _parent
    end_with_parent(parent, by_signal=bool(by_signal))
    _parent = Connection(descriptor)
    # As processes of `multiprocessing` that are spawned: the main module of the parent is imported,
    # and one that would start workers while it is imported is refused.
    process = multiprocessing.current_process()
    process._inheriting = True  # type: ignore[attr-defined]
    spawn.prepare(pickle.loads(_parent.recv_bytes()))
    del process._inheriting  # type: ignore[attr-defined]
    _parent.send_bytes(pickle.dumps(None))
    while True:
        try:
            piece = _parent.recv_bytes()
        except (EOFError, OSError):
            return
        _parent.send_bytes(_answer(piece))


def _answer(piece: bytes) -> bytes:
    """Compute a piece; an error and its traceback are an answer, too."""
    try:
        function, item = pickle.loads(piece)
        return pickle.dumps((function(item), None, ""))
    except Exception as error:
        return pickle.dumps((None, portable(error), traceback.format_exc()))
