"""`mapek keys`: what it makes, and what it leaves alone."""

import ipaddress
import os
import stat
import sys
from datetime import UTC, datetime, timedelta

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from hypothesis import example, given, settings
from hypothesis import strategies as st

from adapters.buses import certificates, security
from adapters.cli.main import main
from mape.errors import ConfigError, UnknownName

NAMES = {f"{name}.{ending}" for name in ("ca", *security.ROLES) for ending in ("key", "pem")}


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def certificate(path):
    return x509.load_pem_x509_certificate(path.read_bytes())


def names_of(found):
    return found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value


# What is made.


def test_there_is_a_pair_for_each_role_and_keys_are_their_owners_only(tmp_path):
    keys = tmp_path / "below" / "keys"
    assert sorted(certificates.make(keys)) == sorted(keys.iterdir())
    assert set(contents(keys)) == NAMES
    assert stat.S_IMODE(keys.stat().st_mode) == 0o700
    for path in keys.glob("*.key"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.parametrize("role", security.ROLES)
def test_a_certificate_is_that_of_its_role_and_for_its_side(shared_keys, role):
    found = certificate(shared_keys / f"{role}.pem")
    found.verify_directly_issued_by(certificate(shared_keys / "ca.pem"))
    [name] = found.subject
    assert (name.oid, name.value) == (NameOID.COMMON_NAME, role)
    key = load_pem_private_key((shared_keys / f"{role}.key").read_bytes(), None)
    assert isinstance(key.curve, ec.SECP256R1)
    assert (shared_keys / f"{role}.key").read_bytes().startswith(b"-----BEGIN PRIVATE KEY-----")
    served = role == "knowledge"
    purposes = found.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert list(purposes) == [ExtendedKeyUsageOID.SERVER_AUTH if served else ExtendedKeyUsageOID.CLIENT_AUTH]
    assert found.extensions.get_extension_for_class(x509.BasicConstraints).value.ca is False
    if served:
        assert set(names_of(found).get_values_for_type(x509.DNSName)) == {"localhost"}
        addresses = set(names_of(found).get_values_for_type(x509.IPAddress))
        assert addresses == {ipaddress.ip_address("127.0.0.1"), ipaddress.ip_address("::1")}
    else:
        with pytest.raises(x509.ExtensionNotFound):
            names_of(found)


LABEL = st.from_regex(r"[a-zA-Z0-9_]([a-zA-Z0-9_-]{0,20}[a-zA-Z0-9_])?", fullmatch=True)
HOST_NAMES = (
    st.lists(LABEL, min_size=1, max_size=4).map(".".join).filter(lambda name: not name.split(".")[-1].isdigit())
)


@settings(max_examples=15)
@example(hosts=[], days=certificates.AUTHORITY_DAYS)
@given(
    hosts=st.lists(st.one_of(HOST_NAMES, st.ip_addresses().map(str)), max_size=4),
    days=st.integers(1, certificates.AUTHORITY_DAYS),
)
def test_any_legal_host_and_number_of_days_is_in_the_certificate(tmp_path_factory, hosts, days):
    folder = tmp_path_factory.mktemp("any") / "keys"
    certificates.make(folder, hosts, days)
    found = certificate(folder / "knowledge.pem")
    served = {str(name.value) for name in names_of(found)}
    assert served == {host.lower() for host in hosts} | set(certificates.LOCAL_HOSTS)
    left = found.not_valid_after_utc - datetime.now(UTC)
    assert timedelta(days=days) - timedelta(minutes=5) < left <= timedelta(days=days)
    for role in security.ROLES:
        security.tls(folder, role)


def test_two_makings_have_nothing_in_common(tmp_path):
    for name in ("a", "b"):
        certificates.make(tmp_path / name)
    first, second = contents(tmp_path / "a"), contents(tmp_path / "b")
    assert all(first[name] != second[name] for name in NAMES)


def test_an_empty_folder_is_taken(tmp_path):
    certificates.make(tmp_path)
    assert set(contents(tmp_path)) == NAMES
    assert stat.S_IMODE(tmp_path.stat().st_mode) == 0o700


# What is refused.


def test_keys_are_never_overwritten(keys):
    before = contents(keys)
    with pytest.raises(ConfigError, match=rf"{keys} holds keys already.*`mapek keys {keys} --renew ROLE`"):
        certificates.make(keys)
    assert contents(keys) == before


def test_a_folder_with_other_files_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    mode = tmp_path.stat().st_mode
    with pytest.raises(ConfigError, match=r"holds other files, such as thesis\.tex"):
        certificates.make(tmp_path)
    assert (set(contents(tmp_path)), tmp_path.stat().st_mode) == ({"thesis.tex"}, mode)


@pytest.mark.parametrize("below", ["file", "file/keys"])
def test_where_no_folder_can_be_it_is_said(tmp_path, below):
    (tmp_path / "file").write_text("x")
    with pytest.raises(ConfigError, match=rf"keys cannot be written to {tmp_path / below}: .*name another folder"):
        certificates.make(tmp_path / below)


@pytest.mark.parametrize(
    "host",
    [
        "",
        "tls/knowledge:7447",
        "knowledge:7447",
        "300.1.1.1",
        "1.2.3",
        "-a",
        "a..b",
        "*",
        "[::1]",
        "münchen",
        "a b",
        "x" * 64,
    ],
)
def test_a_host_that_is_none_is_refused(tmp_path, host):
    with pytest.raises(ConfigError, match="is neither an IP address nor a name"):
        certificates.make(tmp_path / "keys", [host])
    assert not (tmp_path / "keys").exists()


@pytest.mark.parametrize("days", [0, -1, 3651])
def test_a_number_of_days_that_makes_no_sense_is_refused(keys, tmp_path, days):
    for make in (
        lambda: certificates.make(tmp_path / "new", days=days),
        lambda: certificates.renew(keys, "plan", days=days),
    ):
        with pytest.raises(ConfigError, match=rf"{days} days: a certificate is good for 1 to 3,650 days"):
            make()


@pytest.mark.parametrize("existed", [False, True])
@pytest.mark.parametrize("after", [0, 5, 13])
def test_a_full_disk_leaves_nothing_behind(tmp_path, monkeypatch, existed, after):
    folder = tmp_path / "keys"
    if existed:
        folder.mkdir()
    synced = []

    def full(descriptor):
        synced.append(descriptor)
        if len(synced) > after:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ConfigError, match=f"keys cannot be written to {folder}: No space left on device"):
        certificates.make(folder)
    assert list(tmp_path.rglob("*")) == ([folder] if existed else [])


