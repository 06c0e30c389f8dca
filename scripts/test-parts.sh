#!/usr/bin/env bash
# Runs all tests in parts, each by `make test`, with another process beside it that takes parts, too:
#   scripts/test-parts.sh FOLDER     (empty at first, tells which parts are taken)
# Each takes the next part, the longest ones first, until none is left or one fails.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

taken=$1
parts=(problems verification materials sensitivity others 'solvers basis' forms terms assembly study bodies)

# What no other part names, so that every test is in one.
others=
for path in tests/*/ tests/test_*.py; do
  name=$(basename "$path")
  [[ " ${parts[*]} " == *" $name "* ]] || [ -z "$(find "$path" -name 'test_*.py' -print -quit)" ] || others+=" $name"
done

for index in "${!parts[@]}"; do
  mkdir "$taken/part-$index" 2>/dev/null || continue
  names=${parts[index]/#others/$others}
  # shellcheck disable=SC2086 # names without blanks
  make test PYTEST_ARGS="--durations=5 $(printf 'tests/%s ' $names)"
done
