"""Runs testbeds of docker-compose.yml and of `reveille testbed` on the Docker engine of this machine, undisturbed and with
faults. Every run must end with exit code 0 and the digest of `reveille run`.

    python3 tests/containers/check.py target/release/reveille [--only CASE …]

Needs docker and docker compose (v2 or 1.29). Without an image that RUNTIME_IMAGE names, deploy/docker/make-base-image.sh makes
one, as root. Some cases need root too: they kill processes inside containers. Containers, networks, volumes and the image of
the program are removed at the end; the base image stays for the next time. Without an engine it prints `SKIPPED: …` and ends
with 0.
"""

import argparse
import atexit
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
BASE_IMAGE = "reveille-base:local"
# Seconds.
PATIENCE = 180


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("reveille", type=Path)
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES))
    args = parser.parse_args()
    compose = find_compose()
    # A signal must not skip the clean-up.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    image = build_image(args.reveille.resolve())
    for name in args.only:
        started = time.monotonic()
        with Testbed(compose, args.reveille.resolve(), image) as testbed:
            note = CASES[name](testbed)
        print(f"{name}: passed in {time.monotonic() - started:.0f} s; {note}", flush=True)


def find_compose():
    """Returns the compose command of this machine; ends the program without one or without an engine."""
    if not shutil.which("docker") or run("docker", "info", check=False).returncode != 0:
        skip("no docker engine answers")
    if run("docker", "compose", "version", check=False).returncode == 0:
        return ["docker", "compose"]
    if shutil.which("docker-compose"):
        return ["docker-compose"]
    skip("neither `docker compose` nor docker-compose")


def skip(why):
    print(f"SKIPPED: {why}")
    sys.exit(0)


def run(*command, check=True, **options):
    end = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, **options)
    if check and end.returncode != 0:
        raise AssertionError(f"{' '.join(command)} ended with {end.returncode}: {end.stdout}{end.stderr}")
    return end


def build_image(reveille):
    image = f"reveille-test-{secrets.token_hex(4)}:test"
    scripts = REPOSITORY / "deploy/docker"
    runtime = os.environ.get("RUNTIME_IMAGE")
    if not runtime:
        runtime = BASE_IMAGE
        run(str(scripts / "make-base-image.sh"), runtime)
    os.environ["RUNTIME_IMAGE"] = runtime
    run(str(scripts / "build-prebuilt.sh"), image, str(reveille))
    atexit.register(run, "docker", "image", "rm", "--force", image, check=False)
    megabytes = int(run("docker", "image", "inspect", "--format", "{{.Size}}", image).stdout) / 1e6
    print(f"image: {megabytes:.0f} MB", flush=True)
    return image


