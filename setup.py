"""Build the C++ core with CMake; everything else is in pyproject.toml."""

import os
import re
import shlex
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent
CMAKE_ARGS = shlex.split(os.environ.get("CMAKE_ARGS", ""))

# The core, and single kernels for tests where CMAKE_ARGS asks for them.
KERNELS = re.compile(r"-DDIFFCLOTH_KERNELS(:BOOL)?=(ON|YES|TRUE|Y|1)", re.IGNORECASE)
MODULES = ["_core", *(["_kernels"] if any(map(KERNELS.fullmatch, CMAKE_ARGS)) else [])]


class CMakeBuild(build_ext):
    """Configure, build and install csrc/ into the package. CMAKE_ARGS adds arguments."""

    def run(self) -> None:
        # Outside setuptools' temporary folders, so that a second build compiles only what changed;
        # but not from the last one's settings, nor from the paths of its build environment.
        self.cmake_folder = ROOT / "build" / sys.implementation.cache_tag
        (self.cmake_folder / "CMakeCache.txt").unlink(missing_ok=True)
        configure = [
            *("cmake", "-S", str(ROOT / "csrc"), "-B", str(self.cmake_folder), "-G", "Ninja"),
            f"-DPython_EXECUTABLE={sys.executable}",
            *CMAKE_ARGS,
        ]
        subprocess.run(configure, check=True)
        subprocess.run(["cmake", "--build", str(self.cmake_folder)], check=True)
        # setuptools packs all that lies here, also what an earlier build with other switches left.
        for old in Path(self.build_lib, "diffcloth_torch").glob("_kernels*.so"):
            old.unlink()
        super().run()

    def build_extension(self, ext: Extension) -> None:
        package = Path(self.get_ext_fullpath(ext.name)).resolve().parent
        component = ext.name.rpartition(".")[2]
        install = ["cmake", "--install", str(self.cmake_folder), "--component", component]
        subprocess.run([*install, "--prefix", str(package.parent)], check=True)
        copy_licenses(package / "licenses")


def copy_licenses(folder: Path) -> None:
    """Copy the license texts of what is compiled into the core: a wheel must carry them."""
    nanobind = distribution("nanobind")
    (text,) = [file for file in nanobind.files or () if file.name == "LICENSE"]
    (header,) = [file for file in nanobind.files or () if file.name == "robin_map.h"]
    folder.mkdir(exist_ok=True)
    (folder / "nanobind.txt").write_text(text.read_text(), encoding="utf-8")
    # This one stands in the comment above the code.
    comment = header.read_text().partition("*/")[0] + "*/\n"
    assert "MIT License" in comment
    (folder / "robin_map.txt").write_text(comment, encoding="utf-8")


setup(
    ext_modules=[Extension(f"diffcloth_torch.{module}", sources=[]) for module in MODULES],
    cmdclass={"build_ext": CMakeBuild},
)
