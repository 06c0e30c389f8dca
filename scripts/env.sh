# The environment in which everything runs. Source it from the repository's root: . scripts/env.sh

# /usr/bin comes before what follows it on PATH: the compiler and mpirun must be the ones that the
# distribution's dolfinx was built with. Packages in ~/.local would hide those of the distribution.
export PATH="$PWD/.venv/bin:/usr/bin:$PATH"
export PYTHONNOUSERSITE=1

# OpenBLAS' threads make MUMPS several times slower. The hash seed only makes runs repeatable: keys in the cache
# of compiled forms don't depend on it.
export OMP_NUM_THREADS=1
export PYTHONHASHSEED=0
export MPLBACKEND="${MPLBACKEND:-agg}"

# OpenMPI 4 (OMPI_MCA_*) and 5 (PRTE_MCA_*): run as root, run more ranks than there are cores, and don't pin ranks
# to cores, because two runs at the same time would be pinned to the same ones.
export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
export OMPI_MCA_rmaps_base_oversubscribe=1 PRTE_MCA_rmaps_default_mapping_policy=:oversubscribe
# ranks that wait let others work: tests run beside each other
export OMPI_MCA_mpi_yield_when_idle=1
export OMPI_MCA_hwloc_base_binding_policy=none PRTE_MCA_hwloc_default_binding_policy=none

# dolfinx reads the time that a process waits for another one's JIT compile from here (written by setup.sh).
export XDG_CONFIG_HOME="$PWD/.venv/config"

# The JIT cache is in its default place, ~/.cache/fenics, unless there's no home to write to.
if [ ! -w "${HOME:-/nonexistent}" ]; then
  export XDG_CACHE_HOME="${XDG_CACHE_HOME:-$PWD/.cache}"
fi
