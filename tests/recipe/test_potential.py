"""The example of docs/extending.md, applied to a copy: a potential works as it says."""

import subprocess
import sys
from pathlib import Path

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
    if not (extended_tree.ROOT / ".git").exists():
        pytest.skip("needs a clone")
    build = extended_tree.find_build()
    assert build is not None, "no build of this clone in build/: pip install -e ."
    changed = extended_tree.make_tree(tmp_path)
    compiled = extended_tree.compile_core(tmp_path, changed, build)
    assert compiled < 60  # what does not know the inputs stays
    checks = Path("tests", "recipe", "drag_checks.py")
    result = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", checks],
        cwd=tmp_path,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    print(result.stdout[-3000:])
    assert result.returncode == 0, result.stdout + result.stderr
