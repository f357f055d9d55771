import logging
import sys
from pathlib import Path
from unittest import mock

import pytest

from adapters.buses import Wire, member, outbox, security

# pytest imports test modules without a path to their neighbours; `bus_records` and `bus_peers` are such.
sys.path.append(str(Path(__file__).parent))

from bus_peers import Site


@pytest.fixture(scope="module", autouse=True)  # a folder without `__init__.py` is no package that would end
def anybody_may_say_anything():
    """What is asked here is held against Knowledge itself: whom its list lets through stands in tests/security."""
    with mock.patch.object(security, "access_control", return_value={"enabled": False}):
        yield


class _Collect(logging.Handler):
    def __init__(self):
        super().__init__()
        self.records = []

    def emit(self, record):
        self.records.append(self.format(record))


@pytest.fixture(autouse=True)
def no_callback_fails():
    """Zenoh logs what a callback raises, and goes on."""
    collect = _Collect()
    logger = logging.getLogger("zenoh.handlers")
    logger.addHandler(collect)
    yield
    logger.removeHandler(collect)
    assert collect.records == []


@pytest.fixture
def endpoint(tmp_path_factory):
    """Name a socket that no other test has, by a path that is short enough for the kernel."""
    return f"unixsock-stream/{tmp_path_factory.mktemp('z')}/k.sock"


@pytest.fixture
def wire(endpoint):
    return Wire(endpoint, "example")


@pytest.fixture
def site(wire, tmp_path):
    with Site(wire, tmp_path / "log.sqlite") as site:
        yield site


@pytest.fixture
def raw(site):
    return site.session()


@pytest.fixture
def all_four(site):
    return site.everybody()


@pytest.fixture
def impatient(monkeypatch):
    """What was lost is sent again, and asked for, after a moment."""
    monkeypatch.setattr(outbox, "RESEND_AFTER", 0.02)
    monkeypatch.setattr(outbox, "REPEAT_AFTER", 0.01)
    monkeypatch.setattr(member, "KEEP_UP_EVERY", 0.01)
