"""The memory of the machine; counts are checked against it before anything is allocated."""

from __future__ import annotations

import os

from diffcloth_torch.errors import InvalidInput

__all__ = ["check_memory"]


def check_memory(name: str, count: int, each: int, of_what: str) -> int:
    """Require a count of objects that fit into the memory of the machine together.

    Args:
        name: Prefix of the message.
        count: Number of objects.
        each: Smallest size of one of them [bytes].
        of_what: Description of one of them, such as "a state".

    Raises:
        InvalidInput: If they do not fit.
    """
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    most = memory // each
    if count > most:
        raise InvalidInput(
            f"{name} must be at most {most}, as {of_what} takes {each} bytes and this machine has "
            f"{memory >> 20} MiB, got {count}"
        )
    return count
