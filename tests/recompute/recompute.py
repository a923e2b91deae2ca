#!/usr/bin/env python3
"""Recomputes the metrics of run folders from events.csv, devices.csv and scenario.toml alone, and compares them with
summary.json. Standard library only; Python 3.11 or later. Usage: recompute.py FOLDER...

It shares no code with the program: it follows the definitions in docs/results.md. Energies are added as whole
micro-units, so that sums by state must be exactly equal. Runs whose radio loses messages are not supported.
"""

import collections
import csv
import json
import math
import sys
import tomllib
from decimal import Decimal
from pathlib import Path

STATES = ("sensing", "sleep", "report")
TOLERANCE = 1e-9


def micro(text: str) -> int:
    """Units as written in a table, in whole micro-units."""
    scaled = Decimal(text) * 1_000_000
    assert scaled == int(scaled), f"{text}: not a whole number of micro-units"
    return int(scaled)


def ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def nearest_rank(values: list[int], percent: int) -> float:
    ordered = sorted(values)
    return ordered[-(-len(ordered) * percent // 100) - 1] if ordered else math.nan


def event_metrics(rows: list[dict[str, str]], alpha: float, ttis: int) -> dict[str, float]:
    counted = [row for row in rows if row["counted"] == "1"]
    reported = [row for row in counted if row["reports"] != "0"]
    delays = [int(row["last_tti"]) - int(row["start_tti"]) for row in reported]
    for row, delay in zip(reported, delays):
        assert int(row["delay_ttis"]) == delay, row
    assert all(row["delay_ttis"] == "" for row in counted if row["reports"] == "0"), "a missed event with a delay"

    def total(column: str) -> float:
        return math.fsum(float(row[column]) for row in counted)

    events = len(counted)
    return {
        "events": events,
        "info_p1": total("information") / (alpha * ttis),
        "info_per_event": ratio(total("information"), events),
        "detection_delay_ttis": ratio(sum(delays), len(delays)),
        "detection_delay_p95_ttis": nearest_rank(delays, 95),
        "misdetection_pct": ratio(100 * (events - len(reported)), events),
        "reports_per_event": ratio(total("reports"), events),
        "wake_ups_per_event": ratio(total("wake_ups"), events),
        "wrong_activations_per_event": ratio(total("wrong_activations"), events),
        "wasted_energy_per_event": ratio(total("wasted_units"), events),
    }


def count_causes(rows: list[dict[str, str]], devices: list[dict[str, str]], d_max: float) -> collections.Counter[str]:
    """Numbers of missed counted events by cause, where the radio loses nothing."""
    counts: collections.Counter[str] = collections.Counter()
    positions = [(float(device["x_m"]), float(device["y_m"])) for device in devices]
    for row in rows:
        epicentre = float(row["x_m"]), float(row["y_m"])
        distances = [math.dist(epicentre, position) for position in positions]
        assert math.isclose(float(row["nearest_m"]), min(distances), abs_tol=1e-9), row
        assert math.isclose(distances[int(row["nearest_device"])], min(distances), abs_tol=1e-9), row
        cause = row["miss_cause"]
        assert (cause == "") == (row["reports"] != "0"), row
        if cause:
            assert (cause == "out_of_reach") == (min(distances) > d_max), row
            # A device that detects an event and cannot report it is a wrong activation.
            assert (cause == "no_energy") == (row["wrong_activations"] != "0"), row
        if cause and row["counted"] == "1":
            counts[cause] += 1
    return counts


def device_metrics(rows: list[dict[str, str]], ttis: int) -> dict[str, float]:
    n = len(rows)
    spent = []
    for row in rows:
        by_state = [micro(row[f"{state}_units"]) for state in STATES]
        gained = micro(row["start_battery"]) + micro(row["harvested_units"])
        used = sum(by_state) + micro(row["overflow_units"]) + micro(row["final_battery"])
        assert gained == used, f"device {row['device']}: {gained} micro-units gained, {used} spent, lost or left"
        assert int(row["longest_outage_ttis"]) <= int(row["failed_ttis"]) + int(row["unpowered_ttis"]) <= ttis, row
        spent.append(sum(by_state))

    def units(column: str) -> float:
        return sum(micro(row[column]) for row in rows) / 1e6 / n / ttis

    def count(column: str) -> int:
        return sum(int(row[column]) for row in rows)

    return {
        "energy_per_device_tti": sum(spent) / 1e6 / n / ttis,
        **{f"energy_{state}_per_device_tti": units(f"{state}_units") for state in STATES},
        "fairness_energy": ratio(sum(spent) ** 2, n * sum(energy * energy for energy in spent)),
        "harvested_per_device_tti": units("harvested_units"),
        "net_per_device_tti": units("harvested_units") - sum(spent) / 1e6 / n / ttis,
        "overflow_per_device_tti": units("overflow_units"),
        "low_energy_pct": 100 * count("low_ttis") / n / ttis,
        "worst_low_energy_pct": 100 * max(int(row["low_ttis"]) for row in rows) / ttis,
        "failed_actions_pct": ratio(100 * count("failed_ttis"), count("sensing_ttis")),
        "unpowered_pct": 100 * count("unpowered_ttis") / n / ttis,
        "no_power_pct": 100 * (count("failed_ttis") + count("unpowered_ttis")) / n / ttis,
    }


def is_equal(printed: float | None, computed: float) -> bool:
    """Compares with a value of the summary, which has null for a metric without a value."""
    if printed is None or math.isnan(computed):
        return printed is None and math.isnan(computed)
    return abs(printed - computed) <= TOLERANCE * max(1.0, abs(computed))


def check(folder: Path) -> int:
    scenario = tomllib.loads((folder / "scenario.toml").read_text())
    summary = json.loads((folder / "summary.json").read_text())
    events = list(csv.DictReader((folder / "events.csv").open()))
    devices = list(csv.DictReader((folder / "devices.csv").open()))
    ttis = summary["ttis_done"] - math.floor(scenario["ttis"] * scenario["warm_up"])
    assert len(devices) == scenario["devices"], f"{len(devices)} rows for {scenario['devices']} devices"
    # The phases of bursts are drawn; the other processes have a constant α.
    is_drawn = scenario["events"].get("process", "uniform") == "bursts"
    alpha = summary["start_probability"] if is_drawn else scenario["events"]["alpha"]
    computed = event_metrics(events, alpha, ttis) | device_metrics(devices, ttis)
    spent = computed["energy_per_device_tti"] * len(devices) * ttis
    computed["info_per_energy"] = ratio(computed["info_p1"] * alpha * ttis, spent)
    differences = [
        f"{folder}: {name} is {summary['metrics'][name]} in the summary and {value} from the tables"
        for name, value in computed.items()
        if not is_equal(summary["metrics"][name], value)
    ]
    for column in ("reports", "wake_ups", "wrong_activations"):
        by_device = sum(int(row[column]) for row in devices)
        by_event = sum(int(row[column]) for row in events if row["counted"] == "1")
        if by_device != by_event:
            differences.append(f"{folder}: {by_device} {column} of devices, {by_event} of events")
    missed = dict(count_causes(events, devices, scenario["sensing"]["d_max"]))
    stated = {cause: count for cause, count in summary["totals"]["missed"].items() if count}
    if missed != stated:
        differences.append(f"{folder}: {stated} in the summary, and {missed} from the tables")
    for cause, count in summary["totals"]["missed"].items():
        share = ratio(100 * count, computed["events"])
        if not is_equal(summary["metrics"][f"missed_{cause}_pct"], share):
            differences.append(f"{folder}: missed_{cause}_pct is not {share}")
    # Sums by state equal the totals exactly.
    for state in STATES:
        from_table = sum(micro(row[f"{state}_units"]) for row in devices)
        total = summary["totals"]["energy"]["spent"][state]
        if from_table != total:
            differences.append(
                f"{folder}: energy spent on {state} is {total} in the summary and {from_table} from the table, micro-units"
            )
    print("\n".join(differences) if differences else f"{folder}: {len(computed)} metrics are the same")
    return len(differences)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    sys.exit(min(1, sum(check(Path(name)) for name in sys.argv[1:])))
