"""The code of the how-to guides runs, from the top of a page to its end; and the reference lacks no name."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import polarmpm as pm

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(page for page in (DOCS / "howto").glob("*.md") if "```python" in page.read_text())


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_code_of_a_page_runs(page, tmp_path, monkeypatch):
    if pm.Grid.box((0, 0), (1, 1), 1.0).comm.size > 1 and page.stem != "ranks":
        pytest.skip("files of one rank's own folder")
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
    exec(compile("\n".join(blocks), page.name, "exec"), {"__name__": "__main__"})


@pytest.mark.slow
def test_the_readme_says_what_its_example_prints(tmp_path, monkeypatch, capsys):
    """To a tenth of a millimetre: the last digits are the machine's."""
    if pm.Grid.box((0, 0), (1, 1), 1.0).comm.size > 1:
        pytest.skip("a folder of one rank's own")
    monkeypatch.chdir(tmp_path)
    text = (DOCS.parent / "README.md").read_text()
    exec(
        compile(re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)[0], "README", "exec"), {}
    )
    printed, said = (
        np.fromstring(re.findall(pattern, where)[0], sep=" ")
        for pattern, where in (
            (r"end displacement \(m\): \[(.*?)\]", capsys.readouterr().out),
            (r"It prints `\[(.*?)\]`", text),
        )
    )
    np.testing.assert_allclose(said, printed, atol=1e-4)
    off = np.linalg.norm(said - (-22.98, 13.27, 52.86))
    assert f"{off:.2f} m from the converged solution, (-22.98, 13.27, 52.86)" in text


def test_the_reference_has_all_public_names():
    text = "".join(page.read_text() for page in (DOCS / "reference").glob("*.md"))
    assert not [name for name in pm.__all__ if f":: polarmpm.{name}\n" not in text]
