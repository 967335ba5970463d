"""The example of a scheme in docs/extending.md, applied to a copy of the sources."""

import extended_tree
import pytest


@pytest.mark.recipe
@pytest.mark.slow
def test_the_example_steps_and_has_exact_gradients(tmp_path):
    extended_tree.check_example(tmp_path, "Add a scheme", "elastic_checks.py", most=60)
