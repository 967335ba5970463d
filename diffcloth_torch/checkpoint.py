"""Checkpoints: one file format for trainings, fits and optimizations, verified before use.

A file is an archive of `torch.save`, which `torch.load` reads, followed by a record: JSON with the
format, the kind of content and the version of the package; a digest of everything before it; the
length of the JSON; and a mark. The digest is verified before anything is unpickled. Files of 0.1
consist of the archive alone.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
import os
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import LARGEST_COUNT
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.files import open_regular_file, replace_file
from diffcloth_torch.saved_0_1 import CHECKPOINTS

__all__ = [
    "FORMAT",
    "check_generator",
    "check_like",
    "check_optimizer",
    "check_structure",
    "read_checkpoint",
    "refusing_damage",
    "write_checkpoint",
]

FORMAT = 1
"""Number of the format; increased if an older reader would misread a file."""

_MARK = b"diffclth"
_DIGEST_SIZE = hashlib.sha256().digest_size
_LENGTH_SIZE = 4
_LARGEST_RECORD = 4096  # bytes of JSON
_END_SIZE = _DIGEST_SIZE + _LENGTH_SIZE + len(_MARK)
_CHUNK = 1 << 20  # bytes hashed at once

_ARCHIVE, _ARCHIVE_END = b"PK\x03\x04", b"PK\x05\x06"  # signatures of a ZIP file
_ARCHIVE_REST = 18  # bytes after the end signature; the last two hold the length of a comment


def write_checkpoint(path: Path, kind: str, content: object) -> None:
    """Write a file, which replaces an older one completely or not at all.

    Args:
        path: The file, in an existing folder.
        kind: Kind of the content, such as "trainer".
        content: Content, of types that `torch.load` reads with `weights_only`.

    Raises:
        OSError: If the file cannot be written; an older file at `path` remains unchanged.
    """
    # Written by Python: torch.save to a path would report a full disk as a RuntimeError.
    archive = BytesIO()
    torch.save(content, archive)
    record = {"format": FORMAT, "kind": kind, "version": version("diffcloth-torch")}
    text = json.dumps(record).encode()
    digest = hashlib.sha256(archive.getbuffer())
    digest.update(text)
    with replace_file(path) as part, part.open("wb") as file:
        file.write(archive.getbuffer())
        file.write(text + digest.digest() + len(text).to_bytes(_LENGTH_SIZE, "little") + _MARK)


def read_checkpoint(owner: str, path: Path, *kinds: str) -> Any:
    """Read the content of a file after verification of its digest.

    Args:
        owner: Prefix of messages.
        path: The file.
        kinds: Accepted kinds of content, as in `write_checkpoint`.

    Raises:
        InvalidInput: If the file has no content of these kinds, or was changed since it was
            written.
        OSError: If the file cannot be read.
    """
    with open_regular_file(path) as file:
        old = [kind for kind in kinds if kind in CHECKPOINTS]
        if old and _is_of_0_1(file):
            return _read_0_1(owner, path, file, old[0])
        file.seek(0)
        record = _record(owner, path, file)
        if record["format"] != FORMAT:
            raise InvalidInput(
                f"{owner}: {path} has the format {record['format']} of diffcloth_torch "
                f"{record['version']}, this version reads {FORMAT}"
            )
        if record["kind"] not in kinds:
            accepted = " or a ".join(kinds)
            raise InvalidInput(
                f"{owner}: {path} must be a checkpoint of a {accepted}, got one of a "
                f"{record['kind']}"
            )
        file.seek(0)
        with refusing_damage(owner, path):
            return torch.load(file, map_location=cpu.DEVICE, weights_only=True)


def _is_of_0_1(file: BinaryIO) -> bool:
    """Return whether a file begins and ends like an archive without a comment."""
    start = file.read(len(_ARCHIVE))
    file.seek(max(os.fstat(file.fileno()).st_size - len(_ARCHIVE_END) - _ARCHIVE_REST, 0))
    end = file.read()
    return start == _ARCHIVE and end.startswith(_ARCHIVE_END) and end.endswith(b"\0\0")


def _read_0_1(owner: str, path: Path, file: BinaryIO, kind: str) -> Any:
    with refusing_damage(owner, path):
        # torch does not verify the checksums of an archive.
        damaged = zipfile.ZipFile(file).testzip()
        if damaged is not None:
            raise InvalidInput(f"its entry {damaged} was changed since it was written")
        file.seek(0)
        content = torch.load(file, map_location=cpu.DEVICE, weights_only=True)
        try:
            return CHECKPOINTS[kind](content)
        except (KeyError, TypeError, ValueError) as error:
            raise InvalidInput(
                f"it is no complete checkpoint, nor one of a {kind} of 0.1"
            ) from error


def _record(owner: str, path: Path, file: BinaryIO) -> dict[str, Any]:
    size = os.fstat(file.fileno()).st_size
    file.seek(max(size - _END_SIZE, 0))
    end = file.read(_END_SIZE)
    if len(end) < _END_SIZE or not end.endswith(_MARK):
        raise InvalidInput(
            f"{owner}: {path} is no complete checkpoint: it was cut off, or was written by another "
            "program"
        )
    length = int.from_bytes(end[_DIGEST_SIZE : -len(_MARK)], "little")
    before = size - _END_SIZE - length
    digest = hashlib.sha256()
    text = b""
    if length <= _LARGEST_RECORD and before >= 0:
        file.seek(0)
        left = before
        while left > 0 and (data := file.read(min(left, _CHUNK))):
            digest.update(data)
            left -= len(data)
        text = file.read(length)
        digest.update(text)
    if digest.digest() != end[:_DIGEST_SIZE]:
        raise InvalidInput(f"{owner}: {path} was changed since it was written: its digest differs")
    with refusing_damage(owner, path):
        record = json.loads(text)
        check_like("the record", record, {"format": FORMAT, "kind": "", "version": ""})
        return dict(record)


@contextmanager
def refusing_damage(owner: str, path: Path) -> Iterator[None]:
    """Add the name of a file to errors of a block that reads the file.

    Raises:
        InvalidInput: If the block raises any error except `OSError` and `MemoryError`.
    """
    try:
        yield
    except (OSError, MemoryError):
        raise
    except (InvalidInput, TypeError, SimulationError) as error:
        raise InvalidInput(f"{owner}: {path}: {error}") from error
    except Exception as error:  # parsers and unpicklers raise many kinds for damaged bytes
        kind = type(error).__name__
        raise InvalidInput(f"{owner}: {path} is damaged, its content raises {kind}") from error


def check_like(name: str, given: Any, example: Any) -> None:
    """Require the structure of an example, and finite numbers.

    Tensors must have the shape and dtype of the example, mappings its keys, sequences its length;
    integers must be counts.

    Raises:
        InvalidInput: If an entry differs; the message names the entry.
    """
    if isinstance(example, Mapping):
        if not isinstance(given, dict) or given.keys() != example.keys():
            _refuse(name, f"have the keys {', '.join(map(str, example))}", given)
        for key, value in example.items():
            check_like(f"{name}[{key!r}]", given[key], value)
    elif isinstance(example, Sequence) and not isinstance(example, str):
        if type(given) is not type(example) or len(given) != len(example):
            _refuse(name, f"be a {type(example).__name__} of {len(example)}", given)
        for k, (value, like) in enumerate(zip(given, example, strict=True)):
            check_like(f"{name}[{k}]", value, like)
    elif isinstance(example, Tensor):
        _check_tensor(name, given, example)
    elif isinstance(example, bool) or example is None or isinstance(example, str):
        if type(given) is not type(example):
            _refuse(name, f"be a {type(example).__name__}", given)
    elif isinstance(example, int):
        if type(given) is not int or not 0 <= given <= LARGEST_COUNT:
            _refuse(name, f"be an integer between 0 and {LARGEST_COUNT}", given)
    elif not isinstance(given, int | float) or isinstance(given, bool) or not _is_finite(given):
        _refuse(name, "be a finite number", given)


def check_structure(name: str, given: Any, example: Mapping[str, Tensor]) -> None:
    """Require the names, shapes and dtypes of example tensors; numbers may be infinite or NaN.

    Raises:
        InvalidInput: If an entry differs; the message names the entry.
    """
    if not isinstance(given, dict) or given.keys() != example.keys():
        _refuse(name, f"have the keys {', '.join(example)}", given)
    for key, like in example.items():
        _check_shape(f"{name}[{key!r}]", given[key], like)


def _check_tensor(name: str, given: Any, example: Tensor) -> None:
    _check_shape(name, given, example)
    if given.is_floating_point() and not bool(torch.isfinite(given).all()):
        raise InvalidInput(f"{name} must have finite numbers")


def _check_shape(name: str, given: Any, example: Tensor) -> None:
    if (
        not isinstance(given, Tensor)
        or given.dtype != example.dtype
        or given.shape != example.shape
        or given.layout != example.layout
        or not given.is_cpu
    ):
        _refuse(name, f"be a tensor {list(example.shape)} of {example.dtype}", given)


def check_generator(name: str, given: Any) -> None:
    """Require the state of a random generator.

    Raises:
        InvalidInput: If `given` is no such state.
    """
    generator = cpu.generator()
    check_like(name, given, generator.get_state())
    try:
        generator.set_state(given)
    except RuntimeError as error:
        raise InvalidInput(f"{name} must be the state of a generator: {error}") from error


def check_optimizer(name: str, given: Any, optimizer: torch.optim.Optimizer) -> None:
    """Require the state of an optimizer, before its first step or after it.

    Raises:
        InvalidInput: If the optimizer cannot load the state.
    """
    trial = copy.deepcopy(optimizer)
    for group in trial.param_groups:
        for parameter in group["params"]:
            parameter.grad = torch.zeros_like(parameter)
    with cpu.DEVICE:  # device of the step counts of optimizers
        trial.step()
    example = trial.state_dict()
    if not isinstance(given, dict) or given.keys() != example.keys():
        _refuse(name, f"have the keys {', '.join(example)}", given)
    check_like(f"{name}: the groups", given["param_groups"], example["param_groups"])
    for key, entry in given["state"].items():
        if key not in example["state"]:
            _refuse(f"{name}: the parameters", f"be {', '.join(map(str, example['state']))}", key)
        like = dict(example["state"][key])
        steps = entry.get("step") if isinstance(entry, dict) else None
        if isinstance(steps, Tensor) and steps.dtype in (torch.float32, torch.float64):
            like["step"] = cpu.zeros((), dtype=steps.dtype)  # as when the file was written
        check_like(f"{name}: of parameter {key}", entry, like)


def _is_finite(number: float) -> bool:
    try:
        return math.isfinite(number)
    except OverflowError:  # an integer above the range of floats
        return False


def _refuse(name: str, what: str, given: Any) -> None:
    if isinstance(given, Tensor):
        got = f"a tensor {list(given.shape)} of {given.dtype}"
    elif isinstance(given, dict):
        got = f"a dict with the keys {', '.join(str(key)[:40] for key in list(given)[:20])}"
    elif isinstance(given, list | tuple):
        got = f"a {type(given).__name__} of {len(given)}"
    elif isinstance(given, int) and abs(given) > LARGEST_COUNT:
        got = f"one of {given.bit_length()} bits"
    else:
        got = repr(given)[:80]
    raise InvalidInput(f"{name} must {what}, got {got}")
