#!/bin/sh
# Installs the system packages of a list (debian-packages.txt, unless another one beside it is named), if some are
# missing: as root with apt-get, else by asking for them. A script of its own, because an image's largest layer depends on nothing else.
set -eu
cd "$(dirname "$0")"
list=${1:-debian-packages.txt}

stop() {
  printf '\nset-up: %s\n' "$@" >&2
  exit 1
}

if [ "$(. /etc/os-release 2>/dev/null && echo "${ID:-}")" != debian ] || ! command -v apt-get >/dev/null; then
  stop "Debian 12 or 13 is needed, and this is another system. With Docker, the tests and the demo run anywhere:
  docker compose -f docker/compose.yaml run --rm test
  docker compose -f docker/compose.yaml run --rm demo"
fi

installed=$(dpkg-query -W -f '${db:Status-Status} ${Package}\n' | sed -n 's/^installed //p')
missing=$(printf '%s\n' "$installed" | grep -vxFf - "$list" | tr '\n' ' ')
if [ -z "$missing" ]; then exit 0; fi
if [ "$(id -u)" != 0 ]; then
  stop "these packages are missing, and only root can install them:
  apt-get install --no-install-recommends $missing"
fi

echo "set-up: installing $missing(on a fresh system 550 MB to download, some minutes)"
log=$(mktemp)
watcher=
done_() {
  [ -z "$watcher" ] || kill "$watcher" 2>/dev/null || true
  rm -f "$log"
}
trap done_ EXIT
trap 'exit 1' INT TERM

# A line every ten seconds while apt-get works, of what its log has: a silent minute looks like a fault.
progress() {
  while sleep 10; do
    total=$(sed -n 's/.* \([0-9][0-9]*\) newly installed.*/\1/p' "$log" | tail -n 1)
    fetched=$(grep -c '^Get:' "$log" || true)
    unpacked=$(grep -c '^Unpacking ' "$log" || true)
    ready=$(grep -c '^Setting up ' "$log" || true)
    if [ -z "$total" ]; then
      echo "set-up: reading the lists of packages"
    elif [ "$unpacked" = 0 ]; then
      echo "set-up: about $fetched files fetched, $total packages wanted"
    else
      echo "set-up: $unpacked of $total packages unpacked, $ready set up"
    fi
  done
}
progress &
watcher=$!
export DEBIAN_FRONTEND=noninteractive
apt_get() {
  apt-get -q -o Acquire::Retries=5 -o DPkg::Lock::Timeout=600 -o Dpkg::Use-Pty=0 "$@" >>"$log" 2>&1 </dev/null
}
for attempt in 1 2 3; do
  # A broken third-party source fails the update but needn't matter: the installation decides.
  apt_get update || true
  # shellcheck disable=SC2086 # a list of packages
  if apt_get install -y --no-install-recommends $missing; then exit 0; fi
  tail -n 20 "$log" >&2
  echo "set-up: attempt $attempt at installing the packages failed" >&2
  sleep $((attempt * 10))
done
stop "apt-get could not install: $missing"
