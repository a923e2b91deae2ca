"""Decisions for a running emulator, the program named by the variable REVEILLE."""

import json
import os
import subprocess
import sys
import textwrap
import threading
import time
from typing import ClassVar

import numpy as np
import pytest

import reveille
from reveille.environment import ReveilleEnv
from reveille.policy_client import PolicyClient, PortError, ProtocolError, find

PROGRAM = os.environ.get("REVEILLE", "")
needs_program = pytest.mark.skipif(not PROGRAM, reason="REVEILLE names no program")
#: Timeout in seconds, more than ten times the length of any run here.
PATIENCE = 60


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Provides a folder in which no foreign run is found."""
    runtime = tmp_path / "runtime"
    runtime.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    for name in ("REVEILLE_CONNECT", "REVEILLE_RUN", "REVEILLE_KEY"):
        monkeypatch.delenv(name, raising=False)
    yield tmp_path
    # A failed test can leave processes behind.
    for process in Up.started:
        process.kill()
        process.wait()
    Up.started.clear()


class Up:
    """``reveille up`` with an external policy."""

    started: ClassVar[list[subprocess.Popen]] = []

    def __init__(self, folder, *args):
        command = [PROGRAM, "up", "--policy", "external", "-P", "2", "--json", "--quiet", "--out", "out", *args]
        self.process = subprocess.Popen(
            command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.started.append(self.process)

    def summary(self):
        stdout, stderr = self.process.communicate(timeout=PATIENCE)
        assert self.process.returncode == 0, stderr
        return json.loads(stdout)

    def serve(self, client):
        """Lets the client decide, once the run can be found."""
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                return client.serve()
            except PortError:
                assert time.monotonic() < deadline and self.process.poll() is None
                time.sleep(0.05)


def replay(folder):
    command = [PROGRAM, "run", "--policy", "replay=out/inputs.log", "--json", "--out", "again"]
    told = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE, check=True)
    return json.loads(told.stdout)


@needs_program
@pytest.mark.parametrize(("policy", "form"), [("age-index", "cbor"), ("q-learning", "json")])
def test_the_actions_of_a_policy_have_its_digest_over_zenoh(machine, policy, form):
    told = reveille.run(policy=policy, devices=30, ttis=300, seed=4, actions=True)
    assert told["digest"] == told["stepped"]["digest"]
    rows = iter(zip(told["stages"], told["actions"], strict=True))

    def recorded(observation):
        stage, action = next(rows)
        assert stage == observation["stage"]
        return action

    up = Up(machine, "-n", "30", "-k", "300", "--seed", "4")
    assert up.serve(PolicyClient(recorded, form=form)) == len(told["actions"])
    summary = up.summary()
    assert summary["digest"] == told["digest"] == replay(machine)["digest"]
    assert summary["timing"]["decisions"] == len(told["actions"])


@needs_program
@pytest.mark.parametrize("knowledge", ["reported", "oracle"])
def test_a_policy_sees_in_the_emulator_what_it_sees_in_an_environment(machine, knowledge):
    """The policy's draws depend on every bit of the observation."""

    def policy(observation):
        bits = np.concatenate([observation["device"].ravel(), observation["globals"]]).view(np.uint32)
        generator = np.random.default_rng([int(observation["stage"]), int(bits.sum(dtype=np.uint64))])
        return generator.random(len(observation["action_mask"])) < 0.15

    settings = {"sensing.d_max": 6.0, "radio.uplink_loss": 0.1}
    env = ReveilleEnv(devices=25, ttis=300, battery_knowledge=knowledge, set=settings)
    observation, _ = env.reset(seed=7)
    seen, ended = [], False
    while not ended:
        seen.append(observation)
        observation, _, _, ended, info = env.step(policy(observation))
    assert any(row["stage"] == 1 for row in seen)

    client = PolicyClient(lambda question: asked(question), whole=True)
    heard = 0

    def asked(question):
        nonlocal heard
        own = seen[question.seq]
        for key, value in own.items():
            np.testing.assert_array_equal(question.observation[key], value, strict=True)
        heard += len(question.heard)
        return policy(question.observation)

    options = ["--set", f"bs.battery_knowledge={knowledge}"]
    for path, value in settings.items():
        options += ["--set", f"{path}={value}"]
    up = Up(machine, "-n", "25", "-k", "300", "--seed", "7", *options)
    assert up.serve(client) == len(seen)
    assert up.summary()["digest"] == info["digest"]
    assert heard > 0 and client.hello["ttis"] == 300 and len(client.hello["known"]["devices"]) == 25
    names = [column["name"] for column in client.hello["device_features"]]
    assert names == [feature.name for feature in reveille.DEVICE_FEATURES]


