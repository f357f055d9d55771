"""The form for several machines: TCP with keys, where everybody proves who they are."""

import json
import shutil
import socket

import pytest
from real_processes import (
    EXAMPLES,
    alone,
    end_all,
    five,
    hashes,
    passes,
    say,
    started,
    swap,
    until,
    up,
    write_config,
)

from mape import load


@pytest.fixture
def address():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.mark.long
def test_five_machines_with_keys_run_what_one_process_runs(here, address, walk):
    config = load(
        EXAMPLES / "gridworld_goals.toml",
        overrides=["episodes=700", "system.options.switch_at=[301]", f"analyze={walk.part}"],
    )
    config = write_config(here, json.loads(config.to_json()))
    for folder in ("keys", "others"):
        say("keys", str(here / folder))
    (here / "operator").mkdir(mode=0o700)  # nobody needs more than the authority's certificate, and their own key
    for name in ("ca.pem", "operator.pem", "operator.key"):
        shutil.copy(here / "keys" / name, here / "operator" / name)
    tls = ("--tls", "keys")
    with five(config, address, *tls) as served:
        until(lambda: passes(here / "served" / "log.sqlite") > 30, "a run that is on its way")
        look = ("status", "--connect", address)
        code, said = say(*look, "--tls", str(here / "operator"), "--json")
        assert code == 0, said
        status = json.loads(said)
        refused = say(*look, "--tls", str(here / "others"))
        plain = say(*look)
        with started(
            "serve", str(config), "--role", "plan", "--connect", address, "--tls", "operator", cwd=here
        ) as one:
            keyless = one.end(2)
        with started("serve", str(config), "--role", "plan", "--connect", address, "--tls", "others", cwd=here) as one:
            until(lambda: "waiting for Knowledge" in one.said, "a stranger to be kept out")
        walk.over()
        end_all(served)
    assert {role: one["pid"] for role, one in status["roles"].items()} == {
        role: process.pid for role, process in served.items() if role != "knowledge"
    }
    assert all(one["alive"] and one["beat_age"] < 10.0 and one["passes"] > 0 for one in status["roles"].values())
    for code, said in (refused, plain):
        assert (code, said.startswith(f"mapek: no Knowledge answers on {address}")) == (1, True), said
    assert "others" in refused[1]
    assert "plan.pem" in keyless or "plan.key" in keyless
    assert hashes(json.loads((here / "served" / "result.json").read_bytes())) == alone(config)


def test_up_with_keys_outlives_a_swap_and_needs_the_operators_key(here, address, walk):
    config = load(EXAMPLES / "frozen_lake.toml", overrides=["episodes=600", f"analyze={walk.part}"])
    config = write_config(here, json.loads(config.to_json()))
    say("keys", str(here / "keys"))
    with up(config, "--tls", str(here / "keys"), at=address) as running:
        running.wait_for_pass(50)
        assert swap(running, "plan.schedule", "success", "--tls", str(here / "keys"))[0] == 0
        code, said = swap(running, "plan.schedule", "success")
        assert (code, said.startswith("mapek: no Knowledge answers")) == (1, True)
        walk.over()
        running.result()
