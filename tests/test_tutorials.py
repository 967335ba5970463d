"""Tutorials are notebooks: each runs from its first cell to its last in an empty folder."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

jupytext = pytest.importorskip("jupytext")

DOCS = Path(__file__).resolve().parents[1] / "docs"
TUTORIALS = sorted(set(DOCS.glob("tutorials/*.md")) - {DOCS / "tutorials" / "index.md"})
EXAMPLES = sorted(DOCS.glob("examples/*.md"))
CONFIGURATION = DOCS / "examples/configuration.md"  # a page that needs no program


def names(text):
    """Pages in tables of contents."""
    (toctree,) = re.findall(r"```\{toctree\}\n:hidden:\n(.*?)```", text, re.DOTALL)
    return toctree.split()


def test_all_tutorials_are_listed():
    assert len(TUTORIALS) == 7
    index = (DOCS / "tutorials/index.md").read_text()
    assert sorted(names(index)) == [page.stem for page in TUTORIALS]
    for page in TUTORIALS:
        assert f"({page.name})" in index


def test_every_program_has_a_page():
    programs = sorted(path.stem for path in (DOCS.parent / "examples").glob("*.py"))
    assert [page.stem for page in EXAMPLES if page != CONFIGURATION] == programs
    listed = names((DOCS / "examples.md").read_text())
    assert sorted(listed) == [f"examples/{page.stem}" for page in EXAMPLES]


@pytest.mark.parametrize("page", [*TUTORIALS, *EXAMPLES], ids=lambda page: page.stem)
def test_a_page_is_a_notebook(page):
    """A page is for Python 3, and has cells that compile and text around the cells."""
    notebook = jupytext.read(page)
    assert notebook.metadata.kernelspec.name == "python3"
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert cells
    assert notebook.cells[0].cell_type == "markdown"
    for cell in cells:
        ast.parse(re.sub(r"^%.*$", "", cell.source, flags=re.MULTILINE))


@pytest.mark.slow
@pytest.mark.parametrize("page", [*TUTORIALS, CONFIGURATION], ids=lambda page: page.stem)
def test_a_page_runs_in_an_empty_folder(page, tmp_path):
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    for module in ("ipykernel", "viser", "scipy", "gymnasium"):
        pytest.importorskip(module)
    file = tmp_path / f"{page.stem}.ipynb"
    jupytext.write(jupytext.read(page), file)
    notebook = nbformat.read(file, as_version=4)
    # A cell that fails raises.
    resources = {"metadata": {"path": str(tmp_path)}}
    client = nbclient.NotebookClient(
        notebook, timeout=600, startup_timeout=600, resources=resources
    )
    client.execute()
    assert any(cell.get("outputs") for cell in notebook.cells)
    assert "BarrierStartWarning" not in str(notebook.cells)
