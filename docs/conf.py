"""The site of the documentation, which `scripts/docs` builds into build/site.

The root of the repository is the source folder, so that links between pages are the same as on
GitHub. The front page is the README; the reference comes from the docstrings.
"""

import re
import shutil
from importlib.metadata import version as installed_version
from pathlib import Path

project = "diffcloth_torch"
author = copyright = "the authors of diffcloth_torch"
release = version = installed_version("diffcloth-torch")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "README"
include_patterns = ["*.md", "docs/**"]
exclude_patterns = [".*", "build", "results"]

html_theme = "furo"
html_title = "diffcloth_torch"
html_show_sphinx = False
html_copy_source = False

myst_heading_anchors = 3

# `Name` in a docstring is a link where it is the name of something documented, else plain code.
default_role = "py:obj"
autodoc_member_order = "bysource"
autoclass_content = "both"
autodoc_default_options = {"members": True}
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_attr_annotations = False

# On GitHub the README needs no table of contents: it is the site's.
CONTENTS = """
```{toctree}
:hidden:
docs/guide
docs/bodies
docs/robots
docs/tasks
docs/experiments
docs/gallery
docs/reference/index
docs/design
docs/performance
docs/notation
CONTRIBUTING
CHANGELOG
```
"""


def add_contents(app, name, source):
    """Append what GitHub has no use for."""
    if name == root_doc:
        source[0] += CONTENTS


def copy_front_page(app, exception):
    """Let a server find the front page."""
    if not exception:
        shutil.copy(Path(app.outdir, "README.html"), Path(app.outdir, "index.html"))


def leave_out_private(app, what, name, thing, options, signature, returns):
    """Take fields that begin with an underscore out of the signatures of dataclasses."""
    return re.sub(r", _\w+: [^,()]*(?=[,)])", "", signature or "") or None, returns


def setup(app):
    """Connect the functions above."""
    app.connect("source-read", add_contents)
    app.connect("autodoc-process-signature", leave_out_private)
    app.connect("build-finished", copy_front_page)
