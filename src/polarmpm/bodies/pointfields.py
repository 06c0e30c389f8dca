"""Arrays of the state of material points: shapes and types."""

from __future__ import annotations

import numpy as np

# name -> (shape after the point axis; "d" is the space dimension, type)
FIELDS: dict[str, tuple[tuple[int | str, ...], type]] = {
    "id": ((), np.int64),
    "material": ((), np.int32),
    "X": (("d",), float),
    "x": (("d",), float),
    "F": ((3, 3), float),
    "q": ((4,), float),
    "wryness": ((3, 3), float),
    "volume0": ((), float),
    "half_length0": (("d",), float),
    "half_axes0": (("d", "d"), float),
    "unresolved": ((), float),
}

# what bodies with plastic materials have beside it
PLASTIC_FIELDS: dict[str, tuple[tuple[int | str, ...], type]] = {
    "plastic_F": ((3, 3), float),
    "plastic_wryness": ((3, 3), float),
    "hardening": ((), float),
    "dissipation": ((), float),
}

# what bodies with second-gradient materials have beside it
SECOND_FIELDS: dict[str, tuple[tuple[int | str, ...], type]] = {"grad_F": ((3, 3, 3), float)}

# what bodies in motion have beside it
MOTION_FIELDS: dict[str, tuple[tuple[int | str, ...], type]] = {
    "velocity": (("d",), float),
    "acceleration": (("d",), float),
    "spin": ((3,), float),
    "spin_rate": ((3,), float),
}

# what bodies in motion have whose points integrate over their boxes, while the grid is to be reset
SIDE_FIELDS: dict[str, tuple[tuple[int | str, ...], type]] = {
    "side_F": (("d", "d", "d"), float),
    "side_wryness": ((3, 3), float),
    "side_gradients": (("d", 3, "d"), float),
}

# what bodies have whose displacements don't count from their initial positions
COUNTED_FIELDS: dict[str, tuple[tuple[int | str, ...], type]] = {"counted_from": (("d",), float)}

# what points have that are several bodies, each with nodes of its own
BODY_FIELDS: dict[str, tuple[tuple[int | str, ...], type]] = {"body": ((), np.int32)}
