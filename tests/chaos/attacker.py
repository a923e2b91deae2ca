"""A hostile zenoh client: attacker.py ENDPOINT RUN ATTACK+ATTACK SEED.

It prints "ready" once every attack has begun, and continues until it is killed.
"""

import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import zenoh

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "untrusted_clients"))
from bus import COMMANDS, WELCOME, WIRE, check_wire, keys_of, open_session  # noqa: E402

# Bytes of an oversized message.
HUGE = 20 << 20


def put(peer, key, payload):
    """Sends a payload and ignores errors of zenoh."""
    try:
        peer.put(key, payload)
    except zenoh.ZError:
        pass


def noise(endpoint, run, rng):
    """Sends noise, and copies of the messages that observers see, on every key."""
    peer = open_session(endpoint)
    copies = []
    peer.declare_subscriber(f"reveille/{run}/tap", lambda s: copies.append(s.payload.to_bytes()))
    keys = keys_of(run)
    yield
    while True:
        for _ in range(20):
            size = rng.choice([0, 1, 3, 64, 4096])
            payload = rng.choice([rng.randbytes(size), bytes([WIRE]) + rng.randbytes(size), *copies[-3:]])
            put(peer, rng.choice(keys), payload)
        del copies[:-3]
        time.sleep(0.02)


def huge(endpoint, run, rng):
    """Sends oversized messages; the base station closes the link, so each one takes a new link."""
    keys = keys_of(run)
    yield
    while True:
        try:
            peer = open_session(endpoint)
            put(peer, rng.choice(keys), bytes(HUGE))
            time.sleep(0.3)
            peer.close()
        except zenoh.ZError:
            time.sleep(0.3)


def tokens(endpoint, run, rng):
    """Holds the tokens of hosts and of the base station, and answers in its place."""
    peer = open_session(endpoint)
    names = [f"alive/{host}" for host in range(12)] + [f"alive/{host}/{'0' * 32}" for host in range(4)] + ["bs"]
    held = []
    for name in names:
        try:
            held.append(peer.liveliness().declare_token(f"reveille/{run}/emu/{name}"))
        except zenoh.ZError:
            pass
    for key in ["join", "ready", "control", "describe", "log"]:
        answer = lambda query: query.reply(query.key_expr, WELCOME)
        held.append(peer.declare_queryable(f"reveille/{run}/emu/{key}", answer, complete=True))
    yield
    while True:
        time.sleep(1)


def clock(endpoint, run, rng):
    """Sends commands without the key, and forged clock messages."""
    peer = open_session(endpoint)
    check_wire(peer, run)
    yield
    while True:
        key = rng.choice([None, b"0" * 32, rng.randbytes(16).hex().encode()])
        command = rng.choice(COMMANDS)
        try:
            for reply in peer.get(f"reveille/{run}/emu/control", payload=command, attachment=key, timeout=1.0):
                if reply.ok:
                    print("OBEYED", command, flush=True)
        except zenoh.ZError:
            pass
        for tail in ("emu/clock", f"@{'0' * 32}/emu/clock", "*/emu/clock"):
            put(peer, f"reveille/{run}/{tail}", bytes([WIRE]) + rng.randbytes(rng.randint(1, 12)))
        time.sleep(0.05)


def stalled(endpoint, run, rng):
    """Subscribes to everything and stops reading."""
    script = (
        "import sys; sys.path.insert(0, sys.argv[3]); import os, signal, attacker\n"
        "peer = attacker.open_session(sys.argv[1])\n"
        "held = [peer.declare_subscriber(key, lambda s: None) for key in ['**', f'reveille/{sys.argv[2]}/tap']]\n"
        "print('subscribed', flush=True)\n"
        "os.kill(os.getpid(), signal.SIGSTOP)\n"
    )
    here = os.path.dirname(os.path.abspath(__file__))
    command = [sys.executable, "-c", script, endpoint, run, here]
    sleeper = subprocess.Popen(command, stdout=subprocess.PIPE)
    SLEEPERS.append(sleeper)
    sleeper.stdout.readline()
    yield
    while True:
        time.sleep(1)


# The processes that `stalled` has stopped.
SLEEPERS = []


def attack(name, endpoint, run, rng, started):
    """Runs one attack until the end, on its own thread. The attack yields once, when it has begun."""
    try:
        for _ in globals()[name](endpoint, run, rng):
            started.release()
    except zenoh.ZError as error:
        print(f"{name}: {error}", file=sys.stderr, flush=True)
        started.release()


def main():
    endpoint, run, names, seed = sys.argv[1:5]
    started, names = threading.Semaphore(0), names.split("+")

    def end(*_):
        for sleeper in SLEEPERS:
            sleeper.kill()
        os._exit(0)

    signal.signal(signal.SIGTERM, end)
    for number, name in enumerate(names):
        rng = random.Random(f"{seed} {number}")
        threading.Thread(target=attack, args=(name, endpoint, run, rng, started), daemon=True).start()
    for _ in names:
        started.acquire()
    print("ready", flush=True)
    while True:
        time.sleep(1)


if __name__ == "__main__":
    main()
