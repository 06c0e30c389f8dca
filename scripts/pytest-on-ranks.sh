#!/bin/sh
# Runs the tests that are neither slow nor start mpirun themselves, all of them on several ranks at once.
#   scripts/pytest-on-ranks.sh RANKS [pytest's arguments]
# Rank 0 writes to the terminal; what the others write is shown if one of them fails.
set -eu
cd "$(dirname "$0")/.."
. scripts/env.sh

ranks=$1
shift
logs=$(mktemp -d)
trap 'rm -rf "$logs"' EXIT

# mpirun gives rank 0 a terminal of its own, even where this script writes to a log.
color=no
[ ! -t 1 ] || color=yes

# Ranks that wait sleep: two of them share a core with other work.
cc -O1 -shared -fPIC -o "$logs/idle.so" tests/helpers/idle.c

# A rank that fails alone leaves the others waiting for it: hence the time limit, and the stacks of those that wait.
status=0
timeout -k 30 "${MPI_TIMEOUT:-1800}" mpirun -n "$ranks" sh -c '
  logs=$1
  shift
  [ "$OMPI_COMM_WORLD_RANK" = 0 ] || exec >"$logs/rank-$OMPI_COMM_WORLD_RANK.txt" 2>&1
  LD_PRELOAD=$logs/idle.so exec python -m pytest -m "not slow and not mpi" -p no:cacheprovider -o faulthandler_timeout=300 "$@"
' rank "$logs" --color="$color" "$@" </dev/null || status=$?

if [ "$status" != 0 ]; then
  for log in "$logs"/*.txt; do
    [ ! -f "$log" ] || { printf '\n%s\n' "--- ${log##*/} (last 200 lines)" && tail -n 200 "$log"; } >&2
  done
  [ "$status" != 124 ] || echo "the tests on $ranks ranks took longer than ${MPI_TIMEOUT:-1800} s" >&2
  echo "the tests on $ranks ranks failed (status $status)" >&2
fi
exit "$status"
