"""Tests of `decide` and `PolicyClient`, alone and with a running emulator, the program named by the variable REVEILLE.

Decisions over the bus are compared with environments and replays by their digests.
"""

import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

import reveille
from reveille.environment import ReveilleEnv
from reveille.policy_client import PolicyClient, PortError, ProtocolError, find

PROGRAM = os.environ.get("REVEILLE", "")
needs_program = pytest.mark.skipif(not PROGRAM, reason="REVEILLE names no program")
#: Timeout in seconds, more than ten times the length of any run here.
TIMEOUT = 60


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Provides a working folder, from which no run of other programs is found."""
    runtime = tmp_path / "runtime"
    runtime.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    for name in ("REVEILLE_CONNECT", "REVEILLE_RUN", "REVEILLE_KEY", "REVEILLE_TLS"):
        monkeypatch.delenv(name, raising=False)
    yield tmp_path
    # A failed test can leave processes behind.
    for process in EmulatorRun.started:
        process.kill()
        process.wait()
    EmulatorRun.started.clear()


class EmulatorRun:
    """``reveille up`` with an external policy."""

    started: ClassVar[list[subprocess.Popen]] = []

    def __init__(self, folder, *args):
        command = [PROGRAM, "up", "--policy", "external", "-P", "2", "--json", "--quiet", "--out", "out", *args]
        self.process = subprocess.Popen(
            command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.started.append(self.process)

    def summary(self):
        stdout, stderr = self.process.communicate(timeout=TIMEOUT)
        assert self.process.returncode == 0, stderr
        return json.loads(stdout)

    def serve(self, client):
        """Lets the client decide, once the run can be found."""
        deadline = time.monotonic() + TIMEOUT
        while True:
            try:
                return client.serve()
            except PortError:
                assert time.monotonic() < deadline and self.process.poll() is None
                time.sleep(0.05)


def replay(folder):
    command = [PROGRAM, "run", "--policy", "replay=out/inputs.log", "--json", "--out", "again"]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=TIMEOUT, check=True)
    return json.loads(result.stdout)


@needs_program
def test_the_client_without_the_package_decides(folder):
    client = Path(__file__).resolve().parents[2] / "deploy" / "examples" / "client.py"
    command = shlex.join([sys.executable, str(client)])
    summary = EmulatorRun(folder, "-n", "20", "-k", "200", "--policy-command", command).summary()
    assert summary["timing"]["decisions"] >= 200
    assert replay(folder)["digest"] == summary["digest"]


@needs_program
def test_a_policy_process_decides_over_tls(folder):
    """The program needs the cargo feature ``tls``, as in the continuous integration."""
    made = subprocess.run([PROGRAM, "tls", "init", "certs"], cwd=folder, capture_output=True, text=True)
    if made.returncode == 2 and os.environ.get("CI") != "true":
        pytest.skip("the program has no TLS")
    assert made.returncode == 0, made.stderr
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    script = folder / "policy.py"
    script.write_text('import reveille\nreveille.decide(lambda o: {"sense": [0, 1]} if o["stage"] == 0 else {"wake": []})\n')
    command = [PROGRAM, "bs", "--policy", "external", "--policy-command", f"exec {sys.executable} {script}"]
    command += ["--run", "tls", "--listen", f"tls/0.0.0.0:{port}", "--tls", "certs", "-n", "10", "-k", "200"]
    bs = subprocess.Popen([*command, "--json", "--quiet", "--out", "out"], cwd=folder, stdout=subprocess.PIPE, text=True)
    EmulatorRun.started.append(bs)
    command = [PROGRAM, "device", "--run", "tls", "--connect", f"tls/localhost:{port}", "--tls", "certs"]
    device = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=TIMEOUT)
    assert device.returncode == 0, device.stderr
    summary = json.loads(bs.communicate(timeout=TIMEOUT)[0])
    assert summary["timing"]["decisions"] >= 200
    assert summary["digest"] == replay(folder)["digest"]


@needs_program
@pytest.mark.parametrize(("policy", "form"), [("age-index", "cbor"), ("q-learning", "json")])
def test_repeated_actions_of_a_policy_give_its_digest_over_the_bus(folder, policy, form):
    policy_run = reveille.run(policy=policy, devices=30, ttis=300, seed=4, actions=True)
    assert policy_run["digest"] == policy_run["stepped"]["digest"]
    rows = iter(zip(policy_run["stages"], policy_run["actions"], strict=True))

    def next_action(observation):
        stage, action = next(rows)
        assert stage == observation["stage"]
        return action

    emulator_run = EmulatorRun(folder, "-n", "30", "-k", "300", "--seed", "4")
    assert emulator_run.serve(PolicyClient(next_action, form=form)) == len(policy_run["actions"])
    summary = emulator_run.summary()
    assert summary["digest"] == policy_run["digest"] == replay(folder)["digest"]
    assert summary["timing"]["decisions"] == len(policy_run["actions"])


@needs_program
@pytest.mark.parametrize("knowledge", ["reported", "oracle"])
def test_observations_in_the_emulator_equal_those_of_an_environment(folder, knowledge):
    """The policy's draws depend on every bit of the observation."""

    def policy(observation):
        bits = np.concatenate([observation["device"].ravel(), observation["globals"]]).view(np.uint32)
        generator = np.random.default_rng([int(observation["stage"]), int(bits.sum(dtype=np.uint64))])
        return generator.random(len(observation["action_mask"])) < 0.15

    settings = {"sensing.d_max": 6.0, "radio.uplink_loss": 0.1}
    env = ReveilleEnv(devices=25, ttis=300, battery_knowledge=knowledge, set=settings)
    observation, _ = env.reset(seed=7)
    environment_observations, ended = [], False
    while not ended:
        environment_observations.append(observation)
        observation, _, _, ended, info = env.step(policy(observation))
    assert any(row["stage"] == 1 for row in environment_observations)

    client = PolicyClient(lambda question: check_and_decide(question), whole=True)
    report_count = 0

    def check_and_decide(question):
        nonlocal report_count
        expected = environment_observations[question.seq]
        for key, value in expected.items():
            np.testing.assert_array_equal(question.observation[key], value, strict=True)
        report_count += len(question.heard)
        return policy(question.observation)

    options = ["--set", f"bs.battery_knowledge={knowledge}"]
    for path, value in settings.items():
        options += ["--set", f"{path}={value}"]
    emulator_run = EmulatorRun(folder, "-n", "25", "-k", "300", "--seed", "7", *options)
    assert emulator_run.serve(client) == len(environment_observations)
    assert emulator_run.summary()["digest"] == info["digest"]
    assert report_count > 0 and client.hello["ttis"] == 300 and len(client.hello["known"]["devices"]) == 25
    for features, columns in (("device", reveille.DEVICE_COLUMNS), ("global", reveille.GLOBAL_COLUMNS)):
        names = [column["name"] for column in client.hello[f"{features}_features"]]
        assert [columns[name] for name in names] == list(range(len(columns)))


