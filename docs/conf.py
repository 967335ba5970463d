"""The site of the documentation, which `scripts/docs` builds into build/site.

The root of the repository is the source folder, so that links between pages are the same as on
GitHub. The front page is the README; the reference comes from the docstrings. The package is
imported from its sources with a stand-in for the compiled core: nothing is built or installed.
Only the cells of tutorials and examples, if they are executed, run the package that is built.
"""

import inspect
import os
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
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
]
root_doc = "README"
include_patterns = [
    "*.md",
    "changelog.d/README.md",
    "docs/**",
    "csrc/*/README.md",
    "diffcloth_torch/*/README.md",
]
exclude_patterns = [".*", "build", "results"]

html_theme = "furo"
html_title = "diffcloth_torch"
html_show_sphinx = False
html_copy_source = False
html_static_path = ["static"]
html_css_files = ["site.css"]

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3

# `scripts/docs --execute` turns this to "force".
nb_execution_mode = "off"
nb_execution_in_temp = True
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True
# Pages of examples run them by their names.
os.environ["PYTHONPATH"] = str(ROOT / "examples")
os.environ["TQDM_DISABLE"] = "1"
# A requirement of pyvista imports bars of notebooks, which miss ipywidgets.
os.environ["PYTHONWARNINGS"] = "ignore:IProgress not found"
# What `scripts/replays` makes for the gallery is served as it is.
EXTRA = ROOT / "build" / "extra"
EXTRA.mkdir(parents=True, exist_ok=True)
html_extra_path = [str(EXTRA)]

# `Name` in a docstring is a link where it is the name of something documented, else plain code.
default_role = "py:obj"
autodoc_member_order = "bysource"
autoclass_content = "both"
autodoc_default_options = {"members": True}
autodoc_typehints_format = "short"
# By its name: the union of NumPy has eight members.
autodoc_type_aliases = {"ArrayLike": "ArrayLike", "ByName": "ArrayLike | Mapping[str, float]"}
autosummary_generate = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_attr_annotations = False

# Examples of a shell have no prompt, those of docstrings do.
copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True

# On GitHub the README needs no table of contents: it is the site's. The front page shows the parts
# as cards, each with its first page.
CONTENTS = {
    "Start": (
        "Install, take a first gradient, work through tutorials.",
        ["docs/getting-started", "docs/tutorials/index", "docs/gallery"],
    ),
    "How-to": (
        "Your mesh, files, your robot, batches, failures, identification, learning, many machines.",
        [
            "docs/meshes",
            "docs/files",
            "docs/robots",
            "docs/batches",
            "docs/failures",
            "docs/identification",
            "docs/environments",
            "docs/learning",
            "docs/scaling",
        ],
    ),
    "Concepts": (
        "What is guaranteed, how to choose values, how it works.",
        ["docs/guide", "docs/bodies", "docs/design", "docs/gpu"],
    ),
    "Reference": (
        "Classes and functions, configurations, letters and units.",
        ["docs/reference/index", "docs/tasks", "docs/notation", "CHANGELOG"],
    ),
    "Examples": (
        "Programs and configurations, one page each, with their output.",
        ["docs/examples"],
    ),
    "Performance": (
        "What was measured, and how others compare.",
        ["docs/performance", "docs/experiments", "docs/comparison"],
    ),
    "Development": (
        "Extend the package, contribute, read what was tried.",
        ["docs/extending", "CONTRIBUTING", "changelog.d/README", "docs/notes/index"],
    ),
}
PICTURE_OF_A_COMMAND = re.compile(
    r"^    diffcloth \w+ configs/(\w+)\.yaml\n\n!\[.*\]\(.*\)$", re.MULTILINE
)
PICTURE = re.compile(r"^!\[.*\]\(images/(.*)\)$", re.MULTILINE)
CARD = """\
:::{{grid-item-card}} {caption}
:link: {page}
:link-type: doc
{text}
:::
"""
LANGUAGE = "\nlanguage_info: {name: python, pygments_lexer: ipython3}"
DOWNLOAD = "{{nb-download}}`This page as a notebook <{page}.ipynb>`\n\n"
NOT_EXECUTED = """\
:::{note}
The cells were not executed for this build of the site, and nothing is shown below them:
`scripts/docs --execute` does that.
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
    if name == root_doc:
        cards, contents = "", ""
        for caption, (text, pages) in CONTENTS.items():
            cards += CARD.format(caption=caption, page=pages[0], text=text)
            contents += TOCTREE.format(caption=caption, pages="\n".join(pages))
        head, heading, body = source[0].partition("\n## ")
        grid = f"::::{{grid}} 1 2 3 4\n:gutter: 2\n\n{cards}::::\n"
        source[0] = f"{head}\n{grid}{heading}{body}{contents}"
    elif source[0].startswith("---\nfile_format: mystnb"):
        head, title, text = re.split(r"^(# .+\n)", source[0], maxsplit=1, flags=re.MULTILINE)
        # A kernel tells the language of its cells; where none runs, nothing else does.
        head = head.replace("\nkernelspec:", LANGUAGE + "\nkernelspec:")
        page = name.rpartition("/")[2]
        note = "" if app.config.nb_execution_mode == "force" else NOT_EXECUTED
        # Examples run a program of the repository, which is not where a notebook goes.
        link = DOWNLOAD.format(page=page) if name.startswith("docs/tutorials/") else ""
        source[0] = f"{head}{title}\n{link}{note}{text}"
    elif name == "docs/gallery":
        source[0] = PICTURE_OF_A_COMMAND.sub(with_replay, source[0])
        # On a telephone the words in a picture are too small to read.
        source[0] = PICTURE.sub(r'<a href="../_images/\1">\g<0></a>', source[0])


def with_replay(found):
    """What was found, and under it a link to the replay of its configuration, if there is one."""
    page = Path("replays", f"{found[1]}.html")
    if not (EXTRA / page).exists():
        return found[0]
    return f'{found[0]}\n\n<a href="../{page}">Play this motion, and look from all sides</a>\n'


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
    """Leave out private fields of dataclasses and private constructors; print aliases by name."""
    if name in MADE_INSIDE:
        return "", None
    text = re.sub(r", _\w+: [^,()]*(?=[,)])", "", signature or "")
    # In unions Sphinx prints an alias as the class that it has for aliases.
    return re.sub(r"TypeAliasForwardRef\('([^']*)'\)", r"\1", text) or None, returns


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
