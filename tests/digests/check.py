"""Compares the digests of 183 runs with the recorded ones of `digests.tsv`.

    python tests/digests/check.py target/release/reveille            # compare, exit code 1 on a difference
    python tests/digests/check.py target/release/reveille --record   # write digests.tsv; give the reason in the commit

A recorded digest may change only together with the version of the digest. The runs cover every policy, preset, kind of
event, harvest and layout, radio faults, device classes, removed devices, logged external decisions and resumed runs.
Only Linux; needs nothing but the standard library.
"""

import argparse
import concurrent.futures
import csv
import hashlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
RECORDED = HERE / "digests.tsv"
SCENARIOS = HERE.parent.parent / "deploy" / "scenarios"
# Seconds; enough for a short run on two loaded cores.
PATIENCE = 120

POLICIES = ["random", "adjusted", "knn", "q-learning", "dt", "genie", "age-index"]
PRESETS = {"paper": "-n 30 -k 600", "literal": "-s paper-literal -n 30 -k 600", "quick": "-s quick"}
EVENTS = {
    "hot-spots": "--set events.process=hot-spots",
    "aftershocks": "--set events.process=aftershocks",
    "bursts": "--set events.process=bursts --set events.duration_kind=geometric",
    "join-sum": "--set sensing.g=sum-saturation --set events.alpha=0.5",
}
RADIO_FAULTS = {
    "wake-miss": "--set radio.wake_miss=0.3",
    "false-wake": "--set radio.false_wake_up=0.05",
    "uplink-loss": "--set radio.uplink_loss=0.3",
    "plan-loss": "--set radio.plan_loss=0.3 --set bs.sync_interval=37",
    "latency": "--set radio.wake_latency=2",
    "all-faults": "--set radio.wake_miss=0.2 --set radio.false_wake_up=0.02 --set radio.uplink_loss=0.2 "
    "--set radio.plan_loss=0.2 --set radio.wake_latency=1 --set radio.interference=bursts --set bs.sync_interval=37",
}
ENERGY = {
    "reported": "--set bs.battery_knowledge=reported",
    "posterior": "--set bs.ranking=posterior",
    "scarce": "--set harvest.e_b=1 --set energy.initial=0",
    "exponential": "--set harvest.kind=exp-minus-lambda",
    "mpp": "--set harvest.kind=mpp",
    "diurnal": "--set harvest.kind=diurnal --set harvest.diurnal.ttis_per_day=60",
}
SETTINGS = {
    "knn-clear-sky": "-p knn --set harvest.kind=diurnal --set harvest.diurnal.ttis_per_day=60 --set harvest.diurnal.sky=clear",
    "knn-no-radius": "-p knn --set policy.knn.limit_radius=false --set policy.knn.neighbours=3",
    "knn-short-sync": "-p knn --set bs.sync_interval=7",
    "q-learning-ages": "-p q-learning --set policy.q-learning.ages=true --set bs.ranking=posterior",
    "q-learning-learns": "-p q-learning --set policy.q-learning.learn=true --set policy.q-learning.table=nothing",
    "q-learning-window": "-p q-learning --set policy.q-learning.window=4",
    "age-index-foresight": "-p age-index --set policy.age-index.foresight=20 --set bs.battery_knowledge=reported",
    "age-index-free": "-p age-index --set policy.age-index.price=0",
    "dt-dear": "-p dt --set policy.dt.price=4",
    "dt-attention": "-p dt --set policy.dt.model=attention",
    "adjusted-one": "-p random --set policy.random.t_drx=[4]",
    "uniform": "-p knn --set layout.kind=uniform",
    "hex": "-p knn --set layout.kind=hex",
    "probabilistic": "-p knn --set sensing.kind=probabilistic",
}
# Devices lost before they could sense: the first device, the number of devices, the TTI.
OUTAGES = [(3, 5, 100), (20, 6, 400)]
# Runs with the logged decisions of the files next to this script, which were drawn at random once.
LOGGED_DECISIONS = {
    "bits": "-n 20 -k 300",
    "cycles": "-n 20 -k 300 --set bs.battery_knowledge=reported",
    "faults": f"-n 20 -k 300 {RADIO_FAULTS['all-faults']}",
}
SCENARIO_FILES = ["two-classes", "day-and-night", "rush-hours", "solar", "solar-panel"]
SMALL = "-n 30 -k 600"


