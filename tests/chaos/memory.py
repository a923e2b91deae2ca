"""Checks that the memory of a base station and of device processes does not grow over a long run."""

import math
import shutil
import tempfile
import time
from pathlib import Path

import bus_runs
import subprocesses
import scenario
from subprocesses import Failure, Ground

TTIS = 1_000_000
# The share of the run that counts as warm-up, in which tables and buffers fill.
WARM = 0.1
# Number of blocks whose means are fitted. They depend less on each other than neighbouring samples do.
BLOCKS = 20
# Student's t for 95 % and BLOCKS − 2 degrees of freedom.
T_95 = 2.101
EVERY = 0.2
# kB per 10^6 TTIs: a slope whose whole interval lies above this is a leak.
ALLOWED = 500


def resident(pid):
    """Returns the resident memory in kB, or None if the process has ended."""
    try:
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1])
    except OSError:
        pass
    return None


def slope(points):
    """Returns the least-squares slope of y over x over block means, with the half-width of its 95 % interval."""
    size = len(points) / BLOCKS
    if size < 2:
        raise Failure(f"only {len(points)} samples")
    blocks = [points[round(b * size) : round((b + 1) * size)] for b in range(BLOCKS)]
    means = [(sum(x for x, _ in block) / len(block), sum(y for _, y in block) / len(block)) for block in blocks]
    mean_x, mean_y = (sum(values) / BLOCKS for values in zip(*means))
    squares = sum((x - mean_x) ** 2 for x, _ in means)
    rise = sum((x - mean_x) * (y - mean_y) for x, y in means) / squares
    rest = sum((y - mean_y - rise * (x - mean_x)) ** 2 for x, y in means)
    return rise, T_95 * math.sqrt(rest / (BLOCKS - 2) / squares)


def measure(args, policy, ttis):
    """Measures one run. Returns whether it passed."""
    folder = Path(tempfile.mkdtemp(prefix="chaos-")).resolve()
    ground = Ground(args.reveille, folder, 3600)
    # Pace 0: no pacing.
    played = scenario.Scenario(policy, 50, ttis, 1, 0)
    samples, failed = {}, False
    try:
        game = bus_runs.Up(ground, played, f"chaos-{folder.name}", 4)
        game.window = ttis // 1000
        game.begin()
        while game.station.poll() is None:
            at = game.mark()
            if at:
                processes = [("base station", game.station.pid)]
                processes += [(f"device process {i}", pid) for i, pid in enumerate(game.hosts())]
                for name, pid in processes:
                    if kilobytes := resident(pid):
                        samples.setdefault(name, []).append((at, kilobytes))
            time.sleep(EVERY)
        summary = game.finish()
        expected = subprocesses.oracle(args.reveille, played, folder)
        if summary["digest"] != expected:
            raise Failure(f"the digest is {summary['digest']} instead of {expected}")
    except Failure as failure:
        failed = True
        print(f"{policy}: FAILED: {failure}\n    files: {folder}", flush=True)
        return False
    finally:
        ground.close()
        if not failed:
            shutil.rmtree(folder, ignore_errors=True)
    rate = summary["timing"]["ttis_per_s"]
    print(f"{policy}: {ttis} TTIs at {rate:.0f} TTI/s, digest equal; slope after the first {WARM:.0%} of the run:")
    is_flat = True
    for name, points in samples.items():
        kept = [point for point in points if point[0] >= WARM * ttis]
        try:
            rise, half = slope(kept)
        except Failure as failure:
            print(f"    {name}: FAILED: {failure}")
            is_flat = False
            continue
        # kB per 10^6 TTIs.
        rise, half = rise * 1e6, half * 1e6
        fifths = [kept[len(kept) * fifth // 5][1] for fifth in range(5)] + [kept[-1][1]]
        print(
            f"    {name}: {rise:+.0f} ± {half:.0f} kB per 10^6 TTIs ({len(kept)} samples); "
            f"{', '.join(map(str, fifths))} kB",
            flush=True,
        )
        if rise - half > ALLOWED:
            print(f"    {name}: FAILED: more than {ALLOWED} kB per 10^6 TTIs")
            is_flat = False
    return is_flat


def check(args):
    """Measures runs of 10^6 TTIs, or of `--runs` TTIs. Returns whether all passed."""
    chosen = args.only.split(",") if args.only else ["knn", "q-learning"]
    ttis = args.runs if args.runs is not None else TTIS
    return all([measure(args, policy, ttis) for policy in chosen])
