"""Knowledge's router and its clients over TLS on this host, with nothing of mapek but keys and access control."""

import json
import os
import socket
import threading
import time
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta

import zenoh

from adapters.buses import security, tokens
from adapters.buses.signing import Authority, Pem
from adapters.buses.wire import never_freed

PATIENCE = 60.0
STATUS = "mape/s/knowledge/status"

# Within one session Zenoh delivers by itself, without a router and its list.
REMOTE = zenoh.Locality.REMOTE


def direct(handler):
    return zenoh.handlers.Callback(handler, indirect=False)


def config(mode, link, auth=None, **edges):
    quiet = {"enabled": False}
    return zenoh.Config.from_json5(
        json.dumps(
            {
                "mode": mode,
                "scouting": {"delay": 0, "multicast": quiet, "gossip": quiet},
                "transport": {"shared_memory": quiet, "link": link, "auth": {"usrpwd": auth or {}}},
                **edges,
            }
        )
    )


def listen(link, address="tls/127.0.0.1", **edges):
    """Open a router on a free port; return it and the port."""
    for _ in range(20):
        with socket.socket() as probe:
            probe.bind((address.partition("/")[2], 0))
            port = probe.getsockname()[1]
        try:
            router = zenoh.open(config("router", link, listen={"endpoints": [f"{address}:{port}"]}, **edges))
            return never_freed(router), port
        except zenoh.ZError as error:
            if "Address already in use" not in str(error):
                raise
    raise AssertionError("no port was free")


def connect(port, link, *, mode="client", address="tls/127.0.0.1", timeout_ms=0, auth=None):
    """Open a session to a router; by default it has one attempt."""
    edges = {
        "connect": {"endpoints": [f"{address}:{port}"], "timeout_ms": timeout_ms, "exit_on_failure": True},
    }
    if mode != "client":
        edges["listen"] = {"endpoints": []}
    return zenoh.open(config(mode, link, auth, **edges))


def ask(session, key, **options):
    """Return the texts of all replies of others to a query."""
    replies = session.get(
        key, timeout=PATIENCE, consolidation=zenoh.ConsolidationMode.NONE, allowed_destination=REMOTE, **options
    )
    return [reply.ok.payload.to_string() for reply in replies if reply.ok is not None]


def eventually(condition):
    """Wait until a condition holds."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        threading.Event().wait(0.01)


def sign(keys, name, common_name, *, hosts=(), begin=None, days=1):
    """Have the authority of `keys` sign a certificate for anybody; return Zenoh's config for it."""
    authority = Authority(Pem((keys / "ca.key").read_bytes(), (keys / "ca.pem").read_bytes()))
    begin = begin or datetime.now(UTC) - timedelta(minutes=1)
    pem = authority.sign(common_name, hosts, begin, begin + timedelta(days=days))
    (keys / f"{name}.key").write_bytes(pem.key)
    (keys / f"{name}.pem").write_bytes(pem.certificate)
    return shown(keys, name)


def shown(keys, name, side="connect"):
    """Return Zenoh's config for the files of a name, unchecked."""
    tls = {
        "root_ca_certificate": os.fspath(keys / "ca.pem"),
        f"{side}_certificate": os.fspath(keys / f"{name}.pem"),
        f"{side}_private_key": os.fspath(keys / f"{name}.key"),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    return {"protocols": ["tls"], "tls": tls}


class Deployment:
    """Knowledge, which answers whatever it is asked with its name, and those who joined it."""

    def __init__(self, keys=None, token=None):
        self.keys, self.token = keys, token
        self._opened = ExitStack()
        if token is None:
            link = security.tls(keys, "knowledge")
            self.knowledge, self.port = listen(link, access_control=security.access_control())
        else:
            rights = security.access_control("usernames")
            auth = {"dictionary_file": str(token)}
            self.knowledge, self.port = listen({}, "tcp/127.0.0.1", auth=auth, access_control=rights)
        self._opened.enter_context(self.knowledge)
        self.heard = []
        for key in ("mape/s/knowledge/**", "mape/s/*/append/*"):
            self._opened.enter_context(self.knowledge.declare_queryable(key, direct(self._answer)))
        for key in ("mape/**", "else/**"):
            self._opened.enter_context(self.knowledge.declare_subscriber(key, direct(self.heard.append)))
        self._opened.enter_context(self.knowledge.liveliness().declare_token("mape/s/alive/knowledge/1"))

    @staticmethod
    def _answer(query):
        with query:
            # A selector with wildcards is answered under a key without, as Knowledge does.
            query.reply("/".join("s" if part == "*" else part for part in str(query.key_expr).split("/")), "knowledge")

    def join(self, role, link=None, **how):
        if self.token is None:
            link = link or security.tls(self.keys, role)
        else:
            user = {"user": role, "password": tokens.secret(self.token, role)}
            how = {"auth": user, "address": "tcp/127.0.0.1", **how}
        return self._opened.enter_context(connect(self.port, link or {}, timeout_ms=5_000, **how))

    def close(self):
        self._opened.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def in_order(session):
    """Return when all that a session sent before has been dealt with, and all that was sent to it before has come.

    Zenoh keeps order within a link and a priority; this is answered behind what is on its way.
    """
    assert ask(session, STATUS) == ["knowledge"]
