"""What takes root: a small disk, and a link that can be cut. All of it is taken back."""

import itertools
import os
import subprocess

# Threads may ask for the next number at the same time.
_numbers = itertools.count(1)


def can(*command):
    """Whether a command succeeds."""
    try:
        return subprocess.run(command, capture_output=True, timeout=20).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def must(*command):
    """Runs a command that cannot fail."""
    subprocess.run(command, check=True, capture_output=True, timeout=20)


def _number():
    return next(_numbers)


def small_disk(ground, name, kilobytes):
    """A file system of its own in the ground's folder; None where that cannot be."""
    path = ground.folder / name
    path.mkdir()
    if not can("mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "none", str(path)):
        return None
    ground.undo.append(lambda: can("umount", "-l", str(path)))
    return path


def fill(path):
    """Leaves no room on a disk; gives what takes it."""
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
    """A network of its own, with a loopback."""

    def __init__(self, ground, settings=()):
        self.name = f"chaos-{os.getpid()}-{_number()}"
        must("ip", "netns", "add", self.name)
        ground.undo.append(lambda: can("ip", "netns", "del", self.name))
        self.inside("ip", "link", "set", "lo", "up")
        for key, value in settings:
            self.inside("sh", "-c", f"echo '{value}' > /proc/sys/net/{key.replace('.', '/')}")

    def prefix(self):
        """What a command begins with to run in it."""
        return ["ip", "netns", "exec", self.name]

    def inside(self, *command):
        """Runs a command in it."""
        must(*self.prefix(), *command)


class Link(Namespace):
    """A network of its own behind a cable that can be cut."""

    def __init__(self, ground):
        super().__init__(ground)
        number = (os.getpid() * 61 + _number()) % 16000
        high, low = 64 + number // 250 % 64, number % 250 + 1
        self.address = f"100.{high}.{low}.1"
        # No longer than the system allows.
        self.cable = f"cha{number}"
        far = f"chb{number}"
        must("ip", "link", "add", self.cable, "type", "veth", "peer", "name", far)
        ground.undo.append(lambda: can("ip", "link", "del", self.cable))
        must("ip", "link", "set", far, "netns", self.name)
        must("ip", "addr", "add", f"{self.address}/30", "dev", self.cable)
        must("ip", "link", "set", self.cable, "up")
        self.inside("ip", "addr", "add", f"100.{high}.{low}.2/30", "dev", far)
        self.inside("ip", "link", "set", far, "up")

    def cut(self):
        """Nothing gets through."""
        must("ip", "link", "set", self.cable, "down")

    def mend(self):
        """All gets through again."""
        must("ip", "link", "set", self.cable, "up")


def has_networks():
    """Whether networks can be made."""
    name = f"chaos-probe-{os.getpid()}"
    if os.geteuid() != 0 or not can("ip", "netns", "add", name):
        return False
    pair = ["type", "veth", "peer", "name", f"chq{os.getpid()}"]
    can_link = can("ip", "link", "add", f"chp{os.getpid()}", *pair)
    can("ip", "link", "del", f"chp{os.getpid()}")
    can("ip", "netns", "del", name)
    return can_link
