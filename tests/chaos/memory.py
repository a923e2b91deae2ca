"""Checks that the memory of a base station and of device processes does not grow over a long run."""

import math
import shutil
import tempfile
import time
from pathlib import Path

import bus_runs
import subprocesses
import scenario
from subprocesses import Failure, Workspace

TTIS = 1_000_000
# The share of the run that counts as warm-up, in which tables and buffers fill.
WARM_UP_SHARE = 0.1
# Number of blocks whose means are fitted. They depend less on each other than neighbouring samples do.
BLOCKS = 20
# Student's t for 95 % and BLOCKS − 2 degrees of freedom.
T_95 = 2.101
# Seconds between two samples.
SAMPLE_INTERVAL = 0.2
# kB per 10^6 TTIs: a slope whose confidence interval lies above this is a leak.
MAX_SLOPE = 500


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
    gradient = sum((x - mean_x) * (y - mean_y) for x, y in means) / squares
    residuals = sum((y - mean_y - gradient * (x - mean_x)) ** 2 for x, y in means)
    return gradient, T_95 * math.sqrt(residuals / (BLOCKS - 2) / squares)


def measure(args, policy, ttis):
    """Measures one run. Returns whether it passed."""
    folder = Path(tempfile.mkdtemp(prefix="chaos-")).resolve()
    workspace = Workspace(args.reveille, folder, 3600)
    # Pace 0: no pacing.
    drawn = scenario.Scenario(policy, 50, ttis, 1, 0)
    samples, failed = {}, False
    try:
        bus_run = bus_runs.UpRun(workspace, drawn, f"chaos-{folder.name}", 4)
        bus_run.window = ttis // 1000
        bus_run.begin()
        while bus_run.base_station.poll() is None:
            tti = bus_run.mark_tti()
            if tti:
                processes = [("base station", bus_run.base_station.pid)]
                processes += [(f"device process {i}", pid) for i, pid in enumerate(bus_run.hosts())]
                for name, pid in processes:
                    if kilobytes := resident(pid):
                        samples.setdefault(name, []).append((tti, kilobytes))
            time.sleep(SAMPLE_INTERVAL)
        summary = bus_run.finish()
        expected = subprocesses.digest_in_memory(args.reveille, drawn, folder)
        if summary["digest"] != expected:
            raise Failure(f"the digest is {summary['digest']} instead of {expected}")
    except Failure as failure:
        failed = True
        print(f"{policy}: FAILED: {failure}\n    files: {folder}", flush=True)
        return False
    finally:
        workspace.close()
        if not failed:
            shutil.rmtree(folder, ignore_errors=True)
    rate = summary["timing"]["ttis_per_s"]
    print(f"{policy}: {ttis} TTIs at {rate:.0f} TTI/s, digest equal; slope after the first {WARM_UP_SHARE:.0%} of the run:")
    is_flat = True
    for name, points in samples.items():
        kept = [point for point in points if point[0] >= WARM_UP_SHARE * ttis]
        try:
            gradient, half_width = slope(kept)
        except Failure as failure:
            print(f"    {name}: FAILED: {failure}")
            is_flat = False
            continue
        # kB per 10^6 TTIs.
        gradient, half_width = gradient * 1e6, half_width * 1e6
        fifths = [kept[len(kept) * fifth // 5][1] for fifth in range(5)] + [kept[-1][1]]
        print(
            f"    {name}: {gradient:+.0f} ± {half_width:.0f} kB per 10^6 TTIs ({len(kept)} samples); "
            f"{', '.join(map(str, fifths))} kB",
            flush=True,
        )
        if gradient - half_width > MAX_SLOPE:
            print(f"    {name}: FAILED: more than {MAX_SLOPE} kB per 10^6 TTIs")
            is_flat = False
    return is_flat


def check(args):
    """Measures runs of 10^6 TTIs, or of `--runs` TTIs. Returns whether all passed."""
    chosen = args.only.split(",") if args.only else ["knn", "q-learning"]
    ttis = args.runs if args.runs is not None else TTIS
    return all([measure(args, policy, ttis) for policy in chosen])
