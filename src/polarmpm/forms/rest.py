"""How stiff a material is in the undeformed state, from its compiled energy."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from ..kinematics import rotations
from ..materials.base import Material, parameter_values
from .points import PointForm


def stiffness_across(
    material: Material, dim: int, normal: np.ndarray, comm: MPI.Comm
) -> tuple[np.ndarray, np.ndarray]:
    """Largest stiffness (Pa) of a material at rest against gradients c (x) N, for unit normals N (n, d), and
    the same (N) against gradients of the rotation; lam + 2 mu where it is isotropic. Collective."""
    form = PointForm(material.elastic_part, dim)
    kernel, layout = form.compile(comm)[1], form.layout
    nz, one = layout.unknowns, np.eye(3)[None]
    state = form.pack(one, rotations.identity(1), np.zeros((1, 3, 3)), [])
    still = np.zeros((1, nz))
    columns = [still, state, parameter_values(form.material)[None]] + [still] * form.predicts
    upper = np.zeros((nz, nz))
    upper[np.triu_indices(nz)] = kernel(*columns)[0, nz:]
    moduli = upper + upper.T - np.diag(np.diag(upper))
    found = []
    for field in ("displacement", "rotation"):
        at, m = layout.where(field, 1), len(layout.rows(field))
        across = np.zeros((len(normal), m, m))
        if m:
            a = moduli[at, at].reshape(m, dim, m, dim)
            across = np.einsum("iakb,na,nb->nik", a, normal, normal)
        found.append(np.linalg.eigvalsh(across).max(axis=1, initial=0.0) if m else np.zeros(len(normal)))
    return found[0], found[1]
