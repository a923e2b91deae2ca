"""Client of the policy port, which decides for a run in progress.

The base station of ``reveille up --policy external`` or ``reveille bs`` requests every decision over zenoh, and virtual
time stops until the answer. Requests have the form of an environment's observations. A policy trained in
:class:`~reveille.environment.ReveilleEnv` therefore decides here unchanged, and the run has the same digest.

Needs ``eclipse-zenoh`` and ``cbor2``, the extra ``port``.
"""

from __future__ import annotations

import hmac
import json
import os
import queue
import re
import secrets
import stat
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: The protocol version of this client, and the oldest version it supports.
PROTOCOL = 1
OLDEST = 1

#: Seconds without a base station after which :meth:`PolicyClient.serve` returns. This process may have been stopped for
#: a while, or the base station may be resumed at the same endpoint.
GONE = 30.0

#: One thread for all of zenoh: on several, zenoh 1.10 corrupts TLS links (zenoh issue 2557).
ONE_THREAD = "(rx:(handover:app),acc:(handover:app),tx:(handover:app),net:(handover:app),app:(worker_threads:1))"

#: Stage numbers, as in environments, by their names on the bus.
STAGES = {"plan": 0, "wake": 1}


@dataclass(frozen=True)
class Target:
    """Address, name and key of a run."""

    #: Endpoint of the base station, ``tcp/HOST:PORT`` or ``tls/HOST:PORT``.
    connect: str
    #: Name of the run.
    run: str
    #: Key of the run, 32 hexadecimal digits, which a policy process must present.
    key: str = field(repr=False, default="")
    #: Folder of ``reveille tls init``, for an endpoint ``tls/HOST:PORT``; the subfolder ``policy`` suffices.
    tls: str = ""


@dataclass(frozen=True)
class Question:
    """A decision request."""

    #: Observation, as in an environment of the same scenario: ``device``, ``globals``, ``stage``, ``action_mask``.
    observation: dict[str, Any]
    #: The TTI of the decision.
    tti: int
    #: The number of the decision in the run, from 0.
    seq: int
    #: At stage 1, the reports of this TTI in the order of arrival: ``device``, ``information``, ``battery``.
    heard: list[dict[str, Any]]
    #: Reason for the refusal of the last answer to this request, if it was refused.
    refused: str | None


#: A decision: N zeros and ones, as an environment's action, or a mapping. A mapping has one of ``action``, ``sense``
#: (ids), ``cycles`` (``[t_on, t_drx, offset]`` of each device) or ``wake`` (ids, in order). With a plan it may have
#: ``next``, the TTI of the next request.
Decision = NDArray[Any] | Mapping[str, Any]


class PortError(RuntimeError):
    """Deciding for the run is not possible; the message states the cause."""


class ProtocolError(ValueError):
    """The payload is not a decision request of this protocol."""


def _runs() -> list[Target]:
    """Returns the runs of this user on this machine."""
    given = os.environ.get("XDG_RUNTIME_DIR", "")
    folder = Path(given) / "reveille" if os.path.isabs(given) else Path(tempfile.gettempdir()) / f"reveille-{os.getuid()}"
    if not os.path.lexists(folder):
        return []
    found = folder.lstat()
    # Entries of the folder are trusted, so only this user may have access.
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise PortError(f"{folder}: other users have access; use chmod 700, or give connect= and run=")
    targets = []
    for path in sorted(folder.glob("*.json")):
        try:
            entry = json.loads(path.read_text())
            os.kill(entry["pid"], 0)
            targets.append(Target(entry["endpoint"], entry["run"], entry.get("key") or "", entry.get("tls") or ""))
        except (OSError, ValueError, KeyError, TypeError):
            # The run has ended, or its entry is being written.
            continue
    return targets


