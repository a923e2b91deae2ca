"""Runs over the bus, by `up` or by `bs` with separately started device processes: start, resume, end and checks of the end."""

import re
import signal
import socket
import subprocess
import time

import subprocesses
from subprocesses import EXIT_LIMIT, Failure

# Seconds allowed for resuming a run on a busy machine, and for ending one by a signal.
RESUME_LIMIT = 40
END_LIMIT = 15
# Seconds until a new run writes its first resume mark, with a margin for a busy machine.
FIRST_MARK_SECONDS = 1.5
# Seconds without a new TTI after which a run counts as hung.
STALL_LIMIT = 60
# Message of `up` about a device process that ends repeatedly.
REPEATED_FAILURE = "processes before it"


def free_port(host="127.0.0.1"):
    """Returns a port that was free a moment ago."""
    with socket.socket() as listener:
        listener.bind((host, 0))
        return listener.getsockname()[1]


class ClockPoller:
    """Polls the status of a run without blocking, since a frozen base station gives no answer."""

    def __init__(self, bus_run):
        self.bus_run = bus_run
        self.query = None
        self.next_poll = time.monotonic()

    def poll_status(self):
        """Returns the status of the run once its clock runs, None before."""
        now = time.monotonic()
        if self.query is None:
            if now < self.next_poll:
                return None
            workspace = self.bus_run.workspace
            command = [str(workspace.reveille), "clock", "status", "--run", self.bus_run.name]
            streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
            self.query = subprocess.Popen(command, cwd=workspace.folder, env=workspace.env, text=True, **streams)
        if self.query.poll() is None:
            return None
        status = self.query.communicate()[0]
        self.query, self.next_poll = None, now + 0.05
        return status if status.startswith("running at TTI") else None

    def stop(self):
        """Stops polling."""
        if self.query is not None:
            self.query.kill()
            self.query.communicate()


class BusRun:
    """A run over the bus."""

    def __init__(self, workspace, scenario, name, options=(), out="out"):
        self.workspace = workspace
        self.scenario = scenario
        self.name = name
        self.options = list(options)
        self.out = workspace.folder / out
        self.address = "127.0.0.1"
        self.endpoint = None
        # A small window gives many rows, so that a disk fills quickly.
        self.window = 5
        self.base_station = None
        self.first_tti_at = None
        self.last_mark = 0
        self.resumes = []
        workspace.on_poll = self.restart_hosts

    def restart_hosts(self):
        """Restarts device processes that have ended; `up` does this itself."""

    def hosts(self):
        """Returns the device processes."""
        raise NotImplementedError

    def serve_options(self):
        """Returns the options common to the commands that start and resume the run."""
        if self.endpoint is None:
            self.endpoint = f"tcp/{self.address}:{free_port(self.address)}"
        pace = ["--pace", f"{self.scenario.pace_ms}ms"] if self.scenario.pace_ms else []
        return [*pace, f"--run={self.name}", "--listen", self.endpoint, "--json", *self.options]

    def new_run_options(self):
        """Returns the options of a new run only; a resumed run reads them from its folder."""
        return ["--window", self.window, "--out", self.out]

    def is_over(self):
        """Whether the run has ended or has written its summary."""
        return self.base_station.poll() is not None or subprocesses.read_summary(self.out) is not None

    def is_running(self):
        """Whether TTIs are being played, so that a fault hits the run."""
        # A new run has no mark yet.
        is_new = self.first_tti_at is not None and time.monotonic() - self.first_tti_at < FIRST_MARK_SECONDS
        return not self.is_over() and ((self.out / "resume.json").exists() or is_new)

    def wait_until_running(self, what):
        """Waits for the first TTI and returns the status line of the clock."""
        poller = ClockPoller(self)

        def poll():
            return "ended" if self.base_station.poll() is not None else poller.poll_status()

        try:
            status = self.workspace.wait(what, poll, within=RESUME_LIMIT)
        finally:
            poller.stop()
        if status == "ended" and self.base_station.poll() != 0:
            code = self.base_station.poll()
            raise Failure(f"the run ended with {code} before {what}: {self.base_station.err()[-2000:]}")
        self.first_tti_at = time.monotonic()
        return status

    def mark_tti(self):
        """Returns the TTI of the last resume mark, 0 without one."""
        try:
            return int(re.search(r'"tti":\s*(\d+)', (self.out / "resume.json").read_text())[1])
        except (OSError, TypeError):
            return 0

    def resume_and_wait(self, why):
        """Resumes the run and returns the seconds until its clock runs again."""
        started = time.monotonic()
        self.resume()
        self.wait_until_running(f"the run to resume after {why}")
        seconds = time.monotonic() - started
        self.resumes.append(seconds)
        return seconds

    def request_end(self, signum, why):
        """Sends a signal that requests the end. Returns false if the run completed before it."""
        subprocesses.send(self.base_station.pid, signum)
        self.workspace.wait(f"the end after {why}", lambda: self.base_station.poll() is not None, within=END_LIMIT)
        code = self.base_station.poll()
        summary = subprocesses.read_summary(self.out)
        if code == 0 and summary and summary["status"] == "complete":
            return False
        if code != 130 or not summary or summary["status"] != "interrupted":
            status = summary and summary["status"]
            raise Failure(f"after {why} exit code {code}, summary {status}: {self.base_station.err()[-2000:]}")
        return True

    def finish(self):
        """Waits for the end and returns the summary."""
        self.workspace.wait("the end of the run", self.has_ended)
        if self.base_station.poll() == 1 and REPEATED_FAILURE in self.base_station.err():
            # Repeated kills of the same device process end a run, which can then be resumed.
            self.resume_and_wait("six kills of one device process")
            self.workspace.wait("the end of the run", self.has_ended)
        code, summary = self.base_station.poll(), subprocesses.read_summary(self.out)
        if code != 0 or summary is None or summary["status"] != "complete":
            raise Failure(f"the run ended with {code}: {self.base_station.err()[-3000:]}")
        self.end_hosts()
        self.assert_no_process_left()
        for name in ("RUNNING", "FAILED", "resume.json"):
            if (self.out / name).exists():
                raise Failure(f"the folder of a finished run still holds {name}")
        return summary

    def has_ended(self):
        """Whether the run has ended. A run that still advances on a busy machine gets more time."""
        if (mark := self.mark_tti()) != self.last_mark:
            self.last_mark = mark
            self.workspace.extend(STALL_LIMIT)
        return self.base_station.poll() is not None

    def end_hosts(self):
        """Ends the remaining device processes after the run."""

    def assert_no_process_left(self):
        """Fails if a process of an ended run remains."""
        deadline = time.monotonic() + EXIT_LIMIT
        while pids := subprocesses.processes_of(self.name):
            if time.monotonic() > deadline:
                raise Failure(f"processes {pids} remain {EXIT_LIMIT:.0f} s after the end")
            time.sleep(subprocesses.POLL_INTERVAL)

    def takeover_times(self):
        """Returns the seconds until takeover of each lost host, over all commands of the run."""
        texts = [process.err() for process in self.workspace.processes]
        return [seconds for text in texts for seconds in subprocesses.takeover_times(text)]


