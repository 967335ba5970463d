"""Files: only regular ones of a bounded size are read; new ones replace old ones as a whole."""

from __future__ import annotations

import errno
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from diffcloth_torch.errors import InvalidInput

__all__ = ["INTEGER", "NUMBER", "as_path", "read_regular_file", "replacing"]

INTEGER = re.compile(rb"[+-]?[0-9]+")
"""An integer in a text file. Python alone would also read 1_0 and digits of other scripts."""

NUMBER = re.compile(rb"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?|[+-]?(?:nan|inf)")
"""A number in a text file, as C writes it."""


def as_path(name: str, value: object) -> Path:
    """Require text or a path object."""
    if not isinstance(value, str | Path):
        raise TypeError(f"{name} must be a string or a Path, got {type(value).__name__}")
    if "\0" in str(value):
        raise InvalidInput(f"{name} must have no NUL, as no path has, got {str(value)!r}")
    return Path(value)


def read_regular_file(path: Path, largest: int) -> bytes:
    """Read a file whole.

    Reading a pipe or a device, also behind a link, could wait forever.

    Args:
        path: The file.
        largest: Largest accepted size [bytes].

    Raises:
        InvalidInput: If it is not a regular file, or larger.
        OSError: If it does not exist or cannot be read.
    """
    try:
        regular = stat.S_ISREG(path.stat().st_mode)
    except ValueError as error:  # a NUL in the path
        raise InvalidInput(f"{str(path)!r} is no path: {error}") from error
    if regular:
        # The file at the path may have changed since: opening it must not wait either.
        with open(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)), "rb") as file:  # noqa: PTH123
            status = os.fstat(file.fileno())
            regular = stat.S_ISREG(status.st_mode)
            if regular and status.st_size <= largest:
                data = file.read(largest + 1)
                if len(data) <= largest:
                    return data
    if not regular:
        raise InvalidInput(f"{path}: must be a regular file, no folder, pipe or device")
    raise InvalidInput(f"{path}: must be at most {largest >> 20} MiB")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path to write to, of the same ending, which replaces `path` when all is written.

    Raises:
        FileNotFoundError: If there is no folder for the file.
    """
    if not path.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path.parent))
    part = path.with_name(f"{path.stem}.part{path.suffix}")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
