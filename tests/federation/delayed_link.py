"""A link with delay and loss between two network namespaces, in user space: not every kernel has netem. Needs root."""

import fcntl
import heapq
import itertools
import os
import random
import select
import struct
import threading
import time

import sandbox

# From linux/if_tun.h: TUNSETIFF, IFF_TUN and IFF_NO_PI.
SET_INTERFACE, TUN, NO_HEADER = 0x400454CA, 0x0001, 0x1000
# Largest packet of an interface in bytes, with a margin.
MAX_PACKET = 2048

_numbers = itertools.count(1)


class DelayedLink:
    """A link between two namespaces. Its delay (seconds, one way), loss (share of packets) and cut can change at any time."""

    def __init__(self, workspace, near, far, delay=0.0, loss=0.0, seed=0):
        number = next(_numbers)
        self.delay, self.loss, self.is_cut = delay, loss, False
        self.sent = self.dropped = 0
        self.far_namespace = far
        # Addresses of the two ends, in a range that is not routed on the internet.
        self.near, self.far = f"198.18.{number}.1", f"198.18.{number}.2"
        self._chance = random.Random(seed)
        self._is_closed = False
        self._ends = [
            self._make_end(namespace, f"rvl{os.getpid() % 10**6}-{2 * number + end}", own, other)
            for end, (namespace, own, other) in enumerate([(near, self.near, self.far), (far, self.far, self.near)])
        ]
        self._thread = threading.Thread(target=self._forward, daemon=True)
        self._thread.start()
        workspace.cleanups.append(self.close)

    @staticmethod
    def _make_end(namespace, interface, own, other):
        """Creates one end, and returns its file descriptor, which stays valid when the interface moves to the namespace."""
        descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(descriptor, SET_INTERFACE, struct.pack("16sH", interface.encode(), TUN | NO_HEADER))
        sandbox.must("ip", "link", "set", interface, "netns", namespace.name)
        namespace.inside("ip", "addr", "add", own, "peer", other, "dev", interface)
        namespace.inside("ip", "link", "set", interface, "up")
        return descriptor

    def _forward(self):
        """Passes packets from each end to the other until the link is closed."""
        # Packets on the way: time of arrival, number, end, bytes. The number keeps packets of one time in order.
        on_the_way, order = [], itertools.count()
        while not self._is_closed:
            wait = max(0.0, on_the_way[0][0] - time.monotonic()) if on_the_way else 0.1
            for descriptor in select.select(self._ends, [], [], wait)[0]:
                other = self._ends[1 - self._ends.index(descriptor)]
                for packet in self._packets(descriptor):
                    self.sent += 1
                    if self.is_cut or self._chance.random() < self.loss:
                        self.dropped += 1
                    else:
                        heapq.heappush(on_the_way, (time.monotonic() + self.delay, next(order), other, packet))
            while on_the_way and on_the_way[0][0] <= time.monotonic():
                _, _, end, packet = heapq.heappop(on_the_way)
                try:
                    os.write(end, packet)
                except OSError:
                    # The namespace was removed.
                    return

    @staticmethod
    def _packets(descriptor):
        """Returns the packets that wait at an end."""
        packets = []
        try:
            while True:
                packets.append(os.read(descriptor, MAX_PACKET))
        except OSError:
            return packets

    def close(self):
        """Ends the link; the interfaces disappear with their files."""
        self._is_closed = True
        self._thread.join()
        for descriptor in self._ends:
            os.close(descriptor)


def is_possible():
    """Whether this machine can create such links."""
    return sandbox.has_networks() and os.access("/dev/net/tun", os.R_OK | os.W_OK)
