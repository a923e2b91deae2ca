"""Starts, watches and ends Reveille processes. It touches only processes that it started itself."""

import ctypes
import json
import os
import re
import signal
import subprocess
import threading
import time
from pathlib import Path

# Polling interval in seconds.
POLL_INTERVAL = 0.02
# Seconds after which no process of an ended run may remain.
EXIT_LIMIT = 2.0

# Set to end the whole test program.
stop = threading.Event()

STARTED = set()
_starting = threading.Lock()


class Failure(Exception):
    """A property of the program that a case found violated."""


class Hung(Failure):
    """A condition that did not become true in time."""


def adopt_orphans():
    """Makes this process the parent of orphaned descendants, so that it can wait for all of them."""
    # 36 is PR_SET_CHILD_SUBREAPER.
    ctypes.CDLL(None, use_errno=True).prctl(36, 1, 0, 0, 0)


def process_table():
    """Returns the state and the parent of each process of the machine."""
    found = {}
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            # The name before the last parenthesis can contain spaces.
            fields = Path(f"/proc/{name}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        found[int(name)] = (fields[0], int(fields[1]))
    return found


def children(pid):
    """Returns the living children of a process."""
    return sorted(child for child, (state, parent) in process_table().items() if parent == pid and state not in "ZX")


def processes_of(run):
    """Returns the living processes whose command line names the run."""
    found = []
    for pid, (state, _) in process_table().items():
        try:
            arguments = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
        except OSError:
            continue
        if state not in "ZX" and f"--run={run}" in arguments:
            found.append(pid)
    return sorted(found)


def reap():
    """Reaps orphans that have ended."""
    for pid, (state, parent) in process_table().items():
        # Popen waits for its own children: a wait here would take their exit codes.
        if state == "Z" and parent == os.getpid() and pid not in STARTED:
            try:
                os.waitpid(pid, os.WNOHANG)
            except ChildProcessError:
                pass


def kill_group(leader):
    """Kills the remaining processes of the session with this leader, which this program started."""
    for pid, (state, _) in process_table().items():
        try:
            is_member = state not in "ZX" and os.getsid(pid) == leader
        except OSError:
            continue
        if is_member:
            send(pid, signal.SIGKILL)


def send(pid, signum):
    """Sends a signal to a process that may have ended already."""
    try:
        os.kill(pid, signum)
    except ProcessLookupError:
        pass


class Process:
    """A process whose standard output and standard error go to files."""

    def __init__(self, command, folder, name, env=None, shell=False, cwd=None):
        self.name = name
        self.err_path = folder / f"{name}.err"
        self.out_path = folder / f"{name}.out"
        command = [str(word) for word in command]
        if shell:
            # The shell would replace itself with its last command; `exit` after the command keeps it alive.
            command = ["sh", "-c", '"$@"; exit $?', "sh", *command]
        with open(self.out_path, "wb") as out, open(self.err_path, "wb") as err, _starting:
            # Every process leads a session, so that `kill_group` finds its children.
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
        # The shell needs a moment to start the command, whose pid is the one to watch.
        while shell and self.pid == self.popen.pid and self.popen.poll() is None:
            self.pid = next(iter(children(self.popen.pid)), self.pid)
            time.sleep(POLL_INTERVAL / 4)

    def poll(self):
        """Returns the exit code, negative for a signal, or None while the process lives."""
        if self._code is None:
            if self.shell is None:
                self._code = self.popen.poll()
            elif self.shell.poll() is not None:
                self._code = self._poll_orphan()
        return self._code

    def _poll_orphan(self):
        """Polls the process after the shell that started it has ended."""
        # A shell that exited normally passed on the exit code of its command.
        if self.shell.returncode >= 0:
            return self.shell.returncode
        # The shell was killed, so the command is now a child of this process.
        try:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
        except ChildProcessError:
            # It has another parent, or was already reaped.
            return None if Path(f"/proc/{self.pid}").exists() else -signal.SIGKILL
        return None if pid == 0 else os.waitstatus_to_exitcode(status)

    def kill(self):
        """Kills the process with SIGKILL and waits for its end."""
        if self.poll() is None:
            send(self.pid, signal.SIGKILL)
        if self.shell is not None and self.shell.poll() is None:
            send(self.shell.pid, signal.SIGKILL)
        deadline = time.monotonic() + 10
        while self.poll() is None and time.monotonic() < deadline:
            time.sleep(POLL_INTERVAL)
        if self.shell is not None:
            self.shell.wait()

    def err(self):
        """Returns its standard error."""
        return self.err_path.read_text(errors="replace")

    def out(self):
        """Returns its standard output."""
        return self.out_path.read_text(errors="replace")


class Workspace:
    """The folder and environment of a case, the program under test, and the deadline."""

    def __init__(self, reveille, folder, patience):
        self.reveille = reveille
        self.folder = folder
        self.env = dict(os.environ, XDG_RUNTIME_DIR=str(folder))
        self.env.pop("RUST_LOG", None)
        self.deadline = time.monotonic() + patience
        # `extend` never moves the deadline beyond this.
        self.latest_deadline = time.monotonic() + 8 * patience
        self.patience = patience
        self.processes = []
        # Called at each poll: restarts device processes that were started separately.
        self.on_poll = lambda: None
        # Pending actions with their times, such as the end of a lasting fault.
        self.pending = []
        self.cleanups = []

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
        """Moves the deadline to at least `seconds` from now, but not beyond the last one."""
        self.deadline = max(self.deadline, min(time.monotonic() + seconds, self.latest_deadline))

    def schedule(self, seconds, act):
        """Schedules `act`, which runs even while the test waits for something else."""
        self.pending.append((time.monotonic() + seconds, act))

    def run_due_actions(self):
        """Runs the pending actions that are due."""
        if stop.is_set():
            raise KeyboardInterrupt
        now = time.monotonic()
        for entry in [entry for entry in self.pending if entry[0] <= now]:
            self.pending.remove(entry)
            entry[1]()
        self.on_poll()

    def pending_seconds(self):
        """Returns the seconds until the last pending action, 0 without one."""
        return max([0.0, *(at - time.monotonic() for at, _ in self.pending)])

    def wait(self, what, condition, within=None):
        """Polls `look` until it returns a true value, and returns that value."""
        # Faults that are still due can delay the result.
        within = within and within + self.pending_seconds()
        started = time.monotonic()
        while True:
            value = condition()
            if value:
                return value
            waited = time.monotonic() - started
            if time.monotonic() >= self.deadline or (within and waited >= within):
                raise Hung(f"waited {waited:.0f} s for {what}; {self.describe_output()}")
            self.run_due_actions()
            time.sleep(POLL_INTERVAL)

    def rest(self, seconds):
        """Waits for a time while pending actions continue to run."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.run_due_actions()
            time.sleep(max(0, min(POLL_INTERVAL, deadline - time.monotonic())))

    def describe_output(self):
        """Returns the end of the standard error of the living processes, or of the last started one."""
        alive = [process for process in self.processes if process.poll() is None] or self.processes[-1:]
        outputs = [f"{process.name} (pid {process.pid}): {process.err().strip()[-600:] or 'silent'}" for process in alive]
        return "last output: " + "\n    ".join(outputs)

    def assert_sane(self):
        """Fails if a process panicked."""
        for process in self.processes:
            if "panicked" in process.err():
                raise Failure(f"{process.name} has panicked: {process.err()[-2000:]}")

    def close(self):
        """Kills every started process and reverts the changes to the machine."""
        for process in self.processes:
            send(process.pid, signal.SIGCONT)
            process.kill()
            kill_group(process.popen.pid)
        for clean_up in reversed(self.cleanups):
            clean_up()
        self.cleanups.clear()
        reap()


def read_summary(folder):
    """Returns the summary of a run folder, or None without a summary."""
    try:
        return json.loads((folder / "summary.json").read_text())
    except (OSError, ValueError):
        return None


def takeover_times(text):
    """Parses a base station's log: seconds until another process took over, for each lost host."""
    return [float(seconds) for seconds in re.findall(r"had no host for ([\d.]+) s", text)]


def digest_in_memory(reveille, scenario, folder):
    """Returns the digest of the same scenario in `reveille run`."""
    out = folder / "in-memory"
    command = [str(reveille), "run", *scenario.args(), "--json", "--quiet", "--out", str(out)]
    end = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=300)
    if end.returncode != 0:
        raise Failure(f"{' '.join(command)} ended with {end.returncode}: {end.stderr}")
    return json.loads(end.stdout)["digest"]
