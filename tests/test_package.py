"""The package can be imported, and one place states its version."""

import re
from pathlib import Path

import polarmpm

ROOT = Path(__file__).parents[1]
VERSION = polarmpm.__version__


def test_version_is_a_release_number():
    assert re.fullmatch(r"\d+\.\d+\.\d+", VERSION)


def test_the_package_is_built_with_this_version():
    text = (ROOT / "pyproject.toml").read_text()
    assert 'version = { attr = "polarmpm.__version__" }' in text
    assert not re.search(r'^version = "', text, re.MULTILINE)


def test_citation_has_this_version():
    assert re.findall(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE) == [VERSION]


def test_changelog_has_this_version_on_top():
    """Keep a Changelog: what isn't released yet, then releases with their dates, the newest first."""
    text = (ROOT / "CHANGELOG.md").read_text()
    titles = re.findall(r"^## (.+)$", text, re.MULTILINE)
    assert titles[0] == "[Unreleased]"
    releases = [re.fullmatch(r"\[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d|unreleased)", t) for t in titles[1:]]
    assert all(releases), titles
    assert releases[0][1] == VERSION
    assert [r[1] for r in releases] == sorted((r[1] for r in releases), key=_numbers, reverse=True)
    kinds = set(re.findall(r"^### (.+)$", text, re.MULTILINE))
    assert kinds <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


def _numbers(version: str) -> list[int]:
    return [int(n) for n in version.split(".")]
