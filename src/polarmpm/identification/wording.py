"""A fit, or a plan, as text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .judging import TRUSTED, Judgement, direction_in_words, dominated, pairs_in_words, percent
from .transforms import Free


def table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table, the first column to the left."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return [
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True))]
        ).rstrip()
        for row in rows
    ]


def identified(judgement: Judgement, free: Free, v: np.ndarray, limit: float) -> list[str]:
    """What the data don't show, and what goes together."""
    lines = []
    names = free.names
    bad = [k for k in range(len(names)) if not judgement.spread[k] <= limit]
    if bad:
        said = ", ".join(f"{names[k]} ({percent(float(judgement.spread[k]))})" for k in bad)
        lines.append(f"not identifiable: {said}")
    held = [names[k] for k in dominated(judgement)]
    if held:
        lines.append(f"held by priors rather than data: {', '.join(held)}")
    pairs = pairs_in_words(judgement, names)
    if pairs:
        lines.append(f"correlated: {', '.join(pairs)}")
    if names:
        lines.append(f"weakest direction: {direction_in_words(judgement, free, v)}")
    return lines


def fit_in_words(fit: Any) -> str:
    """What `print` shows."""
    sds = fit.sd
    rows = [["", "value", "sd", "95 % interval", ""]]
    ends = fit.intervals()
    for name, value in fit.values.items():
        rows.append([name, f"{value:.6g}", f"{sds[name]:.2g}", *(f"{end:.5g}" for end in ends[name])])
    lines = table(rows)
    per = f" = {fit.chi2 / fit.dof:.3g}" if fit.dof > 0 else ""
    lines.append(f"chi2 / dof = {fit.chi2:.4g} / {fit.dof}{per}; {fit.evaluations} evaluations")
    if not fit.converged:
        lines.append("stopped before a minimum was found: allow more evaluations, or start elsewhere")
    lines += identified(fit.judgement, fit.free, fit.v, fit.limit)
    if (fit.judgement.sd > TRUSTED).any():
        wide = [n for n, sd in zip(fit.names, fit.judgement.sd, strict=True) if sd > TRUSTED]
        lines.append(f"too wide for intervals of first order, see profile: {', '.join(wide)}")
    if len(fit.starts) > 1:
        lines.append("starts: chi2 " + ", ".join(f"{s['chi2']:.4g}" for s in fit.starts))
    if fit.failures:
        lines.append(f"{len(fit.failures)} runs failed, the first one: {fit.failures[0]}")
    outliers = fit.outliers
    if outliers:
        said = "; ".join(
            f"experiment {o.experiment + 1}, {o.name}{list(o.index)} at {o.at:.4g}: {o.residual:+.1f} sigma"
            for o in outliers[:5]
        )
        lines.append(f"outliers ({len(outliers)}): {said}")
    return "\n".join(lines)
