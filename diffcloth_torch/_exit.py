"""The end of the interpreter, while daemon threads compute steps.

Python then ends a thread as soon as it requests the GIL, by unwinding its stack, and destructors in
the C++ of torch and of the core abort the process. Before that, threads of the package may continue
until they are in the core, which blocks them there: see csrc/bind/without_gil.h.
"""

from __future__ import annotations

import atexit
import sys
import threading
import time
from pathlib import Path
from types import FrameType

import torch

from diffcloth_torch import _core

__all__ = ["note_caller"]

_LONGEST_WAIT = 5.0  # [s]
_PAUSE = 0.005  # [s]
_QUIET = 3  # successive polls without a thread at work: one may be between two steps
_OURS = str(Path(__file__).parent)
_BACKWARD = (str(Path(torch.autograd.__file__).parent), torch.Tensor.backward.__code__.co_filename)

_callers: set[int] = set()


def note_caller() -> None:
    """Record that the core works for this thread."""
    _callers.add(threading.get_ident())


def _works(frame: FrameType | None) -> bool:
    """Return whether a step, or a backward that may include one, is on a stack."""
    while frame is not None:
        if frame.f_code.co_filename.startswith((_OURS, *_BACKWARD)):
            return True
        frame = frame.f_back
    return False


def _park_threads() -> None:
    _core.abandon_calls()
    last = time.monotonic() + _LONGEST_WAIT
    quiet = 0
    while quiet < _QUIET and time.monotonic() < last:
        frames = sys._current_frames()
        others = _callers.intersection(frames) - {threading.get_ident(), *_core.parked_threads()}
        if not others:
            return
        quiet = 0 if any(_works(frames[ident]) for ident in others) else quiet + 1
        del frames
        time.sleep(_PAUSE)


atexit.register(_park_threads)
