"""Who knocks without a key, however often, does not fill a disk with what is said of it."""

import os
import re
import socket
import ssl
import threading
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from real_processes import events, say, started, until, write_config

from adapters.processes.sieve import LONGEST, sieve

TABLE = {
    "episodes": 100_000,
    "system": {"id": "mapek/Gridworld-v0"},
    "monitor": {"detectors": ["page_hinkley"]},
}


def sieved(most, *chunks, minute=60.0):
    source, ours = os.pipe()
    theirs, sink = os.pipe()
    working = threading.Thread(target=sieve, args=(most, source, sink, minute))
    working.start()
    for chunk in chunks:
        os.write(ours, chunk)
    os.close(ours)
    working.join(60)
    os.close(sink)
    with os.fdopen(theirs, "rb") as said:
        found = said.read()
    os.close(source)
    return found.decode().splitlines()


@settings(max_examples=25)
@given(st.integers(1, 20), st.integers(0, 100), st.integers(1, 40))
def test_so_many_lines_are_handed_on_and_the_rest_is_counted(most, count, cut):
    whole = b"".join(b"line %d\n" % number for number in range(count))
    said = sieved(most, *(whole[at : at + cut] for at in range(0, len(whole), cut)))
    assert said[:most] == [f"line {number}" for number in range(min(most, count))]
    assert said[most:] == (
        [f"{count - most:,} more lines of Zenoh's within a minute, of which {most} are shown"] if count > most else []
    )


def test_a_new_minute_has_its_own_lines():
    (source, ours), (theirs, sink) = os.pipe(), os.pipe()
    working = threading.Thread(target=sieve, args=(1, source, sink, 0.0))
    working.start()
    for line in (b"a\n", b"b\n"):
        os.write(ours, line)
        assert os.read(theirs, 10) == line
    os.close(ours)
    working.join(60)
    for end in (source, theirs, sink):
        os.close(end)


def test_names_in_a_line_are_cleaned_and_a_line_without_end_fills_no_memory():
    assert sieved(5, b"\x1b[2J\xc2\x9bname\xe2\x80\xae\n") == ["?[2J?name?"]
    (line,) = sieved(5, b"x" * 5000)
    assert len(line) <= LONGEST


@pytest.fixture
def port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def knock(port, times):
    """Begin so many handshakes, and show no certificate."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    for _ in range(times):
        with (
            suppress(OSError),
            socket.create_connection(("127.0.0.1", port), 60) as plain,
            context.wrap_socket(plain) as over_tls,
        ):
            over_tls.recv(1)


@pytest.mark.long
def test_of_a_flood_of_bad_handshakes_so_many_lines_are_logged_and_the_rest_is_counted(here, port):
    config = write_config(here, TABLE)
    say("keys", str(here / "keys"))
    listen = ("--listen", f"tcp/127.0.0.1:{port}", "--tls", "keys", "--refusals", "5")
    with started("up", str(config), "--out", "out", "--no-figures", *listen, cwd=here) as running:
        log = here / "out" / "log.sqlite"
        until(lambda: running.ended or (log.exists() and len(events(log, "joined")) == 4), "all roles")
        knock(port, 60)
        assert not running.ended, running.said
        running.send(2)
        running.end(130)
        # It counts to the end of the process, and then writes how many.
        logged = here / "out" / "logs" / "knowledge.log"
        until(lambda: "more lines of Zenoh's" in logged.read_text(), "the count")
    lines = logged.read_text().splitlines()
    counted = [int(m[1].replace(",", "")) for line in lines if (m := re.match(r"([\d,]+) more lines", line))]
    assert sum(counted) >= 60
    assert len(lines) < 40
