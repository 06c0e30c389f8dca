#!/bin/sh
# What the image does: test (the fast tests, serially and on 2 ranks), demo, study, or any other command.
set -eu
cd "$(dirname "$0")/.."

case "${1:-test}" in
  # tests that start mpirun themselves are left to the native suite: here all others run on 2 ranks, too
  test) exec make test-fast test-mpi RANKS=2 PYTEST_ARGS='-m "not slow and not mpi"' ;;
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
