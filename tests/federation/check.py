#!/usr/bin/env python3
"""Runs on three machines with two routers, over links with delay and loss. Each must end with the digest of `reveille run`.

    tests/federation/check.py target/release/reveille [--measure]

            bs ── reveille bs                         a machine is a network namespace; `══` is a DelayedLink
          ╱╱  ╲╲
    left ╱╱    ╲╲ right
    router      router
    2 devices   2 devices                             a device process reaches only the router of its machine

`--measure` measures the speed with more delays and TTIs, as in docs/testbeds.md. Needs root and /dev/net/tun; without them it
prints `SKIPPED: …` and ends with 0. Only Python's standard library is needed.
"""

import argparse
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

# Leaves no cached bytecode behind.
sys.dont_write_bytecode = True
sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "chaos"))
import sandbox
import subprocesses
from delayed_link import DelayedLink, is_possible
from scenario import Scenario

RUN, PORT = "federation", 7447
# Seconds for a run without its faults.
PATIENCE = 60
# Seconds of one-way delay, and share of lost packets.
DELAY, LOSS = 0.02, 0.01


class Federation:
    """The machines and links, and the processes of one run."""

    def __init__(self, reveille, folder, ttis, delay, loss, options=(), count=()):
        self.workspace = subprocesses.Workspace(reveille, folder, PATIENCE)
        self.scenario = Scenario("knn", 50, ttis, 1, 0)
        self.out = folder / "out"
        try:
            self.machines = {name: sandbox.Namespace(self.workspace) for name in ("bs", "left", "right")}
            self.links = {
                name: DelayedLink(self.workspace, self.machines["bs"], self.machines[name], delay, loss, seed)
                for seed, name in enumerate(("left", "right"))
            }
            listen = f"tcp/0.0.0.0:{PORT}"
            bs = ["bs", *self.scenario.args(), f"--run={RUN}", "--listen", listen, "--out", self.out, "--json", *options]
            self.base_station = self.start("bs", bs)
            self.routers = {name: self.start_router(name) for name in self.links}
            self.devices = [
                self.start(name, ["device", "--connect", f"tcp/127.0.0.1:{PORT}", f"--run={RUN}", *count])
                for name in self.links
                for _ in range(2)
            ]
        except BaseException:
            self.workspace.close()
            raise

    def start(self, machine, args):
        return self.workspace.start(args, prefix=self.machines[machine].prefix())

    def start_router(self, machine):
        connect = f"tcp/{self.links[machine].near}:{PORT}"
        return self.start(machine, ["router", f"--run={RUN}", "--listen", f"tcp/127.0.0.1:{PORT}", "--connect", connect])

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.workspace.close()

    def clock(self, command):
        """Runs a command of the clock on the machine of the base station, and returns its output."""
        words = [*self.machines["bs"].prefix(), str(self.workspace.reveille), "clock", command, "--run", RUN]
        return subprocess.run(words, env=self.workspace.env, capture_output=True, text=True, timeout=30).stdout

    def wait_for_tti(self, tti):
        """Waits until the run has passed a TTI."""

        def has_passed():
            status = self.clock("status")
            return status.startswith("running at TTI") and int(status.split()[3]) >= tti

        self.workspace.wait(f"TTI {tti}", has_passed)

    def time_to_loss(self, process):
        """Kills a process and returns the seconds until the base station names a lost host."""
        if " lost the process" in self.base_station.err():
            raise subprocesses.Failure(f"a host was lost before: {self.base_station.err()}")
        started = time.monotonic()
        process.kill()
        self.workspace.wait("the loss", lambda: " lost the process" in self.base_station.err())
        return time.monotonic() - started

    def finish(self):
        """Waits for the end, checks the digest, and returns the measured times."""
        self.workspace.wait("the end of the run", lambda: self.base_station.poll() is not None)
        summary = subprocesses.read_summary(self.out)
        if self.base_station.poll() != 0 or summary is None:
            raise subprocesses.Failure(f"the base station ended with {self.base_station.poll()}: {self.base_station.err()}")
        expected = subprocesses.digest_in_memory(self.workspace.reveille, self.scenario, self.workspace.folder)
        if summary["digest"] != expected:
            raise subprocesses.Failure(f"the digest is {summary['digest']} instead of {expected}")
        self.workspace.wait("the device processes", lambda: all(device.poll() is not None for device in self.devices))
        if any(device.poll() != 0 for device in self.devices):
            raise subprocesses.Failure("; ".join(device.err() for device in self.devices))
        for router in self.routers.values():
            subprocesses.send(router.pid, signal.SIGINT)
        self.workspace.wait("the routers", lambda: all(router.poll() == 0 for router in self.routers.values()), within=5)
        self.workspace.assert_sane()
        return summary["timing"]


def federate(reveille, *args, **options):
    folder = Path(tempfile.mkdtemp(prefix="federation-")).resolve()
    return Federation(reveille, folder, *args, **options)


def check_cut(reveille):
    """Cuts the link of one machine for 10 s. Its devices cannot move: no process runs more than 13 of 50."""
    with federate(reveille, 300, DELAY, LOSS, count=["--count", "13"]) as run:
        run.wait_for_tti(20)
        link = run.links["right"]
        link.is_cut = True
        run.workspace.rest(10)
        link.is_cut = False
        restored = time.monotonic()
        run.workspace.wait("the hosts to return", lambda: run.base_station.err().count(" is back") >= 2)
        back = time.monotonic() - restored
        run.finish()
        router = run.routers["right"].err()
        if " lost the base station" not in router or "reconnected to run" not in router:
            raise subprocesses.Failure(f"the router does not report the cut: {router}")
    print(f"cut for 10 s: digest equal, hosts back {back:.1f} s after the link", flush=True)


