"""Builds the one compiled file of the package, and states the licence; the rest is in pyproject.toml."""

import os
from concurrent.futures import ThreadPoolExecutor
from glob import glob
from importlib.util import find_spec

import setuptools
from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

# setuptools knows SPDX expressions from 77 on, and asks packaging, which may be an older one; Debian 12's 66
# would refuse one in pyproject.toml.
try:
    NEW = int(setuptools.__version__.split(".")[0]) >= 77 and find_spec("packaging.licenses") is not None
except ImportError:
    NEW = False
LICENCE = {"license_expression": "MIT"} if NEW else {"license": "MIT"}


class SideBySide(build_ext):
    """Compiles as many of the sources at once as there are processors."""

    def build_extensions(self):
        compile_all = self.compiler.compile

        def compile_each(sources, **options):
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                found = pool.map(lambda source: compile_all([source], **options), sources)
                return [made for one in found for made in one]

        self.compiler.compile = compile_each
        super().build_extensions()


setup(
    **LICENCE,
    cmdclass={"build_ext": SideBySide},
    # `python -m polarmpm demo NAME` finds them where there is no clone
    data_files=[("share/polarmpm/demos", sorted(glob("demos/*.py")))],
    # a plain shared library, loaded with ctypes: it needs neither Python's nor NumPy's headers
    ext_modules=[
        Extension(
            "polarmpm.kernels._native",
            # the longest first: others are compiled beside it
            sources=sorted(
                glob("src/polarmpm/kernels/_*.c"), key=lambda name: (-os.path.getsize(name), name)
            ),
            depends=glob("src/polarmpm/kernels/_*.h"),
            # Python's own flags hold -fwrapv, with which the loops' addresses cost a fifth of a residual, and
            # -g, with which compiling takes a third longer
            extra_compile_args=[
                *("-O3", "-std=gnu11", "-fno-math-errno", "-fno-wrapv", "-g0"),
                "-Wno-unused-function",  # units use a part of what they share
            ],
        )
    ],
)
