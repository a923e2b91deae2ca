"""Runs over the bus, with or without manually started device processes."""

import re
import signal
import socket
import subprocess
import time

import subprocesses
from subprocesses import GONE, Failure

# Seconds allowed for resuming a run on a busy machine, and for ending one by a signal.
RESUMED_WITHIN = 40
ENDED_WITHIN = 15
# Seconds until a new run writes its first mark, with a margin for a busy machine.
MARKED = 1.5
# Seconds without a new TTI after which a run counts as hung.
STALLED = 60
# Message of `up` about a device process that ends repeatedly.
REPEATED_FAILURE = "processes before it"


def free_port(host="127.0.0.1"):
    """Returns a port that was free a moment ago."""
    with socket.socket() as listener:
        listener.bind((host, 0))
        return listener.getsockname()[1]


class ClockPoller:
    """Polls the clock of a run without blocking, since a frozen base station gives no answer."""

    def __init__(self, game):
        self.game = game
        self.asked = None
        self.due = time.monotonic()

    def look(self):
        """Returns the status line of the clock once it runs, None before."""
        now = time.monotonic()
        if self.asked is None:
            if now < self.due:
                return None
            ground = self.game.ground
            command = [str(ground.reveille), "clock", "status", "--run", self.game.name]
            how = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
            self.asked = subprocess.Popen(command, cwd=ground.folder, env=ground.env, text=True, **how)
        if self.asked.poll() is None:
            return None
        said = self.asked.communicate()[0]
        self.asked, self.due = None, now + 0.05
        return said if said.startswith("running at TTI") else None

    def end(self):
        """Stops polling."""
        if self.asked is not None:
            self.asked.kill()
            self.asked.communicate()


class Game:
    """A run over the bus."""

    def __init__(self, ground, scenario, name, options=(), out="out"):
        self.ground = ground
        self.scenario = scenario
        self.name = name
        self.options = list(options)
        self.out = ground.folder / out
        self.address = "127.0.0.1"
        self.endpoint = None
        # A small window gives many rows, so that a disk fills quickly.
        self.window = 5
        self.station = None
        self.begun = None
        self.seen = 0
        self.resumes = []
        ground.tending = self.tend

    def tend(self):
        """Does the work of an operator, such as restarting device processes."""

    def hosts(self):
        """Returns the device processes."""
        raise NotImplementedError

    def drive(self):
        """Returns the options of the command that starts or resumes the run."""
        if self.endpoint is None:
            self.endpoint = f"tcp/{self.address}:{free_port(self.address)}"
        pace = ["--pace", f"{self.scenario.pace_ms}ms"] if self.scenario.pace_ms else []
        return [*pace, f"--run={self.name}", "--listen", self.endpoint, "--json", *self.options]

    def place(self):
        """Returns the options of a new run; a resumed run reads them from its folder."""
        return ["--window", self.window, "--out", self.out]

    def is_over(self):
        """Whether the run has ended or has written its summary."""
        return self.station.poll() is not None or subprocesses.read_summary(self.out) is not None

    def is_running(self):
        """Whether TTIs are being played, so that a fault hits the run."""
        # A new run has no mark yet.
        fresh = self.begun is not None and time.monotonic() - self.begun < MARKED
        return not self.is_over() and ((self.out / "resume.json").exists() or fresh)

    def wait_until_running(self, what):
        """Waits for the first TTI and returns the status line of the clock."""
        poller = ClockPoller(self)

        def look():
            return "ended" if self.station.poll() is not None else poller.look()

        try:
            said = self.ground.wait(what, look, within=RESUMED_WITHIN)
        finally:
            poller.end()
        if said == "ended" and self.station.poll() != 0:
            code = self.station.poll()
            raise Failure(f"the run ended with {code} before {what}: {self.station.err()[-2000:]}")
        self.begun = time.monotonic()
        return said

    def mark(self):
        """Returns the TTI of the last mark, 0 without one."""
        try:
            return int(re.search(r'"tti":\s*(\d+)', (self.out / "resume.json").read_text())[1])
        except (OSError, TypeError):
            return 0

    def resume_and_wait(self, why):
        """Resumes the run and returns the seconds until its clock runs again."""
        began = time.monotonic()
        self.resume()
        self.wait_until_running(f"the run to resume after {why}")
        seconds = time.monotonic() - began
        self.resumes.append(seconds)
        return seconds

    def request_end(self, number, why):
        """Sends a signal that requests the end. Returns false if the run completed before it."""
        subprocesses.send(self.station.pid, number)
        code = self.ground.wait(f"the end after {why}", lambda: self.station.poll() is not None, within=ENDED_WITHIN)
        code = self.station.poll()
        summary = subprocesses.read_summary(self.out)
        if code == 0 and summary and summary["status"] == "complete":
            return False
        if code != 130 or not summary or summary["status"] != "interrupted":
            said = summary and summary["status"]
            raise Failure(f"after {why} exit code {code}, summary {said}: {self.station.err()[-2000:]}")
        return True

    def finish(self):
        """Waits for the end and returns the summary."""
        self.ground.wait("the end of the run", self.has_ended)
        if self.station.poll() == 1 and REPEATED_FAILURE in self.station.err():
            # Repeated kills of the same device process end a run, which can then be resumed.
            self.resume_and_wait("six kills of one device process")
            self.ground.wait("the end of the run", self.has_ended)
        code, summary = self.station.poll(), subprocesses.read_summary(self.out)
        if code != 0 or summary is None or summary["status"] != "complete":
            raise Failure(f"the run ended with {code}: {self.station.err()[-3000:]}")
        self.leave()
        self.assert_no_process_left()
        for left in ("RUNNING", "FAILED", "resume.json"):
            if (self.out / left).exists():
                raise Failure(f"the folder of a finished run still holds {left}")
        return summary

    def has_ended(self):
        """Whether the run has ended. A run that still advances on a busy machine gets more time."""
        if (mark := self.mark()) != self.seen:
            self.seen = mark
            self.ground.extend(STALLED)
        return self.station.poll() is not None

    def leave(self):
        """Ends the remaining device processes after the run."""

    def assert_no_process_left(self):
        """Fails if a process of an ended run remains."""
        until = time.monotonic() + GONE
        while left := subprocesses.named(self.name):
            if time.monotonic() > until:
                raise Failure(f"processes {left} remain {GONE:.0f} s after the end")
            time.sleep(subprocesses.LOOK)

    def losses(self):
        """Returns the seconds until takeover of each lost host, over all commands of the run."""
        texts = [process.err() for process in self.ground.processes]
        return [seconds for text in texts for seconds in subprocesses.losses(text)]


