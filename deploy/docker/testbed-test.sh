#!/bin/sh
# Runs a whole testbed on the docker engine: a base station and 50 devices in 5 containers.
#
# usage: testbed-test.sh BINARY [DIGEST]
#
#   BINARY  the `reveille` program to pack and run, such as target/release/reveille
#   DIGEST  what the run's digest must be; without it the digest is only printed
#
# RUNTIME_IMAGE    image to base the test's image on (default: reveille-base:local, which
#                  make-base-image.sh makes where it is absent)
# TESTBED_TIMEOUT  seconds the run may take (default: 600)
# REVEILLE_SCENARIO, REVEILLE_POLICY, REVEILLE_TTIS, REVEILLE_SEED  the run, as in docker-compose.yml
#
# Exit code: 0 passed or skipped (prints "SKIPPED: ..." where there is no engine or no compose),
# 1 failed. Containers, network, volume and image of the test carry a name of their own and go
# away however it ends; the base image stays for the next time.
set -eu

say() { printf 'testbed-test: %s\n' "$*"; }
fail() {
    say "FAILED: $*" >&2
    exit 1
}
skip() {
    printf 'SKIPPED: %s\n' "$*"
    exit 0
}

[ $# -eq 1 ] || [ $# -eq 2 ] || {
    sed -n '2,/^set -eu$/{/^#/s/^# \{0,1\}//p;}' "$0" >&2
    exit 2
}
binary=$1
expected=${2:-}
here=$(cd "$(dirname "$0")" && pwd)
repository=$(cd "$here/../.." && pwd)

command -v docker >/dev/null 2>&1 || skip "no docker command"
docker info >/dev/null 2>&1 || skip "no docker engine answers"
if docker compose version >/dev/null 2>&1; then
    compose() { docker compose "$@"; }
    set -- docker compose
elif command -v docker-compose >/dev/null 2>&1; then
    compose() { docker-compose "$@"; }
    set -- docker-compose
else
    skip "neither 'docker compose' nor docker-compose"
fi
[ -x "$binary" ] || fail "not a program: $binary"

project=reveille-test-$$-$(od -An -N4 -tx4 /dev/urandom | tr -d ' ')
image=$project:test
export COMPOSE_PROJECT_NAME="$project" COMPOSE_FILE="$repository/docker-compose.yml"
export REVEILLE_IMAGE="$image" REVEILLE_RUN=testbed REVEILLE_DEVICES=50 REVEILLE_COUNT=10
export REVEILLE_SCENARIO="${REVEILLE_SCENARIO:-paper}" REVEILLE_POLICY="${REVEILLE_POLICY:-knn}"
export REVEILLE_TTIS="${REVEILLE_TTIS:-2000}" REVEILLE_SEED="${REVEILLE_SEED:-1}"

running=
cleanup() {
    trap '' INT TERM HUP
    if [ -n "$running" ]; then
        kill "$running" 2>/dev/null || true
        wait "$running" || true
    fi
    compose down --volumes --remove-orphans --timeout 5 >/dev/null 2>&1 ||
        say "could not remove everything of project $project" >&2
    docker image rm --force "$image" >/dev/null 2>&1 || true
}
trap cleanup EXIT
trap 'exit 130' INT
trap 'exit 143' TERM HUP

if [ -z "${RUNTIME_IMAGE:-}" ]; then
    RUNTIME_IMAGE=reveille-base:local
    "$here/make-base-image.sh" "$RUNTIME_IMAGE"
fi
export RUNTIME_IMAGE
# Any free port of this machine, and no settings inherited from another testbed.
export REVEILLE_PORT='' REVEILLE_SET='' REVEILLE_PACE=max REVEILLE_ON_LOSS=end REVEILLE_JOIN_TIMEOUT=2min
say "packing $binary into $image"
log=$("$here/build-prebuilt.sh" "$image" "$binary" 2>&1) || {
    printf '%s\n' "$log" >&2
    fail "the image could not be built"
}

say "running $REVEILLE_DEVICES devices, $REVEILLE_TTIS TTIs as project $project"
start=$(date +%s)
code=0
# In the background, so that this script reacts to a signal immediately.
timeout --kill-after=60 "${TESTBED_TIMEOUT:-600}" \
    "$@" up --no-build --no-color --scale device=5 --exit-code-from bs &
running=$!
wait "$running" || code=$?
running=
took=$(($(date +%s) - start))
if [ "$code" -ne 0 ]; then
    compose ps -a >&2 || true
    [ "$code" -ne 124 ] || fail "no end after ${TESTBED_TIMEOUT:-600} s"
    fail "exit code $code after $took s (the base station's, unless compose itself failed)"
fi

summary=$(docker run --rm --network none --volume "${project}_results:/results:ro" \
    --entrypoint cat "$image" "/results/$REVEILLE_RUN/summary.json") ||
    fail "no $REVEILLE_RUN/summary.json in the results volume"
digest=$(printf '%s\n' "$summary" |
    sed -n 's/.*"digest"[[:space:]]*:[[:space:]]*"\([^"]*\)".*/\1/p' | head -n 1)
[ -n "$digest" ] || fail "summary.json has no digest"
say "digest $digest"
[ -z "$expected" ] || [ "$digest" = "$expected" ] || fail "the digest should be $expected"
say "passed in $took s"
