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
        pytest.param("linalg", "step/schemes/coupled.h", id="upward"),
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


def names_of_the_package(text: str) -> list[str]:
    """Names that a module imports from the package itself and that are no modules of it."""
    wanted = re.findall(r"^\s*from diffcloth_torch import (\([^)]*\)|.*)$", text, re.MULTILINE)
    names = [
        name.split()[0] for line in wanted for name in line.strip("()").split(",") if name.strip()
    ]
    modules = {p.stem for p in (ROOT / "diffcloth_torch").iterdir()}
    return [name for name in names if name not in modules]


def test_modules_import_only_the_core_from_the_package_itself():
    """Import contracts ignore imports of the package itself, which stand for the core."""
    for path in (ROOT / "diffcloth_torch").rglob("*.py"):
        text = path.read_text()
        assert set(names_of_the_package(text)) <= {"_core"}, path
        assert not re.search(r"^import diffcloth_torch\b", text, re.MULTILINE), path
    assert names_of_the_package("from diffcloth_torch import State, cpu") == ["State"]


PRIVATE = re.compile(r"(?<!diffcloth_)\b(torch|forward_ad)(\.\w+)*\._[a-zA-Z]")


def test_one_module_uses_undocumented_torch():
    package = ROOT / "diffcloth_torch"
    users = {p.relative_to(package) for p in package.rglob("*.py") if PRIVATE.search(p.read_text())}
    assert users == {Path("autograd/torch_private.py")}


def test_python_imports_point_down():
    pytest.importorskip("importlinter", reason="import-linter is in the extra `dev`")
    lint = Path(sys.executable).with_name("lint-imports")
    result = subprocess.run([lint], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
