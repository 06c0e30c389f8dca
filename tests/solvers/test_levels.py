"""Rows and relaxation of a level: halves of symmetric matrices, and rows of one rank of several."""

from __future__ import annotations

import numpy as np
import pytest

from polarmpm.kernels import native
from polarmpm.solvers.coarsening import PARENTS, Coarsening
from polarmpm.solvers.levels import BACKWARD, FORWARD, FROM_ZERO, LINE, REST, Level

OWN, OTHERS = 40, 7  # nodes of this rank, and columns of others


def dense(block: int) -> np.ndarray:
    """Rows of this rank (OWN block, (OWN + OTHERS) block): the own part symmetric and definite."""
    rng = np.random.default_rng(block)
    near = np.abs(np.arange(OWN)[:, None] - np.arange(OWN + OTHERS)) < 4
    out = rng.normal(size=(OWN * block, (OWN + OTHERS) * block)) * np.kron(near, np.ones((block, block)))
    own = out[:, : OWN * block]
    own[:] = own + own.T + 20.0 * block * np.eye(OWN * block)
    return out


def level(block: int, symmetric: bool, half: bool) -> tuple[Level, np.ndarray]:
    """A level and its dense rows. Columns of other ranks stand before and behind the own ones, as in rows
    that ascend by global numbers; of half rows there are none."""
    A = dense(block)
    if half:
        A[:, OWN * block :] = 0.0
    blocks = A.reshape(OWN, block, OWN + OTHERS, block)
    order = np.concatenate([np.arange(OWN, OWN + 3), np.arange(OWN), np.arange(OWN + 3, OWN + OTHERS)])
    cols = [[c for c in order if blocks[r, :, c].any() and not (half and c < r)] for r in range(OWN)]
    values, starts = [], []
    for r, mine in enumerate(cols):
        for i in range(block):
            starts.append(sum(map(len, values)))
            values.append(np.concatenate([blocks[r, i, c] for c in mine]))
    rows = native.BlockRows()
    native.fill(
        rows,
        block=block,
        half=int(half),
        symmetric=int(symmetric),
        nodes=OWN,
        offsets=np.concatenate([[0], np.cumsum([len(mine) for mine in cols])]),
        cols=np.array([c for mine in cols for c in mine], dtype=np.int32),
        row_start=np.array(starts),
        values=np.concatenate(values),
    )
    made = Level(rows, OWN + OTHERS)
    made.find_runs()
    made.prepare()
    made.renew()
    return made, A


KINDS = pytest.mark.parametrize(
    ("symmetric", "half"), [(True, True), (True, False), (False, False)], ids=["half", "whole", "unsymmetric"]
)


@KINDS
@pytest.mark.parametrize("block", [2, 3, 4, 6])
def test_products_are_those_of_the_dense_rows(block, symmetric, half):
    found, A = level(block, symmetric, half)
    x = np.random.default_rng(1).normal(size=(OWN + OTHERS, block))
    out, b = np.empty((OWN, block)), np.random.default_rng(2).normal(size=(OWN, block))
    found.product(x, out)
    np.testing.assert_allclose(out.ravel(), A @ x.ravel(), rtol=0, atol=1e-12 * np.abs(A).max())
    padded, quick = np.append(x, np.zeros(LINE)), np.zeros(OWN * block + LINE)
    found.quick_product(padded, quick)
    np.testing.assert_allclose(quick[: OWN * block], A @ x.ravel(), rtol=0, atol=1e-6 * np.abs(A).max())
    assert not np.array_equal(quick[: OWN * block], out.ravel())  # numbers in single precision
    some = np.array([0, 3, OWN - 1])
    found.prepare_rest(np.isin(np.arange(OWN), some))
    found.x[:] = x
    found.rest_of(some, b, rest := np.zeros_like(b))
    expected = (b.ravel() - A @ x.ravel()).reshape(b.shape)
    np.testing.assert_allclose(rest[some], expected[some], rtol=0, atol=1e-12 * np.abs(A).max())


@KINDS
@pytest.mark.parametrize("block", [2, 3, 4, 6])
def test_sweeps_are_those_of_the_dense_rows(block, symmetric, half):
    """From zero and what that leaves; then other ranks' values come; two sweeps on, and two the other way."""
    found, A = level(block, symmetric, half)
    of_others = A[:, OWN * block :]
    own, rng = A[:, : OWN * block], np.random.default_rng(3)
    node = np.repeat(np.arange(OWN), block)
    behind, before = node[:, None] < node, node[:, None] > node
    D = np.where(behind | before, 0.0, own)
    added = found.relaxation.kept["added"]
    D[np.diag_indices(len(D))] += added
    b, others = rng.normal(size=(OWN, block)), rng.normal(size=(OTHERS, block))
    close = {"rtol": 0, "atol": 1e-5}

    x = np.linalg.solve(D + np.where(behind, own, 0.0), b.ravel())
    found.relax(FROM_ZERO, b)
    np.testing.assert_allclose(found.x[:OWN].ravel(), x, **close)
    found.x[OWN:] = others
    given = of_others @ others.ravel()
    found.relax(REST, rest := np.zeros_like(b))
    expected = b.ravel() - own @ x - given
    np.testing.assert_allclose(rest.ravel(), expected, **close)
    for how, side in ((BACKWARD, behind), (BACKWARD, behind), (FORWARD, before), (FORWARD, before)):
        M = D + np.where(side, own, 0.0)
        x = x + np.linalg.solve(M, b.ravel() - own @ x - given)
        found.relax(how, b)
        np.testing.assert_allclose(found.x[:OWN].ravel(), x, **close)


@KINDS
def test_coarser_levels_are_products_of_the_dense_rows(symmetric, half):
    """Every second node of a line stays; the rows of this rank alone. Of symmetric ones the half behind the
    diagonal is summed: what stands before it are other ranks' sums behind it."""
    found, A = level(3, symmetric, half)
    every = np.arange(OWN + OTHERS)
    parents, weights = np.full((len(every), PARENTS), -1, dtype=np.int32), np.zeros((len(every), PARENTS))
    parents[:, 0], weights[:, 0] = every // 2, np.where(every % 2, 0.5, 1.0)
    odd = every % 2 == 1
    parents[odd, 1], weights[odd, 1] = every[odd] // 2 + 1, 0.5
    number = parents.max() + 1
    coarse = found.couple(Coarsening((), np.arange(number)[:, None], parents, weights, 3), None)
    coarse.find_runs()
    found.coarsen(coarse, None)
    P = np.zeros((len(every), number))
    P[every, parents[:, 0]] = weights[:, 0]
    P[every[odd], parents[odd, 1]] = 0.5
    P = np.kron(P, np.eye(3))
    x, out = np.random.default_rng(5).normal(size=(number, 3)), np.empty((number, 3))
    coarse.product(x, out)
    expected = P[: OWN * 3].T @ A @ P
    if symmetric:
        expected = np.triu(expected) + np.triu(expected, 1).T
    np.testing.assert_allclose(out.ravel(), expected @ x.ravel(), rtol=0, atol=1e-12 * np.abs(A).max())


@KINDS
def test_numbers_that_are_not_finite_are_told(symmetric, half):
    found, _ = level(3, symmetric, half)
    found.rows.kept["values"][-1] = np.nan
    with pytest.raises(Exception, match="not finite"):
        found.renew()