def find(
    connect: str | None = None,
    run: str | None = None,
    key_file: str | os.PathLike[str] | None = None,
    tls: str | os.PathLike[str] | None = None,
) -> Target:
    """Finds the run: from the arguments, then from the environment that ``--policy-command`` sets
    (``REVEILLE_CONNECT``, ``REVEILLE_RUN``, ``REVEILLE_KEY``, ``REVEILLE_TLS``), then the only run of this user on this
    machine.

    :param connect: the base station's endpoint, ``tcp/HOST:PORT`` or ``tls/HOST:PORT``.
    :param run: the name of the run.
    :param key_file: the file with the run's key, written by ``reveille bs --key-file``.
    :param tls: the folder of certificates, written by ``reveille tls init``.
    :raises PortError: there is no such run, there is more than one, or the key is malformed.
    """
    key = Path(key_file).read_text().strip() if key_file is not None else None
    if key is not None and not re.fullmatch("[0-9a-fA-F]{32}", key):
        raise PortError(f"{key_file}: not a key of a run; it must be 32 hexadecimal digits")
    given = os.environ
    folder = os.fspath(tls) if tls is not None else None
    if connect is None and run is None and "REVEILLE_CONNECT" in given and "REVEILLE_RUN" in given:
        known, folder = given.get("REVEILLE_KEY", ""), folder or given.get("REVEILLE_TLS", "")
        return Target(given["REVEILLE_CONNECT"], given["REVEILLE_RUN"], key or known, folder)
    runs = [
        target
        for target in _runs()
        if (run is None or target.run == run) and (connect is None or target.connect == connect)
    ]
    if connect is not None and run is not None:
        known = runs[0].key if runs else given.get("REVEILLE_KEY", "")
        return Target(connect, run, key or known, folder or (runs[0].tls if runs else given.get("REVEILLE_TLS", "")))
    if len(runs) == 1:
        return Target(runs[0].connect, runs[0].run, key or runs[0].key, folder or runs[0].tls)
    if not runs:
        raise PortError(
            "no such run on this machine; start one with `reveille up --policy external`, or give connect= and run="
        )
    names = ", ".join(target.run for target in runs)
    raise PortError(f"there are {len(runs)} runs on this machine; choose one with run=: {names}")


def _tls_settings(target: Target) -> dict[str, str]:
    """Returns the settings of a session with the certificate of a policy process."""
    folder = Path(target.tls).absolute() / "policy"
    names = {"root_ca_certificate": "ca.pem", "connect_certificate": "cert.pem", "connect_private_key": "key.pem"}
    for name in names.values():
        if not target.tls or not (folder / name).exists():
            raise PortError(f"endpoint {target.connect!r}: needs {folder / name} of `reveille tls init`; give tls=")
    files = {f"transport/link/tls/{key}": json.dumps(str(folder / name)) for key, name in names.items()}
    return {"transport/link/tls/enable_mtls": "true", **files}