class Testbed:
    """A separate compose project, removed at the end."""

    def __init__(self, compose, reveille, image):
        self.compose_command, self.reveille = compose, reveille
        self.project = f"reveille-test-{secrets.token_hex(4)}"
        # No settings inherited from another testbed, and any free port.
        self.environment = {name: value for name, value in os.environ.items() if not name.startswith("REVEILLE_")}
        self.environment |= {
            "COMPOSE_PROJECT_NAME": self.project,
            "COMPOSE_FILE": str(REPOSITORY / "docker-compose.yml"),
            "REVEILLE_IMAGE": image,
            "REVEILLE_PORT": "",
            "REVEILLE_METRICS_PORT": "",
        }
        self.device_services = ["device"]

    def __enter__(self):
        return self

    def __exit__(self, error_type, *_):
        if error_type:
            print(self.compose("logs", "--no-color", check=False).stdout, file=sys.stderr)
        self.compose("down", "--volumes", "--remove-orphans", "--timeout", "5", check=False)

    def compose(self, *args, check=True):
        return run(*self.compose_command, *args, check=check, env=self.environment)

    def start(self, replicas, **settings):
        """Starts a run with these values of REVEILLE_… variables."""
        self.environment |= {f"REVEILLE_{name}": str(value) for name, value in settings.items()}
        self.up("--scale", f"device={replicas}")

    def up(self, *options):
        self.compose("up", "--no-build", "--detach", *options)

    def container(self, service, number=1):
        filters = [f"com.docker.compose.{key}" for key in (f"project={self.project}", f"service={service}", f"container-number={number}")]
        options = [option for text in filters for option in ("--filter", f"label={text}")]
        return run("docker", "ps", "--all", "--quiet", *options).stdout.strip()

    def clock(self, *command):
        return run("docker", "exec", self.container("bs"), "reveille", "clock", *command, check=False).stdout.strip()

    def logs(self, service="bs"):
        end = run("docker", "logs", self.container(service))
        return end.stdout + end.stderr

    def wait_for(self, what, condition):
        deadline = time.monotonic() + PATIENCE
        while not (value := condition()):
            assert time.monotonic() < deadline, f"waited {PATIENCE} s for {what}; clock: {self.clock('status')}"
            time.sleep(0.1)
        return value

    def wait_for_tti(self, tti):
        def has_passed():
            status = self.clock("status")
            return status.startswith(("running", "waiting")) and int(status.split()[3]) >= tti

        self.wait_for(f"TTI {tti}", has_passed)

    def wait_for_text(self, text, service="bs"):
        self.wait_for(repr(text), lambda: text in self.logs(service))

    def finish(self):
        """Waits for the end of the run and checks it; returns the summary."""
        bs = self.container("bs")
        self.wait_for("the end", lambda: inspect(bs, "{{.State.Status}}") == "exited")
        assert inspect(bs, "{{.State.ExitCode}}") == "0", self.logs()
        self.wait_for("the replicas", lambda: all(
            inspect(container, "{{.State.Status}}") == "exited"
            for service in self.device_services
            for container in self.containers(service)
        ))
        with tempfile.TemporaryDirectory() as folder:
            run("docker", "cp", f"{bs}:/results/testbed/summary.json", folder)
            summary = json.loads((Path(folder) / "summary.json").read_text())
            settings = [f"--{name}={self.environment.get(f'REVEILLE_{name.upper()}', default)}" for name, default in RUN_DEFAULTS.items()]
            expected = run(str(self.reveille), "run", *settings, "--quiet", "--json", "--out", f"{folder}/out")
            assert summary["digest"] == json.loads(expected.stdout)["digest"], "another digest than in memory"
        return summary

    def containers(self, service):
        return run(
            "docker", "ps", "--all", "--quiet",
            "--filter", f"label=com.docker.compose.project={self.project}",
            "--filter", f"label=com.docker.compose.service={service}",
        ).stdout.split()


# The defaults of docker-compose.yml.
RUN_DEFAULTS = {"policy": "knn", "devices": 50, "ttis": 2000, "seed": 1}


def inspect(container, form):
    return run("docker", "inspect", "--format", form, container).stdout.strip()


def kill_process(container):
    """Kills the processes of a container, as the kernel does when memory runs out. The engine may restart the container."""
    os.kill(int(inspect(container, "{{.State.Pid}}")), signal.SIGKILL)


def five_replicas(testbed):
    started = time.monotonic()
    testbed.start(5)
    summary = testbed.finish()
    assert summary["timing"]["hosts"] == 5, summary["timing"]
    return f"50 devices in 5 replicas, {time.monotonic() - started:.1f} s from the command to the end"


def twenty_replicas(testbed):
    started = time.monotonic()
    testbed.start(20, DEVICES=200, TTIS=3000, PACE="5ms")
    testbed.wait_for_tti(1)
    ready = time.monotonic() - started
    testbed.wait_for_tti(100)
    memory = run("docker", "stats", "--no-stream", "--format", "{{.MemUsage}}", *testbed.containers("device")).stdout.split("\n")
    hosts = testbed.clock("status", "--hosts").splitlines()[1:]
    assert len(hosts) == 20 and all(" on " in host and "(" in host for host in hosts), hosts
    testbed.finish()
    return f"200 devices in 20 replicas, first TTI after {ready:.1f} s, memory of a replica {memory[0].split(' / ')[0]}"


