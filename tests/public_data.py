"""Public meshes, robots and recordings, which tests read from beside the clone."""

import os
from pathlib import Path

import pytest

DATA = Path(__file__).parents[2] / "shared" / "data"


def public(name: str) -> Path:
    """Path of a file or folder of the data; without it the test is skipped, and fails in CI.

    The reason contains only the first folder, so that pytest shows one line per folder.
    """
    path = DATA / name
    if not path.exists():
        reason = f"needs ../shared/data/{Path(name).parts[0]}, which no clone contains"
        assert "CI" not in os.environ, reason
        pytest.skip(reason)
    return path
