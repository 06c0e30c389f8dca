#!/bin/sh
# Sets up all that the demos and tests need, on Debian 12 or 13; does nothing if that's been done already.
#   scripts/setup.sh            both of the following
#   scripts/setup.sh packages   system packages, by apt-get; asks for them if not run as root
#   scripts/setup.sh venv       .venv with this package installed in editable mode; downloads nothing
set -eu
cd "$(dirname "$0")/.."

python=/usr/bin/python3 # the distribution's: another python3 may come first on PATH, and has no dolfinx
stamp=.venv/.installed

stop() {
  printf '\nset-up: %s\n' "$@" >&2
  exit 1
}

check_system() {
  if [ "$(. /etc/os-release 2>/dev/null && echo "${ID:-}")" != debian ] || ! command -v apt-get >/dev/null; then
    stop "Debian 12 or 13 is needed, and this is another system. With Docker, the tests and the demo run anywhere:
  docker compose -f docker/compose.yaml run test
  docker compose -f docker/compose.yaml run demo"
  fi
}

missing_packages() {
  installed=$(dpkg-query -W -f '${db:Status-Status} ${Package}\n' | sed -n 's/^installed //p')
  while read -r package; do
    printf '%s\n' "$installed" | grep -qxF "$package" || printf '%s ' "$package"
  done <scripts/debian-packages.txt
}

install_packages() {
  missing=$(missing_packages)
  [ -n "$missing" ] || return 0
  if [ "$(id -u)" != 0 ]; then
    stop "these packages are missing, and only root can install them:
  apt-get install --no-install-recommends $missing"
  fi
  echo "set-up: installing $missing"
  export DEBIAN_FRONTEND=noninteractive
  for attempt in 1 2 3; do
    # A broken third-party source fails the update but needn't matter: the installation decides.
    apt_get update || true
    # shellcheck disable=SC2086 # a list of packages
    if apt_get install -y --no-install-recommends $missing; then return 0; fi
    echo "set-up: attempt $attempt at installing the packages failed" >&2
    sleep $((attempt * 10))
  done
  stop "apt-get could not install: $missing"
}

apt_get() {
  apt-get -q -o Acquire::Retries=5 -o DPkg::Lock::Timeout=600 -o Dpkg::Use-Pty=0 "$@" </dev/null
}

# What the installation belongs to: a copied tree would import the original one, and a newer Python finds nothing.
installation() {
  echo "$PWD $("$python" --version 2>&1)"
}

is_current() {
  [ -x .venv/bin/python ] && [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$(installation)" ] || return 1
  for file in pyproject.toml setup.py scripts/debian-packages.txt scripts/setup.sh src/polarmpm/*.[ch]; do
    [ ! "$file" -nt "$stamp" ] || return 1
  done
}

install_venv() {
  echo "set-up: installing into $PWD/.venv"
  rm -f "$stamp"
  "$python" -m venv --clear --system-site-packages .venv
  # All dependencies are Debian's, so nothing is to be fetched; neither are the build tools.
  .venv/bin/python -m pip --quiet --disable-pip-version-check install --no-cache-dir --no-index --no-deps --no-build-isolation --editable .
  # dolfinx' processes wait for another one's JIT compile for 10 s by default, which isn't enough on a busy machine.
  # 0.5 and the later releases read different files.
  mkdir -p .venv/config/dolfinx
  for name in jit_parameters jit_options; do
    echo '{"timeout": 600}' >".venv/config/dolfinx/dolfinx_$name.json"
  done
  (. scripts/env.sh && cd / && python -c 'import dolfinx, polarmpm')
  installation >"$stamp"
}

part=${1:-all}
case $part in
  all | packages | venv) ;;
  *) stop "unknown part '$part': packages or venv" ;;
esac
if [ "$part" != packages ] && is_current; then exit 0; fi
if [ "$part" != venv ]; then
  check_system
  install_packages
fi
if [ "$part" != packages ]; then install_venv; fi
