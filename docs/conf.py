"""The site of the documentation, which `scripts/docs` builds into build/site.

The root of the repository is the source folder, so that links between pages are the same as on
GitHub. The front page is the README; the reference comes from the docstrings. The package is
imported from its sources with a stand-in for the compiled core: nothing is built or installed.
"""

import inspect
import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

import core_stub  # noqa: E402

core_stub.install(ROOT / "diffcloth_torch" / "_core.pyi")

project = "diffcloth_torch"
author = copyright = "the authors of diffcloth_torch"
release = version = re.search(
    r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE
)[1]

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
]
root_doc = "README"
include_patterns = ["*.md", "docs/**"]
exclude_patterns = [".*", "build", "results"]

html_theme = "furo"
html_title = "diffcloth_torch"
html_show_sphinx = False
html_copy_source = False

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3

# `Name` in a docstring is a link where it is the name of something documented, else plain code.
default_role = "py:obj"
autodoc_member_order = "bysource"
autoclass_content = "both"
autodoc_default_options = {"members": True}
autodoc_typehints_format = "short"
autosummary_generate = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_attr_annotations = False

# Examples of a shell have no prompt, those of docstrings do.
copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True

# On GitHub the README needs no table of contents: it is the site's. The front page shows the four
# parts as cards, each with its first page.
CONTENTS = {
    "Start": (
        "Install, and take a first gradient.",
        ["docs/getting-started", "docs/examples", "docs/gallery"],
    ),
    "How-to": (
        "Choose values, load robots, describe tasks, contribute.",
        [
            "docs/guide",
            "docs/robots",
            "docs/identification",
            "docs/environments",
            "docs/learning",
            "docs/scaling",
            "docs/tasks",
            "docs/extending",
            "CONTRIBUTING",
        ],
    ),
    "Reference": (
        "Classes and functions, letters and units.",
        ["docs/reference/index", "docs/notation", "CHANGELOG"],
    ),
    "Background": (
        "How it works, and what was measured.",
        [
            "docs/design",
            "docs/bodies",
            "docs/experiments",
            "docs/performance",
            "docs/notes/index",
        ],
    ),
}
CARD = """\
:::{{grid-item-card}} {caption}
:link: {page}
:link-type: doc
{text}
:::
"""
TOCTREE = """
```{{toctree}}
:hidden:
:caption: {caption}

{pages}
```
"""


def add_contents(app, name, source):
    """Add what GitHub has no use for: cards above the first section, and tables of contents."""
    if name != root_doc:
        return
    cards, contents = "", ""
    for caption, (text, pages) in CONTENTS.items():
        cards += CARD.format(caption=caption, page=pages[0], text=text)
        contents += TOCTREE.format(caption=caption, pages="\n".join(pages))
    head, heading, body = source[0].partition("\n## ")
    source[0] = f"{head}\n::::{{grid}} 2 2 4 4\n{cards}::::\n{heading}{body}{contents}"


def copy_front_page(app, exception):
    """Let a server find the front page."""
    if not exception:
        shutil.copy(Path(app.outdir, "README.html"), Path(app.outdir, "index.html"))


# Classes that the package makes, and attributes that only the package reads.
MADE_INSIDE = {"diffcloth_torch.Report", "diffcloth_torch.Robot"}
INTERNAL = {
    "diffcloth_torch.RigidBody": ["primitive"],
    "diffcloth_torch.Robot": ["mechanism", "surfaces"],
}


def shorten_signature(app, what, name, thing, options, signature, returns):
    """Leave out fields of dataclasses that begin with an underscore, and what no user calls."""
    if name in MADE_INSIDE:
        return "", None
    return re.sub(r", _\w+: [^,()]*(?=[,)])", "", signature or "") or None, returns


def leave_out_internal(app, what, name, thing, options, lines):
    """Take internal attributes out of the docstring of their class."""
    for attribute in INTERNAL.get(name, ()):
        text = "\n".join(lines)
        lines[:] = re.sub(rf"\n    {attribute}: .*(\n {{5,}}.*)*", "", text).split("\n")


def add_summary(app, what, name, thing, options, lines):
    """List the methods of a class, each with its first sentence, above its arguments."""
    # Autodoc also asks for the docstring of __init__.
    if what != "class" or lines[:1] != inspect.getdoc(thing).splitlines()[:1]:
        return
    hidden = getattr(options, "exclude_members", None) or ()
    methods = [
        method
        for method, value in vars(thing).items()
        if (inspect.isroutine(value) or isinstance(value, classmethod | property))
        and not method.startswith("_")
        and inspect.getdoc(getattr(thing, method))
        and method not in hidden
    ]
    if not methods:
        return
    sections = (i for i, line in enumerate(lines) if re.match(r"(Args|Attributes|Raises):$", line))
    place = next(sections, len(lines))
    entries = [f"   {method}" for method in methods]
    summary = [".. rubric:: Methods", "", ".. autosummary::", "   :nosignatures:", "", *entries, ""]
    lines[place:place] = summary


def setup(app):
    """Connect the functions above."""
    app.connect("source-read", add_contents)
    app.connect("autodoc-process-signature", shorten_signature)
    # Before napoleon, which turns the sections of a docstring into lists.
    app.connect("autodoc-process-docstring", leave_out_internal, priority=400)
    app.connect("autodoc-process-docstring", add_summary, priority=401)
    app.connect("build-finished", copy_front_page)
