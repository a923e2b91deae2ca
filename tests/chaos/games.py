"""Runs over the bus, and whoever looks after them."""

import re
import signal
import socket
import subprocess
import time

import program
from program import GONE, Failure

# Seconds in which a run is taken up at the most on a busy machine, and in which a signal ends one.
TAKEN_UP = 40
TOLD = 15
# Seconds until a run that has begun leaves its first mark, with some for a busy machine.
MARKED = 1.5
# Seconds after which a run hangs that comes to no other TTI.
STALLED = 60
# What `up` says of a device process that ends again and again.
HOPELESS = "before it did in its place"


def free_port(host="127.0.0.1"):
    """A port that was free a moment ago."""
    with socket.socket() as listener:
        listener.bind((host, 0))
        return listener.getsockname()[1]


class Asking:
    """Asks the clock of a run where it is, again and again, and waits for no answer: a station may be frozen."""

    def __init__(self, game):
        self.game = game
        self.asked = None
        self.due = time.monotonic()

    def look(self):
        """What the clock says, once it runs."""
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
        """Asks no more."""
        if self.asked is not None:
            self.asked.kill()
            self.asked.communicate()


class Game:
    """A run that is played over the bus."""

    def __init__(self, ground, scenario, name, options=(), out="out"):
        self.ground = ground
        self.scenario = scenario
        self.name = name
        self.options = list(options)
        self.out = ground.folder / out
        self.address = "127.0.0.1"
        self.endpoint = None
        # Many rows, so that a disk is soon full.
        self.window = 5
        self.station = None
        self.begun = None
        self.seen = 0
        self.resumes = []
        ground.tending = self.tend

    def tend(self):
        """What somebody does who looks after the run."""

    def hosts(self):
        """The processes that carry devices."""
        raise NotImplementedError

    def drive(self):
        """The options of the run's command."""
        if self.endpoint is None:
            self.endpoint = f"tcp/{self.address}:{free_port(self.address)}"
        pace = ["--pace", f"{self.scenario.pace_ms}ms"] if self.scenario.pace_ms else []
        return [*pace, f"--run={self.name}", "--listen", self.endpoint, "--json", *self.options]

    def place(self):
        """The options of a run that begins, which one that is taken up has in its folder."""
        return ["--window", self.window, "--out", self.out]

    def is_over(self):
        """Whether the run has come to an end, or is at it."""
        return self.station.poll() is not None or program.read_summary(self.out) is not None

    def is_running(self):
        """Whether TTIs are being played: a fault hits a run."""
        fresh = self.begun is not None and time.monotonic() - self.begun < MARKED
        return not self.is_over() and ((self.out / "mark.json").exists() or fresh)

    def wait_until_running(self, what):
        """Waits for the first TTI; gives what the clock says."""
        asking = Asking(self)

        def look():
            return "ended" if self.station.poll() is not None else asking.look()

        try:
            said = self.ground.wait(what, look, within=TAKEN_UP)
        finally:
            asking.end()
        if said == "ended" and self.station.poll() != 0:
            code = self.station.poll()
            raise Failure(f"waited for {what}, and it ended with {code}: {self.station.err()[-2000:]}")
        self.begun = time.monotonic()
        return said

    def mark(self):
        """The TTI of the last mark; 0 without one."""
        try:
            return int(re.search(r'"tti":\s*(\d+)', (self.out / "mark.json").read_text())[1])
        except (OSError, TypeError):
            return 0

    def go_on(self, why):
        """Takes the run up; gives the seconds until its clock runs again."""
        began = time.monotonic()
        self.resume()
        self.wait_until_running(f"the run to be taken up after {why}")
        seconds = time.monotonic() - began
        self.resumes.append(seconds)
        return seconds

    def told(self, number, why):
        """A signal asks for the end: the run ends in order."""
        program.send(self.station.pid, number)
        code = self.ground.wait(f"the end that {why} asks for", lambda: self.station.poll() is not None, within=TOLD)
        code = self.station.poll()
        summary = program.read_summary(self.out)
        if code == 0 and summary and summary["status"] == "complete":
            return False
        if code != 130 or not summary or summary["status"] != "interrupted":
            said = summary and summary["status"]
            raise Failure(f"after {why} exit code {code}, summary {said}: {self.station.err()[-2000:]}")
        return True

    def finish(self):
        """Waits for the end; gives the summary."""
        self.ground.wait("the end of the run", self.has_ended)
        if self.station.poll() == 1 and HOPELESS in self.station.err():
            # Chance has killed one place too often: that ends a run, and it can be taken up.
            self.go_on("six kills in one place")
            self.ground.wait("the end of the run", self.has_ended)
        code, summary = self.station.poll(), program.read_summary(self.out)
        if code != 0 or summary is None or summary["status"] != "complete":
            raise Failure(f"the run ended with {code}: {self.station.err()[-3000:]}")
        self.leave()
        self.assert_nobody_left()
        for left in ("RUNNING", "FAILED", "mark.json"):
            if (self.out / left).exists():
                raise Failure(f"{left} is left in the folder of a complete run")
        return summary

    def has_ended(self):
        """Whether the run has ended. One that goes on is slow on a busy machine, and does not hang."""
        if (mark := self.mark()) != self.seen:
            self.seen = mark
            self.ground.extend(STALLED)
        return self.station.poll() is not None

    def leave(self):
        """What is to be done at the end."""

    def assert_nobody_left(self):
        """Of a run that has ended nothing is left."""
        until = time.monotonic() + GONE
        while left := program.named(self.name):
            if time.monotonic() > until:
                raise Failure(f"processes {left} are left {GONE:.0f} s after the end")
            time.sleep(program.LOOK)

    def losses(self):
        """How long each loss lasted that another process ended, in all of the run's commands."""
        texts = [process.err() for process in self.ground.processes]
        return [seconds for text in texts for seconds in program.losses(text)]


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
        """Starts it once more."""
        args = ["up", "--resume", self.out, "-P", self.processes, *self.drive()]
        self.station = self.ground.start(args, shell=self.shell)

    def hosts(self):
        """The processes that carry devices."""
        return program.children(self.station.pid) if self.station.poll() is None else []

    def kill_station(self):
        """SIGKILL: its device processes go with it."""
        self.station.kill()
        self.assert_nobody_left()

    def kill_everything(self):
        """SIGKILL of all at once."""
        for pid in [self.station.pid, *self.hosts()]:
            program.send(pid, signal.SIGKILL)
        self.station.kill()
        self.assert_nobody_left()

    def __str__(self):
        return f"up -P {self.processes}"


