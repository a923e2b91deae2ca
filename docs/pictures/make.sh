#!/usr/bin/env bash
# Draws the pictures of the README: an event of a run, and information per event against the number of devices.
#
# usage: docs/pictures/make.sh [REVEILLE [FOLDER [TTIS]]]
#   REVEILLE  the program (target/release/reveille)
#   FOLDER    where run.svg and result.svg go (the folder of this script)
#   TTIS      length of each run (4000); the pictures of the README have this length
set -euo pipefail

reveille=${1:-target/release/reveille}
folder=${2:-$(dirname "$0")}
ttis=${3:-4000}
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

"$reveille" figures deployment --policy knn --devices 50 --ttis "$ttis" --format svg --out "$scratch/run"
"$reveille" sweep --policies knn,adjusted,random,genie --devices 10,50,100,150,200,250 --ttis "$ttis" --seeds 8 \
  --quiet --out "$scratch/sweep"
"$reveille" figures --only information --format svg --out "$scratch/result" "$scratch/sweep"

# Pages with a dark background show them too, so they get a white one of their own.
mkdir -p "$folder"
for picture in run result; do
  sed 's|^<defs>$|<rect width="100%" height="100%" fill="#fff"/>\n<defs>|' "$scratch/$picture"/*.svg > "$folder/$picture.svg"
done
