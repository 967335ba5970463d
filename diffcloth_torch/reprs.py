"""Short texts of records: numbers if there are few, else dtype and shape."""

from __future__ import annotations

import reprlib
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch.autograd.transforms import is_dense

__all__ = ["dataclass_text", "field_text", "record_text", "value_text"]

_MOST_NUMBERS = 4
_MOST_ENTRIES = 8  # of a mapping
_PLAIN = (str, int, float, type(None))
_LINE = 88


def value_text(value: object) -> str:
    """Short text of a value; `(grad)` follows a tensor that requires a gradient."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Tensor):
        shape = "[nested]" if value.is_nested else str(list(value.shape))
        text = f"{str(value.dtype).removeprefix('torch.')}{shape}"
        if is_dense(value) and value.device.type == "cpu" and value.numel() <= _MOST_NUMBERS:
            text = _numbers_text(value.detach()) if value.numel() else text
        return f"{text} (grad)" if value.requires_grad else text
    if isinstance(value, np.ndarray):
        if 0 < value.size <= _MOST_NUMBERS:
            return _numbers_text(value)
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, Mapping):
        entries = [f"{name!r}: {value_text(entry)}" for name, entry in value.items()]
        more = [f"and {len(entries) - _MOST_ENTRIES} more"] if len(entries) > _MOST_ENTRIES else []
        return f"{{{', '.join(entries[:_MOST_ENTRIES] + more)}}}"
    if is_dataclass(value):
        return f"{type(value).__name__}(...)"
    if isinstance(value, tuple) and len(value) <= _MOST_NUMBERS:
        return f"({', '.join(map(value_text, value))})"
    if isinstance(value, list | tuple) and not all(isinstance(v, _PLAIN) for v in value):
        kinds = sorted({type(v).__name__ for v in value})
        return f"[{len(value)} {' or '.join(kinds)}]"
    return reprlib.repr(value)


def dataclass_text(value: Any) -> str:
    """Text of a dataclass, by its fields that are to be shown."""
    shown = [field.name for field in fields(value) if field.repr]
    parts = [field_text(name, getattr(value, name)) for name in shown]
    return record_text(type(value).__name__, parts)


def field_text(name: str, value: object) -> str:
    """A field and its value."""
    return f"{name}={value_text(value)}"


def record_text(kind: str, parts: Iterable[str]) -> str:
    """Text of a record, with line breaks between its parts."""
    first, *rest = [*parts, ""]
    lines = [f"{kind}({first}"]
    for part in rest[:-1]:
        lines[-1] += ","
        if len(part) > _LINE:
            wrapped = textwrap.wrap(part, _LINE - 4, break_long_words=False)
            lines += textwrap.indent("\n".join(wrapped), 4 * " ").splitlines()
            continue
        if len(lines[-1]) + len(part) + 1 < _LINE:
            lines[-1] += f" {part}"
        else:
            lines.append(f"    {part}")
    return "\n".join(lines) + ")"


def _numbers_text(values: Tensor | NDArray[Any]) -> str:
    def text(nested: Any) -> str:
        if isinstance(nested, list):
            return f"[{', '.join(map(text, nested))}]"
        return value_text(nested)

    return text(values.tolist())