def uninterrupted_runs():
    """Yields the name and command of each run that ends without interference."""
    for policy in POLICIES:
        for name, options in PRESETS.items():
            yield f"{policy}/{name}", f"run -p {policy} {options}"
        for name, options in {**EVENTS, **RADIO_FAULTS, **ENERGY}.items():
            yield f"{policy}/{name}", f"run -p {policy} {SMALL} {options}"
    for name, options in SETTINGS.items():
        yield f"settings/{name}", f"run {SMALL} {options}"
    for name in SCENARIO_FILES:
        yield f"file/{name}", f"run -s {SCENARIOS / name}.toml -k 600"
    for count, processes in [(250, 1), (250, 4), (30, 0), (30, 1), (30, 20)]:
        yield f"bus/knn-n{count}-P{processes}", f"up -p knn -n {count} -k 300 -P {processes}"
    for policy in ["q-learning", "genie", "age-index"]:
        yield f"bus/{policy}-faults", f"up -p {policy} {SMALL} -P 4 {RADIO_FAULTS['all-faults']}"
    for name, options in LOGGED_DECISIONS.items():
        yield f"external/{name}", f"run {options} -p replay={HERE / name}.log"
    yield "many/knn", "run -p knn -n 2500 -k 300"
    yield "many/random", "run -p random -n 2500 -k 300"
    yield "seed/knn-7", f"run -p knn {SMALL} --seed 7"


class Failed(Exception):
    """A run did not end with a summary."""


