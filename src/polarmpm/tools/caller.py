"""Warnings that point at the line of the script, however many calls of the package lie between."""

from __future__ import annotations

import sys
import warnings
from types import FrameType

_PACKAGE = __name__.split(".")[0]


def frame_of_script() -> FrameType:
    """The innermost call that isn't the package's own."""
    frame = sys._getframe(1)
    # by their modules: functions that data classes make have no file
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] == _PACKAGE:
        frame = frame.f_back
    return frame


def line_of_script() -> tuple[str, int]:
    """File and line of that call."""
    frame = frame_of_script()
    return frame.f_code.co_filename, frame.f_lineno


def warn(text: str, category: type[Warning] = UserWarning) -> None:
    """`warnings.warn` of the script's line."""
    frame = frame_of_script()
    warnings.warn_explicit(
        text,
        category,
        frame.f_code.co_filename,
        frame.f_lineno,
        module=frame.f_globals.get("__name__"),
        registry=frame.f_globals.setdefault("__warningregistry__", {}),
    )