class UpRun(BusRun):
    """A run of `reveille up`."""

    def __init__(self, workspace, scenario, name, processes, options=(), out="out", shell=False):
        super().__init__(workspace, scenario, name, options, out)
        self.processes = processes
        self.shell = shell

    def begin(self):
        """Starts the run."""
        args = ["up", *self.scenario.args(), "-P", self.processes, *self.serve_options(), *self.new_run_options()]
        self.base_station = self.workspace.start(args, shell=self.shell)
        return self.wait_until_running("the run to begin")

    def resume(self):
        """Resumes the run from its folder."""
        args = ["up", "--resume", self.out, "-P", self.processes, *self.serve_options()]
        self.base_station = self.workspace.start(args, shell=self.shell)

    def hosts(self):
        """Returns the device processes."""
        return subprocesses.children(self.base_station.pid) if self.base_station.poll() is None else []

    def kill_station(self):
        """Kills the base station with SIGKILL; its device processes must end with it."""
        self.base_station.kill()
        self.assert_no_process_left()

    def kill_everything(self):
        """Kills all processes together with SIGKILL."""
        for pid in [self.base_station.pid, *self.hosts()]:
            subprocesses.send(pid, signal.SIGKILL)
        self.base_station.kill()
        self.assert_no_process_left()

    def __str__(self):
        return f"up -P {self.processes}"


class ManualRun(BusRun):
    """A run of `reveille bs` with separately started device processes, optionally in another network namespace."""

    def __init__(self, workspace, scenario, name, processes, options=(), out="out", patience=30, link=None):
        super().__init__(workspace, scenario, name, options, out)
        self.shares = shares(scenario.devices, processes)
        self.patience = patience
        self.link = link
        self.manual_hosts = []
        self.restarts = 0
        if link:
            self.address = link.address

    def begin(self):
        """Starts the run."""
        args = ["bs", *self.scenario.args(), *self.serve_options(), *self.new_run_options()]
        self.base_station = self.workspace.start(args)
        self.manual_hosts = [(count, self.device(count)) for count in self.shares]
        return self.wait_until_running("the run to begin")

    def device(self, count):
        """Starts a device process."""
        args = ["device", "--connect", self.endpoint, f"--run={self.name}", "--count", count]
        prefix = self.link.prefix() if self.link else ()
        return self.workspace.start([*args, "--connect-timeout", f"{self.patience}s"], prefix=prefix)

    def restart_hosts(self):
        """Restarts device processes that were killed, ran out of patience, or were dismissed by an interrupted run."""
        if self.base_station is None or self.is_over():
            return
        for index, (count, process) in enumerate(self.manual_hosts):
            if process.poll() is not None:
                self.restarts += 1
                self.manual_hosts[index] = (count, self.device(count))

    def resume(self):
        """Resumes the base station; device processes may still live."""
        self.base_station = self.workspace.start(["bs", "--resume", self.out, *self.serve_options()])

    def hosts(self):
        """Returns the device processes."""
        return [process.pid for _, process in self.manual_hosts if process.poll() is None]

    def kill_station(self):
        """Kills only the base station with SIGKILL."""
        self.base_station.kill()

    def kill_everything(self):
        """Kills all processes together with SIGKILL."""
        for pid in [self.base_station.pid, *self.hosts()]:
            subprocesses.send(pid, signal.SIGKILL)
        self.base_station.kill()
        for _, process in self.manual_hosts:
            process.kill()

    def end_hosts(self):
        """Waits for hosts with devices to exit, then terminates spare device processes."""
        deadline = time.monotonic() + EXIT_LIMIT
        while self.hosts() and time.monotonic() < deadline:
            time.sleep(subprocesses.POLL_INTERVAL)
        for pid in self.hosts():
            subprocesses.send(pid, signal.SIGTERM)

    def __str__(self):
        where = " behind a link" if self.link else ""
        return f"bs with {len(self.shares)} device processes{where}, patience {self.patience} s"


def shares(devices, processes):
    """Returns the number of devices of each process."""
    return [devices // processes + (index < devices % processes) for index in range(processes)]
