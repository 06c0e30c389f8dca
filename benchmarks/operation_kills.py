"""Runs that are killed at random moments while they write restart files, ParaView files and tables, and then
started again: they have to end with the digits and the files of a run that was never interrupted."""

import os
import random
import signal
import tempfile
import time
from pathlib import Path

import numpy as np
from operation_cases import Case
from operation_files import YIELDING, mesh, state, strip

import polarmpm as pm

STEPS = 12
SCENES = {
    "a reset every 2 steps": strip,
    "resets when distorted, splines": lambda: strip(basis="bspline", reset=pm.WhenDistorted(0.1)),
    "plastic, a reset every step": lambda: strip(material=YIELDING, reset=1),
    "elements": mesh,
}


def run(make, folder, late):
    """The script: all of a run, from wherever it was interrupted. `late`: files are opened after the load."""
    problem = make()
    options = {"fields": ("displacement", "stress", "F"), "grid": hasattr(problem, "grid")}
    file, recorder = folder / "r.h5", None
    if not late:
        recorder = pm.Recorder(folder / "a.pvd", problem, **options)
    if file.exists():
        pm.load_restart(problem, file)
    if late:
        recorder = pm.Recorder(folder / "a.pvd", problem, **options)
    wall = problem.supports[0]
    columns = {"u": problem.points.mean_displacement, "wall": lambda: problem.reaction(wall)}
    with recorder, pm.Table(folder / "t.csv", **columns, energies=problem.energies) as table:
        left = STEPS - problem.progress.step
        for step in problem.march(left, progress=False) if left else ():
            recorder.record(step)
            table.record(step)
            pm.save_restart(problem, file)
    np.save(folder / "end.npy", state(problem))


def start(make, folder, late):
    """The script in a copy of this process; its number."""
    child = os.fork()
    if not child:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        for number in (signal.SIGSEGV, signal.SIGABRT):
            signal.signal(number, signal.SIG_DFL)
        try:
            run(make, folder, late)
        except BaseException as e:
            (folder / "error").write_text(f"{type(e).__name__}: {e}")
            os._exit(1)
        os._exit(0)
    return child


def killed(make, folder, late, delay):
    """Start the script and kill it after some seconds; whether it was still running."""
    child = start(make, folder, late)
    time.sleep(delay)
    os.kill(child, signal.SIGKILL)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def differences(folder, reference):
    """What is wrong with the files of a run that has been continued."""
    if (folder / "error").exists():
        return (folder / "error").read_text()
    found, expected = ({f.relative_to(d) for f in d.rglob("*")} for d in (folder, reference))
    if found != expected:
        some = sorted(map(str, found ^ expected))
        return f"{len(some)} files too many or too few: {', '.join(some[:3])}"
    if not np.array_equal(np.load(folder / "end.npy"), np.load(reference / "end.npy")):
        return "other digits"
    for name in sorted(expected):
        if name.suffix in (".csv", ".pvd", ".vtu"):
            ours, theirs = (d.joinpath(name).read_bytes() for d in (folder, reference))
            if ours != theirs:
                return f"{name}: another content ({len(ours)} of {len(theirs)} bytes)"
    return ""


def cases(quick, seed):
    """22 runs, some of which are killed more than once."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as temporary:
        base, references, number = Path(temporary), {}, 2 if quick else 22
        for k in range(number):
            name, make = list(SCENES.items())[k % len(SCENES)]
            if name not in references:
                run(make, _made(base / f"warm{k}"), True)  # so that all is compiled
                reference = _made(base / f"reference{k}")
                begin = time.perf_counter()
                os.waitpid(start(make, reference, False), 0)
                references[name] = reference, time.perf_counter() - begin
            reference, needed = references[name]
            folder, late, kills = _made(base / str(k)), rng.random() < 0.5, 0
            for _ in range(rng.choice([1, 1, 2, 3])):
                kills += killed(make, folder, late, rng.uniform(0.02, 0.95) * needed)
            os.waitpid(start(make, folder, late), 0)
            wrong = differences(folder, reference)
            yield Case("kills", f"run {k}, {name}", "silent" if wrong else "right", wrong or f"{kills} kills")


def _made(folder):
    folder.mkdir()
    return folder
