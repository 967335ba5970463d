"""Collected errors of independent checks, raised as one error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from diffcloth_torch.errors import InvalidInput

__all__ = ["Refusals"]


class Refusals:
    """Collects the errors of several checks, so that one error has every reason.

    >>> refusals = Refusals()
    >>> for link in links:
    ...     with refusals.collected():
    ...         check(link)
    >>> refusals.raise_any("robot.urdf: ")
    """

    def __init__(self) -> None:
        self._messages: list[str] = []

    def __len__(self) -> int:
        return len(self._messages)

    @contextmanager
    def collected(self) -> Iterator[None]:
        """Collect an `InvalidInput` raised in the block, and end the block there."""
        try:
            yield
        except InvalidInput as error:
            self._messages.append(str(error))

    def raise_any(self, opening: str) -> None:
        """Raise one error with all collected reasons, if there are any.

        Args:
            opening: Start of the message if there are several reasons; each reason then has its own
                line, without this start.

        Raises:
            InvalidInput: With every reason.
        """
        if not self._messages:
            return
        if len(self._messages) == 1:
            raise InvalidInput(self._messages[0])
        reasons = dict.fromkeys(message.removeprefix(opening) for message in self._messages)
        lines = "".join(f"\n- {reason}" for reason in reasons)
        raise InvalidInput(f"{opening}{len(reasons)} reasons:{lines}")