@needs_program
def test_a_command_decides_and_a_bug_in_it_is_shown(machine):
    script = machine / "policy.py"
    script.write_text(
        textwrap.dedent(
            """
            import sys, reveille
            def policy(observation):
                if sys.argv[1:] == ["fails"] and observation["globals"][4] > 0:
                    raise RuntimeError("a bug of mine")
                return {"sense": [0, 1], "next": 100} if observation["stage"] == 0 else {"wake": []}
            print(reveille.decide(policy), "decisions", file=sys.stderr)
            """
        )
    )
    up = Up(machine, "-n", "10", "-k", "100", "--policy-command", f"exec {sys.executable} {script}")
    assert up.summary()["ttis_done"] == 100
    command = f"exec {sys.executable} {script} fails"
    up = Up(machine, "--force", "-n", "10", "-k", "300", "--policy-command", command)
    _, stderr = up.process.communicate(timeout=PATIENCE)
    assert up.process.returncode == 1
    assert "a bug of mine" in stderr and "exit status: 1" in stderr


@needs_program
def test_a_stopped_client_is_waited_for(machine):
    """SIGSTOP for longer than a link may be unresponsive, then SIGCONT."""
    script = machine / "policy.py"
    script.write_text(
        textwrap.dedent(
            """
            import os, signal, reveille
            def policy(observation):
                if not os.path.exists("stopped") and observation["globals"][4] > 0:
                    open("stopped", "w").close()
                    os.kill(os.getpid(), signal.SIGSTOP)
                return {"sense": [0, 1]} if observation["stage"] == 0 else {"wake": []}
            reveille.decide(policy)
            """
        )
    )
    up = Up(machine, "-n", "10", "-k", "100", "--policy-command", f"echo $$ > pid; exec {sys.executable} {script}")

    def go_on():
        deadline = time.monotonic() + PATIENCE
        while not (machine / "stopped").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(3)
        os.kill(int((machine / "pid").read_text()), 18)

    waker = threading.Thread(target=go_on)
    waker.start()
    summary = up.summary()
    waker.join()
    assert summary["ttis_done"] == 100 and summary["digest"] == replay(machine)["digest"]


def test_an_invalid_request_is_refused_with_an_error():
    client = PolicyClient(lambda observation: observation["action_mask"])
    for payload, form in [(b"", "json"), (b"[]", "json"), (b"\xff", "cbor"), (b'{"stage": "plan"}', "json")]:
        with pytest.raises(ProtocolError):
            client.answer(payload, form, "")
    hello = {"protocol": 9, "min": 9, "max": 9, "seq": 0, "tti": 0, "stage": "hello"}
    with pytest.raises(ProtocolError, match="protocol 1 to 1, the base station 9 to 9"):
        client.answer(json.dumps(hello).encode(), "json", "")
    with pytest.raises(ValueError, match="cbor or json"):
        PolicyClient(lambda _: [], form="xml")


