"""Links and names of the documentation exist, and its formulas match the code."""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch import _core

ROOT = Path(__file__).resolve().parents[1]
READMES = sorted([*ROOT.glob("csrc/*/README.md"), *ROOT.glob("diffcloth_torch/*/README.md")])
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *READMES])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if not target.startswith(("http://", "https://", "#")):
            assert (page.parent / target.partition("#")[0]).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_are_named_exist(page):
    for path in re.findall(
        r"`((?:\.ci|configs|docs|examples|scripts|tests)/[\w./-]*\w)`", page.read_text()
    ):
        if path != "tests/oracles":  # named as a possible place for references
            assert (ROOT / path).exists(), path


def files_of(readme):
    """Headers and modules of a folder, without the levels of a kernel."""
    files = [*readme.parent.glob("*.h"), *readme.parent.glob("*.py")]
    return [f.name for f in files if not re.search(r"^__|_(impl|avx\w*|portable)\.h$", f.name)]


def test_every_folder_of_code_has_a_readme():
    folders = [f.parent for f in ROOT.glob("csrc/*/*.h")]
    folders += [f.parent for f in ROOT.glob("diffcloth_torch/*/*.py")]
    assert {readme.parent for readme in READMES} == set(folders)


@pytest.mark.parametrize("readme", READMES, ids=lambda readme: readme.parent.name)
def test_the_readme_of_a_folder_names_its_files(readme):
    text = readme.read_text()
    assert [name for name in files_of(readme) if name not in text] == []
    tops = ("csrc", "diffcloth_torch", "scripts", "tests")
    known = {f.name for top in tops for f in ROOT.glob(f"{top}/**/*")}
    assert [n for n in re.findall(r"\b\w+\.(?:h|cpp|py)\b", text) if n not in known] == []


def test_the_reference_has_every_public_name():
    pages = [page.read_text() for page in ROOT.glob("docs/reference/*.md")]
    named = re.findall(r"^\.\. auto\w+:: diffcloth_torch\.(\w+)$", "\n".join(pages), re.M)
    assert sorted(named) == sorted(dc.__all__)


@pytest.mark.parametrize("module", ["envs", "learn"])
def test_the_reference_has_every_name_of_a_module(module):
    pages = "\n".join(page.read_text() for page in ROOT.glob("docs/reference/*.md"))
    named = re.findall(rf"^\.\. auto\w+:: diffcloth_torch\.{module}\.(?:\w+\.)?(\w+)$", pages, re.M)
    missing = set(importlib.import_module(f"diffcloth_torch.{module}").__all__) - set(named)
    assert not missing


def test_the_stand_in_of_the_core_is_like_the_core():
    """The site is built with the declarations of `_core.pyi` instead of the core."""
    declarations = ROOT / "diffcloth_torch" / "_core.pyi"
    found = importlib.util.spec_from_file_location("core_stub", ROOT / "docs" / "core_stub.py")
    core_stub = importlib.util.module_from_spec(found)
    found.loader.exec_module(core_stub)
    stub = core_stub.read(declarations)
    variables = [
        node for node in ast.parse(declarations.read_text()).body if isinstance(node, ast.AnnAssign)
    ]
    assert variables
    for node in variables:
        ours, theirs = (getattr(core, node.target.id) for core in (_core, stub))
        assert type(ours) is type(theirs), node.target.id
        if node.value is not None:
            assert theirs == ours, node.target.id
            assert [*theirs] == [*ours], node.target.id  # in this order


def test_the_gallery_shows_every_picture_that_a_configuration_makes():
    text = (ROOT / "docs/gallery.md").read_text()
    shown = set(re.findall(r"\]\(images/(\w+\.png)\)", text))
    assert shown == {path.name for path in ROOT.glob("docs/images/*.png")}


@pytest.mark.parametrize(
    ("word", "page"),
    [
        ("tutorial", "tutorials/index.md"),
        ("notebook", "tutorials/index.md"),
        ("gymnasium", "environments.md"),
        ("system identification", "identification.md"),
        ("equilibrium", "guide.md"),
        ("GPU", "gpu.md"),
        ("batch", "guide.md"),
        ("robot", "robots.md"),
        ("own mesh", "meshes.md"),
        ("go wrong", "failures.md"),
    ],
)
def test_a_newcomers_word_stands_in_a_heading(word, page):
    """The site's search ranks pages with the word in a heading first."""
    headings = re.findall(r"^#+ (.+)$", (ROOT / "docs" / page).read_text(), re.MULTILINE)
    assert any(word.lower() in heading.lower() for heading in headings)


def test_the_front_page_has_three_moving_pictures():
    readme = (ROOT / "README.md").read_text()
    shown = re.findall(r"\]\((docs/images/\w+\.webp)\)", readme)
    assert len(shown) == 3
    assert {ROOT / path for path in shown} == set(ROOT.glob("docs/images/*.webp"))
    assert sum((ROOT / path).stat().st_size for path in shown) < 500e3


@pytest.mark.parametrize("record", [dc.Parameters, dc.Control, dc.ContactOptions])
def test_notation_has_every_name(record):
    rows = "\n".join(
        line for line in (ROOT / "docs/notation.md").read_text().splitlines() if line[:1] == "|"
    )
    for field in dataclasses.fields(record):
        if field.name not in ("_unbatched", "self_contact"):  # neither is a quantity
            assert re.search(rf"`(\w+\.)?{field.name}`", rows), field.name


