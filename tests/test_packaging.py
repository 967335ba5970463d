"""The installed package: versions, the C++ core alone, the command, the typing marker."""

import importlib.metadata
import importlib.resources
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from processes import run_python

import diffcloth_torch
from diffcloth_torch import _core

ROOT = Path(__file__).resolve().parent.parent
PYPROJECT = (ROOT / "pyproject.toml").read_text()


def printed(code: str) -> str:
    # Not from ROOT, where an import would find the sources instead of the installed package.
    return run_python(code, cwd=Path(__file__).parent).strip()


def test_the_version_stands_in_one_place():
    (version,) = re.findall(r'^version = "(.+)"$', PYPROJECT, re.MULTILINE)
    assert importlib.metadata.version("diffcloth-torch") == version
    assert diffcloth_torch.__version__ == version


def test_the_classifiers_name_the_wheels_that_a_release_builds():
    named = re.findall(r'"Programming Language :: Python :: 3\.(\d+)"', PYPROJECT)
    built = re.findall(r"cp3(\d+)-\*", re.search(r'^build = "(.+)"$', PYPROJECT, re.MULTILINE)[1])
    assert named == built
    (oldest,) = re.findall(r'^requires-python = ">=3\.(\d+)"$', PYPROJECT, re.MULTILINE)
    assert oldest == named[0]


def test_the_build_needs_no_torch():
    (requires,) = re.findall(r"^requires = (\[.*\])$", PYPROJECT, re.MULTILINE)
    assert "nanobind" in requires
    assert "torch" not in requires


def test_the_core_loads_without_torch_and_numpy():
    code = f"""
import importlib.util, sys
spec = importlib.util.spec_from_file_location("_core", {_core.__file__!r})
spec.loader.exec_module(importlib.util.module_from_spec(spec))
print(sorted({{"torch", "numpy"}} & set(sys.modules)))
"""
    assert printed(code) == "[]"


def test_only_tests_have_the_single_kernels():
    assert not hasattr(_core, "kernels")
    folder = Path(_core.__file__).parent
    if not list(folder.parent.glob("diffcloth_torch-*.dist-info")):
        pytest.skip("about wheels: builds for tests have them")
    assert list(folder.glob("_core*.so"))
    assert not list(folder.glob("_kernels*"))


def test_a_wheel_carries_its_licenses():
    folder = Path(_core.__file__).parent
    dist_info = list(folder.parent.glob("diffcloth_torch-*.dist-info"))
    if not dist_info:
        pytest.skip("about wheels: an editable install has them elsewhere")
    names = {path.name for path in (dist_info[0] / "licenses").iterdir()}
    assert names == {"LICENSE", "NOTICE"}
    texts = {path.name: path.read_text() for path in (folder / "licenses").iterdir()}
    assert set(texts) == {"nanobind.txt", "robin_map.txt"}
    assert "Wenzel Jakob" in texts["nanobind.txt"]
    assert "MIT License" in texts["robin_map.txt"]


def test_a_step_is_taken():
    """A step without data: this test runs in fresh environments to check wheels."""
    code = """
import torch, diffcloth_torch as dc
cloth = dc.Cloth.grid(5, 5, 0.3, pose=[0, 0, 0.002, 1, 0, 0, 0])
simulator = dc.Simulator(dc.Scene([cloth], [dc.RigidBody.plane(2.0)]), 0.01)
start = simulator.initial_state()
positions = start.positions.clone().requires_grad_()
end = simulator.step(start.replace(positions=positions))
end.positions.square().sum().backward()
print(end.report.converged, bool(torch.isfinite(positions.grad).all()))
"""
    assert printed(code) == "True True"


def test_sources_without_a_core_name_the_remedy(tmp_path):
    sources = tmp_path / "diffcloth_torch"
    shutil.copytree(
        Path(diffcloth_torch.__file__).parent,
        sources,
        ignore=shutil.ignore_patterns("*.so", "__pycache__"),
    )
    # The sources are alone on the path: an editable install's finder would add the core.
    code = f"import sys; sys.path[:0] = [{str(tmp_path)!r}]; import diffcloth_torch"
    command = [sys.executable, "-S", "-c", code]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 1
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith(f"ImportError: {sources} holds the sources of diffcloth_torch without a")
    assert "pip install -e ." in last


def test_build_info_names_every_part():
    info = _core.build_info()
    assert set(info) == {
        "compiler",
        "build_type",
        "flags",
        "processor",
        "eigen",
        "instructions",
        "factorization",
        "blas",
    }
    assert all(info.values())
    assert re.fullmatch(r"3\.4\.\d+", info["eigen"])
    assert re.fullmatch(r"multifrontal \((portable|avx2|avx512)\)", info["factorization"])
    # The same bits on every machine of one architecture.
    assert "-ffp-contract=off" in info["flags"]
    assert "-ffast-math" not in info["flags"]


def test_a_blas_is_named_where_cholmod_calls_one():
    kernels = pytest.importorskip("diffcloth_torch._kernels", reason="wheels do not have it")
    blas = _core.build_info()["blas"]
    assert (blas == "none") == ("cholmod" not in kernels.cholesky_backends())


def test_importing_the_package_warns_of_nothing():
    command = [sys.executable, "-W", "error", "-c", "from diffcloth_torch import *"]
    folder = Path(__file__).parent  # as in `printed`
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    assert result.stderr == ""


def test_everything_is_imported_without_the_extras():
    code = """
import sys
sys.modules["gymnasium"] = None  # as if it were not installed
from diffcloth_torch import *
print(sorted({"Cloth", "envs", "learn", "robots"} & set(globals())))
try:
    import diffcloth_torch.envs
except ImportError as error:
    print(error)
"""
    first, last = printed(code).splitlines()
    assert first == "['Cloth', 'robots']"
    assert last == "environments need gymnasium: run  pip install 'diffcloth-torch[envs]'"


@pytest.mark.quick("matplotlib", "pyvista")
@pytest.mark.parametrize("module", ["matplotlib", "pytorch_kinematics", "pyvista", "trimesh"])
def test_importing_the_package_leaves_out(module):
    code = f"import sys; from diffcloth_torch import *; print({module!r} in sys.modules)"
    assert printed(code) == "False"


def test_the_command_is_installed():
    (command,) = importlib.metadata.entry_points(group="console_scripts", name="diffcloth")
    assert command.value == "diffcloth_torch.cli:main"
    assert callable(command.load())


def test_the_gripper_comes_with_the_package():
    assert importlib.resources.files("diffcloth_torch.robots").joinpath("gripper.urdf").is_file()


def test_the_scenes_of_tasks_come_with_the_package():
    folder = importlib.resources.files("diffcloth_torch.tasks")
    for task in ("hit_cloth", "push_cube", "grasp_cloth", "two_cloths"):
        assert folder.joinpath(f"{task}.yaml").is_file()


def test_the_package_is_typed():
    assert importlib.resources.files("diffcloth_torch").joinpath("py.typed").is_file()
