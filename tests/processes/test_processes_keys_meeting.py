"""Keys that some have and others not, or that are for another address: it is said, and nobody waits for ever."""

import json
import re
import socket

import pytest
from real_processes import EXAMPLES, alone, hashes, say, serve, started, until, up, write_config

from mape import load


@pytest.fixture
def port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def config(here):
    say("keys", str(here / "keys"))
    config = load(EXAMPLES / "gridworld_goals.toml", overrides=["episodes=60", "system.options.switch_at=[31]"])
    return write_config(here, json.loads(config.to_json()))


@pytest.mark.parametrize("host", ["0.0.0.0", pytest.param("[::]", marks=pytest.mark.long)])
def test_up_that_listens_on_all_addresses_is_reached_by_its_own_roles(here, config, port, host):
    with up(config, "--tls", "keys", at=f"tcp/{host}:{port}") as running:
        assert hashes(running.result()) == alone(config)


@pytest.mark.parametrize(
    ("host", "why"),
    [("127.0.0.2", r"does not let knowledge be reached as 127.0.0.2 .* --host 127.0.0.2`"),
     ("[::1]", r"cannot be reached with keys: .* Give tcp/127.0.0.1")],
)  # fmt: skip
def test_up_at_an_address_that_its_keys_do_not_hold_for_is_refused_at_once(here, config, port, host, why):
    with up(config, "--tls", "keys", at=f"tcp/{host}:{port}") as running:
        said = running.process.end(2, 60.0)
        assert re.search(why, said), said
        assert not running.out.exists()


@pytest.mark.parametrize("with_keys", [True, False])
def test_who_has_keys_and_who_has_none_are_told_of_each_other(here, config, port, with_keys):
    at = f"tcp/127.0.0.1:{port}"
    keys = ("--tls", "keys")
    why = "who listens there asks for keys: give --tls DIR" if with_keys else "who listens there uses no keys"
    theirs, ours = (keys, ()) if with_keys else ((), keys)
    with serve(config, "knowledge", at, *theirs) as knowledge:
        until(lambda: "Knowledge listens" in knowledge.said, "Knowledge to listen")
        look = ("status", "--connect", at, *(str(here / one) if one == "keys" else one for one in ours))
        told = (1, f"mapek: no Knowledge answers on {at}; {why}")
        # One that stands still for a moment is told of as just that.
        until(lambda: (asked := say(*look))[0] == told[0] and asked[1].startswith(told[1]), told[1])
        with started("serve", str(config), "--role", "plan", "--connect", at, *ours, cwd=here) as plan:
            until(lambda: why in plan.said, "plan to say why it waits")


def test_a_certificate_for_another_address_is_named(here, config, port):
    with serve(config, "knowledge", f"tcp/0.0.0.0:{port}", "--tls", "keys") as knowledge:
        until(lambda: "Knowledge listens" in knowledge.said, "Knowledge to listen")
        at = f"tcp/127.0.0.2:{port}"
        with started("serve", str(config), "--role", "plan", "--connect", at, "--tls", "keys", cwd=here) as plan:
            until(lambda: "not valid for '127.0.0.2'" in plan.said, "plan to say why it waits")
