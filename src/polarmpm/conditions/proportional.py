"""What the arc-length method asks of loads and supports."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from .amplitudes import Amplitude
from .prescribed import Prescribed

_PROBES = (0.0, 1.0, 0.5, 2.0)  # load factors at which loads are compared


def check_linear(
    comm: MPI.Comm, names: Sequence[str], zero: np.ndarray, one: np.ndarray, two: np.ndarray
) -> None:
    """Raise InputError unless forces of terms at the load factors 0, 1 and 2 are linear in it. Collective."""
    wrong = float(np.abs(two - 2.0 * one + zero).max(initial=0.0))
    size = max(float(np.abs(f).max(initial=0.0)) for f in (zero, one, two))
    if comm.allreduce(wrong, op=MPI.MAX) > 1e-9 * comm.allreduce(size, op=MPI.MAX):
        raise InputError(
            f"{', '.join(names)}: not linear in the load factor; with the arc-length method all loads are"
        )


def check_loads(comm: MPI.Comm, loads: list[tuple[Amplitude, np.ndarray]], of_terms: np.ndarray) -> None:
    """Raise InputError unless loads, given with the positions where they act, are linear in the load factor,
    and they or terms, by these forces (nodes, block), grow with it. Collective."""
    grows = bool(comm.allreduce(bool(np.any(of_terms)), op=MPI.LOR))
    for amplitude, position in loads:
        zero, one, half, two = (amplitude.at(f, position) for f in _PROBES)
        size = max(float(np.abs(v).max(initial=0.0)) for v in (zero, one, two))
        wrong = max(
            float(np.abs(v - (zero + f * (one - zero))).max(initial=0.0))
            for f, v in ((0.5, half), (2.0, two))
        )
        change = float(np.abs(one - zero).max(initial=0.0))
        size, wrong, change = (comm.allreduce(v, op=MPI.MAX) for v in (size, wrong, change))
        if wrong > 1e-9 * size:
            raise InputError(
                f"{amplitude.name} is not linear in the load factor; with the arc-length method all loads are"
            )
        grows = grows or change > 0.0
    if not grows:
        raise InputError("march_arc_length: no load grows with the load factor")


def check_supports(comm: MPI.Comm, prescribed: Prescribed) -> None:
    """Raise InputError for a support that depends on the load factor. Collective."""
    for support, mask in zip(prescribed.supports, prescribed.masks, strict=True):
        position = prescribed.nodes.position[mask]
        for amplitude, k in support.columns.values():
            values = [amplitude.at(f, position)[:, k] for f in _PROBES]
            change = max(float(np.abs(v - values[0]).max(initial=0.0)) for v in values)
            if comm.allreduce(change, op=MPI.MAX) > 0.0:
                raise InputError(
                    f"{amplitude.name} depends on the load factor; with the arc-length method only loads do"
                )