@pytest.mark.parametrize("after", [0, 1, 7, 13])
def test_ctrl_c_leaves_nothing_behind(tmp_path, monkeypatch, after):
    moved = []

    def interrupted(path, target):
        moved.append(path)
        if len(moved) > after:
            raise KeyboardInterrupt
        os.rename(path, target)
        return target

    monkeypatch.setattr("pathlib.Path.replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        certificates.make(tmp_path / "keys")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("make", [certificates.make, lambda folder: certificates.renew(folder, "plan")])
def test_without_the_library_the_way_to_it_is_told(tmp_path, monkeypatch, make):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(ConfigError, match=r"cryptography, which is not installed: pip install cryptography"):
        make(tmp_path / "keys")
    assert not (tmp_path / "keys").exists()


def test_using_keys_takes_no_library(keys, monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    for role in security.ROLES:
        security.tls(keys, role)


# Renewal.


def test_a_renewal_replaces_one_pair_and_nothing_else(keys):
    before = contents(keys)
    written = certificates.renew(keys, "plan", days=7)
    after = contents(keys)
    assert {name for name in NAMES if before[name] != after[name]} == {"plan.key", "plan.pem"}
    assert {path.name for path in written} == {"plan.key", "plan.pem"}
    assert set(after) == NAMES
    assert stat.S_IMODE((keys / "plan.key").stat().st_mode) == 0o600
    security.tls(keys, "plan")


def test_knowledges_hosts_are_kept_and_added_to(tmp_path):
    certificates.make(tmp_path / "keys", ["10.0.0.7", "knowledge.example.org"])
    certificates.renew(tmp_path / "keys", "knowledge", ["other.example.org"])
    served = {str(name.value) for name in names_of(certificate(tmp_path / "keys" / "knowledge.pem"))}
    assert served == {*certificates.LOCAL_HOSTS, "10.0.0.7", "knowledge.example.org", "other.example.org"}


@pytest.mark.parametrize("text", [None, "no certificate"])
def test_a_missing_or_damaged_pair_is_made_again(keys, text):
    for name in ("knowledge.pem", "knowledge.key"):
        (keys / name).unlink()
    if text:
        (keys / "knowledge.pem").write_text(text)
    certificates.renew(keys, "knowledge")
    security.tls(keys, "knowledge")


def test_hosts_of_a_role_that_only_connects_are_refused(keys):
    with pytest.raises(ConfigError, match="plan only connects"):
        certificates.renew(keys, "plan", ["knowledge.example.org"])


def test_a_role_that_does_not_exist_cannot_be_renewed(keys):
    with pytest.raises(UnknownName, match="unknown role 'ca'"):
        certificates.renew(keys, "ca")


@pytest.mark.parametrize("spoil", ["missing", "damaged", "exchanged"])
def test_without_the_authority_there_is_no_renewal(keys, tmp_path, spoil):
    if spoil == "missing":
        (keys / "ca.key").unlink()
    elif spoil == "damaged":
        (keys / "ca.pem").write_text("no certificate")
    else:
        (keys / "ca.key").write_bytes((keys / "plan.key").read_bytes())
    before = contents(keys)
    with pytest.raises(ConfigError, match=r"the authority of .* cannot be read .*Renew where ca\.key and ca\.pem are"):
        certificates.renew(keys, "plan")
    assert contents(keys) == before


def test_no_certificate_outlives_its_authority(tmp_path):
    keys = tmp_path / "keys"
    certificates.make(keys, start=datetime.now(UTC) - timedelta(days=3600))
    certificates.renew(keys, "plan", days=400)
    assert certificate(keys / "plan.pem").not_valid_after_utc == certificate(keys / "ca.pem").not_valid_after_utc
    with pytest.raises(ConfigError, match=r"the authority of .* expired on"):
        certificates.renew(keys, "plan", start=datetime.now(UTC) + timedelta(days=100))


# The command.


def test_the_command_makes_keys_and_says_what_to_do_with_them(tmp_path, capsys):
    hosts = ["--host", "knowledge.example.org", "--host", "10.0.0.7"]
    assert main(["keys", str(tmp_path / "keys"), *hosts, "--days", "30"]) == 0
    said = capsys.readouterr().out
    assert "knowledge, execute, monitor, analyze, plan, operator; good for 30 days." in said
    assert "knowledge is reached as localhost, 127.0.0.1, ::1, knowledge.example.org, 10.0.0.7." in said
    assert "Keep ca.key apart" in said
    for role in security.ROLES:
        security.tls(tmp_path / "keys", role)


def test_the_command_renews_one_role(keys, capsys):
    before = contents(keys)
    assert main(["keys", str(keys), "--renew", "monitor"]) == 0
    assert "monitor.pem: good for up to 365 days, once monitor is started" in capsys.readouterr().out
    assert {name for name in NAMES if before[name] != contents(keys)[name]} == {"monitor.key", "monitor.pem"}


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ([], "holds keys already"),
        (["--renew", "planner"], "unknown role 'planner'; did you mean 'plan'?"),
        (["--renew", "knowledge", "--host", "a b"], "host 'a b' is neither an IP address nor a name"),
        (["--renew", "plan", "--days", "4000"], "good for 1 to 3,650 days"),
    ],
)
def test_what_the_command_refuses_is_usage_and_changes_nothing(keys, capsys, options, sentence):
    before = contents(keys)
    assert main(["keys", str(keys), *options]) == 2
    said = capsys.readouterr()
    assert sentence in said.err
    assert said.out == ""
    assert contents(keys) == before
