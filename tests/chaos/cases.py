"""Cases: a scenario with its faults, drawn from one seed, played and judged."""

import random
import shutil
import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import faults
import bus_runs
import sandbox
import subprocesses
import scenario
from subprocesses import Failure, Workspace

# Seconds that a case may take in addition to its faults.
PATIENCE = 150
# Probability of a further fault, and the largest number of faults of a case.
FURTHER_FAULT_PROBABILITY, MAX_FAULTS = 0.45, 4


@dataclass
class Plan:
    """The scenario, the processes and the faults of a case."""

    seed: int
    scenario: scenario.Scenario
    is_up: bool
    processes: int
    faults: list
    options: list = field(default_factory=list)
    patience: int = 30

    def has(self, kind):
        """Whether the case has a fault of this kind."""
        return any(fault.kind == kind for fault in self.faults)

    def __str__(self):
        how = f"up -P {self.processes}" if self.is_up else f"bs and {self.processes} devices"
        return f"seed {self.seed}: {how}, {self.scenario}: {', '.join(str(fault) for fault in self.faults)}"


@dataclass
class Outcome:
    """The result of a case."""

    plan: Plan
    seconds: float = 0.0
    hits: dict = field(default_factory=dict)
    too_late: dict = field(default_factory=dict)
    losses: list = field(default_factory=list)
    longest: float = 0.0
    resumes: list = field(default_factory=list)
    failure: str = ""
    folder: str = ""

    def is_held(self):
        """Whether a fault other than a kill held the run, so that its losses last as long as the fault."""
        return any(fault.kind in ("freeze", "held", "partition", "strangers") for fault in self.plan.faults)

    def __str__(self):
        hit = sum(self.hits.values())
        words = [f"{self.seconds:5.1f} s", f"{hit} hit"]
        if self.too_late:
            words.append(f"{sum(self.too_late.values())} too late")
        if self.losses:
            words.append(f"{len(self.losses)} taken over in {max(self.losses):.2f} s")
        if self.resumes:
            words.append(f"{len(self.resumes)} resumed in {max(self.resumes):.2f} s")
        words.append(f"FAILED: {self.failure}" if self.failure else "digest equal")
        return f"{self.plan}\n    {', '.join(words)}"


def draw(seed, kinds):
    """Draws the case of a seed, with faults of `kinds` only, at least one."""
    rng = random.Random(f"chaos {seed}")
    first = rng.choice(kinds)
    is_up = first not in faults.HAND or (first in faults.UP and rng.random() < 0.65)
    possible = [kind for kind in (faults.UP if is_up else faults.HAND) if kind in kinds]
    chosen = [first]
    while len(chosen) < MAX_FAULTS and rng.random() < FURTHER_FAULT_PROBABILITY:
        chosen.append(rng.choice(possible))
    # A shell can be killed only once, and an attacker stays until the end.
    for single in ("launcher", "strangers"):
        while chosen.count(single) > 1:
            chosen.remove(single)
    drawn = [faults.draw(rng, kind) for kind in chosen]
    # A run that no fault holds must last longer than all faults.
    fault_seconds = sum(fault.params.get("for", 0) for fault in drawn)
    length = 1.5 + fault_seconds + sum(fault.after for fault in drawn) + rng.uniform(0.5, 2)
    return Plan(
        seed=seed,
        scenario=scenario.draw(rng, length),
        is_up=is_up,
        processes=rng.randint(1, 10),
        faults=drawn,
        options=["--audit", rng.choice(["auto", "on"])],
        patience=rng.choice([10, 30, 90]),
    )


def make_run(plan, workspace):
    """Returns the run of a plan, not yet started, or None if this machine does not support it."""
    name = f"chaos-{workspace.folder.name}"
    if plan.has("disk"):
        # Room for the rows of windows, and little more.
        disk = sandbox.small_disk(workspace, "disk", 512 + plan.scenario.ttis // 10)
        out = "disk/out"
        if disk is None:
            return None
    else:
        out = "out"
    if plan.is_up:
        shell = plan.has("launcher")
        return bus_runs.UpRun(workspace, plan.scenario, name, plan.processes, plan.options, out, shell)
    link = sandbox.Link(workspace) if plan.has("partition") else None
    return bus_runs.ManualRun(workspace, plan.scenario, name, plan.processes, plan.options, out, plan.patience, link)


def play(reveille, plan, keep_failed=True):
    """Plays a case and returns its outcome, or None if this machine does not support it."""
    folder = Path(tempfile.mkdtemp(prefix="chaos-")).resolve()
    fault_seconds = sum(fault.params.get("for", 0) for fault in plan.faults)
    workspace = Workspace(reveille, folder, PATIENCE + fault_seconds + plan.scenario.seconds())
    outcome = Outcome(plan, folder=str(folder))
    started = time.monotonic()
    try:
        bus_run = make_run(plan, workspace)
        if bus_run is None:
            return None
        play_plan(plan, bus_run, outcome, subprocesses.digest_in_memory(reveille, plan.scenario, folder))
    except (Failure, subprocess.SubprocessError) as failure:
        outcome.failure = str(failure)
    finally:
        workspace.close()
        outcome.seconds = time.monotonic() - started
        if not (outcome.failure and keep_failed):
            shutil.rmtree(folder, ignore_errors=True)
    return outcome


def play_plan(plan, bus_run, outcome, expected):
    """Runs a plan with its faults, and checks digest, audit and attackers."""
    rng = random.Random(f"strikes {plan.seed}")
    workspace = bus_run.workspace
    bus_run.begin()
    for fault in plan.faults:
        workspace.rest(fault.after)
        is_possible = not bus_run.is_over()
        hit = faults.inject(fault, bus_run, rng) if is_possible else False
        count = outcome.hits if hit else outcome.too_late
        count[fault.kind] = count.get(fault.kind, 0) + (int(hit) or 1)
    summary = bus_run.finish()
    workspace.assert_sane()
    outcome.losses, outcome.resumes = bus_run.takeover_times(), bus_run.resumes
    outcome.longest = summary["timing"]["longest_loss_s"]
    for process in workspace.processes:
        if "OBEYED" in process.out():
            raise Failure(f"the run obeyed an untrusted client: {process.out()}")
    if summary["digest"] != expected:
        raise Failure(f"the digest is {summary['digest']} instead of {expected}")
    if summary["audit"] not in ("complete", "off") and not summary["audit"].startswith("partial: TTI"):
        raise Failure(f"the audit result is {summary['audit']}")
