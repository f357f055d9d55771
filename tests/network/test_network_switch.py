"""The switch itself: what it says of its lines is what TCP over them meets."""

import subprocess
import sys
from contextlib import contextmanager

import pytest
from user_space_switch import Switch, why_not

REASON = why_not()
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))

LISTEN = """
import socket
with socket.create_server(("0.0.0.0", 7447)) as listening:
    print("listens", flush=True)
    with listening.accept()[0] as link:
        while data := link.recv(65536):
            link.sendall(data)
"""
SEND = """
import socket, sys
data = bytes(range(256)) * 400
with socket.create_connection((sys.argv[1], 7447), 60) as link:
    link.sendall(data)
    link.shutdown(socket.SHUT_WR)
    back = b"".join(iter(lambda: link.recv(65536), b""))
sys.exit(back != data)
"""


@contextmanager
def listening_there(switch):
    with subprocess.Popen([*switch.start("there"), sys.executable, "-c", LISTEN], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout.readline() == b"listens\n"
            yield process
        finally:
            process.kill()


def test_what_tcp_sends_over_a_bad_line_comes_whole():
    bad = {"delay": 0.005, "jitter": 0.005, "loss": 0.05, "twice": 0.1, "late": 0.1, "rate": 1e6}
    with Switch(["here", "there"], **bad) as switch, listening_there(switch) as listening:
        sender = [*switch.start("here"), sys.executable, "-c", SEND, switch.addresses["there"]]
        assert subprocess.run(sender, timeout=100).returncode == 0
        assert listening.wait(60) == 0
    assert all(switch.seen[what] for what in ("passed", "lost", "late"))


def test_nothing_passes_a_line_that_is_cut():
    with Switch(["here", "there"]) as switch, listening_there(switch) as listening:
        switch.lines["there", "here"].cut = True  # one way is enough
        sender = [*switch.start("here"), sys.executable, "-c", SEND, switch.addresses["there"]]
        with subprocess.Popen(sender) as sending:
            while switch.seen["cut"] < 2:  # as many answers to who knocks, again
                assert sending.poll() is None
            switch.lines["there", "here"].cut = False
            assert sending.wait(100) == 0
        assert listening.wait(60) == 0
