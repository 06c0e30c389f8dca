"""Operation, meshes: files of gmsh of every format, wrong and damaged ones, scripts, models in memory, meshes
of dolfinx; arguments; two ranks. Every case has a process of its own, since some have crashed it."""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import re
import select
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from operation_cases import Case, attempt, run

sys.path.insert(0, str(Path(__file__).parents[1]))  # for tests.helpers

TIME = 40.0  # seconds for a case


# a process for each case ------------------------------------------------------------------------------
def apart(name: str, case: Callable[[], tuple[str, str]]) -> Case:
    """Run a case in a child of this process."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            with open(os.devnull, "w") as null:
                os.dup2(null.fileno(), 1)
                os.dup2(null.fileno(), 2)
            found = case()
            os.write(write, json.dumps(found).encode())
            status = 0
        except BaseException as e:
            os.write(write, json.dumps(("raw", f"{type(e).__name__}: {e}"[:200])).encode())
            status = 0
        finally:
            os._exit(status)
    os.close(write)
    ready, _, _ = select.select([read], [], [], TIME)
    data = os.read(read, 65536) if ready else b""
    os.close(read)
    if not ready:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if not ready:
        return Case("meshes", name, "hang", f"no end in {TIME:g} s")
    if not data:
        return Case("meshes", name, "crash", f"status {status}")
    verdict, note = json.loads(data)
    return Case("meshes", name, verdict, str(note).splitlines()[0][:160] if note else "")


def refused(function: Callable[[], Any], *words: str) -> Callable[[], tuple[str, str]]:
    """A case that has to be an error with one of the words."""
    return lambda: attempt(function, words)


def same(
    function: Callable[[], Any], expected: Any, tolerance: float = 1e-9
) -> Callable[[], tuple[str, str]]:
    """A case that has to give numbers; an error of ours is none of the right answers but no lie either."""
    import polarmpm as pm

    def case() -> tuple[str, str]:
        try:
            found = np.asarray(function(), dtype=float)
        except pm.PolarMPMError as e:
            return "clear", str(e)
        good = np.allclose(found, expected, rtol=tolerance, atol=tolerance)
        return ("right", "") if good else ("silent", f"{found} instead of {expected}")

    return case


# what is asked of a source ----------------------------------------------------------------------------
def material(stiff: float = 1.0) -> Any:
    import polarmpm as pm

    return pm.NeoHookean(lam=3e3 * stiff, mu=2e3 * stiff)


def elements(source: Any, **options: Any) -> Any:
    import polarmpm as pm

    return pm.Elements(source, **{"material": material(), **options})


def seeded(source: Any, dim: int = 2, **options: Any) -> Any:
    import polarmpm as pm

    grid = pm.Grid.box((-2,) * dim, (4,) * dim, 0.5)
    return pm.seed_mesh(grid, source, **{"material": material(), **options})


def volumes(source: Any, dim: int = 2) -> list[float]:
    """Of the body as elements and as points."""
    return [float(elements(source).points.volume0.sum()), float(seeded(source, dim).volume0.sum())]


def use_both(source: Any) -> Callable[[], Any]:
    return lambda: (elements(source), seeded(source))


# files ------------------------------------------------------------------------------------------------
def good_files(folder: Path) -> Iterator[Case]:
    """Formats, types of cells, degrees: volume, size of a group, regions."""
    from tests.helpers.msh import block, strip

    for version in ("2.2", "4.1"):
        for kind in (2, 3):
            file = folder / f"strip{kind}.msh"
            file.write_text(strip(kind).text(version))
            label = f"{version}, {'triangles' if kind == 2 else 'quadrilaterals'}"
            yield apart(f"volume, {label}", same(lambda f=file: volumes(str(f)), [2.0, 2.0]))
            yield apart(
                f"a group, {label}", same(lambda f=file: elements(str(f)).facets("far right").area, 1.0)
            )
            yield apart(f"regions of points, {label}", same(lambda f=file: regions(str(f)), [1.0, 1.0]))
        file = folder / "block.msh"
        file.write_text(block().text(version))
        yield apart(f"volume, {version}, hexahedra", same(lambda f=file: volumes(str(f), 3), [1.0, 1.0]))
        gaps = strip(2)
        shifted = [(k, g, [[7 * t + 3 for t in row] for row in rows]) for k, g, rows in gaps.blocks]
        gaps.nodes, gaps.blocks = {7 * t + 3: x for t, x in gaps.nodes.items()}, shifted
        gaps.nodes[9999] = (50.0, 50.0, 0.0)
        file = folder / f"gaps{version}.msh"
        file.write_text(gaps.text(version))
        yield apart(f"gaps in the tags, {version}", same(lambda f=file: volumes(str(f)), [2.0, 2.0]))


def regions(file: str) -> list[float]:
    """Volume of the points with each region's material."""
    points = seeded(file, material={"soft": material(), "stiff": material(2.0)})
    return [float(points.volume0[points.material == row].sum()) for row in (0, 1)]


