"""Moduli of a batch's points at a converged step: products with the tangent, for the tangent-linear run.

A product with the tangent asks for the change of what does work on a point's unknowns, where these alone
change. Of few unknowns, as in the plane, the compiled blocks of the tangent are put together once a step,
with those of the boxes' sides and of the return mapping; then each product takes a multiplication.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from .ratestate import At

_MOST_UNKNOWNS, _MOST_BYTES = 32, 2**27  # of a point, beyond which kernels are faster; of a batch


def regions(batch: Any, at: At) -> Iterator[tuple[int, np.ndarray, list[np.ndarray], np.ndarray]]:
    """Of a batch's points that yield: regions, which of them are there, kernels' inputs, local unknowns."""
    y, form, comm = at.yielding, batch.form, batch.along.comm
    assert y is not None
    for region in map(int, np.unique(y.region)):
        which = np.flatnonzero(y.region == region)
        size = form.return_kernels(form.regions[region], comm).size
        yield region, which, batch._inputs(at, y.rows[which]), np.ascontiguousarray(y.X[which, :size])


def inverse(batch: Any, at: At, region: int, inputs: list[np.ndarray], X: np.ndarray) -> np.ndarray:
    """Of the scaled derivatives of a region's local equations by their unknowns, (k, nx, nx)."""
    if region not in at.inverses:
        form, nx = batch.form, X.shape[1]
        kernels = form.return_kernels(form.regions[region], batch.along.comm)
        matrix = kernels.local(np.hstack(inputs), X)[:, nx:].reshape(-1, nx, nx)
        at.inverses[region] = np.linalg.inv(matrix * kernels.row_scale[:, None])
    return at.inverses[region]


