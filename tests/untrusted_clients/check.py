#!/usr/bin/env python3
"""Attacks runs with a client that has no key: eclipse-zenoh, from PyPI.

    pip install eclipse-zenoh
    tests/untrusted_clients/check.py target/release/reveille

Each attack has its own run, which must end in time with the digest of `reveille run`. Names after the program select
attacks. Clients with a key are not tested here.
"""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time

import zenoh

from bus import ACT, COMMANDS, STATUS, WELCOME, WIRE, check_wire, keys_of, open_session

SCENARIO = ["-n", "30", "-k", "1200"]
# Timeout in seconds, more than four times the length of any run here.
PATIENCE = 60


def free_endpoint():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{listener.getsockname()[1]}"


class Run:
    """A run of `up` with four device processes, for one attacker."""

    def __init__(self, reveille, name, *args):
        self.folder = tempfile.mkdtemp(prefix="untrusted-")
        self.name, self.endpoint = name, free_endpoint()
        self.environment = dict(os.environ, XDG_RUNTIME_DIR=self.folder)
        self.reveille = reveille
        command = [reveille, "up", "-P", "4", *SCENARIO, "--pace", "3ms", "--paused", "--audit", "on"]
        command += ["--run", name, "--listen", self.endpoint, "--out", "out", "--json", *args]
        self.process = subprocess.Popen(
            command, cwd=self.folder, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.wait_until_paused()

    def clock(self, *args):
        command = [self.reveille, "clock", *args, "--run", self.name]
        return subprocess.run(command, cwd=self.folder, env=self.environment, capture_output=True, text=True)

    def wait_until_paused(self):
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            if "paused before TTI" in self.clock("status").stdout:
                return
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.05)
        raise AssertionError("the run does not begin")

    def resume(self):
        assert self.clock("resume").returncode == 0

    def memory_mb(self):
        """Returns the peak memory of the base station in MB; 0 once it has ended."""
        with open(f"/proc/{self.process.pid}/status") as status:
            peak_kb = re.search(r"VmHWM:\s+(\d+)", status.read())
            return int(peak_kb[1]) / 1024 if peak_kb else 0

    def finish(self):
        try:
            stdout, stderr = self.process.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            status = self.clock("status")
            self.process.kill()
            raise AssertionError((status.stdout, self.process.communicate()[1])) from None
        assert self.process.returncode == 0, (self.process.returncode, stderr)
        return json.loads(stdout), stderr


def send_noise(run):
    """Puts noise and replayed copies of observer messages on every key."""
    client = open_session(run.endpoint)
    copies = []
    listener = client.declare_subscriber(
        f"reveille/{run.name}/tap", lambda sample: copies.append(sample.payload.to_bytes())
    )
    run.resume()
    for _ in range(40):
        payloads = [bytes([WIRE, 0, 0]), bytes([WIRE, 2]), os.urandom(64), *copies[-4:]]
        for key in keys_of(run.name):
            for payload in payloads:
                try:
                    client.put(key, payload)
                except zenoh.ZError:
                    pass
        time.sleep(0.02)
    assert copies, "an observer receives no messages from the tap"
    listener.undeclare()
    return client


def listen(run):
    """Subscribes to everything; checks that only the tap and the base station's token are visible."""
    client = open_session(run.endpoint)
    received_keys, token_keys = set(), set()
    listeners = []
    for key in ["**", f"reveille/{run.name}/**", f"reveille/{run.name}/*/emu/**", f"reveille/{run.name}/tap"]:
        listeners.append(client.declare_subscriber(key, lambda sample: received_keys.add(str(sample.key_expr))))
    liveliness = client.liveliness()
    for key in ["**", "reveille/*/emu/bs"]:
        listeners.append(
            liveliness.declare_subscriber(key, lambda sample: token_keys.add(str(sample.key_expr)), history=True)
        )
        for reply in liveliness.get(key, timeout=1.0):
            if reply.ok:
                token_keys.add(str(reply.ok.key_expr))
    run.resume()
    run.process.wait(PATIENCE)
    assert received_keys <= {f"reveille/{run.name}/tap"}, received_keys
    assert token_keys <= {f"reveille/{run.name}/emu/bs"}, token_keys
    assert received_keys and token_keys, (received_keys, token_keys)
    return client


