"""The package can be imported, and one place states its version."""

import json
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

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


# installation -------------------------------------------------------------------------------------------
def sourced(folder: Path, command: str) -> subprocess.CompletedProcess:
    script = f'. "{ROOT}/scripts/env.sh"; status=$?; {command}; exit $status'
    return subprocess.run(["sh", "-c", script], cwd=folder, capture_output=True, text=True, check=False)


def test_the_environment_refuses_other_folders(tmp_path):
    """Paths of a foreign folder would hide the distribution's Python."""
    done = sourced(tmp_path, "echo $PATH")
    assert done.returncode == 1
    assert "isn't polarmpm's folder" in done.stderr
    assert str(tmp_path) not in done.stdout


def test_the_environment_changes_its_own_variables_only():
    before = {
        "PATH": "/usr/bin:/bin",
        "HOME": str(ROOT),
        "OMP_NUM_THREADS": "3",
        "XDG_CACHE_HOME": "/nowhere",
        "OMPI_MCA_hwloc_base_binding_policy": "core",
    }
    script = f'. "{ROOT}/scripts/env.sh" && env'
    done = subprocess.run(
        ["sh", "-c", script], cwd=ROOT, env=before, capture_output=True, text=True, check=True
    )
    after = dict(line.split("=", 1) for line in done.stdout.splitlines() if "=" in line)
    changed = {name for name in after if after[name] != before.get(name)} - {"PWD", "OLDPWD", "SHLVL", "_"}
    own = re.compile("PATH|PYTHONNOUSERSITE|PYTHONHASHSEED|OMP_NUM_THREADS|POLARMPM_.*|(OMPI|PRTE)_.*")
    assert all(own.fullmatch(name) for name in changed), changed
    assert not changed & (before.keys() - {"PATH"})
    assert after["PATH"].startswith(str(ROOT / ".venv" / "bin"))


def test_the_recipe_is_of_this_version_and_needs_what_pip_does():
    yaml = pytest.importorskip("yaml")
    recipe = yaml.safe_load((ROOT / "packaging" / "conda" / "recipe.yaml").read_text())
    assert recipe["context"]["version"] == VERSION
    assert recipe["about"]["license"] == "MIT"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = {re.sub(r"^matplotlib\b", "matplotlib-base", need) for need in project["dependencies"]}
    assert wanted <= {need.replace(" ", "") for need in recipe["requirements"]["run"]}
    assert f"python {project['requires-python']}" in recipe["requirements"]["run"]


def test_the_container_of_an_editor_builds_from_files_that_exist():
    folder = ROOT / ".devcontainer"
    told = json.loads((folder / "devcontainer.json").read_text())
    text = (folder / told["build"]["dockerfile"]).read_text()
    for line in re.findall(r"^COPY (.+)$", text, re.MULTILINE):
        assert all((ROOT / name).exists() for name in line.split()[:-1]), line
