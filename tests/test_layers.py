"""Dependencies have one direction: between folders of csrc/, and between Python modules."""

import ast
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
    {"solver"},
    {"projective"},
    {"step"},
    {"bind"},
]
# Inside csrc/step: its folders, and the files of its root without their endings.
STEP_LAYERS = [
    {"inputs", "report"},
    {"scene", "step_potential"},
    {"problem"},
    {"cotangents", "tangents"},
    {"potentials", "scheme"},
    {"nodal"},
    {"schemes"},
    {"step"},
    {"energy", "default_barrier", "throw"},
]
SOURCES = sorted(p for p in (ROOT / "csrc").rglob("*") if p.suffix in {".h", ".cpp"})


def includes(text: str) -> list[str]:
    return re.findall(r'^\s*#\s*include\s+"([^"]+)"', text, re.MULTILINE)


def not_below(unit: str, targets: dict[str, str], layers: list[set[str]]) -> list[str]:
    """Includes (path -> unit) that belong neither to the unit itself nor to a lower row."""
    rank = {name: row for row, names in enumerate(layers) for name in names}
    return [
        path
        for path, target in targets.items()
        if target != unit and rank.get(target, 99) >= rank[unit]
    ]


def forbidden_includes(folder: str, text: str) -> list[str]:
    targets = {path: path.split("/")[0] for path in includes(text)}
    return not_below(folder, targets, CPP_LAYERS)


def forbidden_in_step(unit: str, text: str) -> list[str]:
    inside = [path for path in includes(text) if path.startswith("step/")]
    targets = {path: step_unit(Path(path)) for path in inside}
    return not_below(unit, targets, STEP_LAYERS)


def step_unit(path: Path) -> str:
    """Unit of a path in csrc: the folder in csrc/step, or the file in its root."""
    return path.with_suffix("").parts[1]


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


@pytest.mark.parametrize(
    "source",
    [p for p in SOURCES if p.is_relative_to(ROOT / "csrc/step")],
    ids=lambda p: str(p.relative_to(ROOT)),
)
def test_includes_inside_the_step_point_down(source):
    unit = step_unit(source.relative_to(ROOT / "csrc"))
    assert forbidden_in_step(unit, source.read_text()) == []


@pytest.mark.parametrize(
    ("unit", "path"),
    [
        pytest.param("problem", "step/potentials/air.h", id="upward"),
        pytest.param("nodal", "step/schemes/split.h", id="from one wing to the next"),
        pytest.param("energy", "step/throw.h", id="sideways"),
        pytest.param("scene", "step/new.h", id="to a unit without a place"),
    ],
)
def test_an_include_against_the_order_inside_the_step_is_found(unit, path):
    assert forbidden_in_step(unit, f'#pragma once\n#include "{path}"\n') == [path]


def test_only_bind_knows_python():
    python = re.compile(r"#\s*include\s*[<\"](nanobind|Python\.h|torch|pybind11)")
    users = {p.relative_to(ROOT / "csrc").parts[0] for p in SOURCES if python.search(p.read_text())}
    assert users == {"bind"}


def names_of_the_package(text: str) -> list[str]:
    """Names that a module imports from the package itself, except submodules."""
    wanted = re.findall(r"^\s*from diffcloth_torch import (\([^)]*\)|.*)$", text, re.MULTILINE)
    names = [
        name.split()[0] for line in wanted for name in line.strip("()").split(",") if name.strip()
    ]
    modules = {p.stem for p in (ROOT / "diffcloth_torch").iterdir()}
    return [name for name in names if name not in modules]


def test_modules_import_only_the_core_from_the_package_itself():
    """Import contracts ignore imports from the package itself; these may only be the core."""
    for path in (ROOT / "diffcloth_torch").rglob("*.py"):
        text = path.read_text()
        assert set(names_of_the_package(text)) <= {"_core"}, path
        assert not re.search(r"^import diffcloth_torch\b", text, re.MULTILINE), path
    assert names_of_the_package("from diffcloth_torch import State, cpu") == ["State"]


PRIVATE = re.compile(r"(?<!diffcloth_)\b(torch|forward_ad)(\.\w+)*\._[a-zA-Z]")


def test_a_single_module_uses_undocumented_torch():
    package = ROOT / "diffcloth_torch"
    users = {p.relative_to(package) for p in package.rglob("*.py") if PRIVATE.search(p.read_text())}
    assert users == {Path("autograd/torch_private.py")}


UNPICKLERS = {
    # Read files: the content of a file must not run.
    "diffcloth_torch/checkpoint.py": {"torch.load"},
    "diffcloth_torch/sim/records/trajectory.py": {"torch.load"},
    "benchmarks/branches.py": {"torch.load"},
    "benchmarks/scenes.py": {"torch.load"},
    # Read messages between a process and its own workers.
    "diffcloth_torch/learn/plans.py": {"pickle.loads"},
    "diffcloth_torch/learn/rollouts.py": {"pickle.loads"},
    "diffcloth_torch/processes.py": {"pickle.loads"},
    "diffcloth_torch/worker.py": {"pickle.loads"},
    "benchmarks/scaling.py": {"pickle.loads"},
    "benchmarks/scripted_worker.py": {"pickle.loads"},
}


def unpickled(tree):
    """Calls of `torch.load` and of `pickle`, as (name, keywords)."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            is_numpy = name.endswith("np.load")
            if re.fullmatch(r"(torch|pickle)\.(load|loads|Unpickler)", name) or is_numpy:
                yield name, {k.arg: ast.unparse(k.value) for k in node.keywords}


def test_no_file_is_unpickled_that_could_run_code():
    found: dict[str, set[str]] = {}
    for folder in ("diffcloth_torch", "benchmarks", "examples", "docs", "scripts"):
        for path in (ROOT / folder).rglob("*.py"):
            for name, keywords in unpickled(ast.parse(path.read_text())):
                place = str(path.relative_to(ROOT))
                if name.endswith("np.load"):
                    assert keywords.get("allow_pickle", "False") == "False", place
                    continue
                found.setdefault(place, set()).add(name)
                if name == "torch.load":
                    assert keywords.get("weights_only") == "True", place
    assert found == UNPICKLERS
    text = "torch.load(f, weights_only=False)"
    assert list(unpickled(ast.parse(text))) == [("torch.load", {"weights_only": "False"})]


def test_python_imports_point_down():
    pytest.importorskip("importlinter", reason="import-linter is in the extra `dev`")
    lint = Path(sys.executable).with_name("lint-imports")
    result = subprocess.run([lint], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
