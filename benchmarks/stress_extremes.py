"""Stress tests at the ends of the ranges: moduli, lengths, compression, rotation, units."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from stress_cases import COMM, MICROPOLAR, YOUNG, Watch, block_points

import polarmpm as pm
from polarmpm.kinematics import rotations

HENCKY = pm.Hencky(lam=3e3, mu=2e3)


# moduli -------------------------------------------------------------------------------------------
def solid(coupling=0.35, length=0.1):
    """Lame's constants as ever; kappa / mu, and the length sqrt(gamma / mu) = sqrt(beta / mu) (m)."""
    mu = MICROPOLAR.mu
    gamma = mu * length**2
    return pm.MicropolarElastic(
        lam=MICROPOLAR.lam, mu=mu, kappa=coupling * mu, alpha=0.0, beta=gamma, gamma=gamma
    )


def bending(basis, material, load=2e-4, cells=4):
    """A strip of 4 x 1 m in the plane, `cells` along, clamped at a wall and bent by a body force."""
    h = 4 / cells
    if basis.startswith("FEM"):
        from dolfinx import mesh

        count = [cells, max(1, cells // 4)]
        made = mesh.create_rectangle(COMM, [[0, 0], [4, 1]], count, mesh.CellType.quadrilateral)
        problem = pm.QuasiStaticFEM(pm.Elements(made, material=material, degree=int(basis[-1])), locking=None)
    else:
        grid = pm.Grid.box((0, -4), (8, 8), h, COMM)
        points = block_points((0, 0.3), (4 / h, 1 / h), (4, 4), material, h)
        problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, balanced_reset=False, locking=None)
    problem.fix(pm.plane(x=0.0), u=0, **({"theta": 0} if material.micropolar else {}))
    problem.body_load(force=(0.0, load * YOUNG))
    return problem


def work(problem):
    """What the body force does per volume: mean displacement along it, weighted with volumes (m)."""
    p = problem.points
    return float(p.volume0 @ p.displacement[:, 1] / p.volume0.sum())


@lru_cache(maxsize=64)
def reference(material, load):
    """Mean displacement of finite elements of degree 2, 32 x 8."""
    problem = bending("FEM 2", material, load, cells=32)
    for _ in problem.march(1, adaptive=True, progress=False):
        pass
    return work(problem)


def moduli(basis, coupling, length, load=2e-4, cells=4):
    """Deflection and condition at a kappa / mu and a length l (m); the error is that against the reference.

    Locking is measured elsewhere: here the march has to converge, and the answer be proportional to the load
    where the load is made so small that the strip is linear.
    """
    material = solid(coupling, length)
    problem = bending(basis, material, load, cells)
    watch = Watch(problem, 1, adaptive=True, tangents="FEM" not in basis)
    tiny = [bending(basis, material, share * load, cells) for share in (1e-4, 1e-6)]
    quick = [Watch(t, 1, tangents=False) for t in tiny]
    linear = [work(t) / s for t, s in zip(tiny, (1e-4, 1e-6), strict=True)]
    unlike = abs(linear[1] / linear[0] - 1)
    ratio = work(problem) / reference(material, load)
    measure = f"of linearity at 1e-6 of the load; deflection {ratio:.4g} of the reference"
    # positions are about 4 m, so that displacements are known to 1e-15 m only
    passed = unlike < 1e-6 + 1e-15 / min(map(abs, map(work, tiny))) and not any(q.failure for q in quick)
    case = f"{basis}, kappa/mu = {coupling:g}, l/h = {length * cells / 4:g}"
    return watch.record("moduli", case, passed, error=unlike, measure=measure)


# compression --------------------------------------------------------------------------------------
def compression(basis, material, dim=2, J=0.1, steps=18, reset=1):
    """A block between smooth walls pressed to a J by a platen that takes the grid along: F = diag(1, J)."""
    size = (2.0, 3.0, 2.0)[:dim]
    grid = pm.Grid.box((0,) * dim, size, 1.0, COMM)
    points = block_points((0,) * dim, size, (3,) * dim, material)
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=reset, balanced_reset=False)
    for axis in "xz"[: dim - 1]:
        for wall in (0.0, 2.0):
            problem.fix(pm.plane(**{axis: wall}), **{f"u{axis}": 0})
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.fix(pm.plane(y=3.0, moving=True), uy=-3.0 * (1 - J))
    watch = Watch(problem, steps, adaptive=True)
    F = np.diag([1.0, J, 1.0])
    stress = problem.fields().stress
    expected = uniaxial_stress(material, J)
    error = max(
        np.abs(points.F - F).max() / J, np.abs(stress / expected[1, 1] - expected / expected[1, 1]).max()
    )
    name = f"{type(material).__name__}, {dim}D {basis}, J = {J:g}, {'resets' if reset else 'no resets'}"
    limit = 1e-8 if material is HENCKY else 1e-9  # its logarithm is a fit, to 4e-11 of the energy
    return watch.record("compression", name, error < limit, error=error, measure="of F and stress")


