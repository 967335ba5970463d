"""A worker process of `processes.Pool`: computes pieces, and ends with its parent process.

The module imports only the standard library: a worker must watch its parent before it imports
torch, which takes seconds.
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

_PAUSE = 0.2  # seconds between two checks of the parent
_BETWEEN_SIGNS = 0.5  # seconds between two signs of progress
_PARENT_DIED = 1  # exit code
_PR_SET_PDEATHSIG = 1  # linux/prctl.h

_parent: Connection | None = None  # of this process, if it is a worker
_last_sign = 0.0


def end_with_parent(parent: int, *, by_signal: bool = False) -> None:
    """End this process soon after its parent process has ended for any reason.

    A thread compares the number of the parent process. A pipe to the parent would not suffice: a
    process that the parent forks keeps the pipe open.

    Args:
        parent: Number of the parent process.
        by_signal: If true, the kernel also sends SIGKILL, which ends even a stopped process. The
            kernel sends it when the thread ends that started this process, so that this must be the
            main thread of the parent.
    """
    if by_signal:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGKILL))
    if os.getppid() != parent:  # the parent ended before
        os._exit(_PARENT_DIED)
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_PAUSE)
    os._exit(_PARENT_DIED)


def note_progress() -> None:
    """Restart the deadline of the piece of this worker; in other processes, do nothing."""
    global _last_sign
    if _parent is not None and time.monotonic() > _last_sign + _BETWEEN_SIGNS:
        _last_sign = time.monotonic()
        _parent.send_bytes(pickle.dumps(None))


def portable(error: Exception) -> Exception:
    """Return the error, or its text if it cannot be pickled and read again."""
    try:
        copy = pickle.loads(pickle.dumps(error))
    except Exception:  # any error of a class with arguments of its own
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
    # As for spawned processes of `multiprocessing`: the main module of the parent is imported, and
    # a main module that would start workers during its import is refused.
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
    """Compute a piece; an error and its traceback are answers as well."""
    try:
        function, item = pickle.loads(piece)
        return pickle.dumps((function(item), None, ""))
    except Exception as error:
        return pickle.dumps((None, portable(error), traceback.format_exc()))
