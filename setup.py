"""Builds the one compiled file of the package, and states the licence; the rest is in pyproject.toml."""

from glob import glob
from importlib.util import find_spec

import setuptools
from setuptools import Extension, setup

# setuptools knows SPDX expressions from 77 on, and asks packaging, which may be an older one; Debian 12's 66
# would refuse one in pyproject.toml.
try:
    NEW = int(setuptools.__version__.split(".")[0]) >= 77 and find_spec("packaging.licenses") is not None
except ImportError:
    NEW = False
LICENCE = {"license_expression": "MIT"} if NEW else {"license": "MIT"}

setup(
    **LICENCE,
    # `python -m polarmpm demo NAME` finds them where there is no clone
    data_files=[("share/polarmpm/demos", sorted(glob("demos/*.py")))],
    # a plain shared library, loaded with ctypes: it needs neither Python's nor NumPy's headers
    ext_modules=[
        Extension(
            "polarmpm.kernels._native",
            sources=sorted(glob("src/polarmpm/kernels/_*.c")),
            depends=glob("src/polarmpm/kernels/_*.h"),
            # Python's own flags hold -fwrapv, with which the loops' addresses cost a fifth of a residual, and
            # -g, with which compiling takes a third longer
            extra_compile_args=["-O3", "-std=gnu11", "-fno-math-errno", "-fno-wrapv", "-g0"],
        )
    ],
)