def faults(testbed):
    """Kills and cuts off replicas and the base station in one run."""
    testbed.start(5, TTIS=2500, PACE="10ms")
    testbed.wait_for_tti(100)
    replica = [testbed.container("device", number) for number in range(1, 6)]
    # The engine restarts a process that dies; another replica, or the new process, runs its devices.
    kill_process(replica[0])
    testbed.wait_for_text("had no host for")
    assert f"on {replica[0]} (" in testbed.logs(), "the log names the container"
    testbed.wait_for("a restart", lambda: inspect(replica[0], "{{.RestartCount}} {{.State.Running}}") == "1 true")
    # The engine restarts no container that a user kills.
    run("docker", "kill", replica[1])
    testbed.wait_for_tti(400)
    run("docker", "pause", replica[2])
    time.sleep(4)
    run("docker", "unpause", replica[2])
    testbed.wait_for_tti(600)
    network = f"{testbed.project}_testbed"
    run("docker", "network", "disconnect", "--force", network, replica[3])
    time.sleep(5)
    run("docker", "network", "connect", network, replica[3])
    testbed.wait_for_tti(900)
    # The hosts of the first base station keep their devices until the second one is there.
    bs = testbed.container("bs")
    kill_process(bs)
    testbed.wait_for("a restart", lambda: inspect(bs, "{{.RestartCount}} {{.State.Running}}") == "1 true")
    testbed.wait_for_text("replaying the run up to TTI")
    summary = testbed.finish()
    return f"{summary['timing']['losses']} losses of processes after the base station was killed"


def full_disk(testbed):
    """Fills the disk of the results; with more space, the same command resumes the run."""
    with tempfile.TemporaryDirectory() as folder:
        run("mount", "-t", "tmpfs", "-o", "size=64k,uid=10001,gid=10001", "tmpfs", folder)
        try:
            testbed.start(2, RESULTS=folder, TTIS=20000)
            bs = testbed.container("bs")
            testbed.wait_for("the last attempt", lambda: inspect(bs, "{{.State.Status}}") == "exited")
            assert inspect(bs, "{{.State.ExitCode}}") == "1", testbed.logs()
            assert "No space left on device" in testbed.logs(), testbed.logs()
            run("mount", "-o", "remount,size=10m", folder)
            testbed.up("--scale", "device=2")
            testbed.finish()
        finally:
            testbed.compose("down", "--timeout", "5", check=False)
            run("umount", folder)
    return "resumed after the disk was full"


class Stack(Testbed):
    """The same testbed as a stack on a swarm of this machine only."""

    def __enter__(self):
        run("docker", "swarm", "init", "--advertise-addr=127.0.0.1", "--listen-addr=127.0.0.1")
        return self

    def __exit__(self, error_type, *_):
        if error_type:
            print(run("docker", "service", "logs", f"{self.project}_bs", check=False).stderr, file=sys.stderr)
        run("docker", "stack", "rm", self.project, check=False)
        self.wait_for("the end of the stack", lambda: not self.containers("bs") and not self.containers("device"))
        run("docker", "volume", "rm", f"{self.project}_results", check=False)
        run("docker", "swarm", "leave", "--force")
        run("docker", "network", "rm", "docker_gwbridge", check=False)

    def up(self, *_options):
        with tempfile.TemporaryDirectory() as folder:
            stack, key = Path(folder, "stack.json"), Path(folder, "key/run.key")
            key.parent.mkdir()
            key.write_text(secrets.token_hex(16))
            run(str(self.reveille), "tls", "init", f"{folder}/tls", "--name=bs")
            stack.write_text(run(str(REPOSITORY / "deploy/docker/stack.py"), env=self.environment).stdout)
            # Secrets have the names of files, with `-` in place of `/`.
            for secret in json.loads(stack.read_text())["secrets"]:
                file = secret.removeprefix("reveille-").replace("-", "/")
                run("docker", "secret", "create", secret, f"{folder}/{file}")
            run("docker", "stack", "deploy", "--resolve-image=never", "--compose-file", str(stack), self.project)

    def container(self, service, number=1):
        return self.containers(service)[number - 1]

    def containers(self, service):
        """Returns the containers of a service, the newest first."""
        label = f"label=com.docker.swarm.service.name={self.project}_{service}"
        return run("docker", "ps", "--all", "--quiet", "--filter", label).stdout.split()


