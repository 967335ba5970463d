"""Files: only regular ones are read; a file is replaced completely or not at all."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from diffcloth_torch.errors import InvalidInput

__all__ = [
    "INTEGER",
    "NUMBER",
    "PART",
    "as_path",
    "open_regular_file",
    "read_regular_file",
    "replace_file",
    "writing",
]

PART = ".part"
"""Suffix of a file that is being written, and will replace another one."""

INTEGER = re.compile(rb"[+-]?[0-9]+")
"""An integer in a text file. Python alone would also read 1_0 and digits of other scripts."""

NUMBER = re.compile(rb"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?|[+-]?(?:nan|inf)")
"""A number in a text file, in the notation of C."""


def as_path(name: str, value: object) -> Path:
    """Require text or a path object."""
    if not isinstance(value, str | Path):
        raise TypeError(f"{name} must be a string or a Path, got {type(value).__name__}")
    if "\0" in str(value):
        raise InvalidInput(f"{name} must have no NUL, as no path has, got {str(value)!r}")
    return Path(value)


@contextmanager
def open_regular_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file to read.

    Reading a pipe or a device, also through a link, could wait forever.

    Raises:
        InvalidInput: If it is not a regular file.
        OSError: If it does not exist or cannot be read.
    """
    try:
        regular = stat.S_ISREG(path.stat().st_mode)
    except ValueError as error:  # a NUL in the path
        raise InvalidInput(f"{str(path)!r} is no path: {error}") from error
    if regular:
        # The file at the path may have changed since: opening it must not wait either.
        with open(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)), "rb") as file:  # noqa: PTH123
            if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                yield file
                return
    raise InvalidInput(f"{path}: must be a regular file, no folder, pipe or device")


def read_regular_file(path: Path, largest: int) -> bytes:
    """Read a whole file; see `open_regular_file`.

    Args:
        path: The file.
        largest: Largest accepted size [bytes].

    Raises:
        InvalidInput: If it is not a regular file, or larger.
        OSError: If it does not exist or cannot be read.
    """
    with open_regular_file(path) as file:
        if os.fstat(file.fileno()).st_size <= largest:
            data = file.read(largest + 1)
            if len(data) <= largest:
                return data
    raise InvalidInput(f"{path}: must be at most {largest >> 20} MiB")


@contextmanager
def replace_file(path: Path, *, keeps_ending: bool = False) -> Iterator[Path]:
    """Yield a path for writing; the file there replaces `path` at the end.

    If the block fails, the file at `path` is unchanged, and no other file is left.

    Args:
        path: The file.
        keeps_ending: If true, the other path has the ending of `path`, for writers that choose a
            format by the ending.

    Raises:
        OSError: If it cannot be written; the message is a sentence.
    """
    name = f"{path.stem}{PART}{path.suffix}" if keeps_ending else path.name + PART
    part = path.with_name(name)
    try:
        with writing(path):
            yield part
            with part.open("rb+") as file:  # before the rename, so that a crash keeps either file
                os.fsync(file.fileno())
            part.replace(path)
    except BaseException:
        with suppress(OSError):  # the first error is reported
            part.unlink(missing_ok=True)
        raise


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Add the name of a file or folder to disk errors of a block that writes it.

    Raises:
        OSError: Of the class that the block raised; the message is a sentence.
    """
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, f"{path} cannot be written: {error.strerror}") from error
