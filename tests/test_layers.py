"""Dependencies point one way: between the folders of csrc/, and between the modules in Python."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

# Lowest first. A folder may include itself and lower rows, not its neighbors in a row.
CPP_LAYERS = [
    {"common"},
    {"linalg"},
    {"mesh"},
    {"potential"},
    {"elastic", "air", "contact", "bodies"},
    {"solver", "projective"},
    {"step"},
    {"bind"},
]
RANK = {folder: rank for rank, row in enumerate(CPP_LAYERS) for folder in row}
SOURCES = sorted(p for p in (ROOT / "csrc").rglob("*") if p.suffix in {".h", ".cpp"})


def forbidden_includes(folder: str, text: str) -> list[str]:
    included = re.findall(r'^\s*#\s*include\s+"([^"]+)"', text, re.MULTILINE)
    return [
        path
        for path in included
        if (target := path.split("/")[0]) != folder and RANK.get(target, 99) >= RANK[folder]
    ]


@pytest.mark.parametrize("source", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_cpp_includes_point_down(source):
    folder = source.relative_to(ROOT / "csrc").parts[0]
    assert forbidden_includes(folder, source.read_text()) == []


@pytest.mark.parametrize(
    ("folder", "path"),
    [
        pytest.param("linalg", "step/coupled.h", id="upward"),
        pytest.param("contact", "elastic/stretch.h", id="sideways"),
        pytest.param("mesh", "topology.h", id="not relative to csrc"),
    ],
)
def test_an_include_against_the_order_is_found(folder, path):
    assert forbidden_includes(folder, f'#pragma once\n#include "{path}"\n') == [path]


def test_only_bind_knows_python():
    python = re.compile(r"#\s*include\s*[<\"](nanobind|Python\.h|torch|pybind11)")
    users = {p.relative_to(ROOT / "csrc").parts[0] for p in SOURCES if python.search(p.read_text())}
    assert users == {"bind"}


def test_python_imports_point_down():
    pytest.importorskip("importlinter", reason="import-linter is in the extra `dev`")
    lint = Path(sys.executable).with_name("lint-imports")
    result = subprocess.run([lint], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
