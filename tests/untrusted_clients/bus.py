"""Messages and keys that a zenoh client without a run's key can use on its bus."""

import json

import zenoh

# The first byte of every message: the wire version.
WIRE = 11
# Encoded clock commands: pause, step 1, run to TTI 10, resume, pace max. `STATUS` needs no key.
COMMANDS = [bytes([WIRE, *command]) for command in ([0], [1, 1], [2, 10], [3], [4, 0])]
STATUS = bytes([WIRE, 5])
# An action without the key: let device 0 fail.
ACT = bytes([WIRE, 0, 1, 0, 0, 1])
# A possible answer to a host's join request.
WELCOME = bytes([WIRE, 0])


def open_session(endpoint):
    """Opens a client session."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("connect/timeout_ms", "20000")
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def keys_of(run):
    """Returns keys that such a client can guess."""
    air = ["plan", "plan/0", "plan/*", "wake/0", "wake/0/0", "report/0", "report/0/0"]
    emu = ["clock", "clock/0", "clock/*", "answer/0", "answer/0/0", "alive/0", "bs"]
    emu += ["join", "ready", "control", "describe", "log", "act"]
    prefixes = [f"reveille/{run}", f"reveille/{run}/@", f"reveille/{run}/@{'0' * 32}"]
    keys = [f"{prefix}/air/{key}" for prefix in prefixes for key in air]
    keys += [f"{prefix}/emu/{key}" for prefix in prefixes for key in emu]
    return keys + [f"reveille/{run}/tap", f"reveille/{run}/**", f"reveille/{run}/*/air/wake/*/*", "**"]


def check_wire(peer, run):
    """Checks the wire version with a request; under another version every attack is only noise."""
    replies = list(peer.get(f"reveille/{run}/emu/control", payload=STATUS, timeout=5.0))
    assert replies and all(reply.ok for reply in replies), f"the wire's version is not {WIRE}: {replies}"