def uniaxial_stress(material, J):
    """Cauchy stress of F = diag(1, J, 1), Q = I."""
    lam, mu = material.lam, material.mu
    if isinstance(material, pm.MicropolarElastic):  # B = lam tr E I + 2 mu E, sigma = B F^T / J
        e = J - 1
        return np.diag([lam * e / J, (lam + 2 * mu) * e, lam * e / J])
    if isinstance(material, pm.Hencky):
        e = np.log(J)
        return np.diag([lam * e, (lam + 2 * mu) * e, lam * e]) / J
    pressure = lam * np.log(J) / J
    return np.diag([pressure, pressure + mu * (J**2 - 1) / J, pressure])


# rotation -----------------------------------------------------------------------------------------
def turning(basis, material, dim=2, turns=100, per_turn=10, **options):
    """A block turned rigidly about its middle by prescribed values at its outer nodes; those inside are free.

    The prescribed totals count from the last reset, as positions of nodes do.
    """
    size, middle = 3.0, np.full(dim, 4.0)
    grid = pm.Grid.box((0,) * dim, (8,) * dim, 1.0, COMM)
    points = block_points(middle - size / 2 + 0.1, (size,) * dim, (2,) * dim, material)
    problem = pm.QuasiStatic(grid, points, **{**pm.PUBLISHED, "basis": basis, **options})
    axis = np.array([0.0, 0.0, 1.0]) if dim == 2 else np.array([2.0, -1.0, 2.0]) / 3

    def displacement(t, x):
        since = t - problem.progress.reset_factor
        turn = rotations.to_tensor(rotations.from_vector(2 * np.pi * turns * since * axis[None]))[0]
        return (x - middle) @ (turn[:dim, :dim] - np.eye(dim)).T

    theta = {}
    if material.micropolar:
        vector = 2 * np.pi * turns * axis
        theta["theta"] = vector[2] if dim == 2 else tuple(vector)
    problem.fix(lambda x: np.any(np.abs(x - middle) > 1.2, axis=1), u=displacement, **theta)
    largest = []

    def each(step):
        largest.append(np.abs(problem.fields().stress).max() / YOUNG)

    watch = Watch(problem, turns * per_turn, tangents=False, each=each)
    watch.look()
    kind = "micropolar" if material.micropolar else "classical"
    resets = "no resets" if options.get("reset", 1) is None else "reset every step"
    case = f"{dim}D {kind} {basis}, {turns} turns in {turns * per_turn} steps, {resets}"
    error = max(largest)
    stray = np.linalg.norm(points.x - points.X, axis=1).max() / size
    measure = f"of stress / E; points {stray:.1g} of the block from where they started"
    return watch.record("rotation", case, error < 1e-10 and stray < 1e-9, error=error, measure=measure)


# units --------------------------------------------------------------------------------------------
def scaled(dim, basis, material, metre, pascal):
    """A short bar, bent by a force and a couple, in units in which a metre and a pascal are these numbers.
    Returns the watch, displacements (m) and rotation vectors of the points."""
    numbers = material.parameters()
    per = {name: pascal * (metre**2 if name in ("alpha", "beta", "gamma") else 1) for name in numbers}
    stuff = type(material)(**{name: value * per[name] for name, value in numbers.items()})
    corner = np.array((0.0, 0.3, 0.2)[:dim])
    grid = pm.Grid.box(
        np.multiply(metre, (-1, -3, -2)[:dim]), np.multiply(metre, (6, 3, 3)[:dim]), metre, COMM
    )
    points = block_points(corner, (3.5, 1.0, 1.0)[:dim], (dim,) * dim, stuff, metre)
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=1, balanced_reset=False)
    theta = {"theta": 0} if stuff.micropolar else {}
    problem.fix(lambda x: x[:, 0] < 0.75 * metre, u=0, **theta)
    newton = pascal * metre ** (dim - 1)  # per metre of thickness in plane strain
    tip = points.farthest((1.0, 0.0, 0.0)[:dim])
    couple = None
    if stuff.micropolar:
        couple = np.multiply(newton * metre, 8.0 if dim == 2 else (6.0, 4.0, -10.0))
    problem.load(tip, force=np.multiply(newton, (4.0, -8.0, 5.0)[:dim]), couple=couple)
    watch = Watch(problem, 2)
    return watch, points.displacement / metre, points.rotation_vector


LENGTHS = {"nm": 1e9, "µm": 1e6, "mm": 1e3, "m": 1.0, "km": 1e-3}
STRESSES = {"TPa": 1e-12, "Pa": 1.0, "pPa": 1e12}


def units(dim, basis, material):
    """The same scene in all units; a metre is a number of them."""
    watches, found = [], []
    for metre in LENGTHS.values():
        for pascal in STRESSES.values():
            watch, u, w = scaled(dim, basis, material, metre, pascal)
            watches.append(watch)
            found.append((u, w))
    _, u0, w0 = scaled(dim, basis, material, 1.0, 1.0)
    error = max(np.abs(u - u0).max() / np.abs(u0).max() for u, _ in found)
    if material.micropolar:
        error = max(error, max(np.abs(w - w0).max() / np.abs(w0).max() for _, w in found))
    kind = "micropolar" if material.micropolar else "classical"
    measure = f"displacements and rotations in {', '.join(LENGTHS)} and {', '.join(STRESSES)}; iterations "
    measure += ", ".join(sorted({str(w.iterations) for w in watches}))
    worst = Watch.worst(watches)
    return worst.record("units", f"{dim}D {kind} {basis}", error < 1e-9, error=error, measure=measure)
