#!/bin/sh
# Style and types. ruff and mypy are pinned and live in a virtual environment of their own, so that what they say
# doesn't depend on the machine.
#   scripts/lint.sh [style] [format] [types]   (all of them by default)
set -eu
cd "$(dirname "$0")/.."

venv=.venv-lint
if ! cmp -s scripts/lint-requirements.txt "$venv/installed.txt"; then
  /usr/bin/python3 -m venv --clear "$venv" || {
    echo 'lint: no virtual environment; install it with: apt-get install python3-venv' >&2
    exit 1
  }
  echo '*' >"$venv/.gitignore"
  "$venv/bin/python" -m pip --quiet --disable-pip-version-check --retries 5 install --only-binary :all: \
    -r scripts/lint-requirements.txt || {
    echo 'lint: pip could not install ruff and mypy (scripts/lint-requirements.txt): it needs a package index' >&2
    exit 1
  }
  cp scripts/lint-requirements.txt "$venv/installed.txt"
fi

status=0
[ $# -gt 0 ] || set -- style format types
for check in "$@"; do
  case $check in
    style) "$venv/bin/ruff" check . || status=1 ;;
    format) "$venv/bin/ruff" format --check . || status=1 ;;
    types) "$venv/bin/mypy" || status=1 ;;
    *) echo "lint: $check: allowed are style, format, types" >&2 && exit 2 ;;
  esac
done
exit $status