def test_the_same_question_is_not_decided_twice():
    calls = []

    def policy(observation):
        calls.append(observation)
        return {"sense": [len(calls)]} if len(calls) < 3 else {"senses": []}

    client = PolicyClient(policy)
    hello = {"protocol": 1, "min": 1, "max": 3, "seq": 0, "tti": 0, "stage": "hello"}
    welcome = json.loads(client.answer(json.dumps(hello).encode(), "json", "ab"))
    assert (welcome["protocol"], welcome["key"], welcome["name"]) == (1, "ab", "policy")
    question = {"protocol": 1, "seq": 0, "tti": 0, "stage": "plan", "to": welcome["id"], "device": [[0.5, 1.0]] * 2}
    question |= {"globals": [[0.25]], "action_mask": [2, 2], "heard": []}
    ask = lambda **more: client.answer(json.dumps(question | more).encode(), "json", "ab")  # noqa: E731
    assert json.loads(ask())["sense"] == [1] and json.loads(ask())["sense"] == [1]
    with pytest.warns(UserWarning, match="no device 1"):
        assert json.loads(ask(refused="no device 1"))["sense"] == [2]
    assert ask(to="another client") is None
    assert len(calls) == 2 and calls[0]["device"].shape == (2, 2) and calls[0]["device"].dtype == np.float32
    with pytest.raises(ValueError, match="senses"):
        ask(seq=1)


def test_a_repeated_request_gets_the_first_reply_in_the_encoding_of_the_repetition():
    import cbor2

    decisions = iter([[1, 0], [0, 1]])
    client = PolicyClient(lambda _: next(decisions))
    hello = {"protocol": 1, "min": 1, "max": 1, "seq": 0, "tti": 0, "stage": "hello"}
    known = json.loads(client.answer(json.dumps(hello).encode(), "json", ""))["id"]
    request = {"protocol": 1, "seq": 0, "tti": 0, "stage": "plan", "to": known, "device": [[0.5]] * 2}
    request |= {"globals": [[0.25]], "action_mask": [2, 2], "heard": []}
    assert cbor2.loads(client.answer(cbor2.dumps(request), "cbor", ""))["action"] == b"\1\0"
    assert json.loads(client.answer(json.dumps(request).encode(), "json", ""))["action"] == [1, 0]


def test_a_reply_has_the_newest_protocol_version_of_both_sides():
    client = PolicyClient(lambda _: [0, 0])
    hello = {"protocol": 1, "min": 1, "max": 1, "seq": 0, "tti": 0, "stage": "hello"}
    known = json.loads(client.answer(json.dumps(hello).encode(), "json", ""))["id"]
    for seq, (base_station, expected) in enumerate([(0, 0), (2, 1)]):
        request = {"protocol": base_station, "seq": seq, "tti": 0, "stage": "plan", "to": known, "device": [[0.5]] * 2}
        request |= {"globals": [[0.25]], "action_mask": [2, 2], "heard": []}
        assert json.loads(client.answer(json.dumps(request).encode(), "json", ""))["protocol"] == expected


@pytest.mark.parametrize("decision", [None, [1], [0, 0.1], [float("nan"), 0], [0, 2], "01", [0, 1, 0]])
def test_an_invalid_decision_is_an_error_of_the_policy(decision):
    client = PolicyClient(lambda _: decision)
    hello = {"protocol": 1, "min": 1, "max": 1, "seq": 0, "tti": 0, "stage": "hello"}
    known = json.loads(client.answer(json.dumps(hello).encode(), "json", ""))["id"]
    question = {"protocol": 1, "seq": 0, "tti": 0, "stage": "plan", "to": known, "device": [[0.5]] * 2}
    question |= {"globals": [[0.25]], "action_mask": [2, 2], "heard": []}
    with pytest.raises(ValueError, match=r"zeros and ones|for 2 devices"):
        client.answer(json.dumps(question).encode(), "json", "")


