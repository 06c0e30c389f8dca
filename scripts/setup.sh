#!/bin/sh
# Sets up all that the demos and tests need, on Debian 12 or 13: system packages, and .venv with this package installed
# in editable mode. Does nothing if that's been done already.
set -eu
cd "$(dirname "$0")/.."

python=/usr/bin/python3 # the distribution's: another python3 may come first on PATH, and has no dolfinx
stamp=.venv/.installed

# What the installation belongs to: a copied tree would import the original one, and a newer Python finds nothing.
installation() {
  echo "$PWD $("$python" --version 2>&1)"
}

is_current() {
  [ -x .venv/bin/python ] && [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$(installation)" ] || return 1
  for file in pyproject.toml setup.py src/polarmpm/kernels/*.[ch] scripts/setup.sh scripts/*packages*; do
    [ ! "$file" -nt "$stamp" ] || return 1
  done
}

if is_current; then exit 0; fi
scripts/install-packages.sh

echo "set-up: installing into $PWD/.venv; a C file is compiled, which takes a minute or two"
rm -f "$stamp"
"$python" -m venv --clear --system-site-packages .venv
# All dependencies are Debian's, so nothing is to be fetched; neither are the build tools.
.venv/bin/python -m pip --quiet --disable-pip-version-check --no-cache-dir install \
  --no-index --no-deps --no-build-isolation --editable .
# That both are found; polarmpm isn't imported, so that work in progress on it doesn't stop its installation.
(. scripts/env.sh && cd / && python -c 'import dolfinx, importlib.util as u; assert u.find_spec("polarmpm")')
installation >"$stamp"
