#!/usr/bin/env bash
# Runs the evaluation of the decision transformer in docs/dt.md, on seeds absent from its recordings, and prints tables.
#
#   cargo build --release
#   deploy/examples/judge-dt.sh target/release/reveille FOLDER [RUNS]
#
# 200 runs a point take about half an hour on two cores. An interrupted sweep resumes where it stopped.
set -euo pipefail
reveille=$(realpath "${1:?the program}")
folder=${2:?a folder for the sweeps}
runs=${3:-200}
few=$((runs < 40 ? runs : 40))
here=$(dirname "$(realpath "$0")")
mkdir -p "$folder"
cd "$folder"

sweep() { # NAME RUNS OPTIONS...
    local out="$1" seeds="$2"
    shift 2
    [ -e "$out/results.csv" ] ||
        "$reveille" sweep --seeds "$seeds" --first-seed 7001 --quiet --format csv --out "$out" "$@" >/dev/null
}

prices=policy.age-index.price=0.05,0.1,0.2,0.35,0.6,1,1.5,2,3,5,8
for layout in jittered uniform; do
    at=(--set "layout.kind=$([ "$layout" = uniform ] && echo uniform || echo jittered-grid)")
    # Compared with genie, knn and q-learning.
    sweep "claims-$layout-dt" "$runs" -p dt,genie -n 250 -k 2000 --set policy.dt.price=0.35 "${at[@]}"
    sweep "claims-$layout-knn" "$runs" -p knn -n 250 -k 2000 --grid bs.ranking=p42,posterior "${at[@]}"
    sweep "learning-$layout-windows" "$runs" -p q-learning -n 50,100,250 -k 2000 --grid policy.q-learning.window=1,2,4 \
        --grid bs.ranking=p42,posterior "${at[@]}"
    sweep "learning-$layout-ages" "$runs" -p q-learning -n 50,100,250 -k 2000 --set policy.q-learning.ages=true \
        --grid bs.ranking=p42,posterior "${at[@]}"
    # Compared with age-index.
    for events in uniform bursts aftershocks hot-spots; do
        among=("${at[@]}" --set "events.process=$events" -n 50,100,250 -k 2000)
        sweep "families-$layout-$events-dt" "$runs" -p dt --grid policy.dt.price=0.1,0.35,1 "${among[@]}"
        sweep "families-$layout-$events-age" "$runs" -p age-index --grid "$prices" "${among[@]}"
    done
done
# The target return, and the fixed prices for comparison.
for n in 50 250; do
    sweep "target-$n-dt" "$few" -p dt -n "$n" -k 1200 --grid policy.dt.target=0.1,0.2,0.3,0.4,0.5,0.6,0.7,0.8,0.9
    sweep "target-$n-price" "$few" -p dt -n "$n" -k 1200 --grid policy.dt.price=0.1,0.35,1,2
done
# Numbers of devices and layouts unseen in training.
for layout in uniform poisson-disk hex; do
    for events in uniform bursts; do
        among=(--set "layout.kind=$layout" --set "events.process=$events" -n 30,150,400 -k 1500)
        sweep "unseen-$layout-$events-dt" "$few" -p dt --set policy.dt.price=0.35 "${among[@]}"
        sweep "unseen-$layout-$events-age" "$few" -p age-index --grid "$prices" "${among[@]}"
    done
done
# Other models, for comparison with the shipped one: `FOLDER/models/*.safetensors`.
for model in models/*.safetensors; do
    [ -e "$model" ] || continue
    name=$(basename "$model" .safetensors)
    for events in uniform bursts aftershocks; do
        sweep "ablation-$name-$events-dt" "$few" -p dt --set "policy.dt.model=$model" --set policy.dt.price=1 \
            --set "events.process=$events" -n 50,250 -k 2000
        # Imitating models use less energy than age-index at any of our prices, so higher prices are added.
        sweep "ablation-age-$events" "$few" -p age-index --grid "$prices,16,32" --set "events.process=$events" -n 50,250 -k 2000
    done
done
python3 "$here/judge_dt.py" .
