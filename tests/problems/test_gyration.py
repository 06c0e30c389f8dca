"""Inertia that isn't alike in all directions: asymmetric tops, of microrotations and of rigid bodies."""

import re

import numpy as np
import pytest
from dolfinx import mesh
from scipy.integrate import solve_ivp

import polarmpm as pm
from polarmpm.kinematics import rotations
from polarmpm.kinematics.layout import Layout
from polarmpm.kinematics.timesteps import TimeStep
from tests.conftest import COMM

MATERIAL = pm.MicropolarElastic(lam=1e4, mu=1e4, kappa=1e4, alpha=0.0, beta=0.0, gamma=1e4)
J = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.9]])
SPIN = (0.3, 2.0, 0.3)  # about the axis of the middle moment: the top falls over


def euler(inertia: np.ndarray, until: float) -> np.ndarray:
    """Spin of a free top in its own frame (rad/s)."""

    def rate(t: float, w: np.ndarray) -> np.ndarray:
        return np.linalg.solve(inertia, np.cross(inertia @ w, w))

    found: np.ndarray = solve_ivp(rate, (0.0, until), SPIN, rtol=1e-11, atol=1e-12).y[:, -1]
    return found


def cube(kind: type, microinertia, **options):
    """A stiff cube of 1 m that turns freely; nearly all of its inertia is that of the microrotations."""
    middle = np.full(3, 0.5)
    if kind is pm.Dynamic:
        grid = pm.Grid.box((-0.5, -0.5, -0.5), (1.5, 1.5, 1.5), 1.0, comm=COMM)
        points = pm.seed(grid, material=MATERIAL, bounds=((0, 0, 0), (1, 1, 1)))
        problem = pm.Dynamic(grid, points, density=1.0, microinertia=microinertia, **options)
    else:
        body = mesh.create_unit_cube(COMM, 1, 1, 1, mesh.CellType.hexahedron)
        elements = pm.Elements(body, material=MATERIAL)
        problem = pm.DynamicFEM(elements, density=1.0, microinertia=microinertia, **options)
    problem.velocity(v=lambda x: np.cross(SPIN, x - middle), spin=SPIN)
    return problem, middle


def test_microrotations_turn_like_an_asymmetric_top():
    """Once over, with the spin of Euler's equations, and both invariants kept."""
    problem, middle = cube(pm.DynamicFEM, 20.0 * J, rho_inf=1.0)
    before, energy = problem.angular_momentum(middle), problem.energies()["kinetic"]
    for step in problem.march(4.0, steps=80, progress=False):
        assert step.iterations <= 4
    X = problem.points.X - middle
    second = problem.comm.allreduce(np.einsum("n,ni,nj->ij", problem.points.volume0, X, X))
    exact = euler(20.0 * J + np.trace(second) * np.eye(3) - second, 4.0)
    assert exact[1] < 0.0
    turn = rotations.to_tensor(problem.points.q)
    spin = np.einsum("nji,nj->ni", turn, problem.points.spin)
    assert np.abs(spin - exact).max(initial=0.0) < 0.03
    assert np.allclose(problem.angular_momentum(middle), before, atol=1e-9 * np.abs(before).max())
    energies = problem.energies()
    assert energies["kinetic"] + energies["stored"] == pytest.approx(energy, rel=4e-3)


def test_of_points_with_resets_and_in_a_restart(folder):
    def make():
        return cube(pm.Dynamic, lambda X: np.broadcast_to(20.0 * J, (len(X), 3, 3)), reset=1)

    problem, middle = make()
    before = problem.angular_momentum(middle)
    for step in problem.march(0.4, steps=8, progress=False):
        if step.number == 4:
            pm.save_restart(problem, folder / "a.h5")
    assert np.allclose(problem.angular_momentum(middle), before, atol=1e-4 * np.abs(before).max())
    again, _ = make()
    pm.load_restart(again, folder / "a.h5")
    for _ in again.march(0.4, steps=4, progress=False):
        pass
    one, other = (np.sort(p.comm.allreduce(p.points.spin.sum(axis=0))) for p in (problem, again))
    assert np.allclose(one, other, rtol=1e-9)


@pytest.mark.parametrize("rho_inf", [1.0, 0.8])
def test_a_rigid_body_turns_like_an_asymmetric_top(rho_inf):
    """Momentum and energy to rounding, for whatever `rho_inf`."""
    body = pm.RigidBody((0, 0, 0), mass=1.0, inertia=J, spin=SPIN)
    body.attach(Layout(3, 0), COMM)
    momentum, energy = body.momenta, body.kinetic
    for k in range(200):
        body.integrate(TimeStep(0.02, rho_inf))
        body.set_factor(0.02 * (k + 1))
        body.settle(np.zeros(1), [])
        body.end_at(0.02 * (k + 1))
        body.finished()
    assert np.allclose(body.momenta, momentum, rtol=0, atol=1e-12)
    assert body.kinetic == pytest.approx(energy, rel=1e-12)
    exact = euler(J, 4.0)
    assert exact[1] < 0.0
    assert np.allclose(body.rotation.T @ body.spin, exact, atol=1e-2)


@pytest.mark.parametrize(
    "given",
    [-J, J + np.triu(np.ones((3, 3)), 1), np.diag([1.0, 1.0, 3.0]), np.zeros((3, 3)), np.ones((2, 2))],
)
def test_no_moments_of_inertia(given):
    with pytest.raises(pm.InputError, match="microinertia"):
        cube(pm.Dynamic, given)


def test_drag_takes_a_share_of_the_momentum():
    """Which decays alike in all directions, while the top goes on turning about what is left of it; at the
    end the work against drag is what is missing."""
    problem, middle = cube(pm.DynamicFEM, 20.0 * J, rho_inf=1.0, drag=2.0)
    before, energy = problem.angular_momentum(middle), problem.energies()["kinetic"]
    for _ in problem.march(0.5, dt=0.0125, progress=False):
        pass
    left = problem.angular_momentum(middle)
    assert np.allclose(left, before * np.exp(-1.0), atol=1e-3 * np.abs(before).max())
    e = problem.energies()
    assert e["damped"] == pytest.approx(energy - e["kinetic"] - e["stored"], rel=5e-3)


def test_filtering_tensors_is_refused():
    with pytest.raises(pm.InputError, match=re.escape("filtered = True")):
        cube(pm.Dynamic, J, filtered=True)