def swarm(testbed):
    """Replaces the base station of a stack, as for a machine that is drained."""
    if run("docker", "info", "--format", "{{.Swarm.LocalNodeState}}").stdout.strip() != "inactive":
        return "SKIPPED, since this machine is in a swarm"
    with Stack(testbed.compose_command, testbed.reveille, testbed.environment["REVEILLE_IMAGE"]) as stack:
        stack.start(5, TTIS=3000, PACE="5ms")
        stack.wait_for("a base station", lambda: stack.containers("bs"))
        stack.wait_for_tti(300)
        run("docker", "service", "update", "--detach", "--force", f"{stack.project}_bs")
        stack.wait_for_text("replaying the run up to TTI")
        summary = stack.finish()
        assert summary["timing"]["hosts"] == 5, summary["timing"]
    return "a stack of 5 replicas, whose base station was replaced"


def federated(testbed):
    """Replicas on two networks behind two routers; the network of one router is cut for 5 s."""
    testbed.environment["COMPOSE_PROFILES"] = "federated"
    testbed.device_services = ["device-a", "device-b"]
    testbed.start(0, TTIS=1500, PACE="10ms")
    testbed.wait_for_tti(100)
    router, network = testbed.container("router-a"), f"{testbed.project}_testbed"
    for replica in testbed.containers("device-a"):
        networks = inspect(replica, "{{range $name, $_ := .NetworkSettings.Networks}}{{$name}}{{end}}")
        assert networks == f"{testbed.project}_network-a", networks
    run("docker", "network", "disconnect", "--force", network, router)
    testbed.wait_for_text("lost the base station", "router-a")
    time.sleep(5)
    run("docker", "network", "connect", network, router)
    testbed.wait_for_text("reconnected to run", "router-a")
    summary = testbed.finish()
    assert summary["timing"]["hosts"] == 4, summary["timing"]
    return f"4 replicas behind 2 routers, {summary['timing']['losses']} losses of processes after a network was cut"


def stranger_error(network, image, script):
    """Runs a script in a container on this network, which must fail; returns its standard error."""
    command = ["docker", "run", "--rm", "--network", network, "--tmpfs", "/tmp", "--entrypoint", "/bin/sh", image, "-c", script]
    end = run(*command, check=False)
    assert end.returncode == 1, end.stdout + end.stderr
    return end.stderr


def strangers(testbed):
    """Containers on the network of the testbed without a valid certificate are refused, and the run does not notice."""
    # At this pace the run lasts longer than the attempts; its rest is not delayed.
    testbed.start(2, TTIS=20000, PACE="10ms")
    testbed.wait_for_tti(1)
    network, image = f"{testbed.project}_testbed", testbed.environment["REVEILLE_IMAGE"]

    def stranger(script):
        return stranger_error(network, image, script)

    join = "reveille device --run testbed --connect-timeout 2s --connect"
    assert "no base station answers" in stranger(f"{join} tcp/bs:7447")
    testbed.wait_for_text("refused a TLS connection: received corrupt message")
    # The certificates of another CA, except that the stranger trusts the CA of the testbed.
    ca = run("docker", "exec", testbed.container("device"), "cat", "/tls/device/ca.pem").stdout
    own = f"reveille tls init /tmp/own >/tmp/shown && cat >/tmp/own/device/ca.pem <<'END'\n{ca}END\n"
    assert "no base station accepts a TLS connection" in stranger(f"{own}{join} tls/bs:7447 --tls /tmp/own")
    testbed.wait_for_text("refused a TLS connection: invalid peer certificate")
    # No container sees the keys of other roles.
    for service, roles in {"device": "device", "bs": "bs operator"}.items():
        keys = run("docker", "exec", testbed.container(service), "/bin/sh", "-c", "cd /tls && ls */key.pem").stdout.split()
        assert keys == [f"{role}/key.pem" for role in roles.split()], keys
    testbed.clock("pace", "max")
    summary = testbed.finish()
    assert summary["timing"]["losses"] == 0, summary["timing"]
    return "two strangers refused"


