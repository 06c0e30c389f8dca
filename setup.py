"""Builds the one compiled file of the package; everything else is in pyproject.toml."""

from glob import glob

from setuptools import Extension, setup

# A plain shared library, loaded with ctypes: it needs neither Python's nor NumPy's headers.
setup(
    ext_modules=[
        Extension(
            "polarmpm.kernels._native",
            sources=["src/polarmpm/kernels/_native.c"],
            depends=glob("src/polarmpm/kernels/_*.h"),
            # Python's own flags hold -fwrapv, with which the loops' addresses cost a fifth of a residual
            extra_compile_args=["-O3", "-std=gnu11", "-fno-math-errno", "-fno-wrapv"],
        )
    ]
)
