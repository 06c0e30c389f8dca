"""What the components of fields are called, in tables and in ParaView."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

_AXES = "xyz"


def component_names(name: str, shape: Sequence[int]) -> list[str]:
    """What the components of a field's row are called: x, xy or xyz by their axes, principal values 1 to 3;
    numbers from 0 on where there are other sizes than those of space."""
    size = int(np.prod(shape, dtype=int))
    if not len(shape):
        return [""]
    if name.startswith("principal") and tuple(shape) == (3,):
        return ["1", "2", "3"]
    if len(shape) == 1 and size in (9, 27):  # written out row by row
        shape = (3,) * (2 if size == 9 else 3)
    if max(shape) > 3 or (len(shape) > 1 and len(set(shape)) > 1):
        return [str(k) for k in range(size)]
    return ["".join(_AXES[k] for k in at) for at in np.ndindex(*shape)]


def named_components(name: str, value: np.ndarray) -> Any:
    """A value of a field as `Table` takes it: a number, or numbers by the names of components."""
    value = np.asarray(value)
    if value.ndim == 0:
        return float(value)
    return dict(zip(component_names(name, value.shape), value.ravel().tolist(), strict=True))
