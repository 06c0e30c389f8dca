"""The demo scripts, as modules and run."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from mpi4py import MPI

COMM = MPI.COMM_WORLD
DEMOS = Path(__file__).parents[2] / "demos"


def demo_module(name: str) -> ModuleType:
    """A script of `demos/`, executed anew."""
    spec = importlib.util.spec_from_file_location(name, DEMOS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def demo_result(folder: Path, name: str, *options: str) -> dict[str, Any]:
    """The result of a demo that is run here, on all ranks, as its JSON file in `folder` has it."""
    file = folder / f"{name}.json"
    given = demo_module(name).main([*options, "--json", str(file), "--output", str(folder)])
    COMM.barrier()
    found = json.loads(file.read_text())
    assert found["case"] == given["case"] == name
    assert list(folder.glob("*.png"))
    assert list(folder.glob("*.pvd"))
    result: dict[str, Any] = found["result"]
    return result


def run_demo(name: str, folder: Path, *options: str, ranks: int = 1) -> dict[str, Any]:
    """The JSON object that a demo prints as its last line; its files go to `folder`."""
    command = [sys.executable, str(DEMOS / f"{name}.py"), *options, "--json", "--output", str(folder)]
    if ranks > 1:
        command = ["mpirun", "-n", str(ranks), *command]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=900, env=dict(os.environ), check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found
