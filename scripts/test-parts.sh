#!/usr/bin/env bash
# Runs all tests in parts, each by `make test`, with another process beside it that takes parts from the other end:
#   scripts/test-parts.sh FOLDER first     (one process)
#   scripts/test-parts.sh FOLDER last      (another one; FOLDER, empty at first, tells which parts are taken)
# Each ends where it meets the other one, or at a part that fails.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

taken=$1
parts=(verification problems forms assembly materials 'bodies terms' others 'study sensitivity')

# What no other part names, so that every test is in one.
others=
for path in tests/*/ tests/test_*.py; do
  name=$(basename "$path")
  [[ " ${parts[*]} " == *" $name "* ]] || [ -z "$(find "$path" -name 'test_*.py' -print -quit)" ] || others+=" $name"
done

order=("${!parts[@]}")
if [ "$2" = last ]; then mapfile -t order < <(printf '%s\n' "${order[@]}" | tac); fi
for index in "${order[@]}"; do
  mkdir "$taken/part-$index" 2>/dev/null || break
  names=${parts[index]/#others/$others}
  # shellcheck disable=SC2086 # names without blanks
  make test PYTEST_ARGS="--durations=5 $(printf 'tests/%s ' $names)"
done
