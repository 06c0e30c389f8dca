"""What a script gives of a rigid body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..conditions.amplitudes import Amplitude
from ..tools import checks


def names_of(dim: int) -> tuple[str, ...]:
    return ("ux", "uy", "w") if dim == 2 else ("ux", "uy", "uz", "wx", "wy", "wz")


def held_motions(name: str, given: Any, dim: int) -> dict[int, Amplitude]:
    """Values of the motions that are given, by their number."""
    names = names_of(dim)
    if isinstance(given, str):
        given = (given,)
    if not isinstance(given, Mapping):
        listed = list(given) if isinstance(given, Sequence | set) else [given]
        given = dict.fromkeys(listed, 0.0) if all(isinstance(one, str) for one in listed) else {None: 0.0}
    found = {}
    for key, value in given.items():
        if key not in names:
            raise checks.refuse(f"{name}: held", key, f"allowed are {', '.join(names)}")
        k = names.index(key)
        if dim == 3 and k >= dim and (callable(value) or np.any(value)):
            raise checks.refuse(f"{name}: held: {key}", value, "in space turns can be held at 0 only")
        found[k] = Amplitude(f"{name}: held: {key}", value, 1)
    return found


def inertia_tensor(name: str, given: Any, dim: int) -> np.ndarray | None:
    """Moment of inertia as a tensor (1, 1), or (3, 3)."""
    if given is None:
        return None
    found = checks.numeric(f"{name}: inertia", given, "moments of inertia")
    allowed = "a positive number" if dim == 2 else "a positive number, three, or a positive tensor (3, 3)"
    shapes = ((),) if dim == 2 else ((), (3,), (3, 3))
    if found.shape not in shapes or not np.isfinite(found).all():
        raise checks.refuse(f"{name}: inertia", given, f"{allowed} is needed")
    size = 1 if dim == 2 else 3
    tensor = found if found.ndim == 2 else np.diag(np.broadcast_to(found, (size,)))
    symmetric = np.allclose(tensor, tensor.T, rtol=1e-9, atol=1e-12 * float(np.abs(tensor).max()))
    if not symmetric or np.linalg.eigvalsh(tensor).min() <= 0.0:
        raise checks.refuse(f"{name}: inertia", given, f"{allowed} is needed")
    principal = np.linalg.eigvalsh(tensor)
    if dim == 3 and principal[2] > (principal[0] + principal[1]) * (1.0 + 1e-9):
        raise checks.refuse(
            f"{name}: inertia",
            given,
            "no body has it: the largest principal moment is more than the sum of the others",
        )
    symmetrised: np.ndarray = 0.5 * (tensor + tensor.T)
    return symmetrised


def constant(amplitude: Amplitude, factor: float) -> Amplitude:
    """Its value at a load factor, for ever."""
    value = amplitude.at(factor, np.zeros((1, amplitude.size)))[0]
    made = Amplitude(amplitude.name, lambda time: value, amplitude.size)
    made.begin(0.0, "total")
    return made
