"""Who gets through to Knowledge at all, and what is said before where that could be known."""

import os
import shutil
import subprocess
import sys
import textwrap
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh
from security_deployment import ask, connect, eventually, in_order, listen, shown, sign

from adapters.buses import certificates, security
from mape.errors import ConfigError, UnknownName

NOW = datetime.now(UTC)
PAST, FUTURE = NOW - timedelta(days=30), NOW + timedelta(days=30)
CLIENTS = ["execute", "monitor", "analyze", "plan", "operator"]

UNANSWERED = "Unable to connect to any of"  # what Zenoh says of every handshake that failed


# Handshakes.


@pytest.mark.parametrize("role", CLIENTS)
@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_a_role_gets_through_and_is_known_by_its_name(deployment, role, host):
    session = deployment.join(role, address=f"tls/{host}")
    in_order(session)
    [link] = deployment.knowledge.info.links()
    assert link.auth_identifier == role


def another_authority(keys):
    other = keys.parent / "other"
    certificates.make(other)
    for name in ("plan.pem", "plan.key"):
        shutil.copy(other / name, keys / name)
    return shown(keys, "plan")


def no_certificate(keys):
    link = shown(keys, "plan")
    for name in ("connect_certificate", "connect_private_key"):
        del link["tls"][name]
    return link | {"tls": link["tls"] | {"enable_mtls": False}}


def key_of_another(keys):
    shutil.copy(keys / "monitor.key", keys / "plan.key")
    return shown(keys, "plan")


