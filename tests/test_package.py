"""The package can be imported and knows its version."""

import re

import polarmpm


def test_version_is_a_release_number():
    assert re.fullmatch(r"\d+\.\d+\.\d+", polarmpm.__version__)