def test_numpy_numbers_are_numbers():
    import cbor2

    client = PolicyClient(lambda _: {"sense": list(np.flatnonzero([1, 0, 1])), "next": np.int64(5)})
    hello = {"protocol": 1, "min": 1, "max": 1, "seq": 0, "tti": 0, "stage": "hello"}
    known = cbor2.loads(client.answer(cbor2.dumps(hello), "cbor", ""))["id"]
    numbers = np.array([0.5, 1.0, 0.25], "<f4").tobytes()
    question = {"protocol": 1, "seq": 0, "tti": 0, "stage": "plan", "to": known, "device": numbers}
    question |= {"globals": numbers, "action_mask": b"\x02\x02\x02", "heard": []}
    told = cbor2.loads(client.answer(cbor2.dumps(question), "cbor", ""))
    assert (told["sense"], told["next"]) == ([0, 2], 5)
    with pytest.raises(PortError, match="no key"):
        client.answer(cbor2.dumps(hello | {"refused": {"id": known, "why": "no key"}}), "cbor", "")


@needs_program
def test_one_client_decides_for_one_run_after_another(machine):
    client = PolicyClient(lambda observation: np.zeros(len(observation["action_mask"])))
    for name in ("first", "second"):
        up = Up(machine, "-n", "10", "-k", "1", "--run", name, "--force")
        assert up.serve(client) == 1
        assert up.summary()["ttis_done"] == 1


@needs_program
def test_a_policy_that_cannot_decide_gets_an_error(machine):
    up = Up(machine, "-n", "10", "-k", "5", "--run", "keyed")
    client = PolicyClient(lambda observation: np.zeros(len(observation["action_mask"])))
    wrong = machine / "wrong.key"
    wrong.write_text("00" * 16)
    deadline = time.monotonic() + PATIENCE
    while not list((machine / "runtime").glob("reveille/keyed-*.json")):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    with pytest.raises(PortError, match="key"):
        client.serve(key_file=wrong)
    with pytest.raises(PortError, match="no run other"):
        client.serve(connect=find(run="keyed").connect, run="other", patience=2)
    assert up.serve(client) >= 5
    assert up.summary()["ttis_done"] == 5


@needs_program
def test_the_run_completes_after_the_last_decision(machine):
    script = machine / "policy.py"
    script.write_text(
        textwrap.dedent(
            """
            import time, reveille
            decided = reveille.decide(lambda obs: obs["action_mask"] * 0)
            time.sleep(0.5)
            open("after", "w").write(str(decided))
            """
        )
    )
    up = Up(machine, "-n", "10", "-k", "20", "--policy-command", f"exec {sys.executable} {script}")
    assert up.summary()["ttis_done"] == 20
    assert int((machine / "after").read_text()) >= 20


def test_a_run_is_looked_for_where_it_can_be(machine, monkeypatch):
    with pytest.raises(PortError, match="no such run"):
        find()
    registry = machine / "runtime" / "reveille"
    registry.mkdir(mode=0o700)
    for name in ("a", "b"):
        entry = {"run": name, "endpoint": f"tcp/127.0.0.1:{ord(name)}", "pid": os.getpid(), "key": name * 32}
        (registry / f"{name}-1.json").write_text(json.dumps(entry))
    (registry / "torn-2.json").write_text("{")
    with pytest.raises(PortError, match="choose one with run=: a, b"):
        find()
    assert find(run="b").key == "b" * 32
    assert find(connect="tcp/127.0.0.1:1", run="c").key == ""
    monkeypatch.setenv("REVEILLE_CONNECT", "tcp/127.0.0.1:7")
    monkeypatch.setenv("REVEILLE_RUN", "told")
    monkeypatch.setenv("REVEILLE_KEY", "k")
    told = find()
    assert (told.connect, told.run, told.key) == ("tcp/127.0.0.1:7", "told", "k") and "'k'" not in repr(told)
    registry.chmod(0o755)
    with pytest.raises(PortError, match="other users"):
        find(run="b")
