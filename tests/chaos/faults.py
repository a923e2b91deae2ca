"""Draws faults and applies them to runs."""

import signal
import sys
from dataclasses import dataclass, field
from pathlib import Path

import sandbox
import subprocesses
from bus_runs import ENDED_WITHIN
from subprocesses import Failure

SIGNALS = {"SIGTERM": signal.SIGTERM, "SIGHUP": signal.SIGHUP, "Ctrl-C": signal.SIGINT}
ATTACKS = ["noise", "huge", "tokens", "clock", "stalled"]

# The kinds of faults possible under `up`, and with device processes started by hand.
UP = ["hosts", "station", "everything", "joining", "held", "freeze", "signal", "launcher", "strangers", "disk"]
HAND = ["hosts", "station", "everything", "joining", "held", "freeze", "signal", "partition", "strangers"]
KINDS = [*UP, "partition"]


@dataclass
class Fault:
    """A fault, and its delay in seconds after the fault before it."""

    kind: str
    after: float
    how: dict = field(default_factory=dict)

    def __str__(self):
        how = " ".join(str(value) for value in self.how.values() if value != "")
        return f"{self.kind} {how}".strip()


def draw(random, kind):
    """Draws the parameters of a fault."""
    how = {}
    match kind:
        case "hosts":
            how = {"killed": random.randint(1, 5), "within": round(random.choice([0.0, random.uniform(0, 1.5)]), 2)}
        case "joining":
            how["killed"] = "+".join(random.choice(["host", "station"]) for _ in range(random.randint(1, 4)))
        case "freeze":
            how["process"] = random.choice(["host", "station"])
            # 35 s is more than the 30 s after which an unresponsive host counts as lost.
            how["for"] = 35.0 if random.random() < 0.03 else round(random.uniform(1, 8), 1)
            how["then"] = random.choice(["", "overlapping"])
        case "signal" | "held":
            how["by"] = random.choice(sorted(SIGNALS))
        case "partition":
            how["for"] = 15.0 if random.random() < 0.1 else round(random.uniform(0.3, 6), 1)
            how["then"] = random.choice(["", "overlapping"])
        case "strangers":
            how["doing"] = "+".join(random.sample(ATTACKS, random.randint(1, len(ATTACKS))))
    return Fault(kind, round(random.uniform(0.2, 1.6), 2), how)


def strike(fault, game, random):
    """Applies a fault and resumes the run if it ended. Returns whether the fault hit a run in progress."""
    return globals()[f"strike_{fault.kind}"](fault.how, game, random)


def strike_hosts(how, game, random):
    """Kills device processes with SIGKILL, together or in sequence."""
    struck = set()
    for number in range(how["killed"]):
        if number:
            game.ground.rest(how["within"] / how["killed"])
        # A killed process can look alive for a moment.
        hosts = [pid for pid in game.hosts() if pid not in struck]
        if hosts and game.is_running():
            chosen = random.choice(hosts)
            struck.add(chosen)
            subprocesses.send(chosen, signal.SIGKILL)
    return len(struck)


def strike_station(_, game, random):
    """Kills the base station with SIGKILL."""
    hit = game.is_running()
    game.kill_station()
    return resume_if_ended(game, "SIGKILL of the base station") and hit


def strike_everything(_, game, random):
    """Kills all processes with SIGKILL."""
    hit = game.is_running()
    game.kill_everything()
    return resume_if_ended(game, "SIGKILL of everything") and hit


def strike_joining(how, game, random):
    """Kills everything with SIGKILL, and kills more processes while the run resumes."""
    hit = game.is_running()
    game.kill_everything()
    if is_complete(game):
        return False
    game.resume()
    for process in how["killed"].split("+"):
        game.ground.rest(random.uniform(0, 0.5))
        hosts = game.hosts()
        if process == "host" and hosts:
            subprocesses.send(random.choice(hosts), signal.SIGKILL)
            hit += 1
        elif process == "station":
            game.kill_station()
            if is_complete(game):
                return hit
            game.resume()
            hit += 1
    game.wait_until_running("the run to resume while processes are killed")
    return hit


