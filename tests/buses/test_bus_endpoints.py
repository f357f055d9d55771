"""What is found at an endpoint before anything is opened: nobody loses a file or socket, and who is there is said."""

import socket
import threading
from contextlib import closing

import pytest

from adapters.buses import Wire
from adapters.buses.endpoints import check_free, reached
from mape.errors import BusError, ConfigError


@pytest.fixture
def path(endpoint):
    return endpoint.removeprefix("unixsock-stream/")


def listen_at(path, kind=socket.SOCK_STREAM):
    found = socket.socket(socket.AF_UNIX, kind)
    found.bind(path)
    if kind == socket.SOCK_STREAM:
        found.listen()
    return found


@pytest.mark.parametrize("ending", ["", ".lock"])
def test_a_file_that_is_no_socket_is_left_as_it_is(wire, path, ending):
    with open(path + ending, "w") as file:
        file.write("a thesis")
    with pytest.raises(ConfigError, match="would be removed"):
        wire.listen()
    with open(path + ending) as file:
        assert file.read() == "a thesis"


@pytest.mark.parametrize("kind", [socket.SOCK_STREAM, socket.SOCK_DGRAM])
def test_the_socket_of_another_program_is_left_to_it(wire, path, kind):
    with closing(listen_at(path, kind)), socket.socket(socket.AF_UNIX, kind) as asks:
        with pytest.raises(BusError, match="is another Knowledge running there"):
            wire.listen()
        asks.connect(path)


def test_what_is_left_of_a_program_that_died_is_replaced(wire, path):
    listen_at(path).close()
    with wire.listen(), wire.join("operator", 5.0):
        pass


def test_a_knowledge_is_not_disturbed_by_who_looks_at_its_place(wire, capfd):
    with wire.listen(), wire.join("operator", 5.0) as other:
        with pytest.raises(BusError, match="is another Knowledge running there"):
            check_free(wire.endpoint)
        assert list(other.get(wire.ask("status"))) == []
    assert capfd.readouterr().out == ""


def test_a_port_is_free_again_when_its_listener_is_gone():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        probe.listen()
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        for other in (endpoint, endpoint.replace("127.0.0.1", "localhost"), endpoint.replace("127.0.0.1", "0.0.0.0")):
            with pytest.raises(BusError, match="is another Knowledge running there"):
                check_free(other)
    check_free(endpoint)


@pytest.mark.parametrize("host", ["0.0.0.0", "[::]", "[0:0::0]"])
@pytest.mark.parametrize("keys", [False, True])
def test_what_stands_for_all_addresses_is_reached_on_this_machine(host, keys):
    assert reached(f"tcp/{host}:7447", keys) == "tcp/127.0.0.1:7447"


def test_an_ipv6_address_with_keys_is_refused_with_another_one(tmp_path):
    with pytest.raises(ConfigError, match=r"no certificate against an IPv6 address\. Give tcp/127\.0\.0\.1:7447"):
        Wire("tcp/[::1]:7447", "example", tmp_path).join("plan", 1.0)
    with pytest.raises(ConfigError, match="the name of the machine"):
        reached("tcp/[2001:db8::1]:7447", keys=True)
    assert reached("tcp/[::1]:7447", keys=False) == "tcp/[::1]:7447"


def test_somebody_else_who_listens_is_told_from_nobody():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        wire = Wire(f"tcp/127.0.0.1:{other.getsockname()[1]}", "example")
        accepting = threading.Thread(target=lambda: [other.accept()[0].close()], daemon=True)
        accepting.start()
        with pytest.raises(
            BusError, match=r"no Knowledge answers on .*; who listens there does not answer.*no token .*--token FILE"
        ):
            wire.join("plan", 0.2)
    with pytest.raises(BusError, match=r"no Knowledge answers on .*; start it, or look at the address"):
        wire.join("plan", 0.2)