def wrong_files(folder: Path) -> Iterator[Case]:
    """What is wrong with a mesh, from the tests; the error has to say it."""
    from tests.geometry.test_msh_files import WRONG

    for version in ("2.2", "4.1"):
        for name, (mesh, words) in WRONG.items():
            file = folder / f"{re.sub(r'[^a-z]', '_', name)}.msh"
            file.write_text(mesh.text(version))
            for what, use in (("elements", elements), ("points", seeded)):
                case = refused(lambda u=use, f=file: u(str(f)), *words_of(words))
                yield apart(f"{name}, {version}, {what}", case)


def words_of(pattern: str) -> tuple[str, ...]:
    """Some words of a pattern, of which one has to be in a message that was written otherwise before."""
    plain = re.sub(r"\\.|\.\*|[|()]", " ", pattern)
    return tuple(
        w for w in re.findall(r"[A-Za-z]{4,}", plain) if w not in {"such", "that", "have", "cells"}
    ) or ("cell",)


def scripts(folder: Path) -> Iterator[Case]:
    """Nothing in a file is executed."""
    from tests.helpers.msh import strip

    trace = folder / "EXECUTED"
    header = "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n"
    for name, head in (
        ("a.geo", ""),
        ("a.msh", ""),
        ("b.msh", "$MeshFormat\n"),
        ("c.msh", "\n"),
        ("d.msh", header),
        ("e.msh", header + "$Nodes\n"),
        ("f.msh", strip().text()),
        ("a.opt", ""),
        ("a.txt", ""),
        ("a.pro", ""),
    ):
        file = folder / name
        file.write_text(head + f'SystemCall "touch {trace}";\n')
        for what, use in (("elements", elements), ("points", seeded)):

            def case(use: Any = use, file: Path = file) -> tuple[str, str]:
                trace.unlink(missing_ok=True)
                verdict, note = attempt(lambda: use(str(file)), (file.name,))
                return ("silent", "a shell command was executed") if trace.exists() else (verdict, note)

            yield apart(f"script {name}{' after a header' if head else ''}, {what}", case)


def damaged(folder: Path, chance: random.Random, number: int) -> Iterator[Case]:
    """Files cut, with lines lost or twice, with garbage: an error, or what was there."""
    from tests.helpers.msh import strip

    for k in range(number):
        kind, version = chance.choice((2, 3)), chance.choice(("2.2", "4.1"))
        text = strip(kind).text(version)
        lines = text.splitlines(keepends=True)
        at = chance.randrange(len(lines))
        how = chance.choice(("cut", "line lost", "line twice", "garbage", "number", "lines exchanged"))
        if how == "cut":
            text = text[: chance.randrange(len(text))]
        elif how == "garbage":
            place = chance.randrange(len(text))
            text = text[:place] + "\x00\xff@"[chance.randrange(3)] * 3 + text[place + 3 :]
        else:
            other = chance.randrange(len(lines))
            changed = {
                "line lost": [],
                "line twice": [lines[at]] * 2,
                "number": [re.sub(r"\d+", lambda m: str(int(m[0]) + 77), lines[at], count=1)],
                "lines exchanged": [lines[other]],
            }[how]
            if how == "lines exchanged":
                lines[other] = lines[at]
            lines[at : at + 1] = changed
            text = "".join(lines)
        file = folder / f"damaged{k}.msh"
        file.write_text(text, errors="ignore")

        def case(file: Path = file) -> tuple[str, str]:
            import polarmpm as pm

            try:
                found = volumes(str(file))
            except pm.PolarMPMError as e:
                return ("clear" if "mesh" in str(e) or "Points" in type(e).__name__ else "unclear"), str(e)
            # another mesh may have come of it, but one and the same for both
            return ("right", "") if abs(found[0] - found[1]) < 1e-9 else ("silent", str(found))

        yield apart(f"damaged {k}: {how}, {version}", case)


