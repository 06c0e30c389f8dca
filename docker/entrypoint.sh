#!/bin/sh
# What the image does: test (the fast tests on 2 ranks, and on one what the distribution's versions bear on), demo,
# study, or any other command.
set -eu
cd "$(dirname "$0")/.."

case "${1:-test}" in
  # Tests that start mpirun themselves are left to the native suite, which runs all on one rank. Compiling is part of
  # the run on 2 ranks: hence its time.
  test)
    MPI_TIMEOUT=${MPI_TIMEOUT:-2400} make test-mpi RANKS=2
    exec make test-fast PYTEST_ARGS='-m "not slow and not mpi" tests/assembly tests/io tests/plot tests/solvers \
      tests/study tests/tools tests/verification tests/test_architecture.py tests/test_docs.py tests/test_howto.py \
      tests/test_main.py tests/test_package.py'
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
