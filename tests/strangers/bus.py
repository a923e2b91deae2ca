"""What a client of zenoh that is not ours can say and think of on the bus of a run."""

import json

import zenoh

# The first byte of every message: the version of the wire.
WIRE = 7
# Commands to the clock as they are encoded: pause, step 1, run to TTI 10, resume, pace max; and what anyone may ask.
COMMANDS = [bytes([WIRE, *command]) for command in ([0], [1, 1], [2, 10], [3], [4, 0])]
STATUS = bytes([WIRE, 5])
# What a host may be told that asks for a place.
WELCOME = bytes([WIRE, 0])


def session(endpoint):
    """A client's session."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("connect/timeout_ms", "20000")
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def keys_of(run):
    """Keys that a stranger can think of."""
    air = ["plan", "plan/0", "plan/*", "wake/0", "wake/0/0", "report/0", "report/0/0"]
    emu = ["clock", "clock/0", "clock/*", "answer/0", "answer/0/0", "alive/0", "bs"]
    emu += ["join", "ready", "control", "describe", "log"]
    prefixes = [f"reveille/{run}", f"reveille/{run}/@", f"reveille/{run}/@{'0' * 32}"]
    own = [f"{prefix}/air/{key}" for prefix in prefixes for key in air]
    own += [f"{prefix}/emu/{key}" for prefix in prefixes for key in emu]
    return own + [f"reveille/{run}/tap", f"reveille/{run}/**", f"reveille/{run}/*/air/wake/*/*", "**"]


def check_wire(peer, run):
    """A question of this version is answered: otherwise all that is said here is noise."""
    replies = list(peer.get(f"reveille/{run}/emu/control", payload=STATUS, timeout=5.0))
    assert replies and all(reply.ok for reply in replies), f"the wire's version is not {WIRE}: {replies}"