def other_files(folder: Path) -> Iterator[Case]:
    """Empty ones, binary garbage, other formats, no file, a folder, no permission to tell apart."""
    (folder / "empty.msh").write_text("")
    (folder / "garbage.msh").write_bytes(bytes(range(256)) * 20)
    (folder / "old.msh").write_text("$NOD\n1\n1 0 0 0\n$ENDNOD\n$ELM\n0\n$ENDELM\n")
    (folder / "four.msh").write_text("$MeshFormat\n4 0 8\n$EndMeshFormat\n")
    (folder / "mesh.stl").write_text("solid a\nendsolid a\n")
    (folder / "mesh.vtk").write_text("# vtk DataFile Version 2.0\n")
    for name in ("empty.msh", "garbage.msh", "old.msh", "four.msh", "mesh.stl", "mesh.vtk", "none.msh", ""):
        yield apart(
            f"file {name or 'that is a folder'}", refused(use_both(str(folder / name)), name or "director")
        )


# gmsh in memory ---------------------------------------------------------------------------------------
@contextlib.contextmanager
def session() -> Iterator[Any]:
    import gmsh

    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    yield gmsh
    gmsh.finalize()


def drawn(gmsh: Any, dim: int, order: int) -> None:
    """A disc or ball of radius 1."""
    body = gmsh.model.occ.addDisk(0, 0, 0, 1, 1) if dim == 2 else gmsh.model.occ.addSphere(0, 0, 0, 1)
    gmsh.model.occ.synchronize()
    gmsh.model.addPhysicalGroup(dim, [body], 1)
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.4)
    gmsh.model.mesh.generate(dim)
    gmsh.model.mesh.setOrder(order)


def curved(dim: int, order: int, file: Path | None) -> Callable[[], tuple[str, str]]:
    def volume() -> Any:
        with session() as gmsh:
            drawn(gmsh, dim, order)
            if file is None:
                return (
                    volumes(gmsh.model, dim)
                    if order == 1
                    else [elements(gmsh.model).points.volume0.sum()] * 2
                )
            gmsh.write(str(file))
        return volumes(str(file), dim)

    exact = math.pi if dim == 2 else 4 / 3 * math.pi
    return same(volume, [exact] * 2, 0.05 if order == 1 else 3e-4)


def loose_arc(gmsh: Any) -> Any:
    """Half a disc whose arc has nodes of its own."""
    make = gmsh.model.occ
    ends = make.addPoint(-1, 0, 0), make.addPoint(1, 0, 0)
    line, arc = make.addLine(*ends[::-1]), make.addCircle(0, 0, 0, 1, angle1=0, angle2=math.pi)
    face = make.addPlaneSurface([make.addCurveLoop([line, arc])])
    make.synchronize()
    gmsh.model.addPhysicalGroup(1, [arc], 7)
    gmsh.model.addPhysicalGroup(2, [face], 1)
    gmsh.model.mesh.generate(2)
    return gmsh.model


def two_squares(gmsh: Any) -> Any:
    """Side by side, joined afterwards: the tags of the nodes have gaps."""
    made = [gmsh.model.occ.addRectangle(x, 0, 0, 1, 1) for x in (0, 1)]
    gmsh.model.occ.synchronize()
    gmsh.model.addPhysicalGroup(2, made, 1)
    gmsh.model.mesh.generate(2)
    gmsh.model.mesh.removeDuplicateNodes()
    return gmsh.model


def models(folder: Path) -> Iterator[Case]:
    """Bodies in gmsh's memory."""
    for dim in (2, 3):
        for order in (1, 2):
            yield apart(f"order {order}, {dim} dimensions, file", curved(dim, order, folder / "curved.msh"))
            yield apart(f"order {order}, {dim} dimensions, model", curved(dim, order, None))

    def with_model(make: Callable[[Any], Any], use: Callable[[Any], Any]) -> Callable[[], Any]:
        def call() -> Any:
            with session() as gmsh:
                return use(make(gmsh))

        return call

    yield apart("facets on no cell, model", refused(with_model(loose_arc, elements), "no cell", "share"))
    yield apart(
        "gaps in the tags, model",
        same(with_model(two_squares, lambda m: [elements(m).points.volume0.sum()]), [2.0]),
    )
    yield apart("a model without a mesh", refused(with_model(lambda g: g.model, elements), "physical group"))

    def ended() -> Any:
        with session() as gmsh:
            model = gmsh.model
        return elements(model)

    yield apart("a session that has ended", refused(ended, "gmsh", "initialized"))


