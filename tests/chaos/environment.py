"""Machines that lack disk space, rights, files, ports or a steady clock. Errors must be clear and prompt."""

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
from subprocesses import Failure, Ground

PLAYED = scenario.Scenario("q-learning", 40, 2000, 21, 2)
SHORT = ["-n", "20", "-k", "400", "--json"]
# Seconds within which a command must refuse to start.
SOON = 5
# User and group id of an unprivileged user.
UNPRIVILEGED = 65534

# Moves the wall clock back an hour, forward a day, and back to 2001 during the life of a process.
JUMPS = r"""
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


class Cannot(Exception):
    """A condition that this machine cannot provide."""


def refused(ground, args, parts, prefix=(), soon=SOON, lines=1):
    """Checks that a command fails promptly with an error that contains all `parts`; returns the seconds it took."""
    began = time.monotonic()
    process = ground.start(args, prefix=prefix)
    what = f"the refusal of {' '.join(map(str, args))}"
    ground.wait(what, lambda: process.poll() is not None, within=4 * soon + 20)
    took, said = time.monotonic() - began, process.err()
    lack = [part for part in parts if part not in said]
    if process.poll() != 1 or lack or "panicked" in said or "reveille: " not in said:
        raise Failure(f"{what} is code {process.poll()}, without {lack}: {said[-2000:]}")
    if lines and len(said.strip().splitlines()) > lines:
        raise Failure(f"{what} has more than {lines} lines: {said[-2000:]}")
    if took > soon:
        raise Failure(f"{what} took {took:.1f} s: {said[-2000:]}")
    return took


def played(ground, out="out", **how):
    """Returns a run of the scenario, not yet started."""
    return bus_runs.Up(ground, PLAYED, f"chaos-{ground.folder.name}", how.pop("processes", 4), out=out, **how)


def ends_equal(game, expected):
    """Checks that the run ends with the digest of the run in memory."""
    summary = game.finish()
    game.ground.assert_sane()
    if summary["digest"] != expected:
        raise Failure(f"the digest is {summary['digest']} instead of {expected}")


def full_disk(ground, expected):
    disk = sandbox.small_disk(ground, "disk", 512)
    if disk is None:
        raise Cannot("a small disk needs root")
    game = played(ground, "disk/out")
    game.begin()
    ground.rest(1.2)
    began = time.monotonic()
    if not faults.strike_disk({}, game, random):
        raise Failure("the run ended before the disk was full")
    took = time.monotonic() - began
    ends_equal(game, expected)
    ballast = sandbox.fill(disk)
    before = refused(ground, ["up", *SHORT, "--out", disk / "other"], ["No space left on device"])
    ballast.unlink()
    end = ground.call(["up", *SHORT, "--out", disk / "other"])
    if end.returncode != 0:
        raise Failure(f"the refused run blocks another run: {end.stderr}")
    return f"ended and resumed in {took:.2f} s; refused before the run in {before:.2f} s"


def read_only(ground, expected):
    disk = sandbox.small_disk(ground, "disk", 4096)
    if disk is None:
        raise Cannot("a small disk needs root")
    sandbox.must("mount", "-o", "remount,ro", str(disk))
    took = []
    for command in ("run", "up", "bs --run=chaos-ro --listen tcp/127.0.0.1:0"):
        args = [*command.split(), *SHORT, "--out", disk / "other"]
        took.append(refused(ground, args, ["Read-only file system", "disk/other"]))
    # Resumes a killed run whose folder has become read-only.
    sandbox.must("mount", "-o", "remount,rw", str(disk))
    game = played(ground, "disk/out")
    game.begin()
    ground.rest(1.5)
    game.kill_station()
    sandbox.must("mount", "-o", "remount,ro", str(disk))
    took.append(refused(ground, ["up", "--resume", game.out], ["Read-only file system", "disk/out"]))
    sandbox.must("mount", "-o", "remount,rw", str(disk))
    game.resume_and_wait("a read-only folder")
    ends_equal(game, expected)
    return f"refused in {max(took):.2f} s, resumed when the folder was writable"


def no_rights(ground, _):
    if os.geteuid() != 0 or not shutil.which("setpriv"):
        raise Cannot("another user needs root and setpriv")
    ground.folder.chmod(0o755)
    mine = ground.folder / "mine"
    mine.mkdir(mode=0o755)
    prefix = ["setpriv", f"--reuid={UNPRIVILEGED}", f"--regid={UNPRIVILEGED}", "--clear-groups"]
    if not sandbox.can(*prefix, str(ground.reveille), "--version"):
        raise Cannot("another user cannot run the program in its folder")
    args = ["up", *SHORT, "--out", mine / "out"]
    took = refused(ground, args, ["Permission denied", "mine/out"], prefix)
    return f"refused in {took:.2f} s"


def clock(ground, expected):
    source, library = ground.folder / "jumps.c", ground.folder / "jumps.so"
    source.write_text(JUMPS)
    if not sandbox.can("cc", "-shared", "-fPIC", "-o", str(library), str(source), "-ldl"):
        raise Cannot("a jumping clock needs a C compiler")
    ground.env["LD_PRELOAD"] = str(library)
    shown = ground.start([], command=["python3", "-c", "import time; time.sleep(6); print(time.localtime().tm_year)"])
    ground.wait("the date", lambda: shown.poll() is not None)
    if int(shown.out() or 0) > 2010:
        raise Cannot(f"the clock does not jump: {shown.out()}")
    game = played(ground)
    game.begin()
    ground.rest(3)
    subprocesses.send(game.hosts()[0], signal.SIGKILL)
    ground.rest(0.5)
    game.kill_station()
    took = game.resume_and_wait("SIGKILL with a jumping clock")
    ends_equal(game, expected)
    timing = subprocesses.read_summary(game.out)["timing"]
    if not 0 < timing["run_s"] < 120:
        raise Failure(f"the summary states a run time of {timing['run_s']} s")
    ground.env.pop("LD_PRELOAD")
    return f"clock an hour back, a day forward and in 2001: taken over, and resumed in {took:.2f} s"


def few_files(ground, _):
    def limited(files):
        return ["sh", "-c", f'ulimit -n {files}; exec "$@"', "sh"]

    fifty = ["up", "-n", "50", "-k", "400", "-P", "50", "--out", "out"]
    took = [
        refused(ground, fifty, ["64 files", "ulimit -n 98"], limited(64)),
        refused(ground, ["up", *SHORT, "--out", "out"], ["24 files", "ulimit -n 52"], limited(24)),
        refused(ground, ["bs", *SHORT, "--run=x", "--out", "out"], ["24 files"], limited(24)),
        refused(ground, ["device", "--run=x", "--connect", "tcp/127.0.0.1:9"], ["24 files"], limited(24)),
    ]
    if (ground.folder / "out").exists():
        raise Failure("a refused run left a folder")
    return f"64 and 24 refused in {max(took):.2f} s"


def no_ports(ground, expected):
    if not sandbox.has_networks():
        raise Cannot("a network namespace needs root and iproute2")
    # Four ports in all: the base station takes one, and each device process takes one.
    space = sandbox.Namespace(ground, [("ipv4.ip_local_port_range", "40000 40003")])
    args = ["up", *PLAYED.args(), "-P", "10", "--out", ground.folder / "out"]
    took = refused(ground, args, ["port"], space.prefix(), soon=12, lines=0)
    said = ground.processes[-1].err()
    if not any("no free port" in line for line in said.splitlines()):
        raise Failure(f"the error does not name the cause: {said}")
    if not (ground.folder / "out/FAILED").exists():
        raise Failure("the file FAILED is missing")
    space.inside("sh", "-c", "echo '40000 41000' > /proc/sys/net/ipv4/ip_local_port_range")
    again = ground.start(["up", "--resume", ground.folder / "out", "-P", "10", "--json"], prefix=space.prefix())
    ground.wait("the run without ports", lambda: again.poll() is not None, within=60)
    summary = subprocesses.read_summary(ground.folder / "out")
    if again.poll() != 0 or not summary or summary["digest"] != expected:
        raise Failure(f"the resumed run ended with {again.poll()}: {again.err()}")
    return f"refused in {took:.2f} s, resumed with ports"


def foreign_registry(ground, expected):
    if os.geteuid() != 0:
        raise Cannot("a folder of another user needs root")
    registry = ground.folder / "reveille"
    registry.mkdir(mode=0o700)
    (registry / "trap.json").write_text('{"run":"trap","endpoint":"tcp/127.0.0.1:9","pid":1,"key":null}')
    for path in (registry, registry / "trap.json"):
        os.chown(path, UNPRIVILEGED, UNPRIVILEGED)
    took = refused(ground, ["clock", "status"], ["belongs to another user"])
    out = ground.folder / "out"
    up = ground.start(["up", *PLAYED.args(), "--out", out, "--json"])
    ground.wait("the end of the run", lambda: up.poll() is not None, within=60)
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
        ground = Ground(args.reveille, folder, 150)
        failed = False
        try:
            said = PARTS[name](ground, subprocesses.oracle(args.reveille, PLAYED, folder))
        except Cannot as why:
            said = f"skipped: {why}"
        except Failure as failure:
            failed, is_well = True, False
            said = f"FAILED: {failure}\n    files: {folder}"
        finally:
            ground.close()
            if not failed:
                shutil.rmtree(folder, ignore_errors=True)
        print(f"{name}: {said}", flush=True)
    return is_well