def pose_as_base_station(run):
    """Answers requests like the base station and holds the tokens of hosts."""
    client = open_session(run.endpoint)
    received_requests = []

    def reply(query):
        received_requests.append(str(query.key_expr))
        query.reply(query.key_expr, WELCOME)

    declarations = []
    for key in ["join", "ready", "control", "describe", "log"]:
        declarations.append(client.declare_queryable(f"reveille/{run.name}/emu/{key}", reply, complete=True))
    declarations.append(client.declare_queryable(f"reveille/{run.name}/**", reply, complete=True))
    for host in range(4):
        declarations.append(client.liveliness().declare_token(f"reveille/{run.name}/emu/alive/{host}"))
    # A foreign token must not hide the loss of its host.
    pids = subprocess.run(["pgrep", "-f", f"device .*--run={run.name} "], capture_output=True, text=True).stdout.split()
    run.resume()
    time.sleep(0.5)
    os.kill(int(pids[1]), signal.SIGKILL)
    for _ in range(20):
        run.clock("status")
        time.sleep(0.02)
    # Keeps the declarations until the run ends.
    run.declarations = declarations
    assert not received_requests, received_requests
    return client


def send_commands(run):
    """Sends clock commands and an action without the key; they must be refused and leave the run unchanged."""
    client = open_session(run.endpoint)
    for kind, command in [("act", ACT), *(("control", command) for command in COMMANDS)]:
        for attachment in [None, b"0" * 32, b"\xff" * 32]:
            key = f"reveille/{run.name}/emu/{kind}"
            replies = list(client.get(key, payload=command, attachment=attachment, timeout=3.0))
            assert len(replies) == 1 and b"needs the run's key" in replies[0].err.payload.to_bytes(), (command, replies)
    check_wire(client, run.name)
    assert "paused before TTI 0" in run.clock("status").stdout
    run.resume()
    return client


def flood(run):
    """Sends oversized messages, and requests without pause."""
    client = open_session(run.endpoint)
    run.resume()
    stop = threading.Event()

    def send_requests():
        while not stop.is_set():
            for reply in client.get(f"reveille/{run.name}/emu/control", payload=STATUS, timeout=1.0):
                assert reply.ok

    requests = threading.Thread(target=send_requests)
    requests.start()
    # 200 MiB.
    payload = bytes(200 << 20)
    memory_mb = [run.memory_mb()]
    for key in [f"reveille/{run.name}/emu/join", f"reveille/{run.name}/air/report/0"]:
        try:
            open_session(run.endpoint).put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
        except zenoh.ZError:
            pass
        memory_mb.append(run.memory_mb())
    time.sleep(1)
    stop.set()
    requests.join()
    memory_mb.append(run.memory_mb())
    assert 0 < max(memory_mb) < 400, f"{memory_mb} MB"
    return client


STOPPED_OBSERVER = """
import os, signal, sys
sys.path.insert(0, sys.argv[3])
import bus
client = bus.open_session(sys.argv[1])
subscribers = [client.declare_subscriber(key, lambda sample: None) for key in ["**", f"reveille/{sys.argv[2]}/tap"]]
print("subscribed", flush=True)
os.kill(os.getpid(), signal.SIGSTOP)
"""


def stop_reading(run):
    """Stops reading as an observer; the run must not be delayed."""
    bus_folder = os.path.dirname(os.path.abspath(__file__))
    command = [sys.executable, "-c", STOPPED_OBSERVER, run.endpoint, run.name, bus_folder]
    observer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert observer.stdout.readline() == "subscribed\n"
    started = time.monotonic()
    run.resume()
    run.process.wait(PATIENCE)
    run_s = time.monotonic() - started
    observer.kill()
    observer.wait()
    # Undelayed, the run takes about 4 s at its pace.
    assert run_s < 30, f"the run took {run_s:.0f} s"


def main():
    reveille = os.path.abspath(sys.argv[1])
    with tempfile.TemporaryDirectory() as folder:
        command = [reveille, "run", *SCENARIO, "--quiet", "--json", "--out", "out"]
        process = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
        expected_digest = json.loads(process.stdout)["digest"]
    attacks = [send_noise, listen, pose_as_base_station, send_commands, flood, stop_reading]
    for attack in [attack for attack in attacks if attack.__name__ in (sys.argv[2:] or attack.__name__)]:
        run = Run(reveille, attack.__name__)
        started = time.monotonic()
        try:
            client = attack(run)
            summary, stderr = run.finish()
        finally:
            run.process.kill()
        if client is not None:
            client.close()
        assert summary["digest"] == expected_digest, attack.__name__
        assert summary["status"] == "complete" and summary["audit"] == "complete", summary
        assert "panicked" not in stderr, stderr
        timing = summary["timing"]
        print(
            f"{attack.__name__}: the expected digest, {timing['malformed_messages']} malformed, "
            f"{timing['unexpected_messages']} unexpected, {timing['losses']} losses, {time.monotonic() - started:.1f} s"
        )


main()
