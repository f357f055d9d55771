"""Where there are no keys, the run's token says who somebody is: what it is, where it stands, that it is never sent."""

import contextlib
import json
import os
import socket
import stat
import threading
from pathlib import Path

import pytest
import zenoh
from bus_peers import Site
from bus_records import TOLD, new_ledger
from hypothesis import given
from hypothesis import strategies as st

from adapters.buses import KnowledgeHub, Member, Wire, security, tokens
from adapters.buses.questions import Refused
from adapters.buses.wire import Unanswered
from mape.errors import ConfigError

ROOT = os.getuid() == 0


@pytest.fixture
def runtime(tmp_path, monkeypatch):
    """The user's own runtime folder, empty."""
    folder = tmp_path / "runtime"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    monkeypatch.setattr(tokens.tempfile, "tempdir", str(tmp_path))
    return folder


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(params=["tcp", "unix"])
def endpoint(request, tmp_path_factory):
    if request.param == "tcp":
        return f"tcp/127.0.0.1:{free_port()}"
    return f"unixsock-stream/{tmp_path_factory.mktemp('z')}/k.sock"


def make(endpoint, given=None):
    return tokens.make(endpoint, security.CLIENTS, given)


# What it is, and where.


def test_a_role_that_waits_for_it_looks_again_now_and_then(runtime, endpoint, monkeypatch):
    looks = []
    monkeypatch.setattr(tokens, "find", lambda *given, find=tokens.find: looks.append(1) or find(*given))
    with pytest.raises(Unanswered, match="there is no token"):
        Member(Wire(endpoint, "example"), "plan", patience=1.0).connect()
    assert 1 < len(looks) < 50  # on a slow machine fewer; without a pause it was thousands


def test_it_is_made_once_for_its_owner_alone_with_a_secret_of_its_own_for_each_role(runtime, endpoint):
    path = make(endpoint)
    assert path.parent == runtime / "mapek"
    assert [stat.S_IMODE(each.stat().st_mode) for each in (path.parent, path)] == [0o700, 0o600]
    secrets = {tokens.secret(path, role) for role in security.CLIENTS}
    assert len(secrets) == len(security.CLIENTS)
    assert all(len(secret) >= 43 for secret in secrets)  # 256 bits
    before = path.read_bytes()
    assert make(endpoint) == tokens.find(endpoint) == path
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


def test_each_endpoint_has_its_own(runtime):
    places = ["tcp/127.0.0.1:1", "tcp/127.0.0.1:2", "tcp/127.0.0.2:1", "unixsock-stream//a", "unixsock-stream//b"]
    assert len({make(place).read_bytes() for place in places}) == len(places)


@pytest.mark.parametrize(
    ("listened", "reached"),
    [
        ("tcp/0.0.0.0:7447", "tcp/127.0.0.1:7447"),
        ("tcp/127.0.0.1:7447", "tcp/localhost:7447"),
        ("unixsock-stream//tmp/k", "unixsock-stream//tmp/../tmp/k"),
    ],
)
def test_it_is_found_under_every_name_of_the_same_place(runtime, listened, reached):
    assert tokens.find(reached if make(listened) else "") == make(listened)


@given(st.text(st.characters(blacklist_categories=["Cs", "Cc"], blacklist_characters="?#;"), min_size=1, max_size=60))
def test_every_path_of_a_socket_names_a_file_that_can_be_made(path):
    name = tokens._name(f"unixsock-stream/{path}")
    assert "/" not in name
    assert len(os.fsencode(name)) < 256


def test_what_a_socket_that_is_gone_has_left_is_removed(runtime, tmp_path):
    gone, here = tmp_path / "gone", tmp_path / "here"
    gone.mkdir()
    here.mkdir()
    left, kept = make(f"unixsock-stream/{gone}/k"), make(f"unixsock-stream/{here}/k")
    gone.rmdir()
    make("tcp/127.0.0.1:1")
    assert (left.exists(), kept.exists()) == (False, True)


def opened(path):
    path.chmod(0o640)


def linked(path):
    path.rename(path.with_suffix(".away"))
    path.symlink_to(path.with_suffix(".away"))


def emptied(path):
    path.write_text("")


def weakened(path):
    path.write_text("plan:secret\n")


def given_away(path):
    os.chown(path, 65534, 65534)