class Hand(Game):
    """A run of `reveille bs` with device processes that are started by hand, in another network namespace or not."""

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
        """Starts a process that carries devices."""
        args = ["device", "--connect", self.endpoint, f"--run={self.name}", "--count", count]
        prefix = self.link.prefix() if self.link else ()
        return self.ground.start([*args, "--patience", f"{self.patience}s"], prefix=prefix)

    def tend(self):
        """Starts those again that were killed, have lost patience, or were dismissed by a run that was interrupted."""
        if self.station is None or self.is_over():
            return
        for place, (count, process) in enumerate(self.by_hand):
            if process.poll() is not None:
                self.again += 1
                self.by_hand[place] = (count, self.device(count))

    def resume(self):
        """Starts the base station once more; those who carry devices may live."""
        self.station = self.ground.start(["bs", "--resume", self.out, *self.drive()])

    def hosts(self):
        """The processes that carry devices."""
        return [process.pid for _, process in self.by_hand if process.poll() is None]

    def kill_station(self):
        """SIGKILL of the base station alone."""
        self.station.kill()

    def kill_everything(self):
        """SIGKILL of all at once."""
        for pid in [self.station.pid, *self.hosts()]:
            program.send(pid, signal.SIGKILL)
        self.station.kill()
        for _, process in self.by_hand:
            process.kill()

    def leave(self):
        """Those who carried devices leave by themselves, those who stand by in vain are told to."""
        until = time.monotonic() + GONE
        while self.hosts() and time.monotonic() < until:
            time.sleep(program.LOOK)
        for pid in self.hosts():
            program.send(pid, signal.SIGTERM)

    def __str__(self):
        where = " behind a link" if self.link else ""
        return f"bs with {len(self.shares)} device processes{where}, patience {self.patience} s"


def shares(devices, processes):
    """How many devices each process carries."""
    return [devices // processes + (place < devices % processes) for place in range(processes)]
