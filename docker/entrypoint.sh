#!/bin/sh
# What the image does: test (the fast tests, and those of what ranks share on 2 ranks), demo, study, or any other command.
set -eu
cd "$(dirname "$0")/.."

case "${1:-test}" in
  # Tests that start mpirun themselves are left to the native suite: here others run on 2 ranks, too, every second one
  # of what ranks share, which one depends on the version.
  test)
    make test-fast PYTEST_ARGS='-m "not slow and not mpi"'
    exec make test-mpi RANKS=2 PYTEST_ARGS='tests/assembly tests/bodies tests/conditions tests/io tests/problems \
      tests/solvers tests/terms --every 2'
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
