"""Runs that continue without killed processes (`--on-loss continue`).

`run --input-log` must give the same digest and tables.
"""

import json
import random
import shutil
import tempfile
from pathlib import Path

import faults
import bus_runs
import subprocesses
import scenario
from subprocesses import Failure, Workspace

RUNS = 30
SECONDS = 2.0
TABLES = ["events.csv", "devices.csv", "windows.csv"]


def kill_hosts(bus_run, rng):
    """Kills hosts in sequence, always leaving one, and sometimes everything. Returns the number of killed hosts."""
    killed = 0
    for _ in range(rng.randint(1, 3)):
        bus_run.workspace.rest(rng.uniform(0.05, 0.6))
        # Sometimes two are killed together.
        for _ in range(rng.choice([1, 1, 2])):
            hosts = bus_run.hosts()
            if len(hosts) > 1 and bus_run.is_running():
                subprocesses.send(rng.choice(hosts), 9)
                killed += 1
        if rng.random() < 0.25 and bus_run.is_running():
            bus_run.kill_everything()
            bus_run.processes = rng.randint(1, 6)
            if not faults.resume_if_ended(bus_run, "SIGKILL of everything"):
                break
    return killed


def window_of(out):
    """Returns the TTIs per row of windows.csv. A run killed before its first mark loses its `--window` option."""
    first, end = (out / "windows.csv").read_text().splitlines()[1].split(",")[:2]
    return int(end) - int(first)


def check_replay(workspace, drawn, out, summary):
    """Checks that a run in memory with these inputs has the same digest and the same tables."""
    window = window_of(out)
    inputs = ["--input-log", out / "inputs.log"] if (out / "inputs.log").exists() else []
    replay = workspace.call(["run", *drawn.args(), *inputs, "--window", window, "--quiet", "--json", "--out", "again"])
    if replay.returncode != 0:
        raise Failure(f"run --input-log ended with {replay.returncode}: {replay.stderr[-1500:]}")
    replay_summary = json.loads(replay.stdout)
    if replay_summary["digest"] != summary["digest"]:
        raise Failure(f"the digest is {summary['digest']}, but its inputs give {replay_summary['digest']}")
    for table in TABLES:
        if (out / table).read_bytes() != (workspace.folder / "again" / table).read_bytes():
            raise Failure(f"{table} differs from a run with the same inputs")


def play(args, seed):
    """Plays one run and returns the number of killed processes, None on failure."""
    rng = random.Random(f"outages {seed}")
    policy = sorted(scenario.POLICIES)[seed % len(scenario.POLICIES)]
    drawn = scenario.draw(rng, SECONDS, policy, 48, (0, 2, 3))
    folder, failed = Path(tempfile.mkdtemp(prefix="chaos-")).resolve(), False
    workspace = Workspace(args.reveille, folder, 60 + drawn.seconds())
    try:
        options = ["--on-loss", "continue", "--audit", "on"]
        bus_run = bus_runs.UpRun(workspace, drawn, f"chaos-{folder.name}", rng.randint(3, 8), options)
        # Sums for every TTI, or for five together.
        bus_run.window = rng.choice([1, 5])
        bus_run.begin()
        killed = kill_hosts(bus_run, rng)
        summary = bus_run.finish()
        if summary["audit"] != "complete":
            raise Failure(f"the audit result is {summary['audit']}")
        if not 0 <= summary["metrics"]["removed_pct"] <= 100:
            raise Failure(f"{summary['metrics']['removed_pct']} % of the devices are removed")
        check_replay(workspace, drawn, bus_run.out, summary)
        print(f"seed {seed}: {drawn}, {killed} killed, resumed {len(bus_run.resumes)} times: equal", flush=True)
        return killed
    except Failure as failure:
        failed = True
        print(f"seed {seed}: {drawn}: FAILED: {failure}\n    files: {folder}", flush=True)
        return None
    finally:
        workspace.close()
        if not failed:
            shutil.rmtree(folder, ignore_errors=True)


def check(args):
    """Plays the given number of runs, each with its own seed. Returns whether all passed and a process was killed."""
    runs = args.runs if args.runs is not None else RUNS
    results = [play(args, args.seed + number) for number in range(runs)]
    killed = sum(filter(None, results))
    print(f"{runs} runs, {killed} processes killed; {results.count(None)} failed")
    return killed > 0 and None not in results
