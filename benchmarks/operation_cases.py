"""What the operational tests share: a case with its verdict, and ways to run one where it can do no harm."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

VERDICTS = ("right", "clear", "unclear", "silent", "raw", "crash", "hang")
GOOD = VERDICTS[:2]


@dataclass
class Case:
    """One accident and what came of it.

    Attributes:
        group: such as "disc"; a row of the table.
        name: of the case.
        verdict: one of VERDICTS: the right answer; an error of the package that names the culprit; one that
            doesn't; a wrong answer without a word; another kind of exception; a crash; no end.
        note: first line of the message, or what was wrong.
    """

    group: str
    name: str
    verdict: str
    note: str = ""

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise ValueError(f"verdict = {self.verdict!r}: one of {VERDICTS}")


@dataclass
class Run:
    """How a script in a process of its own has ended."""

    status: int | None  # None: it had to be stopped
    out: str
    err: str

    @property
    def crashed(self) -> bool:
        return self.status is not None and (self.status < 0 or self.status in (134, 135, 139))


def environment(**more: str) -> dict[str, str]:
    """Of a process that is no child of an MPI run, though this one may be one."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_", "PMIX_", "PRTE_"))}
    kept |= {
        k: v for k, v in os.environ.items() if k.startswith(("OMPI_ALLOW", "OMPI_MCA_rmaps", "OMPI_MCA_mpi"))
    }
    return {**kept, "OMP_NUM_THREADS": "1", "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe", **more}


def run(
    script: str, *arguments: str, ranks: int = 1, timeout: float = 60.0, folder: str | None = None, **env: str
) -> Run:
    """Run the text of a script in processes of its own, in a temporary folder unless one is given."""
    with tempfile.TemporaryDirectory() as temporary:
        file = Path(temporary, "case.py")
        file.write_text(script)
        command = [sys.executable, str(file), *arguments]
        if ranks > 1:
            command = ["mpirun", "-n", str(ranks), *command]
        process = subprocess.Popen(
            command,
            cwd=folder or temporary,
            env=environment(**env),
            stdin=subprocess.DEVNULL,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        try:
            out, err = process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            out, err = process.communicate()
            return Run(None, out, err)
        return Run(process.returncode, out, err)


def attempt(function: Callable[[], object], words: tuple[str, ...] = ()) -> tuple[str, str]:
    """Verdict and note on a call in this process that has to be refused, with one of some words."""
    from polarmpm import PolarMPMError

    try:
        found = function()
    except PolarMPMError as e:
        text = str(e)
        clear = not words or any(w.lower() in text.lower() for w in words)
        return ("clear" if clear else "unclear"), text.splitlines()[0]
    except Exception as e:
        return "raw", f"{type(e).__name__}: {e}".splitlines()[0]
    return "silent", repr(found)[:100]


def forked(function: Callable[[], tuple[str, str]], timeout: float = 60.0) -> tuple[str, str]:
    """Verdict and note that a function gives in a copy of this process, which may crash."""
    from polarmpm import PolarMPMError

    sys.stdout.flush()
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.close(reading)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        for number in (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGFPE, signal.SIGALRM):
            signal.signal(number, signal.SIG_DFL)  # PETSc's handlers would wait for other processes
        signal.alarm(int(timeout))
        try:
            found = function()
        except PolarMPMError as e:
            found = "unclear", f"out of place: {e}"
        except BaseException as e:
            found = "raw", f"{type(e).__name__}: {e}"
        os.write(writing, "\n".join(found).encode()[:4000])
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        text = pipe.read().decode()
    _, status = os.waitpid(child, 0)
    if text:
        verdict, _, note = text.partition("\n")
        return verdict, note.splitlines()[0][:200] if note else ""
    number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    return ("hang" if number == signal.SIGALRM else "crash"), f"signal {number}" if number else "no answer"
