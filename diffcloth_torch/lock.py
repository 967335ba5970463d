"""A lock of a folder: only one process writes results into it."""

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import PART, writing

__all__ = ["LOCK", "locked"]

LOCK = ".lock"
"""Name of the lock file in a folder; it contains the process and the machine."""


@contextmanager
def locked(owner: str, folder: Path) -> Iterator[None]:
    """Make a folder, and keep other processes from using it during a block.

    The lock ends with the process, in every case. Unfinished files of a killed process are removed.

    Args:
        owner: Prefix of messages.
        folder: The folder.

    Raises:
        InvalidInput: If another process has the lock.
        OSError: If the folder cannot be made or written.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = _acquired(owner, folder)
    try:
        for part in folder.glob(f"*{PART}"):
            if part.is_file():
                part.unlink()
        yield
    finally:
        (folder / LOCK).unlink(missing_ok=True)
        os.close(descriptor)


def _acquired(owner: str, folder: Path) -> int:
    """Acquire the lock of a folder; return its file descriptor."""
    path = folder / LOCK
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(descriptor, 200).decode(errors="replace") or "another process"
            os.close(descriptor)
            raise InvalidInput(
                f"{owner}: {folder} is in use by {holder}: wait until it ends, or use another "
                "folder"
            ) from None
        if _is_at(descriptor, path):
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode())
            return descriptor
        os.close(descriptor)


def _is_at(descriptor: int, path: Path) -> bool:
    """Return whether an open file still exists: its previous holder may have removed it."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
