"""The potential of docs/extending.md, applied to a copy of the sources, works as described."""

import extended_tree
import pytest


def test_a_hunk_goes_behind_the_one_before_it():
    text = "a\nb\nc\na\nb\nd\n"
    assert extended_tree.patched("f", text, [" c", "+x", " b", "+y"]) == "a\nb\nc\nx\na\nb\ny\nd\n"
    assert extended_tree.patched("f", text, ["-a", "+x", " b"]) == "x\nb\nc\na\nb\nd\n"
    with pytest.raises(AssertionError, match="f has no lines"):
        extended_tree.patched("f", text, [" d", "+x", " a"])


@pytest.mark.recipe
@pytest.mark.slow
def test_the_example_has_exact_gradients_wherever_it_acts(tmp_path):
    # Files that do not include the inputs are not compiled.
    extended_tree.check_example(tmp_path, "Add a potential", "drag_checks.py", most=60)