REFUSED = {
    "a certificate of another authority": another_authority,
    "no certificate": no_certificate,
    "the certificate of a role with the key of another": key_of_another,
    "an expired certificate": lambda keys: sign(keys, "plan", "plan", begin=PAST),
    "a certificate of the future": lambda keys: sign(keys, "plan", "plan", begin=FUTURE),
    "Knowledge's certificate": lambda keys: shown(keys, "knowledge"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_who_cannot_show_a_good_certificate_is_not_let_in(deployment, case):
    link = REFUSED[case](deployment.keys)
    with pytest.raises(zenoh.ZError, match=UNANSWERED):
        connect(deployment.port, link)
    assert deployment.knowledge.info.links() == []


def test_plain_tcp_is_not_let_in(deployment):
    with pytest.raises(zenoh.ZError, match=UNANSWERED):
        connect(deployment.port, {"protocols": ["tcp"]}, address="tcp/127.0.0.1")
    assert deployment.knowledge.info.links() == []


def test_a_client_speaks_nothing_but_tls(shared_keys):
    plain, port = listen({"protocols": ["tcp"]}, address="tcp/127.0.0.1")
    with plain, pytest.raises(zenoh.ZError, match=UNANSWERED):
        connect(port, security.tls(shared_keys, "plan"), address="tcp/127.0.0.1")


def test_knowledge_speaks_nothing_but_tls(shared_keys):
    with pytest.raises(zenoh.ZError):
        listen(security.tls(shared_keys, "knowledge"), address="tcp/127.0.0.1")


def test_a_knowledge_under_a_name_that_its_certificate_lacks_is_not_joined(shared_keys):
    knowledge, port = listen(security.tls(shared_keys, "knowledge"), address="tls/127.0.0.2")
    with knowledge, pytest.raises(zenoh.ZError, match=UNANSWERED):
        connect(port, security.tls(shared_keys, "plan"), address="tls/127.0.0.2")


def test_a_host_that_was_named_is_joined_by_that_name(tmp_path):
    certificates.make(tmp_path / "keys", ["127.0.0.2"])
    knowledge, port = listen(security.tls(tmp_path / "keys", "knowledge"), address="tls/127.0.0.2")
    with knowledge, connect(port, security.tls(tmp_path / "keys", "plan"), address="tls/127.0.0.2"):
        assert [link.auth_identifier for link in knowledge.info.links()] == ["plan"]


@pytest.mark.parametrize("name", [*CLIENTS, "other/knowledge"])
def test_nobody_can_listen_in_knowledges_stead(keys, name):
    certificates.make(keys / "other")
    impostor, port = listen(shown(keys, name, "listen"))
    with impostor:
        with pytest.raises(zenoh.ZError, match=UNANSWERED):
            connect(port, security.tls(keys, "plan"))
        assert impostor.info.links() == []


def test_a_link_is_closed_when_the_certificate_expires(deployment):
    almost = datetime.now(UTC) - timedelta(days=1) + timedelta(seconds=3)
    plan = deployment.join("plan", sign(deployment.keys, "plan", "plan", begin=almost))
    monitor = deployment.join("monitor")
    in_order(plan)
    assert sorted(link.auth_identifier for link in deployment.knowledge.info.links()) == ["monitor", "plan"]
    eventually(lambda: [link.auth_identifier for link in deployment.knowledge.info.links()] == ["monitor"])
    assert ask(plan, "mape/s/knowledge/status") == []
    in_order(monitor)


# What is known before.


@pytest.mark.parametrize("role", security.ROLES)
def test_paths_are_absolute_and_a_role_has_those_of_its_side_only(shared_keys, monkeypatch, role):
    monkeypatch.chdir(shared_keys.parent)
    link = security.tls(Path(shared_keys.name), role)
    side = "listen" if role == "knowledge" else "connect"
    assert link == shown(shared_keys, role, side)


def test_a_role_that_does_not_exist_is_named_with_those_that_do():
    with pytest.raises(UnknownName, match="unknown role 'planner'; did you mean 'plan'"):
        security.tls(Path("keys"), "planner")


@pytest.mark.parametrize("name", ["ca.pem", "plan.pem", "plan.key"])
def test_a_missing_file_is_named(keys, name):
    (keys / name).unlink()
    with pytest.raises(ConfigError, match=rf"there is no {keys / name}\. Make all keys with `mapek keys DIR`"):
        security.tls(keys, "plan")


@pytest.mark.parametrize("name", ["ca.pem", "plan.pem", "plan.key"])
def test_an_unreadable_file_is_named(keys, name):
    (keys / name).unlink()
    (keys / name).mkdir()
    with pytest.raises(ConfigError, match=rf"{keys / name} cannot be read: Is a directory"):
        security.tls(keys, "plan")


def expired(keys):
    certificates.renew(keys, "plan", days=3, start=PAST)


def of_the_future(keys):
    certificates.renew(keys, "plan", start=FUTURE)


def of_monitor(keys):
    for ending in ("pem", "key"):
        shutil.copy(keys / f"monitor.{ending}", keys / f"plan.{ending}")


def with_several_names(keys):
    sign(keys, "plan", "plan/execute")


def of_knowledge(keys):
    for ending in ("pem", "key"):
        shutil.copy(keys / f"knowledge.{ending}", keys / f"plan.{ending}")


def garbage(keys):
    (keys / "plan.pem").write_text("no certificate")


SAID = {
    expired: rf"plan\.pem expired on {PAST + timedelta(days=3):%b}.* GMT\. Renew it where ca\.key is: ",
    of_the_future: r"plan\.pem is not valid before .* GMT; is this host's clock right\?",
    of_monitor: r"plan\.pem is the certificate of monitor, not of plan: its common name has to be the role",
    with_several_names: r"plan\.pem is the certificate of plan/execute, not of plan",
    of_knowledge: r"plan\.pem does not hold as that of plan under .*ca\.pem: unsuitable certificate purpose",
    another_authority: r"plan\.pem does not hold as that of plan under .*ca\.pem: unable to get local issuer",
    key_of_another: r"plan\.key does not belong to the certificate .*plan\.pem",
    garbage: r"plan\.pem and .*plan\.key are not a certificate and its private key, as PEM and without a password",
}


@pytest.mark.parametrize("spoil", SAID)
def test_a_certificate_that_would_be_refused_is_told_before(keys, spoil):
    spoil(keys)
    with pytest.raises(ConfigError, match=SAID[spoil]) as told:
        security.tls(keys, "plan")
    assert f"`mapek keys {keys} --renew plan`" in str(told.value)
    certificates.renew(keys, "plan")
    security.tls(keys, "plan")


def test_a_key_with_a_password_is_refused_without_asking_for_it(keys):
    from cryptography.hazmat.primitives import serialization

    key = serialization.load_pem_private_key((keys / "plan.key").read_bytes(), None)
    secret = serialization.BestAvailableEncryption(b"secret")
    pem, pkcs8 = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    (keys / "plan.key").write_bytes(key.private_bytes(pem, pkcs8, secret))
    with pytest.raises(ConfigError, match="without a password"):
        security.tls(keys, "plan")


@pytest.mark.parametrize("text", ["", "no certificate", "plan.pem"])
def test_an_authority_that_is_none_is_told(keys, text):
    (keys / "ca.pem").write_text((keys / text).read_text() if text.endswith(".pem") else text)
    with pytest.raises(ConfigError, match=r"ca\.pem is no certificate of an authority.* in a new folder"):
        security.tls(keys, "plan")


def test_an_expired_authority_is_told(tmp_path):
    certificates.make(tmp_path / "keys", start=NOW - timedelta(days=4000))
    with pytest.raises(ConfigError, match=r"ca\.pem expired on .* Make all keys anew: `mapek keys DIR`"):
        security.tls(tmp_path / "keys", "plan")


# What is logged.

PROGRAM = """
    import sys
    from pathlib import Path

    sys.path.append({here!r})
    from security_deployment import Deployment, ask, connect, in_order, shown, sign, zenoh

    from adapters.buses import security

    keys = Path({keys!r})
    security.log_refusals()
    with Deployment(keys) as running:
        plan = running.join("plan")
        with plan.declare_subscriber("mape/*/*/analyze", print):
            plan.put("mape/s/knowledge/beat/plan", "x")
            assert ask(plan, "mape/s/0/append/plan", payload="x") == ["knowledge"]
            in_order(plan)
        print("so far all was allowed", flush=True)
        plan.put("mape/s/0/plan", "x")
        plan.put("mape/s/0/plan", "x")
        ask(plan, "mape/s/0/append/monitor", payload="x")
        in_order(plan)
        print("three were denied", flush=True)
        with connect(running.port, sign(keys, "stranger", "stranger")) as stranger:
            stranger.put("mape/s/knowledge/beat/plan", "x")
            ask(stranger, "mape/s/knowledge/status")
        try:
            connect(running.port, shown(keys, "knowledge"))
        except zenoh.ZError:
            print("done", flush=True)
"""


def test_refusals_can_be_logged(keys):
    program = textwrap.dedent(PROGRAM).format(here=str(Path(__file__).parent), keys=str(keys))
    environment = {name: value for name, value in os.environ.items() if name not in ("RUST_LOG", "NO_COLOR")}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, timeout=60, env=environment
    )
    assert (done.returncode, done.stderr) == (0, "")
    allowed, _, rest = done.stdout.partition("so far all was allowed\n")
    denied, _, strange = rest.partition("three were denied\n")
    assert "Common Name: plan" in allowed
    assert "Msg intercepted!" not in allowed
    assert denied.count("Msg intercepted!") == 3
    assert "Common Name: stranger" in strange
    assert "did not match any configured ACL subject" in strange
    assert "certificate does not allow extended key usage for client authentication" in strange
    assert "\x1b" not in done.stdout
