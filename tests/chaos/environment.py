"""Machines that lack disk space, rights, files, ports or a steady clock.

A command must be refused promptly with the cause, or continue; a run resumes with the digest of the run in memory.
"""

import os
import random
import shutil
import signal
import tempfile
import time
from pathlib import Path

import faults
import bus_runs
import sandbox
import subprocesses
import scenario
from subprocesses import Failure, Workspace

SCENARIO = scenario.Scenario("q-learning", 40, 2000, 21, 2)
SHORT = ["-n", "20", "-k", "400", "--json"]
# Seconds within which a command must refuse to start.
REFUSAL_LIMIT = 5
# User and group id of an unprivileged user.
NOBODY = 65534

# Moves the wall clock back an hour, forward a day, and back to 2001 during the life of a process.
JUMPING_CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <sys/time.h>
#include <time.h>
static int (*real)(clockid_t, struct timespec *);
static time_t jump(void) {
    static struct timespec first;
    struct timespec now;
    if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
    real(CLOCK_MONOTONIC, &now);
    if (!first.tv_sec) first = now;
    time_t lived = (now.tv_sec - first.tv_sec) % 8;
    return lived < 1 ? 0 : lived < 3 ? -3600 : lived < 5 ? 86400 : -700000000;
}
int clock_gettime(clockid_t id, struct timespec *t) {
    time_t by = jump();
    int code = real(id, t);
    if (id == CLOCK_REALTIME || id == CLOCK_REALTIME_COARSE) t->tv_sec += by;
    return code;
}
int gettimeofday(struct timeval *t, void *zone) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (t) { t->tv_sec = now.tv_sec; t->tv_usec = now.tv_nsec / 1000; }
    return 0;
}
time_t time(time_t *t) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (t) *t = now.tv_sec;
    return now.tv_sec;
}
"""


class Unsupported(Exception):
    """A condition that this machine cannot create."""


def check_refusal(workspace, args, parts, prefix=(), limit=REFUSAL_LIMIT, lines=1):
    """Checks that a command fails promptly with an error that contains all `parts`; returns the seconds it took."""
    started = time.monotonic()
    process = workspace.start(args, prefix=prefix)
    what = f"the refusal of {' '.join(map(str, args))}"
    workspace.wait(what, lambda: process.poll() is not None, within=4 * limit + 20)
    took, stderr = time.monotonic() - started, process.err()
    missing = [part for part in parts if part not in stderr]
    if process.poll() != 1 or missing or "panicked" in stderr or "reveille: " not in stderr:
        raise Failure(f"{what} is code {process.poll()}, without {missing}: {stderr[-2000:]}")
    if lines and len(stderr.strip().splitlines()) > lines:
        raise Failure(f"{what} has more than {lines} lines: {stderr[-2000:]}")
    if took > limit:
        raise Failure(f"{what} took {took:.1f} s: {stderr[-2000:]}")
    return took


def new_run(workspace, out="out", **how):
    """Returns a run of `SCENARIO`, not yet started."""
    return bus_runs.UpRun(workspace, SCENARIO, f"chaos-{workspace.folder.name}", how.pop("processes", 4), out=out, **how)


def check_digest(bus_run, expected):
    """Checks that the run ends with the digest of the run in memory."""
    summary = bus_run.finish()
    bus_run.workspace.assert_sane()
    if summary["digest"] != expected:
        raise Failure(f"the digest is {summary['digest']} instead of {expected}")


def full_disk(workspace, expected):
    disk = sandbox.small_disk(workspace, "disk", 512)
    if disk is None:
        raise Unsupported("a small disk needs root")
    bus_run = new_run(workspace, "disk/out")
    bus_run.begin()
    workspace.rest(1.2)
    started = time.monotonic()
    if not faults.inject_disk({}, bus_run, random):
        raise Failure("the run ended before the disk was full")
    took = time.monotonic() - started
    check_digest(bus_run, expected)
    ballast = sandbox.fill(disk)
    before = check_refusal(workspace, ["up", *SHORT, "--out", disk / "other"], ["No space left on device"])
    ballast.unlink()
    end = workspace.call(["up", *SHORT, "--out", disk / "other"])
    if end.returncode != 0:
        raise Failure(f"the refused run blocks another run: {end.stderr}")
    return f"ended and resumed in {took:.2f} s; refused before the run in {before:.2f} s"


def read_only(workspace, expected):
    disk = sandbox.small_disk(workspace, "disk", 4096)
    if disk is None:
        raise Unsupported("a small disk needs root")
    sandbox.must("mount", "-o", "remount,ro", str(disk))
    took = []
    for command in ("run", "up", "bs --run=chaos-ro --listen tcp/127.0.0.1:0"):
        args = [*command.split(), *SHORT, "--out", disk / "other"]
        took.append(check_refusal(workspace, args, ["Read-only file system", "disk/other"]))
    # Resumes a killed run whose folder has become read-only.
    sandbox.must("mount", "-o", "remount,rw", str(disk))
    bus_run = new_run(workspace, "disk/out")
    bus_run.begin()
    workspace.rest(1.5)
    bus_run.kill_station()
    sandbox.must("mount", "-o", "remount,ro", str(disk))
    took.append(check_refusal(workspace, ["up", "--resume", bus_run.out], ["Read-only file system", "disk/out"]))
    sandbox.must("mount", "-o", "remount,rw", str(disk))
    bus_run.resume_and_wait("a read-only folder")
    check_digest(bus_run, expected)
    return f"refused in {max(took):.2f} s, resumed when the folder was writable"


def no_rights(workspace, _):
    if os.geteuid() != 0 or not shutil.which("setpriv"):
        raise Unsupported("another user needs root and setpriv")
    workspace.folder.chmod(0o755)
    mine = workspace.folder / "mine"
    mine.mkdir(mode=0o755)
    prefix = ["setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups"]
    if not sandbox.can(*prefix, str(workspace.reveille), "--version"):
        raise Unsupported("another user cannot run the program in its folder")
    args = ["up", *SHORT, "--out", mine / "out"]
    took = check_refusal(workspace, args, ["Permission denied", "mine/out"], prefix)
    return f"refused in {took:.2f} s"


def clock(workspace, expected):
    source, library = workspace.folder / "jumps.c", workspace.folder / "jumps.so"
    source.write_text(JUMPING_CLOCK)
    if not sandbox.can("cc", "-shared", "-fPIC", "-o", str(library), str(source), "-ldl"):
        raise Unsupported("a jumping clock needs a C compiler")
    workspace.env["LD_PRELOAD"] = str(library)
    year_printer = workspace.start([], command=["python3", "-c", "import time; time.sleep(6); print(time.localtime().tm_year)"])
    workspace.wait("the date", lambda: year_printer.poll() is not None)
    if int(year_printer.out() or 0) > 2010:
        raise Unsupported(f"the clock does not jump: {year_printer.out()}")
    bus_run = new_run(workspace)
    bus_run.begin()
    workspace.rest(3)
    subprocesses.send(bus_run.hosts()[0], signal.SIGKILL)
    workspace.rest(0.5)
    bus_run.kill_station()
    took = bus_run.resume_and_wait("SIGKILL with a jumping clock")
    check_digest(bus_run, expected)
    timing = subprocesses.read_summary(bus_run.out)["timing"]
    if not 0 < timing["run_s"] < 120:
        raise Failure(f"the summary states a run time of {timing['run_s']} s")
    workspace.env.pop("LD_PRELOAD")
    return f"clock an hour back, a day forward and in 2001: taken over, and resumed in {took:.2f} s"


def few_files(workspace, _):
    def limited(files):
        return ["sh", "-c", f'ulimit -n {files}; exec "$@"', "sh"]

    fifty_processes = ["up", "-n", "50", "-k", "400", "-P", "50", "--out", "out"]
    took = [
        check_refusal(workspace, fifty_processes, ["64 files", "ulimit -n 98"], limited(64)),
        check_refusal(workspace, ["up", *SHORT, "--out", "out"], ["24 files", "ulimit -n 52"], limited(24)),
        check_refusal(workspace, ["bs", *SHORT, "--run=x", "--out", "out"], ["24 files"], limited(24)),
        check_refusal(workspace, ["device", "--run=x", "--connect", "tcp/127.0.0.1:9"], ["24 files"], limited(24)),
    ]
    if (workspace.folder / "out").exists():
        raise Failure("a refused run left a folder")
    return f"64 and 24 refused in {max(took):.2f} s"


def no_ports(workspace, expected):
    if not sandbox.has_networks():
        raise Unsupported("a network namespace needs root and iproute2")
    # Four ports in all: the base station takes one, and each device process takes one.
    namespace = sandbox.Namespace(workspace, [("ipv4.ip_local_port_range", "40000 40003")])
    args = ["up", *SCENARIO.args(), "-P", "10", "--out", workspace.folder / "out"]
    took = check_refusal(workspace, args, ["port"], namespace.prefix(), limit=12, lines=0)
    stderr = workspace.processes[-1].err()
    if not any("no free port" in line for line in stderr.splitlines()):
        raise Failure(f"the error does not name the cause: {stderr}")
    if not (workspace.folder / "out/FAILED").exists():
        raise Failure("the file FAILED is missing")
    namespace.inside("sh", "-c", "echo '40000 41000' > /proc/sys/net/ipv4/ip_local_port_range")
    resumed = workspace.start(["up", "--resume", workspace.folder / "out", "-P", "10", "--json"], prefix=namespace.prefix())
    workspace.wait("the run without ports", lambda: resumed.poll() is not None, within=60)
    summary = subprocesses.read_summary(workspace.folder / "out")
    if resumed.poll() != 0 or not summary or summary["digest"] != expected:
        raise Failure(f"the resumed run ended with {resumed.poll()}: {resumed.err()}")
    return f"refused in {took:.2f} s, resumed with ports"


def foreign_registry(workspace, expected):
    if os.geteuid() != 0:
        raise Unsupported("a folder of another user needs root")
    registry = workspace.folder / "reveille"
    registry.mkdir(mode=0o700)
    (registry / "trap.json").write_text('{"run":"trap","endpoint":"tcp/127.0.0.1:9","pid":1,"key":null}')
    for path in (registry, registry / "trap.json"):
        os.chown(path, NOBODY, NOBODY)
    took = check_refusal(workspace, ["clock", "status"], ["belongs to another user"])
    out = workspace.folder / "out"
    up = workspace.start(["up", *SCENARIO.args(), "--out", out, "--json"])
    workspace.wait("the end of the run", lambda: up.poll() is not None, within=60)
    summary = subprocesses.read_summary(out)
    if up.poll() != 0 or not summary or summary["digest"] != expected:
        raise Failure(f"the run ended with {up.poll()}: {up.err()}")
    if "belongs to another user" not in up.err():
        raise Failure(f"the run does not report the folder: {up.err()}")
    if [path.name for path in registry.iterdir()] != ["trap.json"]:
        raise Failure("the run wrote into the folder of another user")
    return f"clock refused in {took:.2f} s, the run continued with a warning"


PARTS = {
    "disk": full_disk,
    "read-only": read_only,
    "rights": no_rights,
    "clock": clock,
    "files": few_files,
    "ports": no_ports,
    "registry": foreign_registry,
}


def check(args):
    """Runs the chosen parts. Returns whether all passed."""
    is_well = True
    for name in args.only.split(",") if args.only else list(PARTS):
        folder = Path(tempfile.mkdtemp(prefix="chaos-")).resolve()
        workspace = Workspace(args.reveille, folder, 150)
        failed = False
        try:
            result = PARTS[name](workspace, subprocesses.digest_in_memory(args.reveille, SCENARIO, folder))
        except Unsupported as why:
            result = f"skipped: {why}"
        except Failure as failure:
            failed, is_well = True, False
            result = f"FAILED: {failure}\n    files: {folder}"
        finally:
            workspace.close()
            if not failed:
                shutil.rmtree(folder, ignore_errors=True)
        print(f"{name}: {result}", flush=True)
    return is_well
