"""Runs that lose their terminal or shell, receive signals, or are frozen.

Each run ends promptly and resumes, or continues, with the digest of the run in memory.
"""

import fcntl
import os
import pty
import select
import shutil
import signal
import subprocess
import tempfile
import termios
import threading
import time
from pathlib import Path

import bus_runs
import subprocesses
import scenario
from subprocesses import EXIT_LIMIT, Failure, Workspace

# Runs of about six seconds; one of them learns.
SCENARIOS = [
    scenario.Scenario("knn", 40, 3000, 11, 2),
    scenario.Scenario("q-learning", 40, 3000, 12, 2),
]
FREEZE_SECONDS = 30


class TerminalProcess:
    """A command in a pseudo-terminal."""

    def __init__(self, command, workspace):
        self.master, slave = pty.openpty()

        def take_terminal():
            os.setsid()
            fcntl.ioctl(slave, termios.TIOCSCTTY, 0)

        self.popen = subprocess.Popen(
            [str(word) for word in command],
            cwd=workspace.folder,
            env=workspace.env,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            preexec_fn=take_terminal,
        )
        os.close(slave)
        subprocesses.STARTED.add(self.popen.pid)
        self.pid, self.name, self.shell, self.output = self.popen.pid, "terminal", None, b""
        self.is_open = True
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self):
        # A blocking read would keep the terminal open after it is closed.
        while self.is_open:
            if select.select([self.master], [], [], 0.05)[0]:
                try:
                    self.output += os.read(self.master, 4096)
                except OSError:
                    return

    def poll(self):
        """Returns the exit code, or None while the process lives."""
        return self.popen.poll()

    def err(self):
        """Returns the output on the terminal."""
        return self.output.decode(errors="replace")

    out = err

    def press(self, key):
        """Presses a key."""
        os.write(self.master, key)

    def close(self):
        """Closes the terminal, so that no process holds it any more."""
        if self.is_open:
            self.is_open = False
            self.reader.join()
            os.close(self.master)

    def kill(self):
        """Kills the process and closes the terminal."""
        if self.popen.poll() is None:
            self.popen.kill()
        self.popen.wait()
        self.close()


def check_end(bus_run, code, why):
    """Checks that the run ends promptly with `code` and leaves no process; returns the seconds this took."""
    started = time.monotonic()
    bus_run.workspace.wait(f"the end after {why}", lambda: bus_run.base_station.poll() is not None, within=bus_runs.END_LIMIT)
    took = time.monotonic() - started
    if took > EXIT_LIMIT:
        raise Failure(f"after {why} it took {took:.1f} s to end")
    if code is not None and bus_run.base_station.poll() != code:
        raise Failure(f"after {why} it ended with {bus_run.base_station.poll()}: {bus_run.base_station.err()[-1500:]}")
    bus_run.assert_no_process_left()
    return time.monotonic() - started


def check_in_terminal(bus_run, end, why):
    """Starts a run in a terminal, calls `end` on the terminal, and resumes the run."""
    workspace = bus_run.workspace
    # A user sees a progress bar in the terminal, so `--json` is left out here.
    options = [word for word in bus_run.serve_options() if word != "--json"]
    command = [workspace.reveille, "up", *bus_run.scenario.args(), "-P", bus_run.processes, *options, *bus_run.new_run_options()]
    bus_run.base_station = TerminalProcess(command, workspace)
    workspace.processes.append(bus_run.base_station)
    bus_run.wait_until_running("a run in a terminal to begin")
    # A mark is written after one second.
    workspace.rest(1.5)
    hit = bus_run.is_running()
    end(bus_run.base_station)
    took = check_end(bus_run, 130, why)
    if not hit:
        raise Failure("the run ended before the fault")
    if subprocesses.read_summary(bus_run.out)["status"] != "interrupted":
        raise Failure(f"after {why} the status of the summary is not interrupted")
    bus_run.base_station.kill()
    return f"ended in {took:.2f} s, resumed in {bus_run.resume_and_wait(why):.2f} s"


def closed_terminal(bus_run):
    return check_in_terminal(bus_run, lambda terminal: terminal.close(), "a closed terminal")


def ctrl_c(bus_run):
    return check_in_terminal(bus_run, lambda terminal: terminal.press(b"\x03"), "Ctrl-C")


