# The environment in which everything runs. Source it in the repository's root: . scripts/env.sh
# It changes the variables below and nothing else; those that a shell has set already stay, but for the search path.

if ! grep -q '^name = "polarmpm"' "$PWD/pyproject.toml" 2>/dev/null || [ ! -f "$PWD/scripts/env.sh" ]; then
  echo "env.sh: $PWD isn't polarmpm's folder; cd to the repository's root first, then: . scripts/env.sh" >&2
  # shellcheck disable=SC2317 # where it is run instead of sourced
  return 1 2>/dev/null || exit 1
fi

# /usr/bin comes before what follows it on PATH: the compiler and mpirun must be the ones that the
# distribution's dolfinx was built with. Packages in ~/.local would hide those of the distribution.
case $PATH in
  "$PWD/.venv/bin:/usr/bin:"*) ;;
  *) export PATH="$PWD/.venv/bin:/usr/bin:$PATH" ;;
esac
export PYTHONNOUSERSITE="${PYTHONNOUSERSITE:-1}"

# OpenBLAS' threads make MUMPS several times slower. The hash seed only makes runs repeatable: keys in the cache
# of compiled forms don't depend on it.
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
export PYTHONHASHSEED="${PYTHONHASHSEED:-0}"

# OpenMPI 4 (OMPI_MCA_*) and 5 (PRTE_MCA_*): run as root, run more ranks than there are cores, and don't pin ranks
# to cores, because two runs at the same time would be pinned to the same ones.
export OMPI_ALLOW_RUN_AS_ROOT="${OMPI_ALLOW_RUN_AS_ROOT:-1}"
export OMPI_ALLOW_RUN_AS_ROOT_CONFIRM="${OMPI_ALLOW_RUN_AS_ROOT_CONFIRM:-1}"
export OMPI_MCA_rmaps_base_oversubscribe="${OMPI_MCA_rmaps_base_oversubscribe:-1}"
export PRTE_MCA_rmaps_default_mapping_policy="${PRTE_MCA_rmaps_default_mapping_policy:-:oversubscribe}"
# ranks that wait let others work: tests run beside each other
export OMPI_MCA_mpi_yield_when_idle="${OMPI_MCA_mpi_yield_when_idle:-1}"
export OMPI_MCA_hwloc_base_binding_policy="${OMPI_MCA_hwloc_base_binding_policy:-none}"
export PRTE_MCA_hwloc_default_binding_policy="${PRTE_MCA_hwloc_default_binding_policy:-none}"

# Compiled code is kept in its default place, ~/.cache/polarmpm, unless there's no home to write to.
if [ ! -w "${HOME:-/nonexistent}" ]; then
  export POLARMPM_CACHE="${POLARMPM_CACHE:-$PWD/.cache/polarmpm}"
fi
