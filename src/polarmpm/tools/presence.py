"""That all is there which pip can't install; imported before anything needs it."""

import importlib.util

for _name in ("mpi4py", "petsc4py", "dolfinx"):  # found, not imported: that takes time
    if importlib.util.find_spec(_name) is None:
        raise ImportError(
            f"polarmpm needs {_name}, which isn't found by this Python. pip can't install dolfinx: on Debian "
            "and Ubuntu, apt-get install python3-dolfinx and a venv with --system-site-packages; "
            "elsewhere conda install -c conda-forge fenics-dolfinx, or the image of docker/Dockerfile"
        )
