"""A progress bar on a terminal and in notebooks."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from typing import Any

from tqdm import tqdm


def in_notebook() -> bool:
    """Whether a notebook's kernel runs this, whose standard error isn't a terminal but shows bars, too."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return type(shell).__name__ == "ZMQInteractiveShell"


def bar(shown: bool | None, **options: Any) -> Any:
    """tqdm's bar; None shows it on a terminal and in notebooks, there as a widget if ipywidgets are there."""
    notebook = shown is not False and in_notebook()
    disable = None if shown is None and not notebook else shown is False
    if notebook and find_spec("ipywidgets") is not None:
        from tqdm.notebook import tqdm as widget

        return widget(disable=disable, **options)
    return tqdm(disable=disable, **options)