def summary(reveille, command, folder):
    """Runs `command` in `folder` and returns its summary."""
    arguments = [reveille, *shlex.split(command), "--json", "--quiet"]
    if "--out" not in command and "--resume" not in command:
        arguments += ["--out", str(Path(folder) / "run")]
    try:
        process = subprocess.run(arguments, cwd=folder, capture_output=True, text=True, timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        raise Failed(f"no end within {PATIENCE} s") from None
    if process.returncode:
        raise Failed(f"exit code {process.returncode}: {process.stderr.strip()[-600:]}")
    return json.loads(process.stdout)


def uninterrupted(reveille, command):
    """Returns the digest of a run that ends without interference, with a fingerprint of its CSV tables."""
    with tempfile.TemporaryDirectory() as folder:
        digest = summary(reveille, command, folder)["digest"]
        tables = hashlib.sha256()
        for table in sorted(Path(folder, "run").glob("*.csv")):
            tables.update(table.name.encode() + b"\0" + table.read_bytes())
        return digest, tables.hexdigest()[:16]


def with_outages(reveille, command):
    """Returns the digest of a run that loses devices between TTIs and, if a policy wakes devices, before an event's
    last wake-up; and the number of outages."""
    with tempfile.TemporaryDirectory() as folder:
        scenario_hash = summary(reveille, command, folder)["scenario_hash"]
        outages = [(first, count, tti, None) for first, count, tti in OUTAGES]
        with Path(folder, "run", "events.csv").open(newline="") as table:
            for event in csv.DictReader(table):
                # The first wake-up follows the event's first report. The other outages change later events.
                tti = int(event["start_tti"]) + int(event["delay_ttis"] or 0)
                wake_ups = int(event["wake_ups"])
                if event["delay_ttis"] and wake_ups and tti < 100 and "radio" not in command:
                    outages.insert(0, (12, 2, tti, wake_ups - 1))
                    break
        names = ["first", "count", "tti", "wake_ups"]
        entries = [{"inputs": {"version": 2, "scenario_hash": scenario_hash}}]
        entries += [{"outage": dict(zip(names, outage))} for outage in outages]
        log = Path(folder, "outages.log")
        log.write_text("".join(json.dumps(entry) + "\n" for entry in entries))
        digest = summary(reveille, f"{command} --input-log {log} --out {folder}/lost", folder)["digest"]
        return digest, str(len(outages))


def resumed(reveille, command):
    """Returns the digest of a run whose processes are killed halfway and which then resumes on the bus."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        arguments = [reveille, *shlex.split(command), "--pace", "1ms", "--quiet", "--out", str(out)]
        first = subprocess.Popen(
            arguments, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        deadline = time.monotonic() + PATIENCE
        while not (out / "resume.json").exists():
            if first.poll() is not None or time.monotonic() > deadline:
                raise Failed("the run wrote no resume mark")
            time.sleep(0.05)
        os.killpg(first.pid, signal.SIGKILL)
        first.wait()
        subcommand = shlex.split(command)[0]
        # The third column holds a fingerprint of tables, which this run does not compare.
        return summary(reveille, f"{subcommand} --resume {out}", folder)["digest"], "-"


def runs():
    """Yields the name of each run, the function that runs it, and its command."""
    for name, command in uninterrupted_runs():
        yield name, uninterrupted, command
    for policy in POLICIES:
        yield f"outages/{policy}", with_outages, f"run -p {policy} {SMALL}"
        yield f"outages/{policy}-faults", with_outages, f"run -p {policy} {SMALL} {RADIO_FAULTS['all-faults']}"
    for policy in ["knn", "q-learning", "age-index"]:
        yield f"resumed/{policy}", resumed, f"up -p {policy} -n 30 -k 4000 -P 3 {RADIO_FAULTS['all-faults']}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reveille", type=Path)
    parser.add_argument("--record", action="store_true", help="write the digests instead of comparing them")
    parser.add_argument("--only", default="", metavar="PATTERN", help="runs whose name matches this regular expression")
    args = parser.parse_args()
    reveille = str(args.reveille.resolve())
    if not os.access(reveille, os.X_OK):
        parser.error(f"{args.reveille}: not an executable file; build it with cargo build --release")
    if args.record and args.only:
        parser.error("--record writes all digests; leave out --only")
    chosen = [run for run in runs() if re.search(args.only, run[0])]
    if not chosen:
        parser.error(f"--only {args.only}: no run matches this pattern")

    def row(run):
        name, digest_of, command = run
        try:
            return name, *digest_of(reveille, command)
        except Failed as reason:
            return name, "failed", str(reason)

    started = time.monotonic()
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        rows = list(pool.map(row, chosen))
    failed = [(name, reason) for name, digest, reason in rows if digest == "failed"]
    for name, reason in failed:
        print(f"{name}: {reason}", file=sys.stderr)
    if args.record:
        if failed:
            sys.exit(1)
        with RECORDED.open("w", newline="") as file:
            table = csv.writer(file, delimiter="\t", lineterminator="\n")
            table.writerow(["run", "digest", "tables"])
            table.writerows(rows)
        print(f"{len(rows)} digests written to {RECORDED}")
        return
    with RECORDED.open(newline="") as file:
        recorded_by_name = {name: values for name, *values in csv.reader(file, delimiter="\t")}
    faults = 0
    for name, *values in rows:
        recorded = recorded_by_name.get(name)
        if recorded != values:
            faults += 1
            reason = f"recorded {' '.join(recorded)}, now {' '.join(values)}" if recorded else "no recorded digest"
            print(f"{name}: {reason}", file=sys.stderr)
    # "run" is the header of the column.
    unused = recorded_by_name.keys() - {"run"} - {name for name, _, _ in runs()}
    if unused:
        faults += len(unused)
        print(f"{RECORDED}: unused digests of removed runs: {', '.join(sorted(unused))}", file=sys.stderr)
    matching = sum(recorded_by_name.get(name) == values for name, *values in rows)
    print(f"{matching} of {len(rows)} digests as recorded, in {time.monotonic() - started:.0f} s")
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
