#!/usr/bin/env bash
# Records data and trains a decision transformer like the shipped one. The first training uses recordings of teachers
# (age-index at four prices, knn and q-learning); the second adds recordings of the first model.
#
#   cargo build --release --features train-dt
#   deploy/examples/train-dt.sh target/release/reveille FOLDER
#
# An interrupted run of this script resumes where it stopped. It needs some 3 GB of disk and 10 GB of memory. On two
# cores each of the two sets of recordings takes five minutes, the first training two minutes and the second five.
set -euo pipefail
reveille=$(realpath "${1:?the program}")
folder=${2:?a folder for recordings and models}
# A recording names the path of the model that decided. A path relative to the folder is the same everywhere, and so the
# recording has the same bytes.
mkdir -p "$folder"
cd "$folder"

# Families of events, each with a setting that is varied.
families=(
    "uniform events.alpha=0.1,0.2,0.4"
    "bursts events.bursts.busy_ttis=20,40,80"
    "aftershocks events.aftershocks.radius=1.5,2,3"
    "hot-spots events.hot-spots.places=1,3,6"
)

record() { # NAME OPTIONS...
    local out="$1.parquet"
    shift
    [ -e "$out" ] || "$reveille" train record --set ttis=1800 --chunk 24 --stride 150 --true-batteries --quiet "$@" --out "$out"
}

train() { # NAME SEED STEPS PATIENCE
    local out="$1.safetensors"
    [ -e "$out" ] || "$reveille" train dt *.parquet --steps "$3" --rate 0.003 --patience "$4" --seed "$2" --out "$out"
}

thousand=0
for family in "${families[@]}"; do
    read -r process varied <<<"$family"
    thousand=$((thousand + 1000))
    for size in 250:5 100:8 50:12 20:12; do
        n=${size%:*} seeds=${size#*:}
        record "$process-$n-age" -p age-index -n "$n" --set "events.process=$process" --grid "$varied" \
            --grid policy.age-index.price=0.1,0.35,1,2 --first-seed $((thousand + 1)) --seeds "$seeds"
        record "$process-$n-other" -p knn,q-learning -n "$n" --set "events.process=$process" \
            --first-seed $((thousand + 501)) --seeds "$seeds" --explore 0,0.1
    done
done
train teachers 2 4000 6
thousand=0
for family in "${families[@]}"; do
    read -r process varied <<<"$family"
    thousand=$((thousand + 1000))
    for size in 250:4 100:6 50:10 20:10; do
        n=${size%:*} seeds=${size#*:}
        record "$process-$n-dt" -p dt -n "$n" --set "policy.dt.model=teachers.safetensors" \
            --set "events.process=$process" --grid "$varied" --grid policy.dt.price=0.1,0.35,1,2 \
            --first-seed $((thousand + 701)) --seeds "$seeds"
    done
done
# A narrow model needs many steps: with this patience it takes all of them.
train model 3 12000 60
