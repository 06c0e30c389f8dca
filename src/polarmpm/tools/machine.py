"""What the machine has."""

from __future__ import annotations

import os
from typing import Any

from . import checks


def memory() -> int:
    """Bytes of this machine's memory; what no machine has where the system doesn't tell."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError):
        return 1 << 62


def check_memory(name: str, value: Any, needed: int) -> None:
    """Raise InputError for an argument that asks for more bytes than the machine has.

    Bytes needed are counted before the work, and rather too few: what a large run just about needs passes.
    """
    if needed > memory():
        asked, there = (min(n, 10**300) / 2**30 for n in (needed, memory()))
        raise checks.refuse(
            name, value, f"at least {asked:.3g} GiB are needed, this machine has {there:.3g} GiB"
        )