def is_complete(game):
    """Whether the run is complete, so that there is nothing to resume."""
    summary = subprocesses.read_summary(game.out)
    return summary is not None and summary["status"] == "complete"


def resume_if_ended(game, why):
    """Resumes an ended run. Returns false if the run was complete."""
    if is_complete(game):
        return False
    game.resume_and_wait(why)
    return True


def strike_freeze(how, game, random):
    """Freezes a process with SIGSTOP and continues it later with SIGCONT."""
    hosts = game.hosts()
    pid = game.station.pid if how["process"] == "station" or not hosts else random.choice(hosts)
    hit = game.is_running()
    subprocesses.send(pid, signal.SIGSTOP)
    last(how, game, lambda: subprocesses.send(pid, signal.SIGCONT))
    return hit


def last(how, game, end):
    """Lets a fault last. The next fault follows its end, or overlaps it if `then` is set."""
    game.ground.later(how["for"], end)
    if not how["then"]:
        # The margin ensures that the fault is over.
        game.ground.rest(how["for"] + 2 * subprocesses.LOOK)


def strike_signal(how, game, random):
    """Sends a signal that requests the end of the run, then resumes the run."""
    hit = game.is_running()
    if not game.request_end(SIGNALS[how["by"]], how["by"]):
        return False
    return resume_if_ended(game, how["by"]) and hit


def strike_held(how, game, random):
    """Sends a signal that requests the end while the run is waiting for a frozen device process."""
    hosts, station = game.hosts(), game.station
    if not hosts or not game.is_running():
        return False
    before = station.err().count("the run is waiting")
    pid = random.choice(hosts)
    subprocesses.send(pid, signal.SIGSTOP)

    def held():
        return station.err().count("the run is waiting") > before or game.is_over()

    game.ground.wait("the clock to be held for a frozen process", held, within=ENDED_WITHIN)
    hit = not game.is_over()
    # The run ends in the middle of a TTI.
    is_told = game.request_end(SIGNALS[how["by"]], how["by"])
    # The process continues only now, since the clock must be held when the signal arrives.
    subprocesses.send(pid, signal.SIGCONT)
    return is_told and resume_if_ended(game, how["by"]) and hit


def strike_launcher(_, game, random):
    """Kills the shell that started the run with SIGKILL; the run continues."""
    hit = game.is_running()
    shell = game.station.shell
    if shell is None or shell.poll() is not None:
        return False
    subprocesses.send(shell.pid, signal.SIGKILL)
    shell.wait()
    return hit


def strike_partition(how, game, random):
    """Cuts a link and restores it later."""
    hit = game.is_running()
    game.link.cut()
    last(how, game, game.link.restore)
    return hit


def strike_strangers(how, game, random):
    """Attacks the run from a foreign zenoh client until the run ends."""
    script = Path(__file__).with_name("attacker.py")
    began = game.is_running()
    seed = random.randint(0, 10**6)
    command = [sys.executable, script, game.endpoint, game.name, how["doing"], seed]
    stranger = game.ground.start([], command=command)

    def there():
        return "there" in stranger.out() or stranger.poll() is not None

    # The run may end before the attacker has connected.
    game.ground.wait("the untrusted client to connect", lambda: there() or game.is_over(), within=30)
    if stranger.poll() not in (None, 0) and not game.is_over():
        raise Failure(f"the untrusted client could not connect: {stranger.err()[-1000:]}")
    return began and not game.is_over()


def strike_disk(_, game, random):
    """Fills the disk: the run ends with an error, and resumes after space is freed."""
    hit = game.is_running()
    ballast = sandbox.fill(game.out.parent)
    try:
        game.ground.wait("the end on a full disk", lambda: game.station.poll() is not None, within=ENDED_WITHIN)
    finally:
        ballast.unlink()
    code, said = game.station.poll(), game.station.err()
    if code == 0:
        return False
    if code != 1 or "No space left on device" not in said:
        raise Failure(f"on a full disk the run ended with {code}: {said[-2000:]}")
    if not (game.out / "FAILED").exists():
        raise Failure(f"after a full disk FAILED is missing: {sorted(path.name for path in game.out.iterdir())}")
    return resume_if_ended(game, "a full disk") and hit
