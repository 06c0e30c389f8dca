"""`python -m polarmpm`, and what a Python without dolfinx says."""

from __future__ import annotations

import subprocess
import sys

import pytest

import polarmpm as pm
from polarmpm import __main__ as command


def test_versions(capsys):
    assert command.main([]) == 0
    found = capsys.readouterr().out
    assert f"polarmpm {pm.__version__}" in found
    assert "dolfinx" in found


def test_the_check_passes(capsys):
    assert command.main(["check"]) == 0
    assert "polarmpm works." in capsys.readouterr().out


def test_the_check_can_fail(monkeypatch, capsys):
    soft = pm.NeoHookean.from_engineering(E=0.9e6, nu=0.3)
    monkeypatch.setattr(pm.NeoHookean, "from_engineering", lambda **_: soft)
    assert command.main(["check"]) == 1
    assert "wrong answer" in capsys.readouterr().out


def test_the_cache_is_shown_and_cleared(monkeypatch, tmp_path, capsys):
    folder = tmp_path / "cache"
    (folder / "entry").mkdir(parents=True)
    (folder / "entry" / "kernel.so").write_bytes(b"x" * 2_000_000)
    monkeypatch.setattr("polarmpm.tools.cache.directory", lambda: folder)
    assert command.main(["cache"]) == 0
    assert "1 files, 2.0 MB" in capsys.readouterr().out
    assert command.main(["cache", "--clear"]) == 0
    assert folder.is_dir()
    assert not any(folder.iterdir())
    (folder / "kernel.so").touch()
    assert command.main(["clear"]) == 0
    assert not any(folder.iterdir())


def test_demos_are_listed_and_run(capsys):
    assert command.main(["demo"]) == 0
    assert "shear_layer" in capsys.readouterr().out
    assert command.main(["demo", "shearlayer"]) == 2
    assert "shear_layer" in capsys.readouterr().err
    with pytest.raises(SystemExit) as end:
        command.main(["demo", "torsion", "--help"])
    assert end.value.code == 0
    assert "--moment" in capsys.readouterr().out


def test_demos_of_a_wheel_are_found(monkeypatch, tmp_path, capsys):
    """Where there is no clone they are data of the installation."""
    (tmp_path / "bar.py").write_text('"""A bar."""\nprint("pulled")\n')
    monkeypatch.setattr(command, "DEMOS", (tmp_path / "no clone", tmp_path))
    monkeypatch.setattr(sys, "argv", sys.argv)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert command.main(["demos"]) == 0
    assert command.main(["demo", "bar"]) == 0
    assert capsys.readouterr().out.split() == ["bar", "A", "bar.", "pulled"]
    monkeypatch.setattr(command, "DEMOS", (tmp_path / "no clone",))
    assert command.main(["demo"]) == 1
    assert "no demos in" in capsys.readouterr().err


@pytest.mark.parametrize("missing", ["dolfinx", "mpi4py"])
def test_what_is_missing_is_named(missing):
    code = f"import sys; sys.modules[{missing!r}] = None; import polarmpm"
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert found.returncode == 1
    assert f"polarmpm needs {missing}" in found.stderr
    assert "python3-dolfinx" in found.stderr


@pytest.mark.timeout(120)
def test_a_reader_that_goes_away():
    """As `head` does: PETSc's handler ended the process, with a page of text."""
    script = "import polarmpm\nfor k in range(100000):\n    print(k, flush=True)\n"
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as run:
        assert run.stdout.readline() == "0\n"
        run.stdout.close()
        said = run.stderr.read()
    assert "PETSC ERROR" not in said
    assert "BrokenPipeError" in said


def test_the_version_is_an_option_too(capsys):
    assert command.main(["--version"]) == 0
    assert f"polarmpm {pm.__version__}" in capsys.readouterr().out
