"""The elastic deformation at which a material has a given stress: an initial stress as a state of its points.

With F = I a point has the stress sigma0 where Fp = Fe0^-1 and tau(Fe0) = sigma0, the elastic law inverted by
Newton's method. The yield functions tell whether there can be such a stress.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from ..kernels.kernel import Kernel, PointSpace, compile_expressions
from ..kinematics.layout import Layout
from ..materials.base import Material, evaluate_scalar, named_parameters, parameter_values
from ..materials.plastic import Plastic, check_regions
from ..tools import compat
from .plastic import entries
from .strains import elastic_stress, pushed

_MOST = 100  # iterations
_PATIENCE = 10  # of them that find nothing better, as beyond the solution of an exponential law
_FARTHEST = 0.1  # change of an entry of Fe in one of them
_ACCURACY = 1e-14  # of the residual stress over the largest one, where rounding ends the iteration
_LOOSE = 1e-10
_OUTSIDE = 1e-9  # yield function over elastic modulus


class InitialState:
    """Inverse of a material's elastic law, and its yield functions there. Collective.

    Args:
        dim: of the body, see `entries`.
    """

    def __init__(self, material: Material, dim: int, comm: MPI.Comm):
        self.material, self.comm = material, comm
        self.layout = Layout.of(material, dim)
        places = entries(self.layout)[0]
        if not material.micropolar:  # a turn of Fe isn't seen: it is the right stretch
            places = tuple((i, j) for i, j in places if i <= j)
        self.places = places
        self._numbers = parameter_values(material)
        self._space = PointSpace(compat.point_domain())
        self._x = self._space.coefficient(len(places))
        self._p = self._space.coefficient(len(self._numbers))
        self._chi = self._space.coefficient(1)
        self._kernel = self._law()

    def _tensor(self, x: Any) -> Any:
        rows: list[list[Any]] = [[0.0] * 3 for _ in range(3)]
        for k, (i, j) in enumerate(self.places):
            rows[i][j] = x[k]
            if not self.material.micropolar:
                rows[j][i] = x[k]
        return ufl.as_tensor(rows)

    def _kirchhoff(self, x: Any) -> tuple[Any, Any]:
        """tau, and nu of no wryness, at Fe; the body isn't turned."""
        fe, zero = self._tensor(x), 0 * ufl.Identity(3)
        p = named_parameters(self.material, self._p)
        wryness = zero if self.material.micropolar else None
        b, s = elastic_stress(self.material.elastic_part, fe, wryness, p)
        return pushed(b, None, fe), s

    def _law(self) -> Kernel:
        """tau at the places, and its derivatives by the entries of Fe there."""
        n = len(self.places)
        x = ufl.variable(ufl.as_vector([self._x[k] for k in range(n)]))
        tau = self._kirchhoff(x)[0]
        stress = ufl.as_vector([tau[i, j] for i, j in self.places])
        return self._compile([stress, ufl.diff(stress, x)], [self._x, self._p])

    @cached_property
    def _yields(self) -> Kernel:
        material: Any = self.material
        (tau, nu), p = self._kirchhoff(self._x), named_parameters(material, self._p)
        surfaces = check_regions(material)[1]
        chi, owner = self._chi[0], type(material).__name__
        found = [evaluate_scalar(f"{s.name} of {owner}", s.function, tau, nu, chi, p) for s in surfaces]
        return self._compile([ufl.as_vector(found)], [self._x, self._p, self._chi])

    def _compile(self, expressions: list[Any], coefficients: list[Any]) -> Kernel:
        slots, size = {}, 0
        for c in coefficients:
            slots[c], size = size, size + c.ufl_shape[0]
        return compile_expressions(expressions, slots, size, self._space.domain, self.comm)

    # numbers --------------------------------------------------------------------------------------
    def invert(self, stress: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fe0 (n, 3, 3) at which stresses (n, 3, 3) are tau, and where there is none (n,). Local."""
        n, m = len(stress), len(self.places)
        i, j = np.array(self.places).T
        aim, x = stress[:, i, j], np.tile((i == j).astype(float), (n, 1))
        numbers = np.tile(self._numbers, (n, 1))
        scale = np.maximum(np.abs(aim).max(axis=1, initial=0.0), 1e-12 * self._stiffness())
        best, left = x.copy(), np.full(n, np.inf)
        idle: np.ndarray = np.zeros(n, dtype=int)
        with np.errstate(all="ignore"):
            for _ in range(_MOST):
                out = self._kernel(x, numbers)
                missing = aim - out[:, :m]
                size = np.abs(missing).max(axis=1, initial=0.0) / scale
                better = size < left  # False where it isn't a number
                best[better], left[better] = x[better], size[better]
                idle = np.where(better, 0, idle + 1)
                if np.all((left <= _ACCURACY) | (idle > _PATIENCE)):
                    break
                tangent = out[:, m:].reshape(n, m, m)
                good = np.isfinite(tangent).all(axis=(1, 2)) & np.isfinite(missing).all(axis=1)
                change = np.zeros_like(x)
                inverse = np.linalg.pinv(tangent[good], 1e-13)
                change[good] = np.einsum("nij,nj->ni", inverse, missing[good])
                far = np.abs(change).max(axis=1, initial=0.0)
                x = np.where(
                    good[:, None],
                    x + change * np.minimum(1.0, _FARTHEST / np.maximum(far, 1e-300))[:, None],
                    best,
                )
        fe = np.zeros((n, 3, 3))
        fe[:, i, j] = best
        if not self.material.micropolar:
            fe[:, j, i] = best
        return fe, ~(left <= _LOOSE) | ~(np.linalg.det(fe) > 0)

    def _stiffness(self) -> float:
        material: Any = self.material
        return float(material.modulus)

    def outside(self, fe: np.ndarray, chi: np.ndarray) -> np.ndarray:
        """The largest yield function over the elastic modulus at Fe (n, 3, 3), positive where it is
        outside of the yield surface (n,). Collective."""
        material = self.material
        if not isinstance(material, Plastic) or not material.yields:
            return np.full(len(fe), -1.0)
        i, j = np.array(self.places).T
        with np.errstate(all="ignore"):
            f = self._yields(fe[:, i, j], np.tile(self._numbers, (len(fe), 1)), chi[:, None])
        found: np.ndarray = f.max(axis=1, initial=-np.inf) / self._stiffness()
        return np.where(found > _OUTSIDE, found, np.minimum(found, 0.0))
