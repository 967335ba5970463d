"""The example of a kind of joint in docs/extending.md, applied to a copy of the sources."""

import extended_tree
import pytest


@pytest.mark.recipe
@pytest.mark.slow
def test_the_example_moves_and_has_exact_gradients(tmp_path):
    extended_tree.check_example(tmp_path, "Add a kind of joint", "screw_checks.py", most=5)
