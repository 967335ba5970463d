"""Short searches of plans."""

from __future__ import annotations

import pytest

from diffcloth_torch.learn import plans


@pytest.fixture(scope="session", autouse=True)
def short_searches():
    """Fewer draws and rounds of `plan`, in this process, which alone uses them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plans, "_DRAWS", 2)
        patch.setattr(plans, "_ROUNDS", 1)
        yield
