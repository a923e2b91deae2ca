"""Measures decisions per second over the policy port, in an environment, and of a built-in policy.

    python python/benches/port.py target/release/reveille [--devices 20 250] [--ttis 2000] [--rounds 3]

In all three, a third of the devices sense in turn and no device is woken, so the first two have the same digest.
Each round measures all three in order; the benchmark prints medians.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import reveille
from reveille.policy_client import PortError


def policy(observation: dict[str, Any]) -> np.ndarray:
    """Lets a third of the devices sense, in turn, and wakes no device."""
    n = len(observation["action_mask"])
    if observation["stage"] == 1:
        return np.zeros(n, np.int8)
    sensing = observation["device"][:, 4].argmax()
    return (np.arange(n) % 3 == (sensing + 1) % 3).astype(np.int8)


def stepped(devices: int, ttis: int) -> tuple[float, str]:
    """Returns decisions per second in an environment, and the digest."""
    env = reveille.make(devices=devices, ttis=ttis, battery_knowledge="reported")
    observation, _ = env.reset(seed=1)
    begun, decisions, ended = time.perf_counter(), 0, False
    while not ended:
        observation, _, _, ended, info = env.step(policy(observation))
        decisions += 1
    return decisions / (time.perf_counter() - begun), info["digest"]


def asked(program: str, devices: int, ttis: int, form: str) -> tuple[float, str]:
    """Returns decisions per second over the policy port in ``form``, and the digest."""
    with tempfile.TemporaryDirectory() as folder:
        command = [program, "up", "-p", "external", "-n", str(devices), "-k", str(ttis), "--seed", "1", "--json", "-q"]
        command += ["--set", "bs.battery_knowledge=reported", "-P", "1", "--run", f"bench-{form}", "--out", "out"]
        process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True)
        times: list[float] = []

        def timed(observation: dict[str, Any]) -> np.ndarray:
            times.append(time.perf_counter())
            return policy(observation)

        client = reveille.PolicyClient(timed, form=form)
        while True:
            try:
                client.serve(run=f"bench-{form}")
                break
            except PortError:
                time.sleep(0.02)
        summary = json.loads(process.communicate()[0])
        return (len(times) - 1) / (times[-1] - times[0]), summary["digest"]


def alone(program: str, devices: int, ttis: int) -> float:
    """Returns TTIs per second of the emulator with a built-in policy that decides in every TTI."""
    with tempfile.TemporaryDirectory() as folder:
        command = [program, "up", "-p", "age-index", "-n", str(devices), "-k", str(ttis), "--json", "-q", "-P", "1"]
        command += ["--set", "bs.battery_knowledge=reported", "--no-lookahead", "--out", "out"]
        told = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
        return json.loads(told.stdout)["timing"]["ttis_per_s"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", help="the program `reveille`")
    parser.add_argument("--devices", type=int, nargs="+", default=[20, 250])
    parser.add_argument("--ttis", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    program = str(Path(options.program).resolve())
    print("| N | environment | port, CBOR | port, JSON | age-index alone | CBOR / environment | CBOR / age-index |")
    print("|---|---|---|---|---|---|---|")
    for devices in options.devices:
        rounds = []
        for _ in range(options.rounds):
            (memory, digest), *bus = (
                stepped(devices, options.ttis),
                asked(program, devices, options.ttis, "cbor"),
                asked(program, devices, options.ttis, "json"),
            )
            assert all(other == digest for _, other in bus), "the same decisions are the same run"
            rounds.append((memory, *(rate for rate, _ in bus), alone(program, devices, options.ttis)))
        memory, cbor, plain, own = (statistics.median(column) for column in zip(*rounds, strict=True))
        rates = " | ".join(f"{rate:,.0f}".replace(",", " ") for rate in (memory, cbor, plain, own))
        print(f"| {devices} | {rates} | {cbor / memory:.2f} | {cbor / own:.2f} |")


if __name__ == "__main__":
    main()
