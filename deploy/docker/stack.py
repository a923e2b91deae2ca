#!/usr/bin/env python3
"""Prints the services `bs` and `device` of docker-compose.yml as a stack for Docker Swarm.

    openssl rand -hex 16 | docker secret create reveille-key-run.key -
    reveille tls init tls --name=bs
    for file in tls/{bs,device,operator}/*; do docker secret create "reveille-$(echo "$file" | tr / -)" "$file"; done
    deploy/docker/stack.py | docker stack deploy --compose-file - reveille

Compose evaluates the file, so the same variables apply. Swarm has no host addresses for ports, no conditions for a
start, and no volumes that machines share. Therefore no port is published, devices retry until the base station answers,
and secrets replace the volumes of SHARED_FILES. Needs `docker compose` (v2), or docker-compose 1.29 and Python's YAML
package.
"""

import json
import subprocess
import sys
from pathlib import Path

COMPOSE_FILE = Path(__file__).resolve().parents[2] / "docker-compose.yml"
# Volumes that services share, with their files. A secret has the name of its path: reveille-key-run.key for
# /key/run.key.
SHARED_FILES = {"key": ["run.key"]}
SHARED_FILES |= {f"tls-{role}": ["ca.pem", "cert.pem", "key.pem"] for role in ("bs", "device", "operator")}


def main():
    config = read_config()
    services = {name: as_swarm_service(config["services"][name]) for name in ("bs", "device")}
    # The volume with the results is on one machine.
    services["bs"]["deploy"]["placement"] = {"constraints": ["node.role == manager"]}
    # A base station that ends at a signal dismisses its devices. One that is killed is resumed by its replacement.
    services["bs"]["stop_signal"] = "SIGKILL"
    secrets = {secret["source"] for service in services.values() for secret in service["secrets"]}
    stack = {
        # The schema; newer engines ignore it.
        "version": "3.9",
        "services": services,
        "networks": {"testbed": {"driver": "overlay"}},
        "volumes": {"results": {}},
        "secrets": {name: {"external": True} for name in sorted(secrets)},
    }
    json.dump(stack, sys.stdout, indent=2)


def read_config():
    """Returns docker-compose.yml with its variables replaced."""
    file = ("--file", str(COMPOSE_FILE), "config")
    if subprocess.run(["docker", "compose", "version"], capture_output=True).returncode == 0:
        return json.loads(subprocess.check_output(["docker", "compose", *file, "--format", "json"]))
    # Debian installs this package with docker-compose.
    import yaml

    return yaml.safe_load(subprocess.check_output(["docker-compose", *file]))


def as_swarm_service(service):
    replicas = service.pop("scale", 1)
    attempts = service.pop("restart").removeprefix("on-failure:")
    for key in ("build", "depends_on", "ports", "security_opt"):
        service.pop(key, None)
    # Compose v2 prints fields without a value too, which Swarm refuses.
    for key in ("command", "entrypoint"):
        if service.get(key) is None:
            service.pop(key, None)
    # Swarm ignores `tmpfs`.
    volumes = [{"type": "tmpfs", "target": path} for path in service.pop("tmpfs")]
    secrets = []
    for volume in service["volumes"]:
        source, target = source_and_target(volume)
        if source in SHARED_FILES:
            secrets += [as_secret(f"{target}/{name}") for name in SHARED_FILES[source]]
        else:
            volumes.append(volume)
    service["volumes"], service["secrets"] = volumes, secrets
    service["deploy"] = {
        "replicas": replicas,
        # The name of the service is the address of its container. A virtual address would need IPVS in the kernel.
        "endpoint_mode": "dnsrr",
        "restart_policy": {"condition": "on-failure", "max_attempts": int(attempts)},
    }
    return service


def source_and_target(volume):
    """Returns the source and the path of a volume in the short or the long form."""
    return (volume["source"], volume["target"]) if isinstance(volume, dict) else volume.split(":")[:2]


def as_secret(path):
    source = "reveille" + path.replace("/", "-")
    return {"source": source, "target": path, "uid": "10001", "gid": "10001", "mode": 0o400}


if __name__ == "__main__":
    main()
