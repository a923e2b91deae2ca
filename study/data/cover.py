"""Computes the least number of devices that cover the whole area at the same time, with discs of radius d_max.

    pip install scipy==1.17.1
    python study/data/cover.py reveille > study/data/cover.csv

The discs of as few devices as possible must cover the area within d_max of any device. The discs cut the area into
faces, each covered by one set of devices. A selection of devices covers the area if it contains a device of each such
set. The faces are found by sampling around every corner of the arrangement: crossings of two circles, crossings of a
circle with the border, and the corners of the area. Sets that contain another set are redundant and left out. HiGHS
(scipy.optimize.milp) solves the remaining set cover to optimality, or until the time limit; then the proven lower bound
counts.

`reach` is the share of the area within d_max of some device, from a grid of 800 x 800 points.

The positions are the positions of `reveille run` with the same seed.
"""

import csv
import math
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csr_array

SIDE, D_MAX = 20.0, 4.0
LAYOUTS = ["jittered-grid", "uniform"]
SIZES = [10, 20, 40, 50, 60, 80, 100, 130, 160, 200, 250]
SEEDS = range(1, 5)
SECONDS = 60.0
# Distance of the sampled points from a corner of the arrangement, m.
OFFSET = 1e-7


def positions(program, layout, devices, seed):
    """Returns the positions of a deployment, m, an array of N rows."""
    with tempfile.TemporaryDirectory() as folder:
        command = [program, "run", "--set", f"layout.kind={layout}", "--devices", str(devices), "--seed", str(seed)]
        command += ["--policy", "random", "--ttis", "2", "--out", folder, "--quiet"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        with open(Path(folder) / "devices.csv", newline="") as file:
            return np.array([[float(row["x_m"]), float(row["y_m"])] for row in csv.DictReader(file)])


def corners(at):
    """Returns points next to every corner of the arrangement of discs and area, m: one in each face with a corner."""
    found = [np.array([[x, y] for x in (0.0, SIDE) for y in (0.0, SIDE)])]
    for i in range(len(at)):
        apart = at[i + 1 :] - at[i]
        distance = np.hypot(apart[:, 0], apart[:, 1])
        near = (distance > 0) & (distance < 2 * D_MAX)
        apart, distance = apart[near], distance[near]
        middle = at[i] + apart / 2
        across = np.stack([-apart[:, 1], apart[:, 0]], axis=1) / distance[:, None]
        height = np.sqrt(D_MAX**2 - distance**2 / 4)[:, None]
        found += [middle + height * across, middle - height * across]
        for axis in (0, 1):
            for border in (0.0, SIDE):
                rest = D_MAX**2 - (border - at[i, axis]) ** 2
                for sign in (-1, 1) if rest > 0 else ():
                    point = at[i].copy()
                    point[axis], point[1 - axis] = border, at[i, 1 - axis] + sign * math.sqrt(rest)
                    found.append(point[None, :])
    found = np.concatenate(found)
    turns = [OFFSET * np.array([math.cos(a), math.sin(a)]) for a in np.arange(24) * (2 * math.pi / 24) + 0.1]
    # A disc without any corner is a separate face around its device.
    points = np.concatenate([found + turn for turn in turns] + [at])
    return points[((points > 0) & (points < SIDE)).all(axis=1)]


def sets(at):
    """Returns the sets of devices that cover a face and contain no other such set, as rows of a boolean matrix."""
    points = corners(at)
    rows = set()
    for part in np.array_split(points, max(1, len(points) // 20000)):
        seen = ((part[:, None, :] - at[None, :, :]) ** 2).sum(axis=2) < D_MAX**2
        rows.update(row.tobytes() for row in np.packbits(np.unique(seen, axis=0), axis=1))
    rows = np.array([np.frombuffer(row, dtype=np.uint8) for row in rows])
    rows = np.unpackbits(rows, axis=1, count=len(at)).astype(bool)
    rows = rows[np.argsort(rows.sum(axis=1), kind="stable")]
    rows = rows[rows.any(axis=1)]
    kept = np.empty((0, len(at)), dtype=np.float32)
    sizes = np.empty(0)
    for row in rows:
        if not len(kept) or (kept @ row.astype(np.float32) < sizes).all():
            kept, sizes = np.concatenate([kept, row[None, :]]), np.append(sizes, row.sum())
    return kept


def cover(at):
    """Returns the proven lower bound on the least cover, and the size of the best cover found."""
    needed = csr_array(sets(at).astype(float))
    solved = milp(
        np.ones(len(at)),
        constraints=LinearConstraint(needed, lb=1),
        bounds=Bounds(0, 1),
        integrality=np.ones(len(at)),
        options={"time_limit": SECONDS, "mip_rel_gap": 0.0},
    )
    assert solved.x is not None, solved.message
    chosen = at[solved.x > 0.5]
    assert share(chosen) >= share(at) - 1e-12, "a face without a corner"
    return math.ceil(solved.mip_dual_bound - 1e-6), len(chosen)


def share(at):
    """Returns the share of the area within d_max of any device."""
    axis = (np.arange(800) + 0.5) * SIDE / 800
    x, y = np.meshgrid(axis, axis)
    seen = np.zeros_like(x, dtype=bool)
    for px, py in at:
        seen |= (x - px) ** 2 + (y - py) ** 2 < D_MAX**2
    return seen.mean()


def main(program):
    print("layout,devices,deployments,cover_at_least,cover_found,proven,reach", flush=True)
    for layout in LAYOUTS:
        for devices in SIZES:
            least, found, reach = [], [], []
            for seed in SEEDS:
                at = positions(program, layout, devices, seed)
                low, high = cover(at)
                least.append(low)
                found.append(high)
                reach.append(share(at))
            proven = sum(a == b for a, b in zip(least, found))
            means = [np.mean(values) for values in (least, found, reach)]
            numbers = f"{means[0]:.2f},{means[1]:.2f},{proven},{means[2]:.4f}"
            print(f"{layout},{devices},{len(least)},{numbers}", flush=True)


main(sys.argv[1])
