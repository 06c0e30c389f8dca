#!/bin/sh
# Builds docker/Dockerfile and runs the tests in the image where no Docker engine is at hand: debootstrap makes the
# base, buildah the image. As root, on Debian.
#   scripts/build-image-without-engine.sh build   (layers and the base are kept: a second build takes seconds)
#   scripts/build-image-without-engine.sh test
set -eu
cd "$(dirname "$0")/.."

image=localhost/polarmpm
base=localhost/polarmpm-base
cache=${XDG_CACHE_HOME:-${HOME:-/root}/.cache}/polarmpm
work=
container=
trap cleanup EXIT
trap 'exit 1' INT TERM

cleanup() {
  [ -z "$work" ] || rm -rf "$work"
  [ -z "$container" ] || buildah rm "$container" >/dev/null
}

retry() {
  for attempt in 1 2 3; do
    if "$@"; then return 0; fi
    echo "attempt $attempt failed: $*" >&2
    sleep $((attempt * 10))
  done
  return 1
}

apt_get() {
  DEBIAN_FRONTEND=noninteractive apt-get -q -o Acquire::Retries=5 -o DPkg::Lock::Timeout=600 "$@" </dev/null
}

install_tools() {
  if command -v debootstrap >/dev/null && command -v buildah >/dev/null; then return 0; fi
  apt_get update || true # a broken third-party source needn't matter
  retry apt_get install -y --no-install-recommends debootstrap buildah
}

bootstrap() {
  rm -rf "$work/root"
  debootstrap --variant=minbase trixie "$work/root" ${DEBIAN_MIRROR:+"$DEBIAN_MIRROR"} \
    >"$work/debootstrap.log" 2>&1 || {
    tail -n 20 "$work/debootstrap.log" >&2
    return 1
  }
}

# Debian 13 stands in for debian:trixie-slim. The tarball is made anew after a month, the base image with it.
build_base() {
  tarball=$cache/trixie.tgz
  if [ -z "$(find "$tarball" -mtime -30 2>/dev/null)" ]; then
    echo 'base: debootstrap'
    retry bootstrap
    tar --numeric-owner -C "$work/root" -czf "$tarball.new" --exclude './var/cache/apt/archives/*.deb' .
    rm -rf "$work/root"
    mv "$tarball.new" "$tarball"
  elif buildah inspect --type image "$base" >/dev/null 2>&1; then
    return 0
  fi
  echo "base: from $tarball"
  container=$(buildah from scratch)
  buildah add -q "$container" "$tarball" /
  buildah config --cmd bash --env PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin "$container"
  buildah commit -q --rm "$container" "$base"
  container=
}

build() {
  install_tools
  work=$(mktemp -d)
  mkdir -p "$cache"
  # One build at a time; what an earlier one left behind when it was interrupted can then go.
  exec 9>"$cache/lock"
  flock 9
  buildah containers --quiet --filter "ancestor=$base" | xargs -r buildah rm >/dev/null
  build_base
  # The context is what git tracks, whatever else lies about; without git, .dockerignore has to do.
  context=.
  if git rev-parse --git-dir >/dev/null 2>&1; then
    context=$work/context
    mkdir "$context"
    git ls-files -z | tar --null --files-from=- -cf - | tar -xf - -C "$context"
  fi
  buildah bud --isolation chroot --layers --force-rm --pull-never --build-arg BASE="$base" -t "$image" \
    -f docker/Dockerfile "$context"
}

# `buildah run` ignores both ENTRYPOINT and CMD.
run_tests() {
  container=$(buildah from --pull-never "$image")
  buildah run --isolation chroot "$container" -- docker/entrypoint.sh test
}

if [ "$(id -u)" != 0 ]; then
  echo 'debootstrap and buildah (with chroot isolation) need root' >&2
  exit 1
fi
case "${1:-}" in
  build) build ;;
  test) run_tests ;;
  *) echo "usage: $0 build|test" >&2 && exit 1 ;;
esac
