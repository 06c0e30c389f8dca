"""Builds the one compiled file of the package; everything else is in pyproject.toml."""

from setuptools import Extension, setup

# A plain shared library, loaded with ctypes: it needs neither Python's nor NumPy's headers.
setup(
    ext_modules=[
        Extension(
            "polarmpm.kernels._native",
            sources=["src/polarmpm/kernels/_native.c"],
            depends=[
                f"src/polarmpm/kernels/_{name}.h" for name in ("moments", "points", "return", "scatter")
            ],
            extra_compile_args=["-O3", "-std=gnu11", "-fno-math-errno"],
        )
    ]
)
