"""The compiled loops belong to the package that calls them."""

import pytest

from polarmpm.kernels import native


def test_a_stale_build_is_refused(monkeypatch):
    """Another interface would crash in the middle of a run."""
    assert native.library().polarmpm_interface() == native.INTERFACE
    native.library.cache_clear()
    monkeypatch.setattr(native, "INTERFACE", native.INTERFACE + 1)
    with pytest.raises(ImportError, match="install it again"):
        native.library()
