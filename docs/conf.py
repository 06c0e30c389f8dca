"""Sphinx' settings for the documentation: `make docs` writes docs/_build/html/index.html."""

from __future__ import annotations

import logging
import os
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "src"))
os.environ.setdefault("MPLBACKEND", "agg")

from sphinx_gallery.sorting import FileNameSortKey  # noqa: E402

import polarmpm as pm  # noqa: E402

logging.getLogger("polarmpm").setLevel(logging.WARNING)  # pages don't tell what was compiled for them

project, author = "polarmpm", "the polarmpm developers"
copyright = f"2026, {author}"
version = release = pm.__version__
language = "en"
default_role = "py:obj"  # `names` of docstrings lead to what they mean

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["_build"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
# the gallery's settings hold a function; plain words in backticks may be several names
suppress_warnings = ["config.cache", "ref.python"]

# pages
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
html_theme = "furo"
html_title = f"polarmpm {version}"
html_static_path = ["_static"]
html_css_files = ["polarmpm.css"]
html_copy_source = False
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

# reference
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True, "inherited-members": True, "show-inheritance": True}
autosummary_generate = True
add_module_names = False
python_use_unqualified_type_names = True
napoleon_google_docstring, napoleon_numpy_docstring = True, False
napoleon_use_ivar, napoleon_use_rtype = True, False
napoleon_attr_annotations = True

# examples, which run as the pages are built
sphinx_gallery_conf = {
    "examples_dirs": ["../examples/tutorial", "../examples/gallery"],
    "gallery_dirs": ["tutorial", "gallery"],
    "filename_pattern": r"\.py$",
    "within_subsection_order": FileNameSortKey,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "capture_repr": (),
    "thumbnail_size": (480, 336),
    "show_signature": False,
    "abort_on_example_error": True,
    "matplotlib_animations": False,
}


# files that are read elsewhere, too ----------------------------------------------------------------------

ROOT_PAGES = {"README.md": "readme", "CONTRIBUTING.md": "contributing", "CHANGELOG.md": "changelog"}
SECTION = re.compile(r"^(Args|Attributes|Returns|Yields|Raises|Example|Examples|Note):$")


def _read_page(app: Any, docname: str, source: list[str]) -> None:
    """Pages of the repository's root are read from there; links to them lead into the site."""
    text, up = source[0], "../" * docname.count("/")
    for name, page in ROOT_PAGES.items():
        if docname == f"project/{page}":
            app.env.note_dependency(str(ROOT / name))
            text = (ROOT / name).read_text()
            text = re.sub(r"\]\((?!https?:|#|docs/)([^)]+)\)", r"](../\1)", text).replace("](docs/", "](../")
    for name, page in ROOT_PAGES.items():
        text = text.replace(f"](../{name}", f"]({up}project/{page}.md")
    source[0] = re.sub(r"\[([^\]]+)\]\(\.\./(?:CITATION\.cff|LICENSE)\)", r"\1", text)


def _plain_docstring(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Docstrings are plain English: bars and stars in them are no markup, and indented lines are formulas."""
    found, head = [], True
    for line in lines:
        head = head and not SECTION.match(line)
        if head and line.startswith("    ") and not (found and found[-1].startswith("    ")):
            found += ([""] if found and found[-1] else []) + ["::", ""]
        elif head and line and not line.startswith(" ") and found and found[-1].startswith("    "):
            found.append("")
        literal = (head and line.startswith("    ")) or line.lstrip().startswith(">>>")
        found.append(line if literal else re.sub(r"(?<!\*)\*(?!\*)|\|", lambda match: "\\" + match[0], line))
    lines[:] = found


def setup(app: Any) -> None:
    app.connect("source-read", _read_page)
    app.connect("autodoc-process-docstring", _plain_docstring, priority=400)  # before napoleon
