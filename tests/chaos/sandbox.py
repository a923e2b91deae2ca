"""Sandboxes that need root: a small disk, and a link that can be cut. All of them are removed at the end."""

import itertools
import os
import subprocess

# Threads may take numbers concurrently; `next` on a count is atomic.
_numbers = itertools.count(1)


def can(*command):
    """Whether a command succeeds."""
    try:
        return subprocess.run(command, capture_output=True, timeout=20).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def must(*command):
    """Runs a command and raises an error if it fails."""
    subprocess.run(command, check=True, capture_output=True, timeout=20)


def _number():
    return next(_numbers)


def small_disk(workspace, name, kilobytes):
    """Mounts a small file system in the case's folder; returns None where that is not possible."""
    path = workspace.folder / name
    path.mkdir()
    if not can("mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "none", str(path)):
        return None
    workspace.cleanups.append(lambda: can("umount", "-l", str(path)))
    return path


def fill(path):
    """Fills a disk and returns the file that occupies the space."""
    ballast = path / "ballast"
    with open(ballast, "wb", buffering=0) as file:
        for size in (1 << 20, 1 << 12, 1):
            try:
                while file.write(bytes(size)):
                    pass
            except OSError:
                pass
    return ballast


class Namespace:
    """A network namespace with a loopback interface."""

    def __init__(self, workspace, settings=()):
        self.name = f"chaos-{os.getpid()}-{_number()}"
        must("ip", "netns", "add", self.name)
        workspace.cleanups.append(lambda: can("ip", "netns", "del", self.name))
        self.inside("ip", "link", "set", "lo", "up")
        for key, value in settings:
            self.inside("sh", "-c", f"echo '{value}' > /proc/sys/net/{key.replace('.', '/')}")

    def prefix(self):
        """Returns the command prefix that runs a command in the namespace."""
        return ["ip", "netns", "exec", self.name]

    def inside(self, *command):
        """Runs a command in the namespace."""
        must(*self.prefix(), *command)


class Link(Namespace):
    """A network namespace behind a virtual cable that can be cut."""

    def __init__(self, workspace):
        super().__init__(workspace)
        number = (os.getpid() * 61 + _number()) % 16000
        high, low = 64 + number // 250 % 64, number % 250 + 1
        self.address = f"100.{high}.{low}.1"
        # Interface names have a length limit in the system.
        self.cable = f"cha{number}"
        far = f"chb{number}"
        must("ip", "link", "add", self.cable, "type", "veth", "peer", "name", far)
        workspace.cleanups.append(lambda: can("ip", "link", "del", self.cable))
        must("ip", "link", "set", far, "netns", self.name)
        must("ip", "addr", "add", f"{self.address}/30", "dev", self.cable)
        must("ip", "link", "set", self.cable, "up")
        self.inside("ip", "addr", "add", f"100.{high}.{low}.2/30", "dev", far)
        self.inside("ip", "link", "set", far, "up")

    def cut(self):
        """Stops all traffic."""
        must("ip", "link", "set", self.cable, "down")

    def restore(self):
        """Restores all traffic."""
        must("ip", "link", "set", self.cable, "up")


def has_networks():
    """Whether this machine can create network namespaces and links."""
    name = f"chaos-probe-{os.getpid()}"
    if os.geteuid() != 0 or not can("ip", "netns", "add", name):
        return False
    pair = ["type", "veth", "peer", "name", f"chq{os.getpid()}"]
    can_link = can("ip", "link", "add", f"chp{os.getpid()}", *pair)
    can("ip", "link", "del", f"chp{os.getpid()}")
    can("ip", "netns", "del", name)
    return can_link
