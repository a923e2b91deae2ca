"""How runs end or survive: closed terminals, signals, frozen processes, killed launchers."""

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
from subprocesses import GONE, Failure, Ground

# Runs of about six seconds; one of them learns.
RUNS = [
    scenario.Scenario("knn", 40, 3000, 11, 2),
    scenario.Scenario("q-learning", 40, 3000, 12, 2),
]
FROZEN = 30


class Windowed:
    """A command in a pseudo-terminal."""

    def __init__(self, command, ground):
        self.master, slave = pty.openpty()

        def own():
            os.setsid()
            fcntl.ioctl(slave, termios.TIOCSCTTY, 0)

        self.popen = subprocess.Popen(
            [str(word) for word in command],
            cwd=ground.folder,
            env=ground.env,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            preexec_fn=own,
        )
        os.close(slave)
        subprocesses.STARTED.add(self.popen.pid)
        self.pid, self.name, self.shell, self.said = self.popen.pid, "terminal", None, b""
        self.is_open = True
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self):
        # A blocking read would keep the terminal open after it is closed.
        while self.is_open:
            if select.select([self.master], [], [], 0.05)[0]:
                try:
                    self.said += os.read(self.master, 4096)
                except OSError:
                    return

    def poll(self):
        """Returns the exit code, or None while the process lives."""
        return self.popen.poll()

    def err(self):
        """Returns the output on the terminal."""
        return self.said.decode(errors="replace")

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


def ended(game, code, why):
    """Checks that the run ends promptly with `code` and leaves no process; returns the seconds this took."""
    began = time.monotonic()
    game.ground.wait(f"the end after {why}", lambda: game.station.poll() is not None, within=bus_runs.ENDED_WITHIN)
    took = time.monotonic() - began
    if took > GONE:
        raise Failure(f"after {why} it took {took:.1f} s to end")
    if code is not None and game.station.poll() != code:
        raise Failure(f"after {why} it ended with {game.station.poll()}: {game.station.err()[-1500:]}")
    game.assert_no_process_left()
    return time.monotonic() - began


def by_terminal(game, end, why):
    """Starts a run in a terminal, calls `end` on the terminal, and resumes the run."""
    ground = game.ground
    # A user sees a progress bar in the terminal, so `--json` is left out here.
    options = [word for word in game.drive() if word != "--json"]
    command = [ground.reveille, "up", *game.scenario.args(), "-P", game.processes, *options, *game.place()]
    game.station = Windowed(command, ground)
    ground.processes.append(game.station)
    game.wait_until_running("a run in a terminal to begin")
    # A mark is written after one second.
    ground.rest(1.5)
    hit = game.is_running()
    end(game.station)
    took = ended(game, 130, why)
    if not hit:
        raise Failure("the run ended before the fault")
    if subprocesses.read_summary(game.out)["status"] != "interrupted":
        raise Failure(f"after {why} the status of the summary is not interrupted")
    game.station.kill()
    return f"ended in {took:.2f} s, resumed in {game.resume_and_wait(why):.2f} s"


def closed_terminal(game):
    return by_terminal(game, lambda window: window.close(), "a closed terminal")


def ctrl_c(game):
    return by_terminal(game, lambda window: window.press(b"\x03"), "Ctrl-C")


def by_signal(game, number, why):
    game.begin()
    game.ground.rest(1.5)
    if not game.is_running():
        raise Failure("the run ended before the fault")
    subprocesses.send(game.station.pid, number)
    took = ended(game, 130, why)
    return f"ended in {took:.2f} s, resumed in {game.resume_and_wait(why):.2f} s"


def sigterm(game):
    return by_signal(game, signal.SIGTERM, "SIGTERM")


def sighup(game):
    return by_signal(game, signal.SIGHUP, "SIGHUP")


def killed(game):
    """Kills `up` with SIGKILL; its device processes must not outlive it."""
    game.begin()
    game.ground.rest(1.5)
    began = time.monotonic()
    subprocesses.send(game.station.pid, signal.SIGKILL)
    game.station.kill()
    game.assert_no_process_left()
    took = time.monotonic() - began
    return f"no process left after {took:.2f} s, resumed in {game.resume_and_wait('SIGKILL'):.2f} s"


def killed_shell(game):
    """Kills the shell that started `up` with SIGKILL; the run continues to its end."""
    game.shell = True
    game.begin()
    game.ground.rest(1.5)
    subprocesses.send(game.station.shell.pid, signal.SIGKILL)
    game.station.shell.wait()
    game.ground.rest(1)
    if game.is_over():
        raise Failure("the run did not continue")
    return "the run continued"


def frozen(game, process):
    """Freezes a process with SIGSTOP for half a minute; the run waits, then continues."""
    game.begin()
    game.ground.rest(1)
    pid = game.station.pid if process == "the base station" else game.hosts()[0]
    subprocesses.send(pid, signal.SIGSTOP)
    game.ground.rest(1)
    before = game.mark()
    game.ground.rest(FROZEN - 1)
    after = game.mark()
    # The open TTI may still have closed.
    if after - before > 1:
        raise Failure(f"the clock advanced without {process}: TTI {before} to {after}")
    subprocesses.send(pid, signal.SIGCONT)
    thawed = time.monotonic()

    def has_continued():
        return game.mark() > after or game.is_over()

    game.ground.wait(f"the run to continue after {process} was frozen", has_continued, within=40)
    return f"frozen for {FROZEN} s, continued after {time.monotonic() - thawed:.2f} s"


def frozen_station(game):
    return frozen(game, "the base station")


def frozen_host(game):
    return frozen(game, "a device process")


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
    for played in RUNS:
        for name in chosen:
            folder = Path(tempfile.mkdtemp(prefix="chaos-")).resolve()
            ground = Ground(args.reveille, folder, 150)
            said, failure = "", ""
            try:
                expected = subprocesses.oracle(args.reveille, played, folder)
                game = bus_runs.Up(ground, played, f"chaos-{folder.name}", 4, ["--audit", "on"])
                said = PARTS[name](game)
                summary = game.finish()
                ground.assert_sane()
                if summary["digest"] != expected:
                    raise Failure(f"the digest is {summary['digest']} instead of {expected}")
            except Failure as error:
                failure, is_well = f"FAILED: {error}\n    files: {folder}", False
            finally:
                ground.close()
                if not failure:
                    shutil.rmtree(folder, ignore_errors=True)
            print(f"{name}, {played.policy}: {failure or said + ', no process left, digest equal'}", flush=True)
    return is_well
