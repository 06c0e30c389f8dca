"""What the pages name exists, and what they quote is what the tests run."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path

import pytest

from tests.test_architecture import ORDER, PACKAGE

ROOT = Path(__file__).parents[1]
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]
SOURCES = [*PAGES, *(path for path in PACKAGE.rglob("*.py"))]
RECIPES = ROOT / "tests" / "recipes"
BLOCK = re.compile(r"^# recipe: begin\n(.*?)\s*^# recipe: end$", re.MULTILINE | re.DOTALL)


def named(pattern: str, pages: list[Path]) -> list[tuple[str, str]]:
    """(page, match) of a regular expression."""
    return [(page.name, match) for page in pages for match in re.findall(pattern, page.read_text())]


def anchors(page: Path) -> set[str]:
    """Names of a page's headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


# names ----------------------------------------------------------------------------------------------
def test_named_test_files_exist():
    found = named(r"(?:tests/)?((?:\w+/)*test_\w+\.py)", PAGES)
    assert len(found) > 40
    missing = [f"{page}: {name}" for page, name in found if not (ROOT / "tests" / name).is_file()]
    assert not missing, "\n".join(missing)


def test_named_tests_exist():
    """Tests that a page names by their function."""
    code = "".join(path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))
    missing = [
        f"{page}: {name}" for page, name in named(r"`(test_\w+)`", PAGES) if f"def {name}(" not in code
    ]
    assert not missing, "\n".join(missing)


def test_named_files_exist():
    """Files of the repository's folders, and modules as `folder/module.py`."""
    top = r"\b((?:benchmarks|demos|docs|scripts|docker)/[\w/]+\.(?:py|sh|md|txt|png))\b"
    missing = [f"{page}: {name}" for page, name in named(top, SOURCES) if not (ROOT / name).exists()]
    folders = "|".join(ORDER)
    modules = named(rf"`(?:src/polarmpm/)?((?:{folders})/(?!test_)\w+\.(?:py|c|h))`", PAGES)
    missing += [f"{page}: {name}" for page, name in modules if not (PACKAGE / name).is_file()]
    assert not missing, "\n".join(missing)


def test_links_lead_somewhere():
    missing = []
    for page in PAGES:
        for target, anchor in re.findall(r"\]\(([^)#:\s]*)(?:#([\w-]+))?\)", page.read_text()):
            path = (page.parent / target) if target else page
            if target in ("tutorial/index.rst", "gallery/index.rst"):  # made of these
                path = ROOT / "examples" / path.parent.name / "README.txt"
            if not path.exists() or (anchor and anchor not in anchors(path)):
                missing.append(f"{page.name}: {target}#{anchor}")
    assert not missing, "\n".join(missing)


def test_the_counts_of_accidents_are_those_of_the_last_run():
    """docs/stability.md, *Operation*."""
    page = (ROOT / "docs" / "stability.md").read_text()
    table = page.split("<!-- operation -->")[1].split("<!-- end -->")[0]
    assert table.strip() == (ROOT / "benchmarks" / "results" / "operation.md").read_text().strip()


def test_costs_are_those_of_the_last_run(monkeypatch):
    """docs/cost.md and the README say what benchmarks/cost.py has measured."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")  # of the modules beside it
    spec = importlib.util.spec_from_file_location("cost", ROOT / "benchmarks" / "cost.py")
    assert spec is not None
    assert spec.loader is not None
    cost = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(cost)
    rows = json.loads((ROOT / "benchmarks" / "results" / "cost.json").read_text())
    for file, said in (("docs/cost.md", cost.table(rows)), ("README.md", cost.readme(rows))):
        quoted = (ROOT / file).read_text().split("<!-- cost -->")[1].split("<!-- end -->")[0]
        assert quoted.strip() == said.strip(), file


def test_every_page_is_listed_in_the_readme():
    text = (ROOT / "README.md").read_text()
    assert not [page.name for page in PAGES if page.name != "README.md" and f"{page.name})" not in text]


# what is said twice -----------------------------------------------------------------------------------
@pytest.mark.parametrize("page", ["docs/architecture.md", "docs/draw_architecture.py"])
def test_folders_are_described_in_their_order(page):
    """The table of folders and the picture keep the order that test_architecture.py holds."""
    rows = re.findall(r"^(?:\| `|    Room\(\")(\w+)/?[`\"]", (ROOT / page).read_text(), re.MULTILINE)
    assert tuple(rows) == ORDER


def test_recipes_are_quoted_as_they_are_tested():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    blocks = [block for path in sorted(RECIPES.glob("*.py")) for block in BLOCK.findall(path.read_text())]
    quoted = re.findall(r"^```python\n(.*?)\s*^```$", text, re.MULTILINE | re.DOTALL)
    assert blocks
    assert sorted(blocks) == sorted(quoted)


def test_code_of_generalised_continua_runs():
    """As it stands on its page."""
    blocks = re.findall(
        r"^```python\n(.*?)^```$", (ROOT / "docs" / "generalised.md").read_text(), re.M | re.S
    )
    assert len(blocks) == 2
    for block in blocks:
        exec(compile(block, "generalised.md", "exec"), {})


def test_hooks_do_what_lint_does():
    """Each check of scripts/lint.sh is a hook, and nothing else is."""
    hooks = re.findall(r"entry: (.+)$", (ROOT / ".pre-commit-config.yaml").read_text(), re.MULTILINE)
    script = (ROOT / "scripts" / "lint.sh").read_text()
    checks = re.findall(r"^    (\w+)\) \"", script, re.MULTILINE)
    assert f"set -- {' '.join(checks)}\n" in script
    assert hooks == [f"scripts/lint.sh {check}" for check in checks]