def test_resting_gap_is_that_of_the_guide():
    """A sheet at rest on a floor: its weight is kappa A / 4 phi(gap / barrier distance)."""
    grid = dc.Cloth.grid(7, 7, 0.3)
    rest = np.array(grid.vertices)
    rest[:, :2] += np.random.default_rng(0).uniform(-0.005, 0.005, (49, 2))
    above = rest + np.array([0, 0, 0.004])
    cloth = dc.Cloth(above, grid.faces, rest_positions=rest, material=dc.Material(bending=1e-2))
    contact = dc.ContactOptions(barrier_distance=0.005, barrier_stiffness=20.0)
    # Away from the plane's diagonal, whose contacts with edges of the sheet would carry a part.
    floor = dc.RigidBody.plane(50.0, pose=[9, 0, 0, 1, 0, 0, 0])
    simulator = dc.Simulator(dc.Scene([cloth], [floor]), 0.02, contact=contact)
    with torch.no_grad():
        end = simulator.rollout(simulator.initial_state(), steps=60)[-1]

    r = end.positions[:, 2].numpy() / 0.005
    assert (r > 0.5).all()
    assert (r < 1).all()
    phi = 2 * r * (2 * (r**2 - 1) * np.log(r**2) + (1 - r**2) ** 2 / r**2)
    pressure = 20.0 / 4 * phi.mean()
    # 5 %: vertices at different heights carry different areas.
    assert pressure == pytest.approx(0.124 * 9.81, rel=0.05)


@pytest.mark.parametrize("load", [0.0, 0.5, 0.9])
def test_creep_is_that_of_the_guide(load):
    """A sheet on a floor, pulled sideways by a share of the largest friction."""
    friction, slip = 0.5, 1e-3
    cloth = dc.Cloth.grid(3, 3, 0.1, pose=[0, 0, 0.003, 1, 0, 0, 0])
    contact = dc.ContactOptions(barrier_distance=0.004, slip_velocity=slip)
    scene = dc.Scene([cloth], [dc.RigidBody.plane(50.0)])
    simulator = dc.Simulator(scene, 0.01, contact=contact)
    parameters = simulator.default_parameters().replace(
        friction=friction,
        gravity=torch.tensor([load * friction * 9.81, 0.0, -9.81], dtype=torch.float64),
    )
    with torch.no_grad():
        end = simulator.rollout(simulator.initial_state(), parameters=parameters, steps=100)[-1]
    v = slip * (1 - np.sqrt(1 - load))
    assert end.velocities[:, 0].mean().item() == pytest.approx(v, rel=0.02, abs=1e-8)


def test_the_examples_of_extensions_fit_the_code():
    """Files have the lines around the changes; the potential overrides all abstract members."""
    text = (ROOT / "docs/extending.md").read_text()
    examples = re.findall(r"```diff\n(.*?)```", text, re.DOTALL)
    assert len(examples) == 5
    for example in examples:
        parts = re.split(r"^--- (.+)\n", example, flags=re.M)
        assert len(parts) > 2
        for path, lines in zip(parts[1::2], parts[2::2], strict=True):
            code = (ROOT / path).read_text()
            for line in lines.splitlines():
                assert line[0] == "+" or f"\n{line[1:]}" in code, (path, line)
    required = [
        name
        for path in ("csrc/potential/potential.h", "csrc/step/step_potential.h")
        for name in re.findall(r"(\w+)\([^)]*\)(?: const)? = 0;", (ROOT / path).read_text())
    ]
    section = text[text.index("## Add a potential") : text.index("## Add a parameter")]
    overridden = re.findall(r"(\w+)\([^)]*\)(?: const)? override", section)
    assert set(required) == set(overridden)


def python_blocks():
    for page in PAGES:
        text = page.read_text()
        for found in re.finditer(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
            line = text[: found.start()].count("\n") + 1
            yield pytest.param(page, line, found[1], id=f"{page.stem}-{line}")


@pytest.fixture
def as_a_reader(tmp_path, monkeypatch):
    """A folder with a mesh of the reader's own, and the configurations as they are in a clone."""
    sheet = dc.Cloth.grid((7, 6), (0.3, 0.35), name="shirt")
    dc.Simulator(dc.Scene([sheet]), 0.01).initial_state().export(tmp_path / "shirt.obj")
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    monkeypatch.chdir(tmp_path)


@pytest.mark.filterwarnings(
    "error::diffcloth_torch.BarrierStartWarning", "error:Cloth.grid:FutureWarning"
)
@pytest.mark.parametrize(("page", "line", "code"), list(python_blocks()))
@pytest.mark.usefixtures("as_a_reader")
def test_every_block_of_python_runs_alone(page, line, code):
    """A block runs in a fresh interpreter: it contains its own imports."""
    if "dc.render" in code:
        pytest.importorskip("pyvista")
        pytest.importorskip("imageio_ffmpeg")
    if "dc.show" in code:
        pytest.importorskip("viser")
    if "robots.panda()" in code:
        try:
            dc.robots.panda()
        except ImportError as error:
            pytest.skip(str(error))
    # Lines as in the page.
    exec(compile("\n" * line + code, str(page), "exec"), {"__name__": "__main__"})


def test_pages_agree_on_the_memory_of_the_hanging_sheet():
    """All pages state one amount for the sheet of a slow test in tests/solver."""
    told = []
    for page in PAGES:
        text = " ".join(page.read_text().split())
        for amount, unit in re.findall(
            r"hanging sheet of 200 x 200 vertices (?:takes |is )?([\d.]+) (Gi?B)", text
        ):
            told.append(float(amount) * (2**30 / 1e9 if unit == "GiB" else 1.0))
    assert len(told) == 3
    assert [round(gigabytes, 1) for gigabytes in told] == [0.9] * 3