class Up(Game):
    """A run of `reveille up`."""

    def __init__(self, ground, scenario, name, processes, options=(), out="out", shell=False):
        super().__init__(ground, scenario, name, options, out)
        self.processes = processes
        self.shell = shell

    def begin(self):
        """Starts the run."""
        args = ["up", *self.scenario.args(), "-P", self.processes, *self.drive(), *self.place()]
        self.station = self.ground.start(args, shell=self.shell)
        return self.wait_until_running("the run to begin")

    def resume(self):
        """Resumes the run from its folder."""
        args = ["up", "--resume", self.out, "-P", self.processes, *self.drive()]
        self.station = self.ground.start(args, shell=self.shell)

    def hosts(self):
        """Returns the device processes."""
        return subprocesses.children(self.station.pid) if self.station.poll() is None else []

    def kill_station(self):
        """Kills the base station with SIGKILL; its device processes must end with it."""
        self.station.kill()
        self.assert_no_process_left()

    def kill_everything(self):
        """Kills all processes together with SIGKILL."""
        for pid in [self.station.pid, *self.hosts()]:
            subprocesses.send(pid, signal.SIGKILL)
        self.station.kill()
        self.assert_no_process_left()

    def __str__(self):
        return f"up -P {self.processes}"


class Hand(Game):
    """A run of `reveille bs` whose device processes are started by hand, optionally in another network namespace."""

    def __init__(self, ground, scenario, name, processes, options=(), out="out", patience=30, link=None):
        super().__init__(ground, scenario, name, options, out)
        self.shares = shares(scenario.devices, processes)
        self.patience = patience
        self.link = link
        self.by_hand = []
        self.again = 0
        if link:
            self.address = link.address

    def begin(self):
        """Starts the run."""
        args = ["bs", *self.scenario.args(), *self.drive(), *self.place()]
        self.station = self.ground.start(args)
        self.by_hand = [(count, self.device(count)) for count in self.shares]
        return self.wait_until_running("the run to begin")

    def device(self, count):
        """Starts a device process."""
        args = ["device", "--connect", self.endpoint, f"--run={self.name}", "--count", count]
        prefix = self.link.prefix() if self.link else ()
        return self.ground.start([*args, "--connect-timeout", f"{self.patience}s"], prefix=prefix)

    def tend(self):
        """Restarts device processes that were killed, ran out of patience, or were dismissed by an interrupted run."""
        if self.station is None or self.is_over():
            return
        for place, (count, process) in enumerate(self.by_hand):
            if process.poll() is not None:
                self.again += 1
                self.by_hand[place] = (count, self.device(count))

    def resume(self):
        """Resumes the base station; device processes may still live."""
        self.station = self.ground.start(["bs", "--resume", self.out, *self.drive()])

    def hosts(self):
        """Returns the device processes."""
        return [process.pid for _, process in self.by_hand if process.poll() is None]

    def kill_station(self):
        """Kills only the base station with SIGKILL."""
        self.station.kill()

    def kill_everything(self):
        """Kills all processes together with SIGKILL."""
        for pid in [self.station.pid, *self.hosts()]:
            subprocesses.send(pid, signal.SIGKILL)
        self.station.kill()
        for _, process in self.by_hand:
            process.kill()

    def leave(self):
        """Waits for hosts with devices to exit, then terminates spare device processes."""
        until = time.monotonic() + GONE
        while self.hosts() and time.monotonic() < until:
            time.sleep(subprocesses.LOOK)
        for pid in self.hosts():
            subprocesses.send(pid, signal.SIGTERM)

    def __str__(self):
        where = " behind a link" if self.link else ""
        return f"bs with {len(self.shares)} device processes{where}, patience {self.patience} s"


def shares(devices, processes):
    """Returns the number of devices of each process."""
    return [devices // processes + (place < devices % processes) for place in range(processes)]
