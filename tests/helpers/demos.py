"""The demo scripts as modules."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

DEMOS = Path(__file__).parents[2] / "demos"


def demo_module(name: str) -> ModuleType:
    """A script of `demos/`, executed anew."""
    spec = importlib.util.spec_from_file_location(name, DEMOS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
