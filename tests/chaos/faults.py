"""Draws faults and applies them to runs."""

import signal
import sys
from dataclasses import dataclass, field
from pathlib import Path

import sandbox
import subprocesses
from bus_runs import END_LIMIT
from subprocesses import Failure

SIGNALS = {"SIGTERM": signal.SIGTERM, "SIGHUP": signal.SIGHUP, "Ctrl-C": signal.SIGINT}
ATTACKS = ["noise", "huge", "tokens", "clock", "stalled"]

# The kinds of faults possible under `up`, and with separately started device processes.
UP = ["hosts", "station", "everything", "joining", "held", "freeze", "signal", "launcher", "strangers", "disk"]
HAND = ["hosts", "station", "everything", "joining", "held", "freeze", "signal", "partition", "strangers"]
KINDS = [*UP, "partition"]


@dataclass
class Fault:
    """A fault with its parameters, and its delay in seconds after the fault before it."""

    kind: str
    after: float
    params: dict = field(default_factory=dict)

    def __str__(self):
        params = " ".join(str(value) for value in self.params.values() if value != "")
        return f"{self.kind} {params}".strip()


def draw(rng, kind):
    """Draws the parameters of a fault."""
    params = {}
    match kind:
        case "hosts":
            params = {"killed": rng.randint(1, 5), "within": round(rng.choice([0.0, rng.uniform(0, 1.5)]), 2)}
        case "joining":
            params["killed"] = "+".join(rng.choice(["host", "station"]) for _ in range(rng.randint(1, 4)))
        case "freeze":
            params["process"] = rng.choice(["host", "station"])
            # 35 s is more than the 30 s after which an unresponsive host counts as lost.
            params["for"] = 35.0 if rng.random() < 0.03 else round(rng.uniform(1, 8), 1)
            params["then"] = rng.choice(["", "overlapping"])
        case "signal" | "held":
            params["by"] = rng.choice(sorted(SIGNALS))
        case "partition":
            params["for"] = 15.0 if rng.random() < 0.1 else round(rng.uniform(0.3, 6), 1)
            params["then"] = rng.choice(["", "overlapping"])
        case "strangers":
            params["doing"] = "+".join(rng.sample(ATTACKS, rng.randint(1, len(ATTACKS))))
    return Fault(kind, round(rng.uniform(0.2, 1.6), 2), params)


def inject(fault, bus_run, rng):
    """Applies a fault and resumes the run if it ended. Returns whether the fault hit a run in progress."""
    return globals()[f"inject_{fault.kind}"](fault.params, bus_run, rng)


def inject_hosts(params, bus_run, rng):
    """Kills device processes with SIGKILL, together or in sequence."""
    killed = set()
    for number in range(params["killed"]):
        if number:
            bus_run.workspace.rest(params["within"] / params["killed"])
        # A killed process can look alive for a moment.
        hosts = [pid for pid in bus_run.hosts() if pid not in killed]
        if hosts and bus_run.is_running():
            chosen = rng.choice(hosts)
            killed.add(chosen)
            subprocesses.send(chosen, signal.SIGKILL)
    return len(killed)


def inject_station(_, bus_run, rng):
    """Kills the base station with SIGKILL."""
    hit = bus_run.is_running()
    bus_run.kill_station()
    return resume_if_ended(bus_run, "SIGKILL of the base station") and hit


def inject_everything(_, bus_run, rng):
    """Kills all processes with SIGKILL."""
    hit = bus_run.is_running()
    bus_run.kill_everything()
    return resume_if_ended(bus_run, "SIGKILL of everything") and hit


def inject_joining(params, bus_run, rng):
    """Kills everything with SIGKILL, and kills more processes while the run resumes."""
    hit = bus_run.is_running()
    bus_run.kill_everything()
    if is_complete(bus_run):
        return False
    bus_run.resume()
    for process in params["killed"].split("+"):
        bus_run.workspace.rest(rng.uniform(0, 0.5))
        hosts = bus_run.hosts()
        if process == "host" and hosts:
            subprocesses.send(rng.choice(hosts), signal.SIGKILL)
            hit += 1
        elif process == "station":
            bus_run.kill_station()
            if is_complete(bus_run):
                return hit
            bus_run.resume()
            hit += 1
    bus_run.wait_until_running("the run to resume while processes are killed")
    return hit


def is_complete(bus_run):
    """Whether the run is complete, so that there is nothing to resume."""
    summary = subprocesses.read_summary(bus_run.out)
    return summary is not None and summary["status"] == "complete"