# dolfinx ----------------------------------------------------------------------------------------------
def rectangle(cells: tuple[int, int] = (4, 2)) -> Any:
    from mpi4py import MPI

    from dolfinx import mesh

    return mesh.create_rectangle(MPI.COMM_WORLD, [[0.0, 0.0], [2.0, 1.0]], list(cells))


def moved(change: Callable[[np.ndarray], None]) -> Any:
    made = rectangle()
    change(made.geometry.x)
    return made


def tags(made: Any, dim: int) -> Any:
    from dolfinx import mesh

    return mesh.meshtags(made, dim, np.arange(4, dtype=np.int32), np.ones(4, dtype=np.int32))


def arguments() -> Iterator[Case]:
    """Meshes of dolfinx that can't be used, and arguments."""

    def nan(x: np.ndarray) -> None:
        x[:] = np.nan

    def one_nan(x: np.ndarray) -> None:
        x[3, 1] = np.nan

    def infinite(x: np.ndarray) -> None:
        x[3, 1] = np.inf

    def flat(x: np.ndarray) -> None:
        x[:, 1] = 0.0

    for name, change, words in (
        ("not a number", nan, ("finite",)),
        ("one not a number", one_nan, ("finite",)),
        ("infinite", infinite, ("finite",)),
        ("flat", flat, ("Jacobian",)),
    ):
        yield apart(f"dolfinx mesh, {name}, elements", refused(lambda c=change: elements(moved(c)), *words))
        yield apart(f"dolfinx mesh, {name}, points", refused(lambda c=change: seeded(moved(c)), *words))
    for value in (None, 3.0, [], "", np.ones(3), material()):
        yield apart(f"mesh = {type(value).__name__}, points", refused(lambda v=value: seeded(v), "mesh"))
        yield apart(f"mesh = {type(value).__name__}, elements", refused(lambda v=value: elements(v), "mesh"))
    for degree in (-1, "2", 2.5, True, float("nan"), [2]):
        yield apart(f"degree = {degree!r}", refused(lambda d=degree: seeded(rectangle(), degree=d), "degree"))
        yield apart(
            f"elements, degree = {degree!r}",
            refused(lambda d=degree: elements(rectangle(), degree=d), "degree"),
        )
    for number in (0, 1.5, "2", (2, 2), True, None):
        yield apart(
            f"points_per_cell = {number!r}",
            refused(lambda n=number: seeded(rectangle(), points_per_cell=n), "points_per_cell"),
        )
    for name in ("cells", "facets"):
        for value in ("a", np.ones(8), 3):
            call = lambda n=name, v=value: elements(rectangle(), **{n: v})  # noqa: E731
            yield apart(f"{name} = {type(value).__name__}", refused(call, name))
    yield apart("cells of another dimension", refused(lambda: tagged("cells", 1), "cells"))
    yield apart("facets of another dimension", refused(lambda: tagged("facets", 2), "facets"))
    yield apart(
        "cells of another mesh",
        refused(lambda: elements(rectangle(), cells=tags(rectangle((3, 3)), 2)), "another mesh"),
    )
    yield apart("no material", refused(lambda: seeded(rectangle(), material=None), "material"))
    yield apart(
        "no regions", refused(lambda: seeded(rectangle(), material={"a": material()}), "group", "region")
    )


def tagged(name: str, dim: int) -> Any:
    made = rectangle()
    made.topology.create_entities(1)
    return elements(made, **{name: tags(made, dim)})


# ranks ------------------------------------------------------------------------------------------------
RANKS = """
import sys
sys.path[:0] = {path!r}
import numpy as np, polarmpm as pm
from mpi4py import MPI
import operation_meshes as om
comm, path = MPI.COMM_WORLD, {folder!r}
def model(make):
    if comm.rank: return None
    import gmsh
    gmsh.initialize(); gmsh.option.setNumber("General.Terminal", 0)
    return make(gmsh)
try:
    {body}
    print("VERDICT right ", flush=True)
except pm.PolarMPMError as e:
    print("VERDICT clear", str(e).splitlines()[0], flush=True)
except AssertionError as e:
    print("VERDICT silent", e, flush=True)
except Exception as e:
    print("VERDICT raw", type(e).__name__, e)
"""

