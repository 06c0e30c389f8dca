#!/bin/sh
# What the image does: test (the fast tests, and most of them on 2 ranks), demo, study, or any other command.
set -eu
cd "$(dirname "$0")/.."

case "${1:-test}" in
  # Tests that start mpirun themselves are left to the native suite: here others run on 2 ranks, too, but for those of
  # what each point does by itself.
  test)
    make test-fast PYTEST_ARGS='-m "not slow and not mpi"'
    exec make test-mpi RANKS=2 PYTEST_ARGS='--ignore=tests/forms --ignore=tests/kernels --ignore=tests/kinematics \
      --ignore=tests/materials --ignore=tests/plot'
    ;;
  demo | study)
    if [ ! -w results ]; then
      echo "results/ can't be written by user id $(id -u): on the host, mkdir -p results && chmod a+w results" >&2
      exit 1
    fi
    exec make "$1"
    ;;
  *)
    . scripts/env.sh
    exec "$@"
    ;;
esac