def check_signal(bus_run, signum, why):
    bus_run.begin()
    bus_run.workspace.rest(1.5)
    if not bus_run.is_running():
        raise Failure("the run ended before the fault")
    subprocesses.send(bus_run.base_station.pid, signum)
    took = check_end(bus_run, 130, why)
    return f"ended in {took:.2f} s, resumed in {bus_run.resume_and_wait(why):.2f} s"


def sigterm(bus_run):
    return check_signal(bus_run, signal.SIGTERM, "SIGTERM")


def sighup(bus_run):
    return check_signal(bus_run, signal.SIGHUP, "SIGHUP")


def killed(bus_run):
    """Kills `up` with SIGKILL; its device processes must not outlive it."""
    bus_run.begin()
    bus_run.workspace.rest(1.5)
    began = time.monotonic()
    subprocesses.send(bus_run.base_station.pid, signal.SIGKILL)
    bus_run.base_station.kill()
    bus_run.assert_no_process_left()
    took = time.monotonic() - began
    return f"no process left after {took:.2f} s, resumed in {bus_run.resume_and_wait('SIGKILL'):.2f} s"


def killed_shell(bus_run):
    """Kills the shell that started `up` with SIGKILL; the run continues to its end."""
    bus_run.shell = True
    bus_run.begin()
    bus_run.workspace.rest(1.5)
    subprocesses.send(bus_run.base_station.shell.pid, signal.SIGKILL)
    bus_run.base_station.shell.wait()
    bus_run.workspace.rest(1)
    if bus_run.is_over():
        raise Failure("the run did not continue")
    return "the run continued"


def frozen(bus_run, process):
    """Freezes a process with SIGSTOP for half a minute; the run waits, then continues."""
    bus_run.begin()
    bus_run.workspace.rest(1)
    pid = bus_run.base_station.pid if process == "the base station" else bus_run.hosts()[0]
    subprocesses.send(pid, signal.SIGSTOP)
    bus_run.workspace.rest(1)
    before = bus_run.mark_tti()
    bus_run.workspace.rest(FREEZE_SECONDS - 1)
    after = bus_run.mark_tti()
    # The open TTI may still have closed.
    if after - before > 1:
        raise Failure(f"the clock advanced without {process}: TTI {before} to {after}")
    subprocesses.send(pid, signal.SIGCONT)
    thawed = time.monotonic()

    def has_continued():
        return bus_run.mark_tti() > after or bus_run.is_over()

    bus_run.workspace.wait(f"the run to continue after {process} was frozen", has_continued, within=40)
    return f"frozen for {FREEZE_SECONDS} s, continued after {time.monotonic() - thawed:.2f} s"


def frozen_station(bus_run):
    return frozen(bus_run, "the base station")


def frozen_host(bus_run):
    return frozen(bus_run, "a device process")


PARTS = {
    "terminal": closed_terminal,
    "ctrl-c": ctrl_c,
    "sigterm": sigterm,
    "sighup": sighup,
    "sigkill": killed,
    "shell": killed_shell,
    "station": frozen_station,
    "host": frozen_host,
}


def check(args):
    """Runs the chosen parts with each scenario. Returns whether all passed."""
    chosen = args.only.split(",") if args.only else list(PARTS)
    is_well = True
    for played in SCENARIOS:
        for name in chosen:
            folder = Path(tempfile.mkdtemp(prefix="chaos-")).resolve()
            workspace = Workspace(args.reveille, folder, 150)
            result, failure = "", ""
            try:
                expected = subprocesses.digest_in_memory(args.reveille, played, folder)
                bus_run = bus_runs.UpRun(workspace, played, f"chaos-{folder.name}", 4, ["--audit", "on"])
                result = PARTS[name](bus_run)
                summary = bus_run.finish()
                workspace.assert_sane()
                if summary["digest"] != expected:
                    raise Failure(f"the digest is {summary['digest']} instead of {expected}")
            except Failure as error:
                failure, is_well = f"FAILED: {error}\n    files: {folder}", False
            finally:
                workspace.close()
                if not failure:
                    shutil.rmtree(folder, ignore_errors=True)
            print(f"{name}, {played.policy}: {failure or result + ', no process left, digest equal'}", flush=True)
    return is_well
