"""Projection of the points' velocities to what nodes can move."""

import numpy as np

import polarmpm as pm
from polarmpm.assembly.smoothing import projected
from tests.conftest import COMM


def moving(**options):
    grid = pm.Grid.box((-1.0, -1.0), (1.0, 1.0), 0.25, comm=COMM)
    material = pm.NeoHookean.from_engineering(E=1e6, nu=0.3)
    bounds = (-0.48, -0.47), (0.52, 0.53)
    points = pm.seed(grid, material=material, bounds=bounds, points_per_cell=3)
    problem = pm.Dynamic(grid, points, density=1e3, rho_inf=1.0, reset=1, **options)
    middle = np.array([0.02, 0.03])
    problem.velocity(v=lambda x: 2.0 * (x - middle)[:, ::-1] * (-1.0, 1.0))
    return problem


def sums(array):
    return COMM.allreduce(array.sum(axis=0))


def test_it_keeps_momenta_and_what_nodes_can_move():
    problem = moving()
    list(problem.march(duration=0.01, steps=2, progress=False))
    system, x = problem.system_at(0.02), problem.points.x
    mass = system.inertia.mass
    straight = np.column_stack([1.0 + x[:, 0] - 2 * x[:, 1], x[:, 1]])
    assert np.allclose(projected(system, mass, straight), straight, atol=1e-10)
    rough = np.sin(40.0 * x)
    smooth = projected(system, mass, rough)
    assert np.allclose(sums(mass * smooth), sums(mass * rough), atol=1e-9 * sums(mass)[0])
    turned = [sums(mass[:, 0] * (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0])) for v in (rough, smooth)]
    assert np.isclose(*turned, atol=1e-9 * sums(mass)[0])
    assert np.allclose(projected(system, mass, smooth), smooth, atol=1e-7)
    assert sums((mass * smooth**2).sum(axis=1)) < 0.9 * sums((mass * rough**2).sum(axis=1))


def test_a_filtered_run_keeps_momenta_and_counts_its_energy():
    problem = moving(filtered=True)
    turning, energy = problem.angular_momentum(), problem.energies()["kinetic"]
    for _ in problem.march(0.25, steps=10, progress=False):
        pass
    assert np.allclose(problem.angular_momentum(), turning, rtol=1e-10)
    found = problem.energies()
    assert 0.0 < found["damped"] < 1e-3 * energy
    assert abs(found["residue"]) < 5e-3 * energy
