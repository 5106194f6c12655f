"""UDP sockets as ports: datagrams are chunks, and lines without an end get one."""

import socket

import pytest

from isocharge.common.errors import PortError
from isocharge.serve import Port

pytestmark = pytest.mark.xdist_group("clock")


pytestmark = pytest.mark.xdist_group("clock")


@pytest.fixture
def address():
    """An address that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()


def received(address, *datagrams):
    """What a port reads of datagrams that a board sends."""
    with (
        Port(f"udp://127.0.0.1:{address[1]}", silence_s=10.0) as port,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board,
    ):
        for datagram in datagrams:
            board.sendto(datagram, address)
        chunks = iter(port)
        return [next(chunks).data for datagram in datagrams if datagram]


def test_each_datagram_is_a_chunk(address):
    sent = [b"\x00\xff" * 20, b"\x01", b"\x02\n" * 700]
    assert received(address, *sent) == sent


def test_lines_without_an_end_get_one(address):
    text, bytes_ = [b'{"A": 1}', b"A:1\tB:2", "1 µC".encode()], [b"\xaa\x00", b"\xaa\x55", b"1\x002", b"\x7f"]
    assert received(address, *text, *bytes_) == [*(line + b"\n" for line in text), *bytes_]


def test_a_board_that_ends_its_lines_gets_no_more_ends(address):
    assert received(address, b"1,2\n", b"3,", b"4\n") == [b"1,2\n", b"3,", b"4\n"]


def test_silence(address):
    with Port(f"udp://127.0.0.1:{address[1]}", silence_s=0.05) as port:
        assert port.read(0.01) is None
        with pytest.raises(PortError, match=r"no data for 0\.05 s"):
            next(iter(port))


def test_an_empty_datagram_is_no_silence(address):
    assert received(address, b"\x01", b"", b"\x02") == [b"\x01", b"\x02"]
    with Port(f"udp://127.0.0.1:{address[1]}", silence_s=0.05) as port, socket.socket(type=socket.SOCK_DGRAM) as board:
        board.sendto(b"", address)
        assert port.read(0.01) is None


@pytest.mark.parametrize(
    "url", ["udp://127.0.0.1", "udp://127.0.0.1:99999", "udp://127.0.0.1:9/x", "udp://300.0.0.1:9"]
)
def test_addresses_that_are_none(url):
    with pytest.raises(PortError, match=f"{url}: cannot be opened"), Port(url):
        pass


def test_an_address_that_is_taken(address):
    with Port(f"udp://127.0.0.1:{address[1]}"), pytest.raises(PortError, match="in use"):
        Port(f"udp://127.0.0.1:{address[1]}").__enter__()