def ask_dashboard(url, path, method="GET"):
    """Returns the answer of a dashboard, which must be a success."""
    address, token = url.split("/#")
    request = urllib.request.Request(address + path, headers={"x-reveille-token": token}, method=method)
    with urllib.request.urlopen(request, timeout=10) as answer:
        return answer.read().decode()


def check_refusals(project, image):
    """Checks that a container without a certificate of the testbed cannot join its run, which must be active."""
    join = f"reveille device --run {project} --connect-timeout 2s --connect"
    for script, cause in {
        f"{join} tcp/bs:7447": "no base station answers",
        f"reveille tls init /tmp/own >/tmp/shown && {join} tls/bs:7447 --tls /tmp/own": "no base station accepts a TLS connection",
    }.items():
        error = stranger_error(f"{project}_testbed", image, script)
        assert cause in error, error


def container_of(project, service):
    """Returns the id of the container of a service, also of a stopped one."""
    labels = [f"--filter=label=com.docker.compose.{key}={value}" for key, value in [("project", project), ("service", service)]]
    return run("docker", "ps", "--all", "--quiet", *labels).stdout.strip()


def made_testbed(testbed):
    """Makes a testbed of two classes with `reveille testbed`, one of them behind a slow link, and runs it with a schedule of
    faults and the dashboard. The first `up` is interrupted, the second one resumes the run."""
    reveille = str(testbed.reveille)
    scenario = ["--scenario", str(REPOSITORY / "deploy/scenarios/two-classes.toml"), "--ttis", "1500", "--seed", "3"]
    schedule = ["300 kill bs", "500 kill weak-1", "700 disconnect strong-1 for 5s", "900 pause weak-link for 3s", "1100 slow weak-2 for 2s", "1300 pause bs for 4s", "1400 disconnect bs for 4s"]
    with tempfile.TemporaryDirectory() as folder:
        faults, out = Path(folder) / "faults.txt", f"{folder}/{testbed.project}-made"
        faults.write_text("\n".join(schedule))
        options = ["--dashboard", "--containers", "weak=3,strong=1", "--delay", "weak=5ms", "--loss", "weak=1%", "--cpus", "0.5", "--memory", "64m"]
        image, name = testbed.environment["REVEILLE_IMAGE"], f"{testbed.project}-made"
        label = f"label=com.docker.compose.project={name}"
        run(reveille, "testbed", "init", *scenario, *options, "--image", image, "--faults", str(faults), "--out", out)
        try:
            started = time.monotonic()
            interrupted = subprocess.Popen([reveille, "testbed", "up", out], stderr=subprocess.PIPE, text=True)
            notes, url = [], None
            act = "/api/act/energy?device=7&units=2.5"
            for line in interrupted.stderr:
                notes.append(line.rstrip("\n"))
                if line.startswith("dashboard at "):
                    assert url is None, notes
                    url = line.split()[2]
                    assert "<html" in ask_dashboard(url, "/") and "next" in json.loads(ask_dashboard(url, "/api/now"))
                    assert "receives 2.5 units" in ask_dashboard(url, act, "POST")
                    # The base station runs; after TTI 300 it would be down.
                    check_refusals(name, image)
                    second = run(reveille, "testbed", "up", out, check=False)
                    assert second.returncode == 1 and "another `reveille testbed up`" in second.stderr, second.stderr
                if line.startswith("TTI 500"):
                    # The page follows the base station that the engine has started again.
                    now = json.loads(ask_dashboard(url, "/api/now"))
                    assert now["reachable"] and not now["broken"] and now["next"] >= 499, now
                    assert "receives 2.5 units" in ask_dashboard(url, act, "POST")
                    clock = run(reveille, "testbed", "clock", out, "status").stdout
                    assert "TTI" in clock and "of 1500" in clock, clock
                    unknown = run(reveille, "testbed", "logs", out, "weak-9", check=False)
                    assert unknown.returncode == 1 and "the testbed has bs, " in unknown.stderr, unknown.stderr
                    interrupted.send_signal(signal.SIGINT)
            assert interrupted.wait() == 130, notes
            # On a busy machine the run reaches a third fault before the signal.
            done = [line for line in notes if line.startswith("TTI ")]
            assert len(done) >= 2 and done == [f"TTI {line.replace(' ', ': ', 1)}" for line in schedule[:len(done)]], notes
            end = run(reveille, "testbed", "up", out, "--check")
            notes = end.stderr.splitlines()
            for line in schedule[len(done):]:
                tti, fault = line.split(" ", 1)
                assert f"TTI {tti}: {fault}" in notes and f"restore {fault.split()[1]}" in notes, end.stderr
            assert "TTI 300: kill bs: skipped, since the run has passed this TTI" in notes, end.stderr
            duration = time.monotonic() - started
            summary = json.loads(Path(f"{out}/results/summary.json").read_text())
            assert f"digest {summary['digest']}" in end.stdout.splitlines() and f"results in {out}/results" in end.stdout, end.stdout
            actions = Path(f"{out}/results/inputs.log")
            assert actions.read_text().count("energy") == 2, actions.read_text()
            expected = run(reveille, "run", *scenario, "--input-log", str(actions), "--quiet", "--json", "--out", f"{folder}/out")
            assert summary["digest"] == json.loads(expected.stdout)["digest"], "another digest than in memory"
            # A fault of the base station loses all 4 processes, another fault at most 3.
            assert 4 <= summary["timing"]["losses"] <= 4 * len(schedule) and summary["timing"]["hosts"] == 4, summary["timing"]
            assert inspect(container_of(name, "weak-1"), "{{.HostConfig.Memory}} {{.HostConfig.NanoCpus}}") == f"{64 << 20} 500000000"
            status = run(reveille, "testbed", "status", out).stdout
            assert status.startswith(f"{name}: the run is over\n") and status.count("Exited (0)") == 6, status
            assert all(len(line) <= 110 for line in status.splitlines()), status
            # The dashboard stays and shows the whole run, also after the faults that cut it off.
            # It may still compute the TTIs that it missed.
            url, deadline = status.split("dashboard at ")[1].split()[0], time.monotonic() + 60
            while (shown := json.loads(ask_dashboard(url, "/api/now")))["next"] < 1500 and time.monotonic() < deadline:
                time.sleep(0.5)
            assert shown["next"] == 1500, (status, shown)
            for fault, cause in {"restore": "has ended (Exited (0)", "pause": "does not run (Exited (0)"}.items():
                end = run(reveille, "testbed", "fault", out, fault, "weak-1", check=False)
                assert end.returncode == 1 and cause in end.stderr and end.stderr.count("\n") == 1, end.stderr
            again = run(reveille, "testbed", "up", out)
            assert f"digest {summary['digest']}" in again.stdout, again.stdout
        finally:
            # Also after an edit that makes the description unreadable.
            Path(f"{out}/testbed.toml").write_text("name =")
            run(reveille, "testbed", "down", out)
        for kind in ("container", "volume", "network"):
            left = run("docker", kind, "ls", *(["--all"] if kind == "container" else []), "--quiet", "--filter", label).stdout
            assert not left, f"{kind}: {left}"
    return f"1500 TTIs with {len(schedule)} faults and an interruption in {duration:.0f} s, {summary['timing']['losses']} losses of processes in the last part"


CASES = {
    "five": five_replicas,
    "twenty": twenty_replicas,
    "faults": faults,
    "disk": full_disk,
    "strangers": strangers,
    "federated": federated,
    "swarm": swarm,
    "testbed": made_testbed,
}

if __name__ == "__main__":
    main()
