"""The check of a document against a schema, with error messages in the terms of the file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from diffcloth_torch.config.documents import Document
from diffcloth_torch.errors import InvalidInput

__all__ = ["validate"]

S = TypeVar("S", bound=BaseModel)


def validate(model: type[S], document: Document, source: str | Path) -> S:
    """Check a document against a schema.

    Raises:
        InvalidInput: If a key is unknown or missing, or a value is not accepted; the message names
            the key, the value and the accepted values.
    """
    try:
        return model.model_validate(document)
    except ValidationError as error:
        problems = _sentences(document, error.errors())
        more = f" ({len(problems) - 1} more problems)" if len(problems) > 1 else ""
        raise InvalidInput(f"{source}: {problems[0]}{more}") from error


def _sentences(document: Document, problems: Iterable[Any]) -> list[str]:
    """One sentence for each key that has a problem."""
    messages: dict[str, list[str]] = {}
    shown: dict[str, str] = {}
    for problem in problems:
        name = _key_text(document, problem["loc"], missing=problem["type"] == "missing")
        messages.setdefault(name, []).append(_message(problem))
        given = problem["input"]
        plain = problem["type"] not in ("missing", "value_error") and not isinstance(given, dict)
        kind = "the text " if isinstance(given, str) and _is_number(problem) else ""
        shown[name] = f", got {kind}{given!r}" if plain else ""
    # A value that may be of several types has a message for each type.
    return [
        f"`{name}` {' or '.join(dict.fromkeys(texts))}{shown[name]}".replace("``", "the file")
        for name, texts in messages.items()
    ]


def _is_number(problem: Any) -> bool:
    """Return whether a number is required."""
    return str(problem["type"]).partition("_")[0] in ("float", "int")


def _message(problem: Any) -> str:
    kind, context = problem["type"], problem.get("ctx", {})
    if kind == "missing":
        return "is missing"
    if kind == "value_error":
        return str(context["error"])
    if kind == "union_tag_not_found":
        return "needs the key `kind`"
    if kind == "union_tag_invalid":
        return f"must have as `kind` one of {context['expected_tags']}; got {context['tag']!r}"
    text = str(problem["msg"]).removeprefix("Input should ")
    return f"must {text}" if text != problem["msg"] else f"is not accepted: {text}"


def _key_text(document: Document, location: tuple[int | str, ...], *, missing: bool) -> str:
    """Write a location as in the file; pydantic's also names the tried member of a union."""
    text = ""
    place: Any = document
    for i, part in enumerate(location):
        in_mapping = isinstance(place, dict) and part in place
        in_list = isinstance(place, list) and isinstance(part, int) and part < len(place)
        if in_mapping or in_list:
            place = place[part]
        elif not (missing and i == len(location) - 1):
            continue
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    return text.removeprefix(".")