def resume_if_ended(bus_run, why):
    """Resumes an ended run. Returns false if the run was complete."""
    if is_complete(bus_run):
        return False
    bus_run.resume_and_wait(why)
    return True


def inject_freeze(params, bus_run, rng):
    """Freezes a process with SIGSTOP and continues it later with SIGCONT."""
    hosts = bus_run.hosts()
    pid = bus_run.base_station.pid if params["process"] == "station" or not hosts else rng.choice(hosts)
    hit = bus_run.is_running()
    subprocesses.send(pid, signal.SIGSTOP)
    end_later(params, bus_run, lambda: subprocesses.send(pid, signal.SIGCONT))
    return hit


def end_later(params, bus_run, end):
    """Calls `end` after the duration of the fault. The next fault follows then, or overlaps it if `then` is set."""
    bus_run.workspace.schedule(params["for"], end)
    if not params["then"]:
        # The margin ensures that the fault is over.
        bus_run.workspace.rest(params["for"] + 2 * subprocesses.POLL_INTERVAL)


def inject_signal(params, bus_run, rng):
    """Sends a signal that requests the end of the run, then resumes the run."""
    hit = bus_run.is_running()
    if not bus_run.request_end(SIGNALS[params["by"]], params["by"]):
        return False
    return resume_if_ended(bus_run, params["by"]) and hit


def inject_held(params, bus_run, rng):
    """Sends a signal that requests the end while the run is waiting for a frozen device process."""
    hosts, base_station = bus_run.hosts(), bus_run.base_station
    if not hosts or not bus_run.is_running():
        return False
    waits_before = base_station.err().count("the run is waiting")
    pid = rng.choice(hosts)
    subprocesses.send(pid, signal.SIGSTOP)

    def is_waiting():
        return base_station.err().count("the run is waiting") > waits_before or bus_run.is_over()

    bus_run.workspace.wait("the clock to be held for a frozen process", is_waiting, within=END_LIMIT)
    hit = not bus_run.is_over()
    # The run ends in the middle of a TTI.
    is_interrupted = bus_run.request_end(SIGNALS[params["by"]], params["by"])
    # The process continues only now, since the clock must be held when the signal arrives.
    subprocesses.send(pid, signal.SIGCONT)
    return is_interrupted and resume_if_ended(bus_run, params["by"]) and hit


def inject_launcher(_, bus_run, rng):
    """Kills the shell that started the run with SIGKILL; the run continues."""
    hit = bus_run.is_running()
    shell = bus_run.base_station.shell
    if shell is None or shell.poll() is not None:
        return False
    subprocesses.send(shell.pid, signal.SIGKILL)
    shell.wait()
    return hit


def inject_partition(params, bus_run, rng):
    """Cuts a link and restores it later."""
    hit = bus_run.is_running()
    bus_run.link.cut()
    end_later(params, bus_run, bus_run.link.restore)
    return hit


def inject_strangers(params, bus_run, rng):
    """Attacks the run from a foreign zenoh client until the run ends."""
    script = Path(__file__).with_name("attacker.py")
    was_running = bus_run.is_running()
    seed = rng.randint(0, 10**6)
    command = [sys.executable, script, bus_run.endpoint, bus_run.name, params["doing"], seed]
    attacker = bus_run.workspace.start([], command=command)

    def is_ready():
        return "ready" in attacker.out() or attacker.poll() is not None

    # The run may end before the attacker has connected.
    bus_run.workspace.wait("the untrusted client to connect", lambda: is_ready() or bus_run.is_over(), within=30)
    if attacker.poll() not in (None, 0) and not bus_run.is_over():
        raise Failure(f"the untrusted client could not connect: {attacker.err()[-1000:]}")
    return was_running and not bus_run.is_over()


def inject_disk(_, bus_run, rng):
    """Fills the disk: the run ends with an error, and resumes after space is freed."""
    hit = bus_run.is_running()
    ballast = sandbox.fill(bus_run.out.parent)
    try:
        bus_run.workspace.wait("the end on a full disk", lambda: bus_run.base_station.poll() is not None, within=END_LIMIT)
    finally:
        ballast.unlink()
    code, stderr = bus_run.base_station.poll(), bus_run.base_station.err()
    if code == 0:
        return False
    if code != 1 or "No space left on device" not in stderr:
        raise Failure(f"on a full disk the run ended with {code}: {stderr[-2000:]}")
    if not (bus_run.out / "FAILED").exists():
        raise Failure(f"after a full disk FAILED is missing: {sorted(path.name for path in bus_run.out.iterdir())}")
    return resume_if_ended(bus_run, "a full disk") and hit