@needs_program
def test_a_policy_command_decides_and_its_failure_is_reported(folder):
    script = folder / "policy.py"
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
    emulator_run = EmulatorRun(folder, "-n", "10", "-k", "100", "--policy-command", f"exec {sys.executable} {script}")
    assert emulator_run.summary()["ttis_done"] == 100
    command = f"exec {sys.executable} {script} fails"
    emulator_run = EmulatorRun(folder, "--force", "-n", "10", "-k", "300", "--policy-command", command)
    _, stderr = emulator_run.process.communicate(timeout=TIMEOUT)
    assert emulator_run.process.returncode == 1
    assert "a bug of mine" in stderr and "exit status: 1" in stderr


@needs_program
def test_the_run_waits_for_a_stopped_client(folder):
    """SIGSTOP for longer than a link may be unresponsive, then SIGCONT."""
    script = folder / "policy.py"
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
    command = f"echo $$ > pid; exec {sys.executable} {script}"
    emulator_run = EmulatorRun(folder, "-n", "10", "-k", "100", "--policy-command", command)

    def resume_client():
        deadline = time.monotonic() + TIMEOUT
        while not (folder / "stopped").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(3)
        os.kill(int((folder / "pid").read_text()), signal.SIGCONT)

    waker = threading.Thread(target=resume_client)
    waker.start()
    summary = emulator_run.summary()
    waker.join()
    assert summary["ttis_done"] == 100 and summary["digest"] == replay(folder)["digest"]


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


