#!/usr/bin/env bash
# Instructions per device-TTI in memory, counted by callgrind: the same on every machine, however busy it is.
# Usage: deploy/bench/instructions.sh [POLICIES [DEVICES]], comma-separated lists. Needs valgrind.
#
# Each figure comes from two runs of different length, so that what a run costs once (start, deployment, clusters) drops
# out of "per device-TTI" and stands apart. callgrind shows a CPU without SHA instructions: the digest counts for more here
# than it does in time.
set -euo pipefail
cd "$(dirname "$0")/../.."
policies=${1:-knn,adjusted,random,genie}
devices=${2:-10,250,2500}
short=2000 long=6000 repeat=3 # `bench memory` runs each measurement three times
command -v valgrind >/dev/null || { echo "valgrind is not installed (Debian: apt-get install valgrind)" >&2; exit 1; }
cargo build --release --locked --quiet -p reveille-deploy
program=${CARGO_TARGET_DIR:-target}/release/reveille

count() { # policy, devices, TTIs
    valgrind --tool=callgrind --callgrind-out-file=/dev/null "$program" bench memory --keep-density \
        --policies "$1" --devices "$2" --ttis "$3" 2>&1 >/dev/null | sed -n 's/.*Collected : *\([0-9]*\).*/\1/p'
}

printf '%10s %8s %18s %18s\n' policy devices "per device-TTI" "set-up per device"
for policy in ${policies//,/ }; do
    for n in ${devices//,/ }; do
        a=$(count "$policy" "$n" "$short")
        b=$(count "$policy" "$n" "$long")
        awk -v a="$a" -v b="$b" -v s="$short" -v l="$long" -v n="$n" -v r="$repeat" -v p="$policy" 'BEGIN {
            per = (b - a) / (r * n * (l - s))
            printf "%10s %8d %18.1f %18.0f\n", p, n, per, (a / r - per * n * s) / n
        }'
    done
done