SPOILT = [opened, linked, emptied, weakened, *([given_away] if ROOT else [])]


@pytest.mark.parametrize("spoil", SPOILT)
def test_what_is_not_ones_own_alone_is_not_taken_for_one(runtime, endpoint, spoil):
    path = make(endpoint)
    spoil(path)
    for use in (
        lambda: make(endpoint),
        lambda: tokens.secret(path, "plan"),
        lambda: Wire(endpoint, "s").join("plan", 1),
    ):
        with pytest.raises(ConfigError, match="token"):
            use()
    assert not Path(endpoint.partition("/")[2]).exists()


@pytest.mark.parametrize("spoil", [opened, emptied])
def test_a_knowledge_whose_token_is_spoilt_does_not_listen(runtime, endpoint, spoil):
    spoil(make(endpoint))
    wire = Wire(endpoint, "s")
    for use in (wire.check_listen, wire.check_here, wire.listen):
        with pytest.raises(ConfigError, match="token"):
            use()


def test_a_runtime_folder_that_others_can_enter_is_passed_by(runtime, tmp_path):
    (runtime / "mapek").mkdir(mode=0o755)
    assert make("tcp/127.0.0.1:1").parent == tmp_path / f"mapek-run-{os.getuid()}"
    assert tokens.find("tcp/127.0.0.1:1").exists()


