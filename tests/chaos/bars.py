"""Fixed sets of cases, with figures to hold a release against."""

import random

import environment
import faults
import lifecycle
import memory
import outages
import scenario
from cases import Plan

# How many runs of each part.
KILLS = {"hosts": 100, "station": 30, "everything": 10}
CHECKS = {
    "lifecycle": lifecycle.check,
    "memory": memory.check,
    "environment": environment.check,
    "outages": outages.check,
}
BARS = ["kills", *CHECKS]
# What the runs of 50 devices are played with.
DEVICES, PROCESSES = 50, 10
# How long they last at the least.
SECONDS = 2.5


def kills(args):
    """Kills: of device processes, of base stations, of everything."""
    parts = args.only.split(",") if args.only else list(KILLS)
    seed = args.seed
    for part in parts:
        for _ in range(args.runs if args.runs is not None else KILLS[part]):
            yield killed(seed, part)
            seed += 1


def killed(seed, part):
    """A run of 50 devices in 10 processes with kills of one part."""
    chance = random.Random(f"{part} {seed}")
    policy = sorted(scenario.POLICIES)[seed % len(scenario.POLICIES)]
    drawn = scenario.draw(chance, SECONDS, policy, DEVICES, (2, 3))
    if part == "hosts":
        moments = sorted(chance.uniform(0.1, 0.9 * SECONDS) for _ in range(chance.randint(1, 5)))
        gaps = [after - before for before, after in zip([0, *moments], moments)]
        strikes = [faults.Fault("hosts", round(gap, 2), {"killed": 1, "within": 0}) for gap in gaps]
    else:
        strikes = [faults.Fault(part, round(chance.uniform(0.1, 0.9 * SECONDS), 2))]
    # Base stations by hand have device processes that outlive them; those of `up` do not.
    is_up = part == "hosts" or seed % 2 == 0
    return Plan(seed, drawn, is_up, PROCESSES, strikes, ["--audit", "on"])
