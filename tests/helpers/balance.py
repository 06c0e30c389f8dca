"""Forces and moments of a body in equilibrium, summed by hand."""

from __future__ import annotations

import numpy as np

import polarmpm as pm
from polarmpm.kinematics import rotations


def in_balance(problem: pm.QuasiStatic) -> tuple[float, float]:
    """Sum of dead loads on points and of all reactions over the loads' size, and the same of their moments
    over the loads' size times the body's. Collective."""
    system, p, comm = problem.system, problem.points, problem.comm
    own, d, r = system.owned, problem.layout.dim, problem.layout.rotations
    forces, couples = problem._converged_loads
    f = np.where(system.prescribed.fixed, system.residual, 0.0)[:own]
    w = problem._equilibrium.w[:own]
    m = f[:, d:]
    if r == 3:  # what does work on Dw is J_r(Dw) times the couple
        m = np.linalg.solve(rotations.right_tangent(w), m[:, :, None])[:, :, 0]
    ends = np.stack([p.x.max(axis=0, initial=-np.inf), -p.x.min(axis=0, initial=np.inf)])
    ends = np.max(comm.allgather(ends), axis=0)
    length, middle = np.linalg.norm(ends.sum(axis=0)), 0.5 * (ends[0] - ends[1])
    at, push = np.vstack([system.positions()[:own], p.x]) - middle, np.vstack([f[:, :d], forces])
    turn = np.cross(at, push).reshape(len(at), -1)
    moment = turn.sum(axis=0)
    if r:
        moment = moment + m.sum(axis=0) + couples.sum(axis=0)
    force, moment = comm.allreduce(push.sum(axis=0)), comm.allreduce(moment)
    load = np.linalg.norm(comm.allreduce(np.abs(forces).sum(axis=0)))
    turned = np.linalg.norm(comm.allreduce(np.abs(couples).sum(axis=0))) if r else 0.0
    size = max(load, turned / length)
    return float(np.linalg.norm(force) / size), float(np.linalg.norm(moment) / (size * length))
