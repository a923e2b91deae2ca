#!/usr/bin/env python3
"""Prints the tables of docs/dt.md from the sweeps of judge-dt.sh: `python judge_dt.py FOLDER`. Needs only Python.

Each `dt` run is compared, on its seed, with the line through the points (energy, P1) of another policy, without points
that a cheaper one beats; above its energies, with its largest P1. Differences have 95 % intervals over seeds.
"""

import csv
import sys
from collections import defaultdict
from pathlib import Path
from statistics import fmean, stdev

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
PRICE = "policy.dt.price"


def rows(name):
    """Returns the runs of the sweep `name`, as dictionaries of text."""
    with open(FOLDER / name / "results.csv", newline="") as table:
        return list(csv.DictReader(table))


def interval(values):
    """Returns half of the 95 % interval of the mean of `values`."""
    count = len(values)
    return (1.96 + 2.4 / (count - 1)) * stdev(values) / count**0.5 if count > 1 else float("nan")


def column(runs, metric):
    """Returns `metric` for the runs in which it is defined."""
    return [float(run[metric]) for run in runs if run[metric] != ""]


def mean(runs, metric):
    return fmean(column(runs, metric))


def with_interval(values, digits=4):
    return f"{fmean(values):.{digits}f} ± {interval(values):.{digits}f}"


def line_at(points, energy):
    """Returns P1 at `energy` on the line through `points`, without beaten ones; None below their energies.

    Above them it is the largest P1, which the other policy reaches with less energy.
    """
    front = []
    for cost, found in sorted(points):
        if not front or found > front[-1][1]:
            front.append((cost, found))
    for (left, low), (right, high) in zip(front, front[1:]):
        if left <= energy <= right:
            return low + (high - low) * (energy - left) / (right - left)
    return front[-1][1] if energy >= front[-1][0] else None


def difference_cells(ours, theirs):
    """Formats the last cells of a row: P1 difference at equal energy, and the number of runs outside the line."""
    points = defaultdict(list)
    for run in theirs:
        points[run["seed"]].append((float(run["energy_per_device_tti"]), float(run["info_p1"])))
    differences, lines = [], []
    for run in ours:
        line = line_at(points[run["seed"]], float(run["energy_per_device_tti"]))
        if line is not None:
            differences.append(float(run["info_p1"]) - line)
            lines.append(line)
    # A mean over few runs would not be about the same worlds as the other cells of the row.
    if 2 * len(differences) < len(ours):
        return f"| outside the energies of the line in {len(ours) - len(differences)} of {len(ours)} runs | |"
    share, width = 100 * fmean(differences) / fmean(lines), 100 * interval(differences) / fmean(lines)
    left = len(ours) - len(differences)
    note = f", {left} run{'s' if left > 1 else ''} outside" if left else ""
    difference = f"{fmean(differences):+.4f} ± {interval(differences):.4f}"
    return f"| {fmean(lines):.3f} | {difference} ({share:+.1f} ± {width:.1f} %{note}) |"


def by(runs, *fields):
    """Groups runs by equal `fields`, in order of first appearance."""
    groups = defaultdict(list)
    for run in runs:
        groups[tuple(run[field] for field in fields)].append(run)
    return groups


def point(runs):
    return f"{mean(runs, 'info_p1'):.3f} | {mean(runs, 'energy_per_device_tti'):.3f}"


def heading(title, *names):
    print(f"\n{title}\n")
    print("| " + " | ".join(names) + " |")
    print("|" + "---|" * len(names))


def claims(layout):
    names = ["policy", "P1", "share of genie", "energy", "missed, %", "wrong per event", "runs"]
    heading(f"Claims, N = 250, {layout}", *names)
    all_runs = by(rows(f"claims-{layout}-dt"), "policy")
    all_runs.update(by(rows(f"claims-{layout}-knn"), "policy", "bs.ranking"))
    learning = [run for run in rows(f"learning-{layout}-windows") if run["n"] == "250"]
    all_runs.update(by(learning, "policy", "policy.q-learning.window", "bs.ranking"))
    best = {run["seed"]: float(run["info_p1"]) for run in all_runs[("genie",)]}
    for name, runs in all_runs.items():
        share = [float(run["info_p1"]) / best[run["seed"]] for run in runs]
        print(
            f"| {' '.join(name)} | {with_interval(column(runs, 'info_p1'))} | {with_interval(share)} "
            f"| {with_interval(column(runs, 'energy_per_device_tti'))} | {mean(runs, 'misdetection_pct'):.4f} "
            f"| {mean(runs, 'wrong_activations_per_event'):.3f} | {len(runs)} |"
        )


def learned(layout):
    names = ["ranking", "N", "price", "P1", "energy", "P1 on the line", "difference"]
    heading(f"Compared with the line of q-learning, {layout}", *names)
    lines = rows(f"learning-{layout}-windows") + rows(f"learning-{layout}-ages")
    for (ranking, n), theirs in by(lines, "bs.ranking", "n").items():
        ours = [run for run in rows(f"families-{layout}-uniform-dt") if run["n"] == n]
        for (price,), runs in by(ours, PRICE).items():
            print(f"| {ranking} | {n} | {price} | {point(runs)} {difference_cells(runs, theirs)}")


def families(layout):
    names = ["events", "N", "price", "P1", "energy", "P1 of age-index", "difference"]
    heading(f"Compared with age-index, {layout}", *names)
    for events in ["uniform", "bursts", "aftershocks", "hot-spots"]:
        theirs = by(rows(f"families-{layout}-{events}-age"), "n")
        for (n, price), runs in by(rows(f"families-{layout}-{events}-dt"), "n", PRICE).items():
            print(f"| {events} | {n} | {price} | {point(runs)} {difference_cells(runs, theirs[(n,)])}")


def targets(n):
    heading(f"Target return, N = {n}", "target", "P1", "energy", "P1 of fixed prices", "difference")
    prices = rows(f"target-{n}-price")
    for (target,), runs in by(rows(f"target-{n}-dt"), "policy.dt.target").items():
        print(f"| {target} | {point(runs)} {difference_cells(runs, prices)}")


def unseen():
    names = ["events", "layout", "N", "P1", "energy", "P1 of age-index", "difference"]
    heading("Settings unseen in training, price 0.35", *names)
    for events in ["uniform", "bursts"]:
        for layout in ["uniform", "poisson-disk", "hex"]:
            theirs = by(rows(f"unseen-{layout}-{events}-age"), "n")
            for (n,), runs in by(rows(f"unseen-{layout}-{events}-dt"), "n").items():
                print(f"| {events} | {layout} | {n} | {point(runs)} {difference_cells(runs, theirs[(n,)])}")


def ablations():
    models = sorted({path.name.rsplit("-", 2)[0] for path in FOLDER.glob("ablation-*-dt")})
    if not models:
        return
    heading("Custom models, price 1", "model", "events", "N", "P1", "energy", "P1 of age-index", "difference")
    for model in models:
        for events in ["uniform", "bursts", "aftershocks"]:
            theirs = by(rows(f"ablation-age-{events}"), "n")
            for (n,), runs in by(rows(f"{model}-{events}-dt"), "n").items():
                difference = difference_cells(runs, theirs[(n,)])
                print(f"| {model.removeprefix('ablation-')} | {events} | {n} | {point(runs)} {difference}")


for layout in ["jittered", "uniform"]:
    claims(layout)
    learned(layout)
    families(layout)
for n in ["50", "250"]:
    targets(n)
unseen()
ablations()
