"""Configuration files: reading YAML safely, changing values, and resolving file names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, ScalarEvent

from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import read_regular_file
from diffcloth_torch.operations import operation

__all__ = [
    "Document",
    "check_plain_document",
    "read_document",
    "resolve_path",
    "resolve_relative",
    "set_values",
]

Document = dict[str, Any]

# A configuration is a page of text. A file that exceeds these generous bounds is a mistake, or
# would fill the memory.
_LARGEST_CONFIG_BYTES = 1 << 20
_MOST_VALUES = 100_000  # including written-out aliases
_DEEPEST = 50

_SET = "--set"  # option of the command line


def read_document(path: str | Path) -> Document:
    """Read a YAML 1.2 mapping.

    Raises:
        InvalidInput: If the file is missing, too large, no regular file, not YAML, not a mapping,
            nested too deeply, contains itself, or repeats a key.
    """
    path = Path(path)
    try:
        data = read_regular_file(path, _LARGEST_CONFIG_BYTES)
    except FileNotFoundError as error:
        raise InvalidInput(f"{path}: there is no such file") from error
    try:
        document = _parse(data.decode("utf-8"))
    except ValueError as error:
        raise InvalidInput(f"{path}: not readable as YAML: {_one_line(error)}") from error
    if not isinstance(document, dict):
        raise InvalidInput(f"{path}: a configuration must be a mapping of keys to values")
    return document


def check_plain_document(document: Mapping[str, Any]) -> Document:
    """Copy a configuration that is not a file; the rules for files apply.

    Raises:
        InvalidInput: If it is nested too deeply or contains values other than text and numbers.
    """
    try:
        copy: Document = _plain_copy(document, _DEEPEST)
        _check_plain(copy, "the configuration")
    except ValueError as error:
        raise InvalidInput(f"{operation()}: {error}") from error
    return copy


def _plain_copy(value: Any, levels: int) -> Any:
    """Copy mappings as dicts and tuples as lists."""
    if not isinstance(value, Mapping | list | tuple):
        return value
    if levels == 0:
        raise ValueError(f"it must be at most {_DEEPEST} levels deep")
    if isinstance(value, Mapping):
        return {key: _plain_copy(entry, levels - 1) for key, entry in value.items()}
    return [_plain_copy(entry, levels - 1) for entry in value]


def _parse(text: str) -> Any:
    """Read YAML 1.2; raise ValueError if that fails."""
    reader = YAML(typ="safe", pure=True)
    try:
        _check_extent(reader.parse(text))
        document = reader.load(text)
    except MemoryError:
        raise
    except MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f"line {error.problem_mark.line + 1}: "
        raise ValueError(f"{line}{error.problem or error.context}") from error
    except Exception as error:  # also errors of Python's conversions of dates and numbers
        raise ValueError(str(error)) from error
    _check_plain(document, "the file")
    return document


def _check_extent(events: Iterable[Any]) -> None:
    """Bound depth and size of a document, counting aliases as if written out."""
    sizes: dict[str, int] = {}  # of anchored values
    anchors: set[str] = set()
    opened: list[tuple[str | None, int]] = []  # anchor of a collection, and values before it
    count = 0
    for event in events:
        name = getattr(event, "anchor", None)
        if name is not None and not isinstance(event, AliasEvent):
            if name in anchors:
                raise ValueError(f"the anchor &{name} must stand once")
            anchors.add(name)
        if isinstance(event, AliasEvent):
            if name not in sizes:
                raise ValueError(f"the alias *{name} must follow the end of what it stands for")
            count += sizes[name]
        elif isinstance(event, CollectionStartEvent):
            opened.append((name, count))
            count += 1
        elif isinstance(event, CollectionEndEvent):
            name, before = opened.pop()
            if name is not None:
                sizes[name] = count - before
        elif isinstance(event, ScalarEvent):
            count += 1
            if name is not None:
                sizes[name] = 1
        if count > _MOST_VALUES:
            raise ValueError(f"it must have at most {_MOST_VALUES} values, aliases written out")
        if len(opened) > _DEEPEST:
            raise ValueError(f"it must be at most {_DEEPEST} levels deep")


def _check_plain(value: Any, place: str) -> None:
    """Refuse YAML values that are not allowed in configurations: dates, sets, non-text keys."""
    if isinstance(value, dict):
        for key, entry in value.items():
            if not isinstance(key, str):
                raise ValueError(f"a key must be text, got {key!r} in {place}")
            _check_plain(entry, f"`{key}`")
    elif isinstance(value, list):
        for entry in value:
            _check_plain(entry, place)
    elif not isinstance(value, str | bool | int | float | None):
        raise ValueError(f"{place} must hold text or numbers, got a {type(value).__name__}")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def set_values(document: Document, assignments: Iterable[str]) -> Document:
    """Copy a document with changed values.

    Args:
        document: Contents of a configuration file.
        assignments: "key=value" each; the key is dotted, an item of a list is addressed by its
            number or its `name`, and the value is YAML.

    Raises:
        InvalidInput: If an assignment is malformed or its key cannot exist.
    """
    changed: Document = _copy(document)
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not equals or not key:
            raise InvalidInput(f"{operation(_SET)}: must be key=value, got {assignment!r}")
        try:
            value = _parse(text)
        except ValueError as error:
            raise InvalidInput(
                f"{operation(_SET)}: `{key}`: the value is not YAML: {_one_line(error)}"
            ) from error
        *parents, last = key.split(".")
        place: Any = changed
        for part in parents:
            place = _descend(key, place, part)
        if isinstance(place, list):
            place[_item(key, place, last)] = value
        elif isinstance(place, dict):
            place[last] = value
        else:
            raise InvalidInput(f"{operation(_SET)}: `{key}`: `{last}` lies below a plain value")
    return changed


def _copy(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copy(entry) for key, entry in value.items()}
    return [_copy(entry) for entry in value] if isinstance(value, list) else value


def _descend(key: str, place: Any, part: str) -> Any:
    if isinstance(place, list):
        return place[_item(key, place, part)]
    if isinstance(place, dict):
        return place.setdefault(part, {})  # a section that the file leaves at its defaults
    raise InvalidInput(f"{operation(_SET)}: `{key}`: `{part}` lies below a plain value")


def _item(key: str, items: list[Any], part: str) -> int:
    names = [item.get("name") if isinstance(item, dict) else None for item in items]
    if part in names:
        return names.index(part)
    if part.isdecimal() and int(part) < len(items):
        return int(part)
    named = [str(name) for name in names if name is not None]
    accepted = ", ".join([f"0 .. {len(items) - 1}", *named]) if items else "none, it is empty"
    raise InvalidInput(
        f"{operation(_SET)}: `{key}`: the items of the list are {accepted}; got `{part}`"
    )


def resolve_relative(config: Path, given: str) -> Path:
    """Resolve a path relative to its configuration, whether or not it exists.

    Raises:
        InvalidInput: If links lead in a circle.
    """
    try:
        return (config.resolve().parent / given).resolve()
    except (OSError, RuntimeError) as error:  # RuntimeError: a circle, before Python 3.13
        raise InvalidInput(f"{config}: the path {given!r} cannot be resolved: {error}") from error


def resolve_path(config: Path, root: str, given: str) -> Path:
    """Resolve a file name relative to its configuration, and require it to be under the root.

    Raises:
        InvalidInput: If the file lies elsewhere or does not exist.
    """
    allowed = resolve_relative(config, root)
    path = resolve_relative(config, given)
    if not path.is_relative_to(allowed):
        raise InvalidInput(
            f"{config}: the file {given!r} must lie under the root {str(allowed)!r}; declare a "
            "higher one with the key `root`, relative to the configuration (for example `root: ..`)"
        )
    if not path.is_file():
        raise InvalidInput(f"{config}: there is no file {given!r} (looked for {str(path)!r})")
    return path