class PolicyClient:
    """Client that decides for one run.

    ::

        client = reveille.PolicyClient(lambda observation: my_network(observation))
        client.serve()  # until the run is over

    The policy receives an observation and returns a decision. With ``whole=True`` it receives the :class:`Question`,
    which holds more. If a request is repeated, such as after a lost link, the client repeats its answer and does not
    call the policy.
    """

    def __init__(
        self,
        policy: Callable[[Any], Decision],
        *,
        name: str | None = None,
        whole: bool = False,
        form: str = "cbor",
    ) -> None:
        """Makes a client.

        :param policy: function that returns the decision.
        :param name: name of this process in messages of the run; the name of the policy by default.
        :param whole: call the policy with the whole :class:`Question`.
        :param form: ``"cbor"``, or ``"json"``, which is longer but readable.
        """
        if form not in ("cbor", "json"):
            raise ValueError(f"form {form!r}: must be cbor or json")
        self.policy = policy
        self.name = name or getattr(policy, "__name__", type(policy).__name__)
        self.whole = whole
        self.form = form
        #: Greeting of the base station, with ``run``, ``ttis``, ``known`` and the features.
        self.hello: dict[str, Any] | None = None
        #: Number of decisions made.
        self.decided = 0
        self._id = secrets.token_hex(8)
        self._last: tuple[tuple[Any, ...], dict[str, Any]] | None = None
        self._is_over = False

    def serve(
        self,
        *,
        connect: str | None = None,
        run: str | None = None,
        key_file: str | os.PathLike[str] | None = None,
        tls: str | os.PathLike[str] | None = None,
        patience: float = 30.0,
    ) -> int:
        """Decides until the run is over and returns the number of decisions. For the other arguments see :func:`find`.

        :param patience: seconds to try to reach the base station.
        :raises PortError: there is no such run, it cannot be reached, or it refuses this process.
        """
        target = find(connect, run, key_file, tls)
        if not re.fullmatch(r"(tcp|tls)/.+:[0-9]{1,5}", target.connect):
            raise PortError(f"endpoint {target.connect!r}: must be tcp/HOST:PORT or tls/HOST:PORT")
        if target.connect.startswith("tls/"):
            # zenoh needs one thread for a TLS link, and reads this when its first session opens.
            os.environ["ZENOH_RUNTIME"] = ONE_THREAD
        import zenoh

        # Another run may send equal requests, which need new answers. The new id is free of earlier refusals.
        self._id, self._last, self._is_over = secrets.token_hex(8), None, False
        self.decided, self.hello = 0, None
        config = zenoh.Config()
        settings = {
            "mode": '"client"',
            "connect/endpoints": json.dumps([target.connect]),
            "connect/timeout_ms": str(int(patience * 1000)),
            "connect/exit_on_failure": "true",
            "scouting/multicast/enabled": "false",
            "scouting/gossip/enabled": "false",
        }
        if target.connect.startswith("tls/"):
            settings |= _tls_settings(target)
        for key, value in settings.items():
            config.insert_json5(key, value)
        try:
            session = zenoh.open(config)
        except zenoh.ZError as error:
            raise PortError(f"no base station answers at {target.connect} within {patience:g} s") from error
        with session:
            return self._serve(zenoh, session, target, patience)

    def _serve(self, zenoh: Any, session: Any, target: Target, patience: float) -> int:
        # Zenoh's threads only enqueue. This thread decides: it can be interrupted, and a slow policy does not block
        # them.
        questions: queue.SimpleQueue[Any] = queue.SimpleQueue()
        prefix = f"reveille/{target.run}"
        there = {"is_alive": False}

        def changed(sample: Any) -> None:
            there["is_alive"] = sample.kind != zenoh.SampleKind.DELETE

        watched = session.liveliness().declare_subscriber(f"{prefix}/emu/bs", changed, history=True)
        port = session.declare_queryable(f"{prefix}/policy/v1", questions.put)
        seen, limit = time.monotonic(), patience
        try:
            while not self._is_over and not session.is_closed():
                if there["is_alive"]:
                    seen, limit = time.monotonic(), GONE
                elif time.monotonic() - seen > limit:
                    if self.hello is None:
                        raise PortError(f"no run {target.run} at {target.connect}; check run=")
                    break
                try:
                    query = questions.get(timeout=0.2)
                except queue.Empty:
                    continue
                try:
                    self._answer(zenoh, query, target)
                finally:
                    # The base station waits for the end of a query, not only for its answer.
                    query.drop()
        finally:
            port.undeclare()
            watched.undeclare()
        return self.decided

    def _answer(self, zenoh: Any, query: Any, target: Target) -> None:
        encoding = zenoh.Encoding.APPLICATION_JSON
        payload = query.payload.to_bytes() if query.payload is not None else b""
        is_cbor = query.encoding == zenoh.Encoding.APPLICATION_CBOR
        if is_cbor:
            encoding = zenoh.Encoding.APPLICATION_CBOR
        try:
            answer = self.answer(payload, "cbor" if is_cbor else "json", target.key)
        except ProtocolError as error:
            query.reply_err(str(error), encoding=zenoh.Encoding.TEXT_PLAIN)
            return
        if answer is not None:
            query.reply(query.key_expr, answer, encoding=encoding)

    def answer(self, payload: bytes, form: str, key: str) -> bytes | None:
        """Encodes the answer to a request in its form, for callers with their own transport. Returns None for "bye" and
        for a request addressed to another process.

        :raises ProtocolError: the payload is not a valid request.
        :raises ValueError: the policy returned an invalid decision.
        """
        question = _decode(payload, form)
        try:
            if question["stage"] == "bye":
                self._is_over = True
                return None
            if question["stage"] == "hello":
                return _encode(self._welcome(question, key), form)
            if not hmac.compare_digest(str(question["to"]), self._id):
                return None
            echo = {name: question[name] for name in ("seq", "tti", "stage")}
            protocol = min(PROTOCOL, question["protocol"])
            asked = self._read(question)
        except ProtocolError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise ProtocolError(f"invalid decision request: {type(error).__name__}: {error}") from error
        head = tuple(echo.values())
        if self._last is not None and self._last[0] == head and asked.refused is None:
            return _encode(self._last[1], form)
        if asked.refused is not None:
            warnings.warn(f"the decision for TTI {asked.tti} was refused: {asked.refused}", stacklevel=2)
        decision = self.policy(asked if self.whole else asked.observation)
        fields = _said(decision, len(asked.observation["action_mask"]))
        reply = {"protocol": protocol, **echo, "id": self._id, "key": key, **fields}
        answer = _encode(reply, form)
        self.decided += 1
        self._last = (head, reply)
        return answer

    def _welcome(self, hello: dict[str, Any], key: str) -> dict[str, Any]:
        if hello["min"] > PROTOCOL or hello["max"] < OLDEST:
            raise ProtocolError(
                f"this package has protocol {OLDEST} to {PROTOCOL}, the base station {hello['min']} to {hello['max']}"
            )
        refused = hello.get("refused")
        if refused and refused["id"] == self._id:
            raise PortError(f"the base station refused this policy process: {refused['why']}")
        self.hello = hello
        return {
            "protocol": min(PROTOCOL, hello["max"]),
            "seq": hello["seq"],
            "tti": hello["tti"],
            "stage": "hello",
            "id": self._id,
            "name": self.name,
            "key": key,
            "form": self.form,
        }

    @staticmethod
    def _read(question: dict[str, Any]) -> Question:
        mask = question["action_mask"]
        mask = np.frombuffer(mask, np.int8).copy() if isinstance(mask, bytes) else np.asarray(mask, np.int8)
        observation = {
            "device": _numbers(question["device"]).reshape(len(mask), -1),
            "globals": _numbers(question["globals"]).reshape(-1),
            "stage": np.int64(STAGES[question["stage"]]),
            "action_mask": mask,
        }
        heard, refused = question["heard"], question.get("refused")
        return Question(observation, question["tti"], question["seq"], heard, refused)


