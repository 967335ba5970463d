"""Build the C++ core with CMake; everything else is in pyproject.toml."""

import os
import shlex
import subprocess
import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent


class CMakeBuild(build_ext):
    """Configure, build and install csrc/ into the package. CMAKE_ARGS adds arguments."""

    def build_extension(self, ext: Extension) -> None:
        package = Path(self.get_ext_fullpath(ext.name)).resolve().parent
        # Outside setuptools' temporary folders, so that a second build compiles only what changed;
        # but not from the last one's settings, nor from the paths of its build environment.
        build = ROOT / "build" / sys.implementation.cache_tag
        (build / "CMakeCache.txt").unlink(missing_ok=True)
        configure = [
            *("cmake", "-S", str(ROOT / "csrc"), "-B", str(build), "-G", "Ninja"),
            f"-DPython_EXECUTABLE={sys.executable}",
            *shlex.split(os.environ.get("CMAKE_ARGS", "")),
        ]
        subprocess.run(configure, check=True)
        subprocess.run(["cmake", "--build", str(build)], check=True)
        subprocess.run(
            ["cmake", "--install", str(build), "--prefix", str(package.parent)], check=True
        )


setup(
    ext_modules=[Extension("diffcloth_torch._core", sources=[])],
    cmdclass={"build_ext": CMakeBuild},
)
