#!/usr/bin/env bash
# Draws the pictures of the README (an event of a run, information against the number of devices), of docs/age-index.md
# (information against energy), of docs/dt.md (attention of a decision, effect of a target return) and of docs/radio.md (policies
# against failing wake-ups).
#
# usage: docs/figures/make.sh [REVEILLE [FOLDER [TTIS [SEEDS]]]]
#   REVEILLE  the program (target/release/reveille)
#   FOLDER    where the pictures go (the folder of this script)
#   TTIS      length of each run (4000), a quarter of it for each target
#   SEEDS     runs of each point (8)
set -euo pipefail

reveille=${1:-target/release/reveille}
folder=${2:-$(dirname "$0")}
ttis=${3:-4000}
seeds=${4:-8}
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

"$reveille" figures deployment --policy knn --devices 50 --ttis "$ttis" --format svg --out "$scratch/run"
over_n=(--devices 10,50,100,150,200,250 --ttis "$ttis" --quiet)
policies=knn,adjusted,random,genie,q-learning,age-index,dt
"$reveille" sweep --policies "$policies" "${over_n[@]}" --seeds "$seeds" --out "$scratch/sweep"
"$reveille" figures --only information --format svg --out "$scratch/result" "$scratch/sweep"

trade() {
  "$reveille" sweep --devices 250 --ttis "$ttis" --seeds "$seeds" --quiet --out "$scratch/$1" "${@:2}"
}
trade prices --policies age-index --grid policy.age-index.price=0.1,0.2,0.35,0.7,1.2
trade windows --policies q-learning --grid policy.q-learning.window=1,2,4 --grid bs.ranking=p42,posterior
trade rankings --policies knn,adjusted --grid bs.ranking=p42,posterior
trade ends --policies genie,random
"$reveille" figures --only front --format svg --out "$scratch/front" "$scratch"/{prices,windows,rankings,ends}

"$reveille" figures attention --devices 100 --ttis "$ttis" --tti $((ttis - 100)) --set events.process=aftershocks \
  --format svg --out "$scratch/attention"

"$reveille" sweep --policies dt --devices 50,100 --ttis $((ttis / 4)) --seeds "$seeds" --quiet --out "$scratch/targets" \
  --grid policy.dt.target=0.1,0.3,0.5,0.7,0.9
for metric in info_p1 energy_per_device_tti; do
  "$reveille" figures sweep "$scratch/targets" --x policy.dt.target --y "$metric" --by devices --format svg \
    --out "$scratch/target-${metric%%_*}"
done

for fault in wake_latency wake_miss; do
  "$reveille" figures robustness --only "$fault" --ttis "$ttis" --seeds "$seeds" --set bs.sync_interval=100 \
    --format svg --out "$scratch/${fault/_/-}"
done

# A white background keeps the pictures readable on dark pages.
mkdir -p "$folder"
for picture in run result front attention target-info target-energy wake-latency wake-miss; do
  sed 's|^<defs>$|<rect width="100%" height="100%" fill="#fff"/>\n<defs>|' "$scratch/$picture"/*.svg > "$folder/$picture.svg"
done
