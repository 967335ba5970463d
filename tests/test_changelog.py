"""Fragments of the changelog have names that towncrier reads, and become a section of the file."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("towncrier", reason="towncrier is in the extra `dev`")

ROOT = Path(__file__).resolve().parents[1]


def towncrier(folder, *arguments):
    """A finished `towncrier build --version 99.0` in a folder."""
    program = Path(sys.executable).with_name("towncrier")
    return subprocess.run(
        [program, "build", "--version", "99.0", *arguments],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip


@pytest.fixture
def project(tmp_path):
    """A copy of the changelog, its settings and its folder of fragments, without fragments."""
    for name in ("pyproject.toml", "CHANGELOG.md", "changelog.d/README.md"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    return tmp_path


def test_fragments_of_the_repository_make_a_section():
    result = towncrier(ROOT, "--draft")
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("## [99.0] - ")


def test_a_release_moves_the_fragments_above_the_last_section(project):
    before = (project / "CHANGELOG.md").read_text()
    texts = {
        "removed": "`dc.old`.",
        "added": "`dc.new`: two lines\nof one bullet.",
        "fixed": "A crash.",
        "changed": "A default.",
    }
    for kind, text in texts.items():
        (project / "changelog.d" / f"+subject.{kind}.md").write_text(text + "\n")
    result = towncrier(project, "--yes", "--date", "2031-01-02")
    assert result.returncode == 0, result.stderr
    head, last = before.split("\n## ", 1)
    assert (project / "CHANGELOG.md").read_text().split("\n## ") == [
        head,
        "[99.0] - 2031-01-02\n\n"
        "### Added\n\n- `dc.new`: two lines\n  of one bullet.\n\n"
        "### Changed\n\n- A default.\n\n"
        "### Fixed\n\n- A crash.\n\n"
        "### Removed\n\n- `dc.old`.\n\n",
        *last.split("\n## "),
    ]
    assert [file.name for file in (project / "changelog.d").iterdir()] == ["README.md"]


@pytest.mark.parametrize(
    "name", ["+subject.improved.md", "subject.added.md", "123.added.md", "+subject.md", "notes.txt"]
)
def test_a_fragment_of_another_name_is_refused(project, name):
    (project / "changelog.d" / name).write_text("A change.\n")
    result = towncrier(project, "--draft")
    assert result.returncode == 1
    assert name.partition(".")[0] in result.stderr
