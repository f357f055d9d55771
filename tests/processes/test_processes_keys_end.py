"""A certificate near its end is warned of, one that ended is named by who holds it; a renewed one is gone on with."""

import json
import socket
from datetime import UTC, datetime, timedelta

import pytest
from real_processes import EXAMPLES, alone, end_all, five, hashes, passes, until, write_config

from adapters.buses import certificates
from adapters.buses.own_keys import OwnKeys
from adapters.buses.signing import Authority, Pem
from mape import load

DAY = 86_400.0


def sign(keys, role, begin, end):
    """Give a role a certificate for any span."""
    authority = Authority(Pem((keys / "ca.key").read_bytes(), (keys / "ca.pem").read_bytes()))
    pem = authority.sign(role, ["localhost", "127.0.0.1"] if role == "knowledge" else [], begin, end)
    for name, data in ((f"{role}.key", pem.key), (f"{role}.pem", pem.certificate)):
        (keys / f"{name}.new").write_bytes(data)
        (keys / f"{name}.new").replace(keys / name)


@pytest.fixture
def keys(tmp_path):
    certificates.make(tmp_path / "keys")
    return tmp_path / "keys"


def said(caplog):
    return [record.getMessage() for record in caplog.records]


@pytest.mark.parametrize(("days", "warned"), [(365, 14), (30, 3), (1, 0.1)])
def test_a_certificate_is_warned_of_once_a_fortnight_or_a_tenth_of_its_life_before_its_end(keys, caplog, days, warned):
    begin = datetime.now(UTC).replace(microsecond=0) - timedelta(minutes=10)
    sign(keys, "plan", begin, begin + timedelta(days=days))
    own, end = OwnKeys(keys, "plan"), begin.timestamp() + days * DAY
    assert not own.renewed(end - warned * DAY - 1)
    assert said(caplog) == []
    for _ in range(2):
        assert not own.renewed(end - warned * DAY + 1)
    assert not own.renewed(end)
    near, ended = said(caplog)
    assert f"{keys / 'plan.pem'} ends on " in near
    assert f"`mapek keys {keys} --renew plan`" in near
    assert f"{keys / 'plan.pem'} ended on " in ended


def test_the_authority_s_end_is_told_of_as_well(keys, caplog):
    OwnKeys(keys, "plan").renewed((datetime.now(UTC) + timedelta(days=3649)).timestamp())
    assert any(f"{keys / 'ca.pem'} ends on" in line for line in said(caplog))


def test_files_that_are_replaced_one_after_the_other_are_taken_when_they_fit(keys, caplog):
    own, key = OwnKeys(keys, "plan"), (keys / "plan.key").read_bytes()
    certificates.renew(keys, "plan")
    new = (keys / "plan.key").read_bytes()
    (keys / "plan.key").write_bytes(key)
    assert not own.renewed()
    assert "does not belong to the certificate" in said(caplog)[-1]
    (keys / "plan.key").write_bytes(new)
    assert own.renewed()
    assert not own.renewed()
    (keys / "plan.pem").unlink()
    assert not own.renewed()
    assert "there is no" in said(caplog)[-1]


def run_with(here, walk, role, seconds):
    config = load(
        EXAMPLES / "gridworld_goals.toml",
        overrides=["episodes=4000", "system.options.switch_at=[101]", f'analyze="{walk.part}"'],
    )
    path = write_config(here, json.loads(config.to_json()))
    certificates.make(here / "keys")
    if seconds:
        now = datetime.now(UTC)
        sign(here / "keys", role, now - timedelta(hours=1), now + timedelta(seconds=seconds))
    return path


@pytest.fixture
def at():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.mark.long
@pytest.mark.parametrize("role", ["monitor", "execute", "knowledge"])
def test_one_that_ends_in_mid_run_is_named_and_renewed_in_place_the_run_goes_on(here, walk, at, role):
    config = run_with(here, walk, role, 30)
    keys, log = here / "keys", here / "served" / "log.sqlite"
    with five(config, at, "--tls", str(keys)) as served:
        until(lambda: f"{keys / role}.pem ends on" in served[role].said, "a warning", 120)
        until(lambda: passes(log) > 5, "a run that is on its way", 120)
        until(lambda: f"{keys / role}.pem ended on" in served[role].said, "the end of the certificate", 120)
        certificates.renew(keys, role)
        until(lambda: "goes on with the renewed keys" in served[role].said, "the renewed one", 120)
        reached = passes(log)
        until(lambda: passes(log) > reached + 20, "further passes", 120)
        walk.over()
        end_all(served, 200)
    found = json.loads((here / "served" / "result.json").read_bytes())
    assert hashes(found) == alone(config)


@pytest.mark.long
@pytest.mark.parametrize("role", ["plan", "knowledge"])
def test_one_that_is_renewed_long_before_its_end_is_gone_on_with_at_once(here, walk, at, role):
    config = run_with(here, walk, role, 0)
    keys, log = here / "keys", here / "served" / "log.sqlite"
    with five(config, at, "--tls", str(keys)) as served:
        until(lambda: passes(log) > 5, "a run that is on its way", 120)
        certificates.renew(keys, role)
        until(lambda: "goes on with the renewed keys" in served[role].said, "the renewed one", 120)
        reached = passes(log)
        until(lambda: passes(log) > reached + 20, "further passes", 120)
        walk.over()
        end_all(served, 200)
    found = json.loads((here / "served" / "result.json").read_bytes())
    assert hashes(found) == alone(config)