def check_lost_router(reveille):
    """Kills the router of one machine and starts it again."""
    with federate(reveille, 1000, 0.002, 0.0, ["--pace", "4ms"], ["--count", "13"]) as run:
        run.wait_for_tti(20)
        lost = run.time_to_loss(run.routers["right"])
        run.routers["right"] = run.start_router("right")
        run.workspace.wait("the hosts to return", lambda: run.base_station.err().count(" is back") >= 2)
        run.finish()
    print(f"killed router: digest equal, loss reported after {lost:.2f} s", flush=True)


def check_killed_device(reveille):
    """Kills a device process behind a router; the one next to it takes over its devices."""
    with federate(reveille, 1000, 0.002, 0.0, ["--pace", "4ms"]) as run:
        run.wait_for_tti(20)
        lost = run.time_to_loss(run.devices.pop())
        run.finish()
        if "had no host for" not in run.base_station.err():
            raise subprocesses.Failure(f"no takeover: {run.base_station.err()}")
    print(f"killed device process behind a router: digest equal, loss reported after {lost:.2f} s", flush=True)


def check_cut_tls(reveille):
    """Cuts the TLS link of one host. Hosts with other links stay, and the run continues soon after the lease of 2 s."""
    folder = Path(tempfile.mkdtemp(prefix="federation-")).resolve()
    workspace = subprocesses.Workspace(reveille, folder, PATIENCE)
    try:
        bs = sandbox.Namespace(workspace)
        links = [DelayedLink(workspace, bs, sandbox.Namespace(workspace)) for _ in range(3)]
        if workspace.call(["tls", "init", "certs", *(word for link in links for word in ("--name", link.near))]).returncode != 0:
            print("SKIPPED: a cut TLS link needs a build with the feature tls", flush=True)
            return
        tls, out = ["--tls", folder / "certs"], folder / "out"
        args = ["--run", RUN, "--devices", 30, "--ttis", 1500, "--pace", "10ms", "--on-loss", "continue", "--out", out]
        station = workspace.start(["bs", *args, *tls, "--listen", f"tls/0.0.0.0:{PORT}"], prefix=bs.prefix())
        for link in links:
            connect = ["--connect", f"tls/{link.near}:{PORT}", "--count", 10]
            workspace.start(["device", f"--run={RUN}", *connect, *tls], prefix=link.far_namespace.prefix())
        workspace.rest(5)
        links[0].is_cut = True
        workspace.wait("the end of the run", lambda: station.poll() is not None)
        timing = (subprocesses.read_summary(out) or {}).get("timing")
        lost_hosts = station.err().count("; the run continues without its devices")
        if station.poll() != 0 or lost_hosts != 1 or timing is None or timing["max_late_ms"] > 4500:
            raise subprocesses.Failure(f"{lost_hosts} hosts lost, {timing}: {station.err()}")
    finally:
        workspace.close()
    print(f"cut TLS link: one host lost, the run held for {timing['max_late_ms'] / 1000:.1f} s", flush=True)


def measure(reveille, delays, losses, ttis, repeat):
    """Prints TTIs per second, with and without lookahead."""
    print("| one-way delay | loss | no lookahead, TTIs/s | lookahead, TTIs/s | grants per TTI |\n|---:|---:|---:|---:|---:|")
    for loss, delay in [(loss, delay) for loss in losses for delay in delays]:
        speeds, grants = {}, 0
        for options in ((), ("--no-lookahead",)):
            timings = []
            for _ in range(repeat):
                with federate(reveille, ttis, delay, loss, ["--audit", "off", *options]) as run:
                    timings.append(run.finish())
            speeds[options] = statistics.median(timing["ttis_per_s"] for timing in timings)
            grants = grants or timings[0]["grants"]
        slow, fast = speeds[("--no-lookahead",)], speeds[()]
        print(f"| {1000 * delay:.0f} ms | {100 * loss:.0f} % | {slow:.0f} | {fast:.0f} | {grants / ttis:.2f} |", flush=True)


def measure_grants(reveille, ttis):
    """Prints the distribution of the time between grants, without lookahead, as an observer on the first machine sees them."""
    for loss in (0.0, LOSS):
        with federate(reveille, ttis, DELAY, loss, ["--audit", "off", "--no-lookahead", "--paused"]) as run:
            run.workspace.wait("all devices", lambda: run.clock("status").startswith("paused"))
            tail = [*run.machines["bs"].prefix(), str(reveille), "inspect", "tail", "--run", RUN, "--kind", "clock"]
            with subprocess.Popen(tail, env=run.workspace.env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as observer:
                observer.stderr.readline()
                run.clock("resume")
                times = [time.monotonic() for _ in observer.stdout]
            run.finish()
        gaps = sorted(1000 * (after - before) for before, after in zip(times, times[1:]))
        shown = ", ".join(f"{share:.0%} {gaps[int(share * len(gaps))]:.0f}" for share in (0.5, 0.9, 0.95, 0.99))
        print(f"{len(gaps)} grants at {100 * loss:.0f} % loss, ms: {shown}, longest {gaps[-1]:.0f}", flush=True)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("reveille", type=Path)
    parser.add_argument("--measure", action="store_true")
    args = parser.parse_args()
    if not is_possible():
        print("SKIPPED: links with delay need root, iproute2 and /dev/net/tun")
        return
    # A signal must not skip the removal of namespaces.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    reveille = args.reveille.resolve()
    if args.measure:
        measure(reveille, (0.0, 0.005, 0.01, DELAY), (0.0, LOSS), 600, 3)
        measure_grants(reveille, 600)
        return
    for check in (check_killed_device, check_lost_router, check_cut, check_cut_tls):
        check(reveille)
    measure(reveille, (0.0, DELAY), (0.0,), 150, 1)


if __name__ == "__main__":
    main()
