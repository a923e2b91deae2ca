#!/bin/sh
# Makes an image from a `reveille` binary that is already built.
#
# usage: build-prebuilt.sh IMAGE BINARY
#
#   IMAGE   image to make, such as reveille:local
#   BINARY  the program, such as target/dist/reveille; the image gets it without symbols and line tables
#
# RUNTIME_IMAGE  what the image is based on (default: debian:bookworm-slim). Its C library must not
#                be older than the one the binary was built against.
# VERSION, REVISION  the image's labels (default: the workspace's version; git's HEAD)
#
# The build context is a temporary directory with two files in it, never target/.
set -eu

die() {
    printf 'build-prebuilt: %s\n' "$*" >&2
    exit 1
}

[ $# -eq 2 ] || {
    sed -n '2,/^set -eu$/{/^#/s/^# \{0,1\}//p;}' "$0" >&2
    exit 2
}
image=$1
binary=$2
here=$(cd "$(dirname "$0")" && pwd)
repository=$(cd "$here/../.." && pwd)

[ -f "$binary" ] || die "no such file: $binary"
[ -x "$binary" ] || die "not executable: $binary"
command -v docker >/dev/null 2>&1 || die "docker is missing: install docker.io"

version=${VERSION:-$(sed -n 's/^version = "\(.*\)"$/\1/p' "$repository/Cargo.toml" | head -n 1)}
revision=${REVISION:-$(git -C "$repository" rev-parse HEAD 2>/dev/null || echo unknown)}

context=$(mktemp -d)
trap 'rm -rf "$context"' EXIT
trap 'exit 130' INT
trap 'exit 143' TERM HUP
cp "$binary" "$context/reveille"
chmod 0755 "$context/reveille"
# A quarter of a release build are names of functions. strip is part of binutils, which come with the linker.
if command -v strip >/dev/null 2>&1; then strip "$context/reveille"; fi
cp "$here/Dockerfile.prebuilt" "$context/Dockerfile"

docker build --force-rm --tag "$image" \
    --build-arg "RUNTIME_IMAGE=${RUNTIME_IMAGE:-debian:bookworm-slim}" \
    --build-arg "BINARY=reveille" \
    --build-arg "VERSION=${version:-unknown}" \
    --build-arg "REVISION=$revision" \
    "$context"
