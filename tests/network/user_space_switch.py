"""A network of this test alone: a namespace for each host, and a packet switch between them that can be as bad as any.

Each host has a TUN device; what it sends is read here, and handed to the one that it is for, late, twice, out of order,
slowly, or not at all. TCP, TLS and Zenoh above it are the real ones. Addresses exist within these namespaces only, and
all is gone with this process.

Run as a program, this file starts another one in a namespace: ``python user_space_switch.py NAMESPACE COMMAND...``.
"""

import ctypes
import fcntl
import heapq
import os
import random
import select
import socket
import struct
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_NEW_NET = 0x4000_0000
_SET_TUN, _TUN_WITHOUT_HEADER = 0x4004_54CA, 0x1001
_SET_FLAGS, _SET_ADDRESS, _SET_MASK, _UP_AND_RUNNING = 0x8914, 0x8916, 0x891C, 0x41
_LIBC = ctypes.CDLL(None, use_errno=True)

QUEUE = 256 << 10
"""Bytes that wait for a slow link before what comes further is lost, as in a router at its edge."""


def why_not() -> str | None:
    """Say why namespaces cannot be made here; None where they can."""
    try:
        with Switch(["one"]):
            return None
    except OSError as error:
        return f"no network namespace with a TUN device can be made here: {error}"


def _checked(done: int) -> None:
    if done:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


@dataclass
class Line:
    """How packets go from one host to another.

    Attributes
    ----------
    delay, jitter : seconds one way, and how many more at most; packets keep their order.
    loss, twice, late : shares of the packets that are lost, come twice, and are overtaken.
    rate : bytes a second; None for as many as come.
    cut : nothing passes.
    """

    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    twice: float = 0.0
    late: float = 0.0
    rate: float | None = None
    cut: bool = False
    free_at: float = 0.0
    last_due: float = 0.0


class Switch:
    """Hosts with a line from each to each; `with` has them made, and gone."""

    def __init__(self, hosts, seed=0, **line):
        self.addresses = {host: f"10.77.0.{number}" for number, host in enumerate(hosts, start=1)}
        self.lines = {(a, b): Line(**line) for a in hosts for b in hosts if a != b}
        self.seen = Counter()  # what became of the packets
        self.bytes = Counter()  # (from, to) -> bytes that were sent
        self._random = random.Random(seed)
        self._opened = []  # file descriptors
        self._namespaces, self._tuns = {}, {}
        self._waiting, self._count = [], 0
        self._thread = threading.Thread(target=self._work, name="switch", daemon=True)
        self._wake = os.pipe()

    def __enter__(self):
        try:
            for host in self.addresses:
                self._make(host)
        except BaseException:
            self._close()
            raise
        self._thread.start()
        return self

    def __exit__(self, *_):
        os.write(self._wake[1], b"x")
        self._thread.join()
        self._close()

    def _close(self):
        for opened in (*self._opened, *self._wake):
            os.close(opened)
        self._opened.clear()

    def start(self, host):
        """Return the words that go before a command that is to run on a host."""
        namespace = f"/proc/{os.getpid()}/fd/{self._namespaces[host]}"
        return [sys.executable, str(Path(__file__).resolve()), namespace]

    def between(self, one, other):
        """Return the lines between two hosts, there and back."""
        return self.lines[one, other], self.lines[other, one]

    def _make(self, host):
        failed = []

        def make():  # a thread has a namespace of its own; the others of this process stay where they are
            try:
                _checked(_LIBC.unshare(_NEW_NET))
                self._namespaces[host] = self._kept(os.open("/proc/thread-self/ns/net", os.O_RDONLY | os.O_CLOEXEC))
                tun = self._kept(os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC))
                fcntl.ioctl(tun, _SET_TUN, struct.pack("16sH22x", b"tun0", _TUN_WITHOUT_HEADER))
                _bring_up("lo", None)
                _bring_up("tun0", self.addresses[host])
                self._tuns[tun] = host
            except OSError as error:
                failed.append(error)

        thread = threading.Thread(target=make)
        thread.start()
        thread.join()
        if failed:
            raise failed[0]

    def _kept(self, descriptor):
        self._opened.append(descriptor)
        return descriptor

    def _work(self):
        poll = select.poll()
        for descriptor in (*self._tuns, self._wake[0]):
            poll.register(descriptor, select.POLLIN)
        by_address = {socket.inet_aton(address): host for host, address in self.addresses.items()}
        into = {host: tun for tun, host in self._tuns.items()}
        while True:
            now = time.monotonic()
            while self._waiting and self._waiting[0][0] <= now:
                _, _, host, packet = heapq.heappop(self._waiting)
                with suppress(BlockingIOError):
                    os.write(into[host], packet)
            left = 1000.0 if not self._waiting else max(0.0, (self._waiting[0][0] - now) * 1000)
            for descriptor, _ in poll.poll(left):
                if descriptor == self._wake[0]:
                    return
                with suppress(BlockingIOError):
                    for _ in range(64):
                        packet = os.read(descriptor, 65536)
                        host = by_address.get(packet[16:20]) if packet[0] >> 4 == 4 else None
                        if host is not None and host != self._tuns[descriptor]:
                            self._take(self._tuns[descriptor], host, packet)

    def _take(self, source, target, packet):
        line, now = self.lines[source, target], time.monotonic()
        self.bytes[source, target] += len(packet)
        if line.cut or self._random.random() < line.loss:
            self.seen["cut" if line.cut else "lost"] += 1
            return
        due = now
        if line.rate is not None:
            line.free_at = max(line.free_at, now)
            if (line.free_at - now) * line.rate > QUEUE:
                self.seen["overflowed"] += 1
                return
            line.free_at += len(packet) / line.rate
            due = line.free_at
        due += line.delay + line.jitter * self._random.random()
        if self._random.random() < line.late:
            self.seen["late"] += 1
            due += line.delay / 4 + 0.002
        else:
            due = line.last_due = max(due, line.last_due)
        for _ in range(1 + (self._random.random() < line.twice)):
            self.seen["passed"] += 1
            self._count += 1
            heapq.heappush(self._waiting, (due, self._count, target, packet))


def _bring_up(device, address):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        name = device.encode()
        if address is not None:
            for order, value in ((_SET_ADDRESS, address), (_SET_MASK, "255.255.255.0")):
                fcntl.ioctl(control, order, struct.pack("16sHH4s8x", name, socket.AF_INET, 0, socket.inet_aton(value)))
        fcntl.ioctl(control, _SET_FLAGS, struct.pack("16sH14x", name, _UP_AND_RUNNING))


if __name__ == "__main__":
    _namespace = os.open(sys.argv[1], os.O_RDONLY | os.O_CLOEXEC)
    _checked(_LIBC.setns(_namespace, _NEW_NET))
    os.execvp(sys.argv[2], sys.argv[2:])
