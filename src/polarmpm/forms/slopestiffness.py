"""Stiffness of a material at rest against second gradients, the scale of the interior penalty."""

from __future__ import annotations

from itertools import combinations_with_replacement, product

import numpy as np
import ufl

from ..errors import InputError
from ..kernels import codegen
from ..kernels.codegen import Scalariser
from ..kernels.kernel import PointSpace
from ..materials.base import Material, evaluate_energy, evaluate_measures, named_parameters, parameter_values
from ..tools import compat

_SIZES = (1e-6, 1e-3, 1.0, 1e3)  # of second gradients (1/m) at which energies without a stiffness are tried


def slope_stiffness(material: Material, dim: int) -> float:
    """Largest second derivative (N) of the energy, at rest, by the size of second gradients a N N with unit
    vectors a and N: (lam + 2 mu) l^2/12 of an isotropic solid whose energy is that of its micro-space.

    It is the largest eigenvalue over normals N that are parallel to axes, or halfway between them.

    Raises:
        InputError: it is no number, or zero though the energy depends on second gradients.
    """
    signs = np.array([n for n in product((0, 1, -1), repeat=dim) if next((s for s in n if s), 0) > 0], float)
    normals = signs / np.linalg.norm(signs, axis=1, keepdims=True)
    pairs = list(combinations_with_replacement(range(dim), 2))
    along = np.array([np.eye(dim)[i] + (np.eye(dim)[j] if i != j else 0.0) for i, j in pairs])
    rows = np.array([[*_padded(a), *_padded(n)] for n in normals for a in along])
    second = _second_derivatives(material, rows, 0.0).reshape(len(normals), len(pairs))
    kind = type(material.elastic_part).__name__
    if not np.all(np.isfinite(second)):
        bad = second[~np.isfinite(second)][0]
        raise InputError(
            f"material: the second derivative of the energy of {kind} by the second gradient is {bad} at "
            "rest; it must be smooth there"
        )
    matrices = np.zeros((len(normals), dim, dim))
    at = {pair: second[:, k] for k, pair in enumerate(pairs)}
    for i, j in pairs:
        value = at[i, j] if i == j else 0.5 * (at[i, j] - at[i, i] - at[j, j])
        matrices[:, i, j] = matrices[:, j, i] = value
    largest = float(np.linalg.eigvalsh(matrices).max())
    if largest <= 0 and any(np.any(_second_derivatives(material, rows, size) != 0) for size in _SIZES):
        raise InputError(
            f"material: the energy of {kind} has no stiffness against second gradients at rest, its second "
            f"derivative is {largest:g} N there; elements take the size of their interior penalty from it"
        )
    return largest


def _padded(v: np.ndarray) -> list[float]:
    return [*v, *[0.0] * (3 - len(v))]


def _second_derivatives(material: Material, rows: np.ndarray, size: float) -> np.ndarray:
    """d2W/dt2 (m,) of W(I, t a N N) at t = size for rows (a, N) (m, 6)."""
    numbers = parameter_values(material)
    space = PointSpace(compat.point_domain())
    pair, scale, p = (space.coefficient(n) for n in (6, 1, len(numbers)))
    t = ufl.variable(scale[0])
    gradient = [
        [[t * pair[i] * pair[3 + j] * pair[3 + k] for k in range(3)] for j in range(3)] for i in range(3)
    ]
    measures = evaluate_measures(material, ufl.Identity(3), ufl.as_tensor(gradient))
    energy = evaluate_energy(material, measures, named_parameters(material, p))
    scalarise = Scalariser({pair: 0, scale: 6, p: 7})
    node = scalarise.plain(scalarise(codegen.expand(ufl.diff(ufl.diff(energy, t), t))).data.flat[0])
    inputs = np.vstack([rows.T, np.full((1, len(rows)), size), np.tile(numbers[:, None], len(rows))])
    found: np.ndarray = scalarise.graph.values([node], inputs)[0]
    return found