def test_a_repeated_question_is_answered_without_a_second_decision():
    observations = []

    def policy(observation):
        observations.append(observation)
        return {"sense": [len(observations)]} if len(observations) < 3 else {"senses": []}

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
    assert len(observations) == 2
    assert observations[0]["device"].shape == (2, 2) and observations[0]["device"].dtype == np.float32
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
    client_id = json.loads(client.answer(json.dumps(hello).encode(), "json", ""))["id"]
    question = {"protocol": 1, "seq": 0, "tti": 0, "stage": "plan", "to": client_id, "device": [[0.5]] * 2}
    question |= {"globals": [[0.25]], "action_mask": [2, 2], "heard": []}
    with pytest.raises(ValueError, match=r"zeros and ones|for 2 devices"):
        client.answer(json.dumps(question).encode(), "json", "")


def test_decisions_may_contain_numpy_numbers():
    import cbor2

    client = PolicyClient(lambda _: {"sense": list(np.flatnonzero([1, 0, 1])), "next": np.int64(5)})
    hello = {"protocol": 1, "min": 1, "max": 1, "seq": 0, "tti": 0, "stage": "hello"}
    client_id = cbor2.loads(client.answer(cbor2.dumps(hello), "cbor", ""))["id"]
    numbers = np.array([0.5, 1.0, 0.25], "<f4").tobytes()
    question = {"protocol": 1, "seq": 0, "tti": 0, "stage": "plan", "to": client_id, "device": numbers}
    question |= {"globals": numbers, "action_mask": b"\x02\x02\x02", "heard": []}
    decision = cbor2.loads(client.answer(cbor2.dumps(question), "cbor", ""))
    assert (decision["sense"], decision["next"]) == ([0, 2], 5)
    with pytest.raises(PortError, match="no key"):
        client.answer(cbor2.dumps(hello | {"refused": {"id": client_id, "why": "no key"}}), "cbor", "")


@needs_program
def test_one_client_decides_for_two_runs_in_turn(folder):
    client = PolicyClient(lambda observation: np.zeros(len(observation["action_mask"])))
    for name in ("first", "second"):
        emulator_run = EmulatorRun(folder, "-n", "10", "-k", "1", "--run", name, "--force")
        assert emulator_run.serve(client) == 1
        assert emulator_run.summary()["ttis_done"] == 1


@needs_program
def test_a_wrong_key_and_an_unknown_run_are_refused(folder):
    emulator_run = EmulatorRun(folder, "-n", "10", "-k", "5", "--run", "keyed")
    client = PolicyClient(lambda observation: np.zeros(len(observation["action_mask"])))
    wrong_key = folder / "wrong.key"
    wrong_key.write_text("00" * 16)
    deadline = time.monotonic() + TIMEOUT
    while not list((folder / "runtime").glob("reveille/keyed-*.json")):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    with pytest.raises(PortError, match="key"):
        client.serve(key_file=wrong_key)
    with pytest.raises(PortError, match="no run other"):
        client.serve(connect=find(run="keyed").connect, run="other", patience=2)
    assert emulator_run.serve(client) >= 5
    assert emulator_run.summary()["ttis_done"] == 5


@needs_program
def test_a_policy_command_may_outlive_its_last_decision(folder):
    script = folder / "policy.py"
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
    emulator_run = EmulatorRun(folder, "-n", "10", "-k", "20", "--policy-command", f"exec {sys.executable} {script}")
    assert emulator_run.summary()["ttis_done"] == 20
    assert int((folder / "after").read_text()) >= 20


def test_find_uses_the_registry_arguments_and_variables(folder, monkeypatch):
    with pytest.raises(PortError, match="no such run"):
        find()
    registry = folder / "runtime" / "reveille"
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
    monkeypatch.setenv("REVEILLE_RUN", "named")
    monkeypatch.setenv("REVEILLE_KEY", "k")
    found = find()
    assert (found.connect, found.run, found.key) == ("tcp/127.0.0.1:7", "named", "k") and "'k'" not in repr(found)
    registry.chmod(0o755)
    with pytest.raises(PortError, match="other users"):
        find(run="b")
