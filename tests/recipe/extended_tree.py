"""Copies of the sources with an example of docs/extending.md applied; changed files compiled."""

import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "extending.md"
_INCLUDE = re.compile(r'^\s*#\s*include\s+"([^"]+)"', re.MULTILINE)


def section_of_page(title: str) -> str:
    """Text of a section of the page."""
    _, *parts = PAGE.read_text().split(f"\n## {title}\n")
    assert len(parts) == 1, title
    return parts[0].split("\n## ")[0]


def classes_of_page(text: str) -> dict[str, str]:
    """Path of each class that a section adds -> its text."""
    paths = re.findall(r"^\*\*The class\*\*, `([^`]+)`", text, re.MULTILINE)
    return dict(zip(paths, re.findall(r"```cpp\n(.*?)```", text, re.DOTALL), strict=True))


def changes_of_page(text: str) -> dict[str, list[str]]:
    """Path of each file that the diff of a section changes -> its lines."""
    diff = re.search(r"```diff\n(.*?)```", text, re.DOTALL)[1]
    parts = re.split(r"^--- (.+)\n", diff, flags=re.MULTILINE)
    assert not parts[0]
    return {path: lines.splitlines() for path, lines in zip(parts[1::2], parts[2::2], strict=True)}


def patched(path: str, text: str, lines: list[str]) -> str:
    """A file after a diff without line numbers: each hunk applies behind the previous hunk.

    An added line goes behind the line above it in the diff, or before the next context line.
    """
    place = 0
    hunk: list[str] = []
    for line in [*lines, None]:
        # A context line that is not adjacent in the file ends a hunk.
        if line is not None and (line[0] == "+" or not hunk or _follows(text, place, hunk, line)):
            hunk.append(line)
            continue
        text, place = _with_hunk(path, text, place, hunk)
        hunk = [] if line is None else [line]
    return text


def _old(hunk: list[str]) -> str:
    return "".join(f"\n{line[1:]}" for line in hunk if line[0] != "+") + "\n"


def _follows(text: str, place: int, hunk: list[str], line: str) -> bool:
    return _old([*hunk, line]) in f"\n{text}"[place:]


def _with_hunk(path: str, text: str, place: int, hunk: list[str]) -> tuple[str, int]:
    old = _old(hunk)
    at = f"\n{text}".find(old, place)
    assert at >= 0, f"{path} has no lines{old}"
    new = "".join(f"\n{line[1:]}" for line in hunk if line[0] != "-") + "\n"
    result = (f"\n{text}"[:at] + new + f"\n{text}"[at + len(old) :])[1:]
    return result, at + len(new) - 1


def make_tree(folder: Path, title: str) -> set[str]:
    """Copy all tracked files to a folder and apply the example of a section.

    Returns:
        Paths of the files that the example adds or changes.
    """
    names = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split("\0")
    for name in filter(None, names):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    text = section_of_page(title)
    classes = classes_of_page(text)
    for path, code in classes.items():
        assert not (folder / path).exists()
        (folder / path).write_text(code)
    changes = changes_of_page(text)
    for changed, lines in changes.items():
        file = folder / changed
        file.write_text(patched(changed, file.read_text(), lines))
    return {*classes, *changes}


def find_build() -> Path | None:
    """The newest build of these sources with users' options; None if there is no build."""
    found = []
    for cache in ROOT.glob("build/*/CMakeCache.txt"):
        text = cache.read_text()
        if (
            f"CMAKE_HOME_DIRECTORY:INTERNAL={ROOT / 'csrc'}\n" in text
            and re.search(r"^CMAKE_BUILD_TYPE:\w+=(Release)?$", text, re.MULTILINE)
            and "-fsanitize" not in text
            and (cache.parent / "libdiffcloth.a").exists()
        ):
            found.append(cache)
    return max(found, key=lambda cache: cache.stat().st_mtime).parent if found else None


def compile_core(tree: Path, changed: set[str], build: Path) -> int:
    """Compile and install the core of a tree; return the number of compiled files.

    Args:
        tree: The sources.
        changed: Paths of files that differ from the sources of the build.
        build: Build folder with the objects that do not depend on changed files.
    """
    cache = (build / "CMakeCache.txt").read_text()
    compiler = re.search(r"^CMAKE_CXX_COMPILER:\w+=(.*)$", cache, re.MULTILINE)[1]
    flags = re.search(r"^CMAKE_CXX_FLAGS:\w+=(.*)$", cache, re.MULTILINE)[1]
    own = tree / "build"
    _run(
        *("cmake", "-S", tree / "csrc", "-B", own, "-G", "Ninja", "-DCMAKE_BUILD_TYPE=Release"),
        *(f"-DCMAKE_CXX_COMPILER={compiler}", f"-DCMAKE_CXX_FLAGS={flags}"),
        *("-DCMAKE_CXX_FLAGS_RELEASE=-O1 -DNDEBUG", f"-DPython_EXECUTABLE={sys.executable}"),
    )
    # Ninja has no record of objects from another build; therefore its commands run directly.
    commands = _run("ninja", "-C", own, "-t", "commands", "_core").splitlines()
    dirty = _dependents(tree / "csrc", {p.removeprefix("csrc/") for p in changed})
    headers: list[str] = []  # to be compiled before all else
    compiled: list[str] = []
    links: list[str] = []
    for command in commands:
        source = re.search(r" -c (\S+)$", command)
        target = re.search(r" -o (\S+)", command)
        if source is None:
            links.append(command)
            continue
        path = Path(source[1])
        if "cmake_pch" in path.name:
            headers.append(command)
            continue
        inside = path.is_relative_to(tree / "csrc")
        relative = path.relative_to(tree / "csrc").as_posix() if inside else None
        old, new = build / target[1], own / target[1]
        new.parent.mkdir(parents=True, exist_ok=True)
        if old.exists() and relative not in dirty:
            shutil.copy2(old, new)
        else:
            compiled.append(command)
    for command in headers:
        _run("sh", "-c", command, cwd=own)
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        list(pool.map(lambda command: _run("sh", "-c", command, cwd=own), compiled))
    for command in links:
        _run("sh", "-c", command, cwd=own)
    _run("cmake", "--install", own, "--component", "_core", "--prefix", tree)
    return len(compiled)


def _dependents(csrc: Path, changed: set[str]) -> set[str]:
    """Changed files, and all files that include a changed file directly or indirectly."""
    includes = {
        path.relative_to(csrc).as_posix(): set(_INCLUDE.findall(path.read_text()))
        for path in csrc.rglob("*")
        if path.suffix in (".h", ".cpp")
    }
    dirty = set(changed)
    while True:
        more = {path for path, used in includes.items() if used & dirty} - dirty
        if not more:
            return dirty
        dirty |= more


def check_example(folder: Path, title: str, checks: str, most: int) -> None:
    """Apply the example of a section to a copy of the sources, compile it, and run its checks.

    Args:
        folder: Place for the copy.
        title: Title of the section.
        checks: File of tests in this folder.
        most: Limit of the number of files that are compiled.
    """
    if not (ROOT / ".git").exists():
        pytest.skip("needs a clone")
    build = find_build()
    assert build is not None, "no build of this clone in build/: pip install -e ."
    assert compile_core(folder, make_tree(folder, title), build) < most
    result = subprocess.run(
        [
            *(sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider"),
            Path("tests", "recipe", checks),
        ],
        cwd=folder,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    print(result.stdout[-3000:])
    assert result.returncode == 0, result.stdout + result.stderr


def _run(*command, cwd=None) -> str:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    result = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, f"{command}\n{result.stdout}{result.stderr}"
    return result.stdout