def test_a_folder_that_somebody_else_has_made_ready_is_refused(runtime, tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    (tmp_path / "theirs").mkdir(mode=0o700)
    (tmp_path / f"mapek-run-{os.getuid()}").symlink_to(tmp_path / "theirs")
    with pytest.raises(ConfigError, match=r"no folder can hold the run's token: .* is a link.*--token FILE"):
        make("tcp/127.0.0.1:1")


def test_keys_and_a_token_are_not_given_together(tmp_path):
    with pytest.raises(ConfigError, match="leave out --tls or --token"):
        Wire("tcp/127.0.0.1:1", "s", tls=tmp_path, token=tmp_path / "t")


# Who comes in.


class Recording:
    """A relay that keeps every byte between a client and Knowledge: what the client `sent`, and what it was told."""

    def __init__(self, port):
        self.sent, self.told = [], []
        self._to = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                client = self._listener.accept()[0]
                knowledge = socket.create_connection(("127.0.0.1", self._to))
                for direction in ((client, knowledge, self.sent), (knowledge, client, self.told)):
                    threading.Thread(target=self._carry, args=direction, daemon=True).start()

    @staticmethod
    def _carry(source, target, heard):
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                heard.append(data)
                target.sendall(data)
        for each in (source, target):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def close(self):
        self._listener.close()


def overheard(site):
    """Let Execute join through a relay, and return what that has heard."""
    relay = Recording(port_of(site.wire.endpoint))
    through = Wire(f"tcp/127.0.0.1:{relay.port}", "s", token=tokens.find(site.wire.endpoint))
    with contextlib.closing(relay), Member(through, "execute", layout=TOLD, patience=60):
        pass
    return relay


def port_of(endpoint):
    return int(endpoint.rpartition(":")[2])


@pytest.fixture
def site(runtime, tmp_path):
    with Site(Wire(f"tcp/127.0.0.1:{free_port()}", "s"), tmp_path / "log.sqlite") as site:
        yield site


def test_no_secret_crosses_the_wire(site):
    relay, token = overheard(site), tokens.find(site.wire.endpoint)
    heard = b"".join([*relay.sent, *relay.told])
    assert b"execute" in heard  # who it is, does
    for role in security.CLIENTS:
        assert tokens.secret(token, role).encode() not in heard


def test_what_a_role_once_said_lets_nobody_in_again(site):
    relay = overheard(site)
    assert site.ledger.epoch("execute") == 1
    with socket.create_connection(("127.0.0.1", port_of(site.wire.endpoint))) as link, contextlib.suppress(OSError):
        link.settimeout(60)
        for data in relay.sent:
            link.sendall(data)
        while link.recv(65536):
            pass
    with site.wire.join("operator", 60) as operator:  # asked behind it
        assert [reply.ok is not None for reply in operator.get("mape/s/knowledge/status")] == [True]
    assert site.ledger.epoch("execute") == 1


def session(endpoint, user, password):
    quiet = {"enabled": False}
    auth = {} if user is None else {"user": user, "password": password}
    connect = {"endpoints": [endpoint], "timeout_ms": 300, "exit_on_failure": True}
    whole = {
        "mode": "client", "connect": connect, "scouting": {"multicast": quiet, "gossip": quiet},
        "transport": {"shared_memory": quiet, "auth": {"usrpwd": auth}},
    }  # fmt: skip
    return zenoh.open(zenoh.Config.from_json5(json.dumps(whole)))


@pytest.mark.parametrize("who", ["nobody", "a stranger", "a guess", "another's secret", "the router"])
def test_who_has_not_the_secret_of_a_role_opens_no_session(site, who):
    secret = tokens.secret(tokens.find(site.wire.endpoint), "plan")
    user, password = {
        "nobody": (None, None),
        "a stranger": ("stranger", "x" * 43),
        "a guess": ("operator", "x" * 43),
        "another's secret": ("operator", secret),
        "the router": ("knowledge", ""),
    }[who]
    with pytest.raises(zenoh.ZError):
        session(site.wire.endpoint, user, password)
    session(site.wire.endpoint, "plan", secret).close()


def test_a_token_with_one_role_makes_one_that_role_and_no_other(site, tmp_path):
    whole = tokens.find(site.wire.endpoint)
    mine = tmp_path / "mine.token"
    mine.touch(mode=0o600)
    mine.write_text(f"monitor:{tokens.secret(whole, 'monitor')}\n")
    wire = Wire(site.wire.endpoint, "s", token=mine)
    wire.join("monitor", 60).close()
    with pytest.raises(ConfigError, match="no line for operator; it has monitor"):
        wire.join("operator", 1)


def test_another_token_is_refused_and_said_so(site, tmp_path):
    other = make("tcp/127.0.0.1:1", tmp_path / "other.token")
    with pytest.raises(Unanswered, match="another token") as refused:
        Wire(site.wire.endpoint, "s", token=other).join("operator", 0.3)
    assert refused.value.found


def test_who_is_early_waits_for_the_token(runtime, endpoint, tmp_path):
    wire = Wire(endpoint, "s")
    told = []
    member = Member(wire, "execute", layout=TOLD, patience=60, waiting=told.append)
    joining = threading.Thread(target=member.connect)
    joining.start()
    while not told:
        threading.Event().wait(0.01)
    with Site(wire, tmp_path / "log.sqlite") as site:
        joining.join(60)
        assert site.ledger.epoch("execute") == 1
        member.close()


def test_a_knowledge_that_is_started_again_knows_who_had_joined(site):
    operator = site.session()
    for _ in range(2):
        assert [reply.ok is not None for reply in operator.get("mape/s/knowledge/status")] == [True]
        site.close()
        site.open()
        end = threading.Event()
        while not any(reply.ok for reply in operator.get("mape/s/knowledge/status", timeout=1)):
            end.wait(0.05)


# Who poses as Knowledge.


class Impostor(KnowledgeHub):
    """One that would answer every role, and can prove nothing: it never saw the token."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.answers._proof = lambda role, challenge: self.guess

    guess = "00" * 32


@pytest.mark.parametrize("guess", ["", "00" * 32, "replayed"])
def test_a_role_is_not_led_by_who_only_listens_where_knowledge_would(runtime, guess):
    wire = Wire(f"tcp/127.0.0.1:{free_port()}", "s")
    make(wire.endpoint)
    impostor = Impostor(new_ledger(begun=False), wire)
    impostor.guess = wire.proof("execute", "earlier") if guess == "replayed" else guess
    with impostor:
        member = Member(wire, "execute", layout=TOLD, patience=60)
        with pytest.raises(Refused, match="has not the run's token"):
            member.connect()
        member.close()
    impostor.ledger.store.close()


@given(st.text(max_size=64), st.text(max_size=64), st.sampled_from(security.CLIENTS), st.sampled_from(security.CLIENTS))
def test_a_proof_is_of_one_challenge_and_one_role(first, second, one, other):
    wire = Wire("tcp/127.0.0.1:1", "s")
    make(wire.endpoint)
    same = first == second and one == other
    assert (wire.proof(one, first) == wire.proof(other, second)) == same


def test_with_keys_certificates_are_the_proof(tmp_path):
    assert Wire("tcp/127.0.0.1:1", "s", tls=tmp_path).proof("plan", "anything") == ""