def _numbers(rows: Any) -> NDArray[np.float32]:
    if isinstance(rows, bytes):
        return np.frombuffer(rows, "<f4").astype(np.float32)
    return np.asarray(rows, np.float32)


def _said(decision: Decision, devices: int) -> dict[str, Any]:
    if isinstance(decision, Mapping):
        unknown = set(decision) - {"action", "sense", "cycles", "wake", "next"}
        if unknown:
            raise ValueError(f"decision: unknown keys {sorted(unknown)}; use action, sense, cycles, wake and next")
        said = {name: np.asarray(value).tolist() for name, value in decision.items() if name != "action"}
        return said | (_bits(decision["action"], devices) if "action" in decision else {})
    return _bits(decision, devices)


def _bits(action: Any, devices: int) -> dict[str, Any]:
    bits = np.asarray(action).reshape(-1)
    if bits.dtype.kind not in "biuf" or not np.isin(bits, (0, 1)).all():
        raise ValueError(f"decision {action!r}: must be zeros and ones, one for each device")
    if len(bits) != devices:
        raise ValueError(f"decision: {len(bits)} numbers for {devices} devices; give one for each device")
    return {"action": bits.astype(np.uint8).tolist()}


def _encode(message: dict[str, Any], form: str) -> bytes:
    if form == "json":
        return json.dumps(message).encode()
    import cbor2

    # In CBOR the bits of an action are a byte string.
    return cbor2.dumps(message | {"action": bytes(message["action"])} if "action" in message else message)


def _decode(payload: bytes, form: str) -> dict[str, Any]:
    loads: Callable[[bytes], Any] = json.loads
    if form == "cbor":
        import cbor2

        loads = cbor2.loads
    try:
        message = loads(payload)
    except Exception as error:
        raise ProtocolError(f"the request is not valid {form}: {error}") from error
    if not isinstance(message, dict):
        raise ProtocolError("invalid decision request: not a map")
    return message


def decide(policy: Callable[[dict[str, Any]], Decision], **where: Any) -> int:
    """Decides for a run until it is over, with :class:`PolicyClient`.

    :param policy: function that returns the decision for an observation.
    :param where: see :meth:`PolicyClient.serve`.
    """
    return PolicyClient(policy).serve(**where)