class PointModuli:
    """Derivatives of what does work on a point's unknowns by these: z, its derivatives along the half axes,
    and the projected scalars t.

    Args:
        batch: `BatchRates`.
        kernels: (residual, residual and tangent).
    """

    def __init__(self, batch: Any, at: At, kernels: Any):
        self._nz, self._m = batch.layout.unknowns, batch.form.scalars
        self._boxes = 0 if at.zk is None else at.zk.shape[1]
        self._batch, self._at, self._kernels = batch, at, kernels
        here = self._elastic(at.z)
        self._blocks = here if at.zk is None else self._with_sides(here, at.zk)
        if at.yielding is not None:
            rows, own = at.yielding.rows, self._own
            self._blocks[rows[:, None, None], own[:, None], own] += self._returned() - here[rows]

    @property
    def _own(self) -> np.ndarray:
        """Rows of z and t."""
        nz, whole = self._nz, self._nz * (1 + self._boxes)
        return np.concatenate([np.arange(nz), np.arange(whole, whole + self._m)])

    @staticmethod
    def worth(batch: Any, at: At) -> bool:
        """Whether the moduli are few."""
        nz, m = batch.layout.unknowns, batch.form.scalars
        size = nz * (1 if at.zk is None else 1 + at.zk.shape[1]) + m
        return bool(size <= _MOST_UNKNOWNS and 8 * size**2 * len(at.z) <= _MOST_BYTES)

    def _inputs(self, z: np.ndarray, rows: Any = slice(None)) -> tuple[np.ndarray, ...]:
        z, state = z[rows], self._at.state[rows]
        return z, state, np.tile(self._batch.numbers, (len(z), 1))

    def _symmetric(self, upper: np.ndarray) -> np.ndarray:
        """(n, nz, nz) of upper triangles (n, k)."""
        i, j = np.triu_indices(self._nz)
        out: np.ndarray = np.empty((len(upper), self._nz, self._nz))
        out[:, i, j] = out[:, j, i] = upper
        return out

    def _elastic(self, z: np.ndarray) -> np.ndarray:
        """Second derivatives (n, nz + m, nz + m) of the elastic energy at z and t."""
        nz, m, inputs = self._nz, self._m, self._inputs(z)
        before = (inputs[0],) if self._batch.form.predicts else ()  # no correction: the derivative itself
        blocks = self._symmetric(self._kernels[1](*inputs, *before)[:, nz:])
        if not m:
            return blocks
        out = np.empty((len(z), nz + m, nz + m))
        of_t = self._batch.form.compile_scalars(self._batch.along.comm).conjugate(*inputs)
        out[:, :nz, :nz] = blocks
        out[:, nz:, :nz] = of_t[:, m : m + m * nz].reshape(-1, m, nz)
        out[:, :nz, nz:] = np.swapaxes(out[:, nz:, :nz], 1, 2)
        out[:, nz:, nz:] = of_t[:, m + m * nz :].reshape(-1, m, m)
        return out

    def _with_sides(self, here: np.ndarray, zk: np.ndarray) -> np.ndarray:
        """With the unknowns' derivatives along the half axes between z and t."""
        n, d, nz = zk.shape
        own, inner = self._own, slice(0, nz)
        out = np.zeros((n, nz * (1 + d) + self._m, nz * (1 + d) + self._m))
        share = self._batch.share
        assert share is not None
        weight = share[:, None, None]
        whole = (1.0 - 2.0 * d * weight) * here
        for k in range(d):
            up, down = (weight * self._elastic(self._at.z + sign * zk[:, k]) for sign in (1.0, -1.0))
            even, odd = up + down, up - down
            whole += even
            side = np.arange(nz * (1 + k), nz * (2 + k))
            out[:, side[:, None], side] = even[:, inner, inner]
            out[:, side[:, None], own] = odd[:, inner]
            out[:, own[:, None], side] = odd[:, :, inner]
        out[:, own[:, None], own] = whole
        return out

    def _returned(self) -> np.ndarray:
        """The same of points that yield, (k, nz + m, nz + m), with the local unknowns' changes."""
        y, batch, form, nz, n = self._at.yielding, self._batch, self._batch.form, self._nz, self._nz + self._m
        assert y is not None
        out = np.zeros((len(y.rows), n, n))
        for region, which, inputs, X in regions(batch, self._at):
            kernels = form.return_kernels(form.regions[region], batch.along.comm)
            nx, moduli = kernels.size, kernels.moduli(np.hstack(inputs), X)[:, n:]
            by_z, by_X, of_X = np.split(moduli, [n * n, n * n + n * nx], axis=1)
            of_X = of_X.reshape(-1, nx, n) * kernels.row_scale[:, None]
            moved = inverse(batch, self._at, region, inputs, X) @ of_X
            out[which] = by_z.reshape(-1, n, n) - by_X.reshape(-1, n, nx) @ moved
        if self._m:
            curvature = form.compile_scalars(batch.along.comm).curvature
            out[:, :nz, :nz] += self._symmetric(curvature(*self._inputs(self._at.z, y.rows)))
        return out

    def scalars(self, dz: np.ndarray, dzk: np.ndarray | None) -> np.ndarray:
        """Changes of the stiff scalars (n, m)."""
        n, m, nz, measure = len(dz), self._m, self._nz, self._at.measure
        assert measure is not None
        of_e = measure.columns(m, m + m * nz)
        out: np.ndarray = np.einsum("nmz,nz->nm", of_e.whole.reshape(n, m, nz), dz)
        if dzk is not None and of_e.odd is not None:
            out += np.einsum("ndmz,ndz->nm", of_e.odd.reshape(n, self._boxes, m, nz), dzk)
        return out

    def times(
        self, dz: np.ndarray, dzk: np.ndarray | None, dt: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Changes of what does work on z (n, nz) and on its derivatives along the half axes (n, d, nz), and
        of L_t (n, m)."""
        n, d, nz = len(dz), self._boxes, self._nz
        changes = [dz] if dzk is None else [dz, dzk.reshape(n, d * nz)]
        changes += [] if dt is None else [dt]
        found = (self._blocks @ np.hstack(changes)[:, :, None])[:, :, 0]
        sides = None if dzk is None else found[:, nz : nz * (1 + d)].reshape(n, d, nz)
        return found[:, :nz], sides, found[:, nz * (1 + d) :]
