#!/usr/bin/env python3
"""Random fault injection: each run must end with the digest of the same run in memory.

    tests/chaos/run.py target/release/reveille --minutes 1
    tests/chaos/run.py target/release/reveille --runs 20 --only hosts,freeze
    tests/chaos/run.py target/release/reveille --bar kills

Only Python's standard library is needed. Untrusted clients (`strangers`) need eclipse-zenoh; small disks and cut links
need root. Kinds of faults that this machine cannot provide are named and skipped. Each case has its own seed, which
repeats it.
"""

import argparse
import concurrent.futures
import importlib.util
import os
import random
import shlex
import signal
import statistics
import sys
import time
from pathlib import Path

# Leaves no cached bytecode behind.
sys.dont_write_bytecode = True

import suites
import cases
import faults
import sandbox
import subprocesses


def parse():
    """Parses the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reveille", type=Path, metavar="BINARY")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=float, help="start new cases for this many minutes [default: 1]")
    length.add_argument("--runs", type=int, help="number of cases")
    parser.add_argument("--seed", type=int, help="seed of the first case; each next case adds 1 [default: random]")
    parser.add_argument("--only", help=f"kinds of faults: {', '.join(faults.KINDS)}; with --bar, its parts")
    parser.add_argument("--bar", choices=sorted(suites.BARS), help="run a fixed set of cases instead of random ones")
    parser.add_argument("-j", "--jobs", type=int, default=1, help="number of parallel cases [default: 1]")
    return parser.parse_args()


def possible_kinds(only):
    """Returns the requested kinds of faults that this machine supports."""
    kinds = only.split(",") if only else list(faults.KINDS)
    if unknown := [kind for kind in kinds if kind not in faults.KINDS]:
        sys.exit(f"--only {','.join(unknown)}: unknown kind; use {', '.join(faults.KINDS)}")
    cannot = {}
    if importlib.util.find_spec("zenoh") is None:
        cannot["strangers"] = "untrusted clients need eclipse-zenoh (pip install eclipse-zenoh)"
    if os.geteuid() != 0:
        cannot["disk"] = "a small disk needs root"
    if not sandbox.has_networks():
        cannot["partition"] = "cutting a link needs root and iproute2"
    for kind, why in cannot.items():
        if kind in kinds:
            print(f"skipping {kind}: {why}")
    return [kind for kind in kinds if kind not in cannot]


def replay(args, plan):
    """Returns the command that repeats a case."""
    command = [sys.executable, sys.argv[0], str(args.reveille), "--runs", "1", "--seed", str(plan.seed)]
    command += ["--only", args.only] if args.only else []
    return shlex.join(command + (["--bar", args.bar] if args.bar else []))


def interrupt(*_):
    """Handles every ending signal like Ctrl-C, even where a shell has set SIGINT to be ignored."""
    subprocesses.stop.set()
    raise KeyboardInterrupt


def plans(args):
    """Draws the requested cases in order."""
    kinds = possible_kinds(args.only)
    if not kinds:
        sys.exit("no kind of fault is left; choose others with --only")
    until = time.monotonic() + 60 * (args.minutes if args.minutes is not None else 1)
    for number in range(args.runs if args.runs is not None else 10**9):
        if args.runs is None and time.monotonic() >= until:
            return
        yield cases.draw(args.seed + number, kinds)


def play_all(args, plans):
    """Plays the cases and prints the outcome of each."""
    outcomes = []

    def show(outcome):
        if outcome is not None:
            outcomes.append(outcome)
            print(outcome, flush=True)
            if outcome.failure:
                print(f"    repeat: {replay(args, outcome.plan)}\n    files: {outcome.folder}", flush=True)

    if args.jobs == 1:
        for plan in plans:
            show(cases.play(args.reveille, plan))
        return outcomes
    with concurrent.futures.ThreadPoolExecutor(args.jobs) as pool:
        running = set()
        for plan in plans:
            running.add(pool.submit(cases.play, args.reveille, plan))
            if len(running) >= args.jobs:
                done, running = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
                for future in done:
                    show(future.result())
        for future in concurrent.futures.as_completed(running):
            show(future.result())
    return outcomes


def total(counts):
    """Sums counts by kind and formats them."""
    sums = {}
    for count in counts:
        for kind, number in count.items():
            sums[kind] = sums.get(kind, 0) + number
    shown = ", ".join(f"{kind} {number}" for kind, number in sorted(sums.items()))
    return f"{sum(sums.values())} ({shown})" if sums else "0"


def spread(seconds):
    """Formats the median and the maximum of durations."""
    if not seconds:
        return "none"
    return f"{len(seconds)}, median {statistics.median(seconds):.2f} s, worst {max(seconds):.2f} s"


def conclude(args, outcomes, seconds):
    """Prints the totals. Returns whether all cases passed and a fault hit a run."""
    failed = [outcome for outcome in outcomes if outcome.failure]
    print(f"\n{len(outcomes)} runs in {seconds:.0f} s; digests equal: {len(outcomes) - len(failed)} of {len(outcomes)}")
    print(f"faults that hit a run: {total(outcome.hits for outcome in outcomes)}")
    print(f"faults that came too late: {total(outcome.too_late for outcome in outcomes)}")
    passed = [outcome for outcome in outcomes if not outcome.failure]
    print(f"devices taken over after kills: {spread([s for o in passed if not o.is_held() for s in o.losses])}")
    print(f"longest_loss_s of those runs: {spread([o.longest for o in passed if o.longest and not o.is_held()])}")
    print(f"runs resumed: {spread([s for o in passed if not o.is_held() for s in o.resumes])}")
    held = [outcome for outcome in passed if outcome.is_held()]
    print("runs that were also frozen, disconnected or attacked:")
    print(f"    longest losses: {spread([outcome.longest for outcome in held if outcome.longest])}")
    print(f"    resumed: {spread([seconds for outcome in held for seconds in outcome.resumes])}")
    for outcome in failed:
        print(f"FAILED: seed {outcome.plan.seed}: {replay(args, outcome.plan)}")
    is_hit = any(outcome.hits for outcome in outcomes)
    if not is_hit:
        print("FAILED: no fault hit a run")
    return is_hit and not failed


def main():
    args = parse()
    args.reveille = args.reveille.resolve()
    if not os.access(args.reveille, os.X_OK):
        sys.exit(f"{args.reveille}: not an executable file; build it first")
    if args.seed is None:
        args.seed = random.SystemRandom().randint(1, 10**6) * 1000
    print(f"seed {args.seed}", flush=True)
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(number, interrupt)
    subprocesses.adopt_orphans()
    began = time.monotonic()
    try:
        if args.bar and args.bar in suites.CHECKS:
            is_well = suites.CHECKS[args.bar](args)
        else:
            outcomes = play_all(args, suites.kills(args) if args.bar else plans(args))
            is_well = conclude(args, outcomes, time.monotonic() - began)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    sys.exit(0 if is_well else 1)


main()
