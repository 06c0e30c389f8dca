"""Running a test module as a script on several ranks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

import polarmpm as pm

ROOT = str(Path(__file__).parents[2])  # of the repository, for `import tests` in other processes
PATH = os.pathsep.join([str(Path(pm.__file__).parents[1]), ROOT])  # for PYTHONPATH: package and tests


def environment() -> dict[str, str]:
    """Of a fresh mpirun, which finds the package and the tests."""
    keep = {k: v for k, v in os.environ.items() if not k.startswith(("PMIX_", "OMPI_", "PRTE_"))}
    package = str(Path(pm.__file__).parents[1])
    return {
        **keep,
        "OMP_NUM_THREADS": "1",
        "OMPI_ALLOW_RUN_AS_ROOT": "1",
        "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
        "OMPI_MCA_rmaps_base_oversubscribe": "1",
        "OMPI_MCA_mpi_yield_when_idle": "1",  # ranks that wait let the others work
        "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",
        "PYTHONPATH": os.pathsep.join([package, ROOT, *filter(None, [os.environ.get("PYTHONPATH")])]),
    }


def ending(ranks: int, script: str, *arguments: str, timeout: float = 60.0) -> tuple[int, str]:
    """Status of a fresh mpirun of a script's text, and all that the ranks wrote."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "script.py")
        file.write_text(script)
        command = ["mpirun", "-n", str(ranks), sys.executable, str(file), *arguments]
        run = subprocess.run(
            command,
            env=environment(),
            cwd=folder,
            timeout=timeout,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            stdin=subprocess.DEVNULL,
            check=False,
        )
        return run.returncode, run.stdout


def on_ranks(ranks: int, case: str, script: str, timeout: float = 120.0) -> list[dict]:
    """What each rank of a fresh mpirun of a script found."""
    env = environment()
    with tempfile.TemporaryDirectory() as folder:
        command = ["mpirun", "-n", str(ranks), sys.executable, script, case, folder]
        run = subprocess.run(
            command,
            env=env,
            timeout=timeout,
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
            check=False,
        )
        assert run.returncode == 0, run.stdout + run.stderr
        return [json.loads(Path(folder, f"{rank}.json").read_text()) for rank in range(ranks)]


def close(found: list, expected: list) -> None:
    found, expected = np.asarray(found), np.asarray(expected)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * max(abs(expected).max(), 1e-300))


def report(solve: Callable[[str], dict[str, Any]]) -> None:
    """What a script that `on_ranks` runs does: solves the case that it was given and writes what it found."""
    case, folder = sys.argv[1:3]
    Path(folder, f"{MPI.COMM_WORLD.rank}.json").write_text(json.dumps(solve(case)))
