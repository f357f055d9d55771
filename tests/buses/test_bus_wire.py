"""Names, keys and endpoints: what may stand on the wire, before anything is opened."""

import pytest

from adapters.buses import Wire
from adapters.buses.wire import INPUT, role_of, system_segment
from adapters.roles import ROLES, STAGE_OF
from knowledge import STAGES
from mape.errors import ConfigError

UNIX = "unixsock-stream//run/k.sock"


@pytest.mark.parametrize("name", ["", "Grid", "a/b", "a*", "@adv", "a b", "ü", "a\n", "$*", "a#b", "a?b", "**"])
def test_a_name_that_is_special_on_the_wire_is_refused(name):
    with pytest.raises(ConfigError, match="on the wire it has only a-z, 0-9, _ and -"):
        Wire(UNIX, name)


def test_only_an_operator_asks_whatever_system_is_there():
    assert Wire(UNIX, "*").ask("status") == "mape/*/knowledge/status"


@pytest.mark.parametrize(
    ("identifier", "name"), [("mapek/Gridworld-v0", "mapek-gridworld-v0"), ("Taxi-v4", "taxi-v4"), ("a::B c", "a-b-c")]
)
def test_a_systems_id_becomes_a_name(identifier, name):
    assert system_segment(identifier) == name


def test_an_id_of_which_no_letter_may_stand_is_refused():
    with pytest.raises(ConfigError, match="the system's name is ''"):
        system_segment("äöü")


@pytest.mark.parametrize(
    "endpoint",
    ["", "tcp", "tcp/127.0.0.1", "tcp/127.0.0.1:0", "tcp/127.0.0.1:70000", "udp/127.0.0.1:1", "unixsock-stream/",
     "unixsock-stream//run/a?b", "unixsock-stream//run/a#b", "unixsock-stream//run/a;b", "tcp/127.0.0.1:7447#x=1"],
)  # fmt: skip
def test_what_is_no_endpoint_is_refused(endpoint):
    with pytest.raises(ConfigError, match="endpoint"):
        Wire(endpoint, "example")


@pytest.mark.parametrize("endpoint", ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/10.0.0.7:7447", "tcp/host.local:1"])
def test_one_that_others_could_reach_takes_keys_or_a_word(endpoint, tmp_path):
    with pytest.raises(ConfigError, match=r"can be reached from other machines.*mapek keys.*--insecure"):
        Wire(endpoint, "example")
    assert Wire(endpoint, "example", insecure=True).endpoint == endpoint
    assert Wire(endpoint, "example", tls=tmp_path).endpoint == endpoint


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:1", "tcp/127.9.9.9:65535", "tcp/localhost:7447", "tcp/[::1]:7447"])
def test_one_on_this_machine_is_taken(endpoint):
    assert Wire(endpoint, "example").endpoint == endpoint


def test_a_socket_path_that_the_kernel_would_not_take_is_refused():
    Wire("unixsock-stream/" + "x" * 107, "example")
    with pytest.raises(ConfigError, match="has 108 bytes"):
        Wire("unixsock-stream/" + "x" * 108, "example")
    with pytest.raises(ConfigError, match="has 108 bytes"):
        Wire("unixsock-stream/" + "ü" * 54, "example")


def test_each_role_waits_for_what_the_role_before_it_sends():
    for role, kind in INPUT.items():
        sender = role_of(kind)
        assert STAGES[STAGE_OF[sender]] is kind
        assert ROLES[(ROLES.index(sender) + 1) % 4] == role
