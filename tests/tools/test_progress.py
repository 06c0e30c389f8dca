"""Progress in notebooks, and notebooks of the tutorial."""

from __future__ import annotations

import io
import re
import sys
from contextlib import redirect_stderr
from pathlib import Path
from types import SimpleNamespace

import pytest

from polarmpm.tools import progress

TUTORIAL = Path(__file__).parents[2] / "examples" / "tutorial"


class ZMQInteractiveShell:
    """Of the name of a notebook's."""


@pytest.mark.parametrize(("shown", "expected"), [(None, True), (True, True), (False, False)])
def test_notebooks_show_a_bar(monkeypatch, shown, expected):
    shell = SimpleNamespace(get_ipython=lambda: ZMQInteractiveShell())
    monkeypatch.setitem(sys.modules, "IPython", shell)
    monkeypatch.setattr(progress, "find_spec", lambda name: None)  # no widgets
    assert progress.in_notebook()
    text = io.StringIO()
    with redirect_stderr(text), progress.bar(shown, total=2) as bar:
        bar.update(2)
    assert ("100%" in text.getvalue()) == expected


def test_files_show_none_by_default(monkeypatch):
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    assert not progress.in_notebook()
    text = io.StringIO()
    with redirect_stderr(text), progress.bar(None, total=2) as bar:
        bar.update(2)
    assert text.getvalue() == ""


def cells(path: Path) -> list[tuple[str, str]]:
    """Kinds and sources of the cells that sphinx-gallery makes of a script."""
    head, *rest = re.split(r"^# %%.*$", path.read_text(), flags=re.MULTILINE)
    title = re.match(r'\s*"""(.*?)"""', head, re.DOTALL)
    assert title
    found = [("markdown", title[1]), ("code", head[title.end() :])]
    for part in rest:
        words = re.match(r"(?:\n?#[^\n]*)*", part)
        assert words
        found += [("markdown", words[0]), ("code", part[words.end() :])]
    return [(kind, source) for kind, source in found if source.strip()]


def test_the_first_notebook_runs_cell_by_cell(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    from polarmpm.plot import styled

    names: dict[str, object] = {"__name__": "__main__"}
    with styled():  # what the script sets is put back
        for kind, source in cells(TUTORIAL / "1_first_bar.py"):
            if kind == "code":
                exec(compile(source, "cell", "exec"), names)
    assert "problem" in names


def test_the_first_notebook_runs_in_a_kernel(monkeypatch, tmp_path):
    monkeypatch.delenv("MPLBACKEND", raising=False)  # a kernel has one of its own
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    make = {"markdown": nbformat.v4.new_markdown_cell, "code": nbformat.v4.new_code_cell}
    notebook = nbformat.v4.new_notebook()
    notebook.cells = [make[kind](source) for kind, source in cells(TUTORIAL / "1_first_bar.py")]
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, kernel_name="python3", resources=resources, timeout=300).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert any("image/png" in output.get("data", {}) for output in outputs)
