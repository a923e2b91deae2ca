"""Processes of Reveille: started, watched and ended. Nothing is touched that was not started from here."""

import ctypes
import json
import os
import re
import signal
import subprocess
import threading
import time
from pathlib import Path

# Seconds between two looks.
LOOK = 0.02
# Seconds after which nothing of a run that has ended may be left.
GONE = 2.0

# Set when all is to end.
stop = threading.Event()

STARTED = set()
_starting = threading.Lock()


class Failure(Exception):
    """The tool has not kept its promise."""


class Hung(Failure):
    """Something has not come to its end in time."""


def adopt_orphans():
    """Makes this process the parent of those whose own parent was killed, so that all can be waited for."""
    ctypes.CDLL(None, use_errno=True).prctl(36, 1, 0, 0, 0)


def table():
    """All processes of the machine: the state and the parent of each."""
    found = {}
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            fields = Path(f"/proc/{name}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        found[int(name)] = (fields[0], int(fields[1]))
    return found


def children(pid):
    """The living children of a process."""
    return sorted(child for child, (state, parent) in table().items() if parent == pid and state not in "ZX")


def named(run):
    """The living processes of a run, by their command lines."""
    found = []
    for pid, (state, _) in table().items():
        try:
            line = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
        except OSError:
            continue
        if state not in "ZX" and f"--run={run}" in line:
            found.append(pid)
    return sorted(found)


def reap():
    """Waits for orphans that have ended."""
    for pid, (state, parent) in table().items():
        if state == "Z" and parent == os.getpid() and pid not in STARTED:
            try:
                os.waitpid(pid, os.WNOHANG)
            except ChildProcessError:
                pass


def kill_group(leader):
    """Ends what is left of a group of processes that was started from here."""
    for pid, (state, _) in table().items():
        try:
            is_member = state not in "ZX" and os.getsid(pid) == leader
        except OSError:
            continue
        if is_member:
            send(pid, signal.SIGKILL)


def send(pid, number):
    """Sends a signal to a process that may have gone."""
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        pass


class Process:
    """A process, with all that it says in files."""

    def __init__(self, command, folder, name, env=None, shell=False, cwd=None):
        self.name = name
        self.err_path = folder / f"{name}.err"
        self.out_path = folder / f"{name}.out"
        command = [str(word) for word in command]
        if shell:
            # Not the last command, so that the shell stays.
            command = ["sh", "-c", '"$@"; exit $?', "sh", *command]
        with open(self.out_path, "wb") as out, open(self.err_path, "wb") as err, _starting:
            self.popen = subprocess.Popen(
                command,
                cwd=cwd or folder,
                env=env,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                start_new_session=True,
            )
            STARTED.add(self.popen.pid)
        self.started = time.monotonic()
        self.shell = self.popen if shell else None
        self.pid = self.popen.pid
        self._code = None
        while shell and self.pid == self.popen.pid and self.popen.poll() is None:
            self.pid = next(iter(children(self.popen.pid)), self.pid)
            time.sleep(LOOK / 4)

    def poll(self):
        """The exit code, negative for a signal; None while it lives."""
        if self._code is None:
            if self.shell is None:
                self._code = self.popen.poll()
            elif self.shell.poll() is not None:
                self._code = self._poll_orphan()
        return self._code

    def _poll_orphan(self):
        """As `poll`, where a shell had started it that has ended."""
        if self.shell.returncode >= 0:
            return self.shell.returncode
        try:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
        except ChildProcessError:
            # Somebody else has it, or it was waited for.
            return None if Path(f"/proc/{self.pid}").exists() else -signal.SIGKILL
        return None if pid == 0 else os.waitstatus_to_exitcode(status)

    def kill(self):
        """Ends it with SIGKILL and waits for that."""
        if self.poll() is None:
            send(self.pid, signal.SIGKILL)
        if self.shell is not None and self.shell.poll() is None:
            send(self.shell.pid, signal.SIGKILL)
        until = time.monotonic() + 10
        while self.poll() is None and time.monotonic() < until:
            time.sleep(LOOK)
        if self.shell is not None:
            self.shell.wait()

    def err(self):
        """What it has said on standard error."""
        return self.err_path.read_text(errors="replace")

    def out(self):
        """What it has said on standard output."""
        return self.out_path.read_text(errors="replace")


class Ground:
    """A folder in which runs are played, the program, and the moment at which patience ends."""

    def __init__(self, reveille, folder, patience):
        self.reveille = reveille
        self.folder = folder
        self.env = dict(os.environ, XDG_RUNTIME_DIR=str(folder))
        self.env.pop("RUST_LOG", None)
        self.until = time.monotonic() + patience
        # No patience goes beyond this.
        self.last = time.monotonic() + 8 * patience
        self.patience = patience
        self.processes = []
        # Called at each look: those who keep the run going by hand.
        self.tending = lambda: None
        # What is to be done at which moment, such as an end of a fault that lasts.
        self.due = []
        self.undo = []

    def start(self, args, shell=False, prefix=(), command=None, cwd=None, env=None):
        """Starts `reveille ARGS`, or another command."""
        words = [*prefix, *(command or [self.reveille, *args])]
        name = f"{len(self.processes):02}-{Path(str(words[0] if command else args[0])).name}"
        process = Process(words, self.folder, name, env=env or self.env, shell=shell, cwd=cwd)
        self.processes.append(process)
        return process

    def call(self, args, patience=30):
        """Runs `reveille ARGS` to its end."""
        return subprocess.run(
            [str(self.reveille), *map(str, args)],
            cwd=self.folder,
            env=self.env,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=patience,
        )

    def extend(self, seconds):
        """There is patience for so long from now on, if there was less."""
        self.until = max(self.until, min(time.monotonic() + seconds, self.last))

    def later(self, seconds, act):
        """Does something after a while, whatever is waited for then."""
        self.due.append((time.monotonic() + seconds, act))

    def look_after(self):
        """Does what is due."""
        if stop.is_set():
            raise KeyboardInterrupt
        now = time.monotonic()
        for one in [one for one in self.due if one[0] <= now]:
            self.due.remove(one)
            one[1]()
        self.tending()

    def still(self):
        """How many seconds it takes until nothing is to be done any more."""
        return max([0.0, *(at - time.monotonic() for at, _ in self.due)])

    def wait(self, what, look, within=None):
        """Waits until `look` sees something, and gives that."""
        within = within and within + self.still()
        began = time.monotonic()
        while True:
            seen = look()
            if seen:
                return seen
            waited = time.monotonic() - began
            if time.monotonic() >= self.until or (within and waited >= within):
                raise Hung(f"waited {waited:.0f} s for {what}; {self.tails()}")
            self.look_after()
            time.sleep(LOOK)

    def rest(self, seconds):
        """Lets time pass."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.look_after()
            time.sleep(max(0, min(LOOK, until - time.monotonic())))

    def tails(self):
        """The last words of those who live, or of the last to end."""
        alive = [process for process in self.processes if process.poll() is None] or self.processes[-1:]
        said = [f"{process.name} (pid {process.pid}): {process.err().strip()[-600:] or 'silent'}" for process in alive]
        return "last words: " + "\n    ".join(said)

    def assert_sane(self):
        """Nobody has panicked."""
        for process in self.processes:
            if "panicked" in process.err():
                raise Failure(f"{process.name} has panicked: {process.err()[-2000:]}")

    def close(self):
        """Ends all that was started, and takes back what was done to the machine."""
        for process in self.processes:
            send(process.pid, signal.SIGCONT)
            process.kill()
            kill_group(process.popen.pid)
        for undo in reversed(self.undo):
            undo()
        self.undo.clear()
        reap()


def read_summary(folder):
    """The summary in a run folder, if there is one."""
    try:
        return json.loads((folder / "summary.json").read_text())
    except (OSError, ValueError):
        return None


def losses(text):
    """How long each loss lasted that another process has ended, by what a base station says."""
    return [float(seconds) for seconds in re.findall(r"carried again after ([\d.]+) s", text)]


def oracle(reveille, scenario, folder):
    """The digest of the same run in memory."""
    out = folder / "oracle"
    command = [str(reveille), "run", *scenario.args(), "--json", "--quiet", "--out", str(out)]
    end = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=300)
    if end.returncode != 0:
        raise Failure(f"{' '.join(command)} ended with {end.returncode}: {end.stderr}")
    return json.loads(end.stdout)["digest"]
