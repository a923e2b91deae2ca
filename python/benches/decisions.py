"""Decisions per second: through the package, the same actions in Rust, and a plain NumPy environment.

    python benches/decisions.py [--seconds 1.0] [--envs 1 64 256] [--devices 20 250] [--threads 2]

Each of `--rounds` rounds measures all three in turn; the table shows medians and their ratio. Absolute rates depend on
the machine and its load, ratios much less. "Rust" is the compiled batch with the same actions and arrays, without the
Python package around it. The NumPy environment is a typical handwritten one: batteries, harvests, events and the stage
0 reward for all environments together, without reports, wake-ups, beliefs or records.
"""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np
from reveille import _native
from reveille.scenario import overrides
from reveille.vector import ReveilleVectorEnv


class Plain:
    """Stage 0 of K environments of N devices, in NumPy."""

    def __init__(self, k: int, n: int, seed: int = 0) -> None:
        self.random = np.random.default_rng(seed)
        self.k, self.n = k, n
        self.positions = self.random.random((k, n, 2)) * 20
        self.levels = np.full((k, n), 50.0)
        self.since = np.zeros((k, n))

    def step(self, actions: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Plays a TTI in all environments."""
        on = actions.astype(bool)
        arrivals = self.random.random((self.k, self.n)) < 0.0905
        self.levels = np.minimum(self.levels + 5.0 * arrivals, 100.0)
        cost = np.where(on, 1.0, 1 / 14)
        able = self.levels >= cost
        self.levels = np.where(able, self.levels - cost, 0.0)
        event = self.random.random(self.k) < 0.2
        place = self.random.random((self.k, 1, 2)) * 20
        distance = np.sqrt(((self.positions - place) ** 2).sum(axis=2))
        hears = on & able & (distance <= 4.0) & event[:, None] & (self.levels >= 10.0)
        self.levels = self.levels - 10.0 * hears
        information = np.where(hears, np.exp(-distance), 0.0).max(axis=1)
        self.since = np.where(on, 0.0, self.since + 1.0)
        missed = event & ~hears.any(axis=1)
        reward = 1.0 - on.mean(axis=1) - 14.0 * 0.2 * missed
        seen = np.stack([self.positions[..., 0] / 20, self.positions[..., 1] / 20, self.levels / 100, self.since], axis=2)
        return {"device": seen.astype(np.float32), "information": information}, reward


def rate(step, decisions: int, seconds: float) -> float:
    """Returns decisions per second of ``step``, which makes ``decisions`` decisions."""
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        for _ in range(4):
            step()
        count += 4
    return count * decisions / (time.perf_counter() - start)


def measure(k: int, n: int, threads: int, seconds: float, rounds: int) -> dict[str, float]:
    """Measures K environments of N devices and returns the medians."""
    random = np.random.default_rng(1)
    share = 0.1
    actions = [(random.random((k, n)) < share).astype(np.int8) for _ in range(64)]
    settings = {"devices": n, "ttis": 10**6, "battery_knowledge": "reported"}
    env = ReveilleVectorEnv(num_envs=k, threads=threads, copy=False, **settings)
    env.reset(seed=1)
    batch = _native.Batch("paper", overrides(None, **settings), list(range(1, k + 1)), threads, 14.0, 1.0)
    rests = np.zeros(k, dtype=bool)
    plain = Plain(k, n)
    turns = {"python": [0], "rust": [0], "numpy": [0]}

    def following(name: str) -> np.ndarray:
        turns[name][0] += 1
        return actions[turns[name][0] % len(actions)]

    steps = {
        "python": lambda: env.step(following("python")),
        "rust": lambda: batch.step(following("rust"), rests),
        "numpy": lambda: plain.step(following("numpy")),
    }
    for step in steps.values():
        rate(step, k, seconds / 5)
    found: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(rounds):
        for name, step in steps.items():
            found[name].append(rate(step, k, seconds))
    return {name: statistics.median(rates) for name, rates in found.items()}


def main() -> None:
    """Prints a row for each combination of sizes."""
    parser = argparse.ArgumentParser(description="Decisions per second.")
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--envs", type=int, nargs="+", default=[1, 64, 256])
    parser.add_argument("--devices", type=int, nargs="+", default=[20, 250])
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    print("| N | environments | Python | Rust | NumPy | Python / Rust | Python / NumPy |")
    print("|---|---|---|---|---|---|---|")
    for n in args.devices:
        for k in args.envs:
            told = measure(k, n, args.threads, args.seconds, args.rounds)
            python, rust, numpy = told["python"], told["rust"], told["numpy"]
            row = f"{python:,.0f} | {rust:,.0f} | {numpy:,.0f} | {python / rust:.2f} | {python / numpy:.2f}"
            print(f"| {n} | {k} | {row} |", flush=True)


if __name__ == "__main__":
    main()
