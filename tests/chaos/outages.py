"""Runs that go on without killed processes: what they came to follows from the outages that they have written down."""

import json
import random
import shutil
import tempfile
from pathlib import Path

import faults
import games
import program
import scenario
from program import Failure, Ground

RUNS = 30
SECONDS = 2.0
TABLES = ["events.csv", "devices.csv", "windows.csv"]


def strike(game, chance):
    """Kills all but one process at the most, one after another, and at times everything. How many were killed."""
    killed = 0
    for _ in range(chance.randint(1, 3)):
        game.ground.rest(chance.uniform(0.05, 0.6))
        # Two at once, now and then.
        for _ in range(chance.choice([1, 1, 2])):
            hosts = game.hosts()
            if len(hosts) > 1 and game.is_running():
                program.send(chance.choice(hosts), 9)
                killed += 1
        if chance.random() < 0.25 and game.is_running():
            game.kill_everything()
            game.processes = chance.randint(1, 6)
            if not faults.take_up(game, "SIGKILL of everything"):
                break
    return killed


def window_of(out):
    """The TTIs in a row of windows.csv. A run that was killed before its first mark has forgotten what it was told."""
    first, end = (out / "windows.csv").read_text().splitlines()[1].split(",")[:2]
    return int(end) - int(first)


def check_again(ground, played, out, summary):
    """A run in memory with these inputs comes to the same, table by table."""
    window = window_of(out)
    inputs = ["--inputs", out / "inputs.log"] if (out / "inputs.log").exists() else []
    done = ground.call(["run", *played.args(), *inputs, "--window", window, "--quiet", "--json", "--out", "again"])
    if done.returncode != 0:
        raise Failure(f"run --inputs ended with {done.returncode}: {done.stderr[-1500:]}")
    again = json.loads(done.stdout)
    if again["digest"] != summary["digest"]:
        raise Failure(f"the digest is {summary['digest']}, of a run with its inputs {again['digest']}")
    for table in TABLES:
        if (out / table).read_bytes() != (ground.folder / "again" / table).read_bytes():
            raise Failure(f"{table} is not that of a run with its inputs")


def play(args, seed):
    """One run; how many processes were killed in it."""
    chance = random.Random(f"outages {seed}")
    policy = sorted(scenario.POLICIES)[seed % len(scenario.POLICIES)]
    played = scenario.draw(chance, SECONDS, policy, 48, (0, 2, 3))
    folder, failed = Path(tempfile.mkdtemp(prefix="chaos-")).resolve(), False
    ground = Ground(args.reveille, folder, 60 + played.seconds())
    try:
        options = ["--on-loss", "continue", "--audit", "on"]
        game = games.Up(ground, played, f"chaos-{folder.name}", chance.randint(3, 8), options)
        # The sums of every TTI, or of a few together.
        game.window = chance.choice([1, 5])
        game.begin()
        killed = strike(game, chance)
        summary = game.finish()
        if summary["audit"] != "whole":
            raise Failure(f"the audit says {summary['audit']}")
        if not 0 <= summary["metrics"]["gone_pct"] <= 100:
            raise Failure(f"{summary['metrics']['gone_pct']} % are gone")
        check_again(ground, played, game.out, summary)
        print(f"seed {seed}: {played}, {killed} killed, {len(game.resumes)} times taken up: equal", flush=True)
        return killed
    except Failure as failure:
        failed = True
        print(f"seed {seed}: {played}: FAILED: {failure}\n    its files: {folder}", flush=True)
        return None
    finally:
        ground.close()
        if not failed:
            shutil.rmtree(folder, ignore_errors=True)


def check(args):
    """So many runs, each with a seed of its own."""
    runs = args.runs if args.runs is not None else RUNS
    came = [play(args, args.seed + number) for number in range(runs)]
    killed = sum(filter(None, came))
    print(f"{runs} runs, {killed} processes killed; {came.count(None)} failed")
    return killed > 0 and None not in came
