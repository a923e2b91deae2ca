"""Runs that continue without killed processes. A replay of their logged outages must give the same results."""

import json
import random
import shutil
import tempfile
from pathlib import Path

import faults
import bus_runs
import subprocesses
import scenario
from subprocesses import Failure, Ground

RUNS = 30
SECONDS = 2.0
TABLES = ["events.csv", "devices.csv", "windows.csv"]


def strike(game, chance):
    """Kills hosts in sequence, always leaving one, and sometimes everything. Returns the number of killed hosts."""
    killed = 0
    for _ in range(chance.randint(1, 3)):
        game.ground.rest(chance.uniform(0.05, 0.6))
        # Sometimes two are killed together.
        for _ in range(chance.choice([1, 1, 2])):
            hosts = game.hosts()
            if len(hosts) > 1 and game.is_running():
                subprocesses.send(chance.choice(hosts), 9)
                killed += 1
        if chance.random() < 0.25 and game.is_running():
            game.kill_everything()
            game.processes = chance.randint(1, 6)
            if not faults.resume_if_ended(game, "SIGKILL of everything"):
                break
    return killed


def window_of(out):
    """Returns the TTIs per row of windows.csv. A run killed before its first mark loses its `--window` option."""
    first, end = (out / "windows.csv").read_text().splitlines()[1].split(",")[:2]
    return int(end) - int(first)


def check_again(ground, played, out, summary):
    """Checks that a run in memory with these inputs has the same digest and the same tables."""
    window = window_of(out)
    inputs = ["--input-log", out / "inputs.log"] if (out / "inputs.log").exists() else []
    done = ground.call(["run", *played.args(), *inputs, "--window", window, "--quiet", "--json", "--out", "again"])
    if done.returncode != 0:
        raise Failure(f"run --input-log ended with {done.returncode}: {done.stderr[-1500:]}")
    again = json.loads(done.stdout)
    if again["digest"] != summary["digest"]:
        raise Failure(f"the digest is {summary['digest']}, but its inputs give {again['digest']}")
    for table in TABLES:
        if (out / table).read_bytes() != (ground.folder / "again" / table).read_bytes():
            raise Failure(f"{table} differs from a run with the same inputs")


def play(args, seed):
    """Plays one run and returns the number of killed processes, None on failure."""
    chance = random.Random(f"outages {seed}")
    policy = sorted(scenario.POLICIES)[seed % len(scenario.POLICIES)]
    played = scenario.draw(chance, SECONDS, policy, 48, (0, 2, 3))
    folder, failed = Path(tempfile.mkdtemp(prefix="chaos-")).resolve(), False
    ground = Ground(args.reveille, folder, 60 + played.seconds())
    try:
        options = ["--on-loss", "continue", "--audit", "on"]
        game = bus_runs.Up(ground, played, f"chaos-{folder.name}", chance.randint(3, 8), options)
        # Sums for every TTI, or for five together.
        game.window = chance.choice([1, 5])
        game.begin()
        killed = strike(game, chance)
        summary = game.finish()
        if summary["audit"] != "complete":
            raise Failure(f"the audit result is {summary['audit']}")
        if not 0 <= summary["metrics"]["removed_pct"] <= 100:
            raise Failure(f"{summary['metrics']['removed_pct']} % of the devices are removed")
        check_again(ground, played, game.out, summary)
        print(f"seed {seed}: {played}, {killed} killed, resumed {len(game.resumes)} times: equal", flush=True)
        return killed
    except Failure as failure:
        failed = True
        print(f"seed {seed}: {played}: FAILED: {failure}\n    files: {folder}", flush=True)
        return None
    finally:
        ground.close()
        if not failed:
            shutil.rmtree(folder, ignore_errors=True)


def check(args):
    """Plays the given number of runs, each with its own seed. Returns whether all passed and a process was killed."""
    runs = args.runs if args.runs is not None else RUNS
    came = [play(args, args.seed + number) for number in range(runs)]
    killed = sum(filter(None, came))
    print(f"{runs} runs, {killed} processes killed; {came.count(None)} failed")
    return killed > 0 and None not in came
