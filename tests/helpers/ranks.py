"""Running a test module as a script on several ranks."""

from __future__ import annotations

import atexit
import contextlib
import gc
import json
import os
import runpy
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
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


class Crew:
    """Ranks of one mpirun that run script after script: starting and importing take longer than most scripts.

    Each rank reads its orders from a pipe of its own, so that one that waits takes no time from others, and
    ends when the pipe does. A script is executed anew, among the modules that earlier ones imported.
    """

    def __init__(self, ranks: int, env: dict[str, str]):
        self.ranks, self.folder = ranks, Path(tempfile.mkdtemp(prefix="ranks-"))
        self.orders = []
        for rank in range(ranks):
            os.mkfifo(self.folder / f"orders-{rank}")
            # for reading, too: that waits for no reader
            self.orders.append(os.open(self.folder / f"orders-{rank}", os.O_RDWR))
        idle, source = str(self.folder / "idle.so"), str(Path(__file__).with_name("idle.c"))
        subprocess.run(["cc", "-O1", "-shared", "-fPIC", "-o", idle, source], check=True)
        script = ["-m", "tests.helpers.ranks", str(self.folder)]
        command = ["mpirun", "-n", str(ranks), "-x", "LD_PRELOAD", sys.executable, *script]
        with open(self.folder / "log", "w") as log:
            self.process = subprocess.Popen(
                [*command, str(self.folder)],
                env={**env, "LD_PRELOAD": idle},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def run(self, script: str, case: str, timeout: float) -> list[dict]:
        """What each rank found.

        Raises:
            AssertionError: a rank failed.
            subprocess.TimeoutExpired: a rank isn't done in time (s).
        """
        log = self.folder / "log"
        begin = log.stat().st_size
        with tempfile.TemporaryDirectory() as folder:
            done = [Path(folder, f"{rank}.done") for rank in range(self.ranks)]
            for order in self.orders:
                os.write(order, (json.dumps([script, case, folder]) + "\n").encode())
            end = time.monotonic() + timeout
            while not all(file.exists() for file in done):
                assert self.process.poll() is None, log.read_bytes()[begin:].decode(errors="replace")
                if time.monotonic() > end:
                    raise subprocess.TimeoutExpired([script, case], timeout)
                time.sleep(0.01)
            return [json.loads(Path(folder, f"{rank}.json").read_text()) for rank in range(self.ranks)]

    def dismiss(self, busy: bool) -> None:
        """End the ranks, whatever they are doing."""
        for order in self.orders:
            os.close(order)
        for end in (self.process.terminate, self.process.kill) if busy else (lambda: None, self.process.kill):
            end()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(20)
                break
        shutil.rmtree(self.folder, ignore_errors=True)


_crews: dict[int, tuple[dict[str, str], Crew]] = {}


def dismiss(ranks: int, busy: bool = False) -> None:
    if ranks in _crews:
        _crews.pop(ranks)[1].dismiss(busy)


@atexit.register
def _dismiss_all() -> None:
    for ranks in list(_crews):
        dismiss(ranks)


def on_ranks(ranks: int, case: str, script: str, timeout: float = 120.0) -> list[dict]:
    """What each rank found that ran a script; those of an earlier call run it if they can."""
    env = environment()
    env.pop("PYTEST_CURRENT_TEST", None)
    if ranks in _crews and _crews[ranks][0] != env:
        dismiss(ranks)
    if ranks not in _crews:
        _crews[ranks] = env, Crew(ranks, env)
    try:
        found = _crews[ranks][1].run(script, case, timeout)
    except BaseException:
        dismiss(ranks, busy=True)
        raise
    if ranks > 3:  # too many to be kept
        dismiss(ranks)
    return found


def serve(folder: str) -> None:
    """Of a rank of a crew: run the scripts that it is told to, until no more can come."""
    comm = MPI.COMM_WORLD
    with open(Path(folder, f"orders-{comm.rank}")) as orders:
        for order in orders:
            sys.argv[:] = json.loads(order)
            script, folder = sys.argv[0], sys.argv[-1]
            try:
                runpy.run_path(script, run_name="__main__")
            except BaseException as e:
                if not isinstance(e, SystemExit) or e.code:
                    traceback.print_exc()
                    sys.stderr.flush()
                    comm.Abort(1)
            gc.collect()  # on all ranks at the same place: some objects are freed by all at once
            Path(folder, f"{comm.rank}.done").touch()


def close(found: list, expected: list) -> None:
    found, expected = np.asarray(found), np.asarray(expected)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * max(abs(expected).max(), 1e-300))


def report(solve: Callable[[str], dict[str, Any]]) -> None:
    """What a script that `on_ranks` runs does: solves the case that it was given and writes what it found."""
    case, folder = sys.argv[1:3]
    Path(folder, f"{MPI.COMM_WORLD.rank}.json").write_text(json.dumps(solve(case)))


if __name__ == "__main__":
    serve(sys.argv[1])
