"""Fixed sets of cases, with target figures for a release."""

import random

import environment
import faults
import lifecycle
import memory
import outages
import scenario
from cases import Plan

# Number of runs of each part.
KILLS = {"hosts": 100, "station": 30, "everything": 10}
CHECKS = {
    "lifecycle": lifecycle.check,
    "memory": memory.check,
    "environment": environment.check,
    "outages": outages.check,
}
BARS = ["kills", *CHECKS]
# Devices and device processes of the kill runs.
DEVICES, PROCESSES = 50, 10
# The minimum length of a run, in seconds.
SECONDS = 2.5


def kills(args):
    """Draws runs with kills of device processes, of base stations, or of everything."""
    parts = args.only.split(",") if args.only else list(KILLS)
    seed = args.seed
    for part in parts:
        for _ in range(args.runs if args.runs is not None else KILLS[part]):
            yield draw_kills(seed, part)
            seed += 1


def draw_kills(seed, part):
    """Draws a run of 50 devices in 10 processes with kills of one part."""
    rng = random.Random(f"{part} {seed}")
    policy = sorted(scenario.POLICIES)[seed % len(scenario.POLICIES)]
    drawn = scenario.draw(rng, SECONDS, policy, DEVICES, (2, 3))
    if part == "hosts":
        moments = sorted(rng.uniform(0.1, 0.9 * SECONDS) for _ in range(rng.randint(1, 5)))
        gaps = [after - before for before, after in zip([0, *moments], moments)]
        drawn_faults = [faults.Fault("hosts", round(gap, 2), {"killed": 1, "within": 0}) for gap in gaps]
    else:
        drawn_faults = [faults.Fault(part, round(rng.uniform(0.1, 0.9 * SECONDS), 2))]
    # Only device processes started by hand outlive their base station.
    is_up = part == "hosts" or seed % 2 == 0
    return Plan(seed, drawn, is_up, PROCESSES, drawn_faults, ["--audit", "on"])