ON_RANKS = {
    "gaps in the tags": (
        "assert abs(comm.allreduce(om.elements(model(om.two_squares)).points.volume0.sum()) - 2) < 1e-9",
        "right",
    ),
    "facets on no cell": ("om.elements(model(om.loose_arc))", "clear"),
    "a file with a bow tie": ("om.elements(path + '/bow_tie.msh')", "clear"),
    "a script": ("om.seeded(path + '/evil.msh')", "clear"),
    "no file": ("om.seeded(path + '/none.msh')", "clear"),
    "None everywhere": ("om.elements(None)", "clear"),
    "a model on rank 1": ("om.elements(None if comm.rank == 0 else 3.0)", "clear"),
    "a file on rank 0 alone": ("om.elements(path + '/strip.msh' if comm.rank == 0 else 3.0)", "clear"),
    "a mesh of one rank": (
        "from dolfinx import mesh; "
        "om.seeded(mesh.create_rectangle(MPI.COMM_SELF, [[0.0, 0.0], [2.0, 1.0]], [4, 2]))",
        "clear",
    ),
    "a mesh with a node of one rank that is no number": (
        "m = om.rectangle(); m.geometry.x[:comm.rank] = np.nan; om.elements(m)",
        "clear",
    ),
    "a file": (
        "assert abs(comm.allreduce(om.seeded(path + '/strip.msh').volume0.sum()) - 2) < 1e-9",
        "right",
    ),
    "a cracked body": (
        "assert abs(comm.allreduce(om.elements(path + '/cracked.msh').points.volume0.sum()) - 2) < 1e-9",
        "right",
    ),
    "a bow tie on three": ("om.elements(path + '/bow_tie.msh')", "clear"),
    "more ranks than cells": (
        "assert abs(comm.allreduce(om.elements(path + '/one.msh').points.volume0.sum()) - 1) < 1e-9",
        "right",
    ),
}

THREE = ("more ranks than cells", "a cracked body", "a bow tie on three")


def on_two_ranks(folder: Path, names: list[str]) -> Iterator[Case]:
    from tests.bodies.test_mesh_groups import cracked
    from tests.geometry.test_msh_files import WRONG
    from tests.helpers.msh import strip

    (folder / "cracked.msh").write_text(cracked().text())
    (folder / "bow_tie.msh").write_text(WRONG["bow tie"][0].text())
    (folder / "strip.msh").write_text(strip().text())
    one = strip(3, 2, 1, (1.0, 1.0))
    one.blocks = one.blocks[3:]
    (folder / "one.msh").write_text(one.text())
    (folder / "evil.msh").write_text(f'SystemCall "touch {folder}/EXECUTED";\n')
    for name in names:
        body, expected = ON_RANKS[name]
        here = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
        ranks = 3 if name in THREE else 2
        done = run(RANKS.format(path=here, folder=str(folder), body=body), ranks=ranks, timeout=TIME)
        label = f"{ranks} ranks: {name}"
        found = re.findall(r"VERDICT (\w+?) ?(?=VERDICT|\n| )([^\n]*?)(?=VERDICT|\n|$)", done.out)
        if done.status is None:
            yield Case("meshes", label, "hang", f"no end in {TIME:g} s")
        elif len(found) < ranks:
            yield Case("meshes", label, "crash", f"status {done.status}")
        else:
            worst = next((f for f in found if f[0] != expected), found[0])
            # right answers where errors are due are none
            verdict = "silent" if worst[0] == "right" != expected else worst[0]
            yield Case("meshes", label, verdict, worst[1].strip()[:160])


def cases(quick: bool, seed: int) -> Iterator[Case]:
    """See operation.py."""
    import polarmpm  # noqa: F401 (children have it)

    folder = Path(tempfile.mkdtemp())
    chance = random.Random(seed)
    try:
        groups = [
            good_files(folder),
            wrong_files(folder),
            scripts(folder),
            other_files(folder),
            models(folder),
            arguments(),
            damaged(folder, chance, 4 if quick else 60),
        ]
        for group in groups:
            for k, case in enumerate(group):
                yield case
                if quick and k == 3:
                    break
        yield from on_two_ranks(folder, ["a script", "a file"] if quick else list(ON_RANKS))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
