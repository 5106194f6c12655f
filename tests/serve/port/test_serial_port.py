"""Sources of bytes: serial ports, TCP and UDP sockets, and files. Ports may be silent, disappear, or need requests."""

import os
import socket
import sys
import termios
import threading
import time
from contextlib import contextmanager, nullcontext
from itertools import islice, pairwise
from types import SimpleNamespace
from unittest import mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import InputError, PluginError, PortError, PortLost
from isocharge.serve import Chunk, Port, open_source
from isocharge.serve.port import serial_line
from isocharge.serve.port.serial_line import QUIET_TIME_s, REPEAT_TIME_s, Request, Requester
from isocharge.serve.virtual_sensor.sensor import PseudoPort


@pytest.fixture
def board():
    port = PseudoPort()
    yield port
    port.close()


def test_chunk_has_the_bytes_unchanged_and_the_time_of_arrival(board):
    board.write_whole(b"bytes before the opening are dropped")
    time.sleep(0.02)
    all_bytes = bytes(range(256))
    received_bytes = b""
    with Port(board.url) as port:
        sent_s = time.time()
        board.write_whole(all_bytes)
        for chunk in port:
            received_bytes += chunk.data
            if len(received_bytes) >= len(all_bytes):
                break
    assert received_bytes == all_bytes
    assert sent_s <= chunk.timestamp <= time.time()
    assert 0 <= time.perf_counter_ns() - chunk.clock_ns < 60e9
    assert chunk.outage_s == 0.0


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("/dev/ttyNone", "there is no such port: plug the board in"),
        ("/dev/null", r"cannot be opened at 115200 baud .*check the cable"),
        *(
            (f"{scheme}://127.0.0.1", rf"cannot be opened \(expected a port number, as in {scheme}://127.0.0.1:7000\)")
            for scheme in ("tcp", "socket", "rfc2217")
        ),
        ("socket://127.0.0.1:1", r"cannot be opened \(.*refused\); check the host and the port number"),
        ("telepathy://x", r"cannot be opened \(invalid URL"),
        *(
            (f"udp://{place}", r"cannot be opened \(")
            for place in ("127.0.0.1", "127.0.0.1:99999", "127.0.0.1:9/x", "300.0.0.1:9")
        ),
    ],
)
def test_port_that_cannot_be_opened_is_refused(url, message):
    with pytest.raises(PortError, match=f"^{url}: {message}"), Port(url):
        pass


@pytest.mark.parametrize("url", ["telepathy://x", "tcp://127.0.0.1", "udp://127.0.0.1"])
def test_option_wait_does_not_wait_for_a_wrong_url(url):
    with pytest.raises(PortError, match="cannot be opened"), Port(url, wait=3600.0):
        pass


@pytest.mark.parametrize("make", [Port, open_source])
def test_option_wait_waits_for_a_port(board, tmp_path, make):
    link = tmp_path / "film"
    plugging = threading.Timer(0.3, link.symlink_to, (board.url,))
    plugging.start()
    with make(str(link), wait=30.0) as port:
        assert port.is_live
    plugging.join()


def test_port_opened_by_another_program_is_refused(board):
    with Port(board.url), pytest.raises(PortError, match=r"lock.*no other program has it open"), Port(board.url):
        pass


def test_silent_port_is_opened_again_after_growing_pauses(board, monkeypatch):
    """A board that restarts at each opening, and needs longer than the wait for the first byte, gets more time."""
    pauses_s = []

    def sleep(pause_s):
        pauses_s.append(round(pause_s, 3))
        if len(pauses_s) == 6:
            raise InterruptedError

    monkeypatch.setattr("isocharge.serve.port.source.START_UP_s", 0.05)
    monkeypatch.setattr("isocharge.serve.port.source.RETRY_PAUSE_s", 0.01)
    monkeypatch.setattr("isocharge.serve.port.source.time.sleep", sleep)
    with Port(board.url, silence_s=0.01, reconnect=True) as port, pytest.raises(InterruptedError):
        next(iter(port))
    assert pauses_s == [0.01, 0.02, 0.04, 0.05, 0.05, 0.05]


def test_silent_port_is_lost_and_waits_until_the_board_has_started_again(board, monkeypatch):
    monkeypatch.setattr("isocharge.serve.port.source.START_UP_s", 0.05)
    port = Port(board.url, silence_s=0.01)
    with port:  # an Arduino restarts when DTR rises
        board.write_whole(b"started")
        next(iter(port))
        with pytest.raises(PortLost, match=r"no data for 0\.01 s; check that"):
            next(iter(port))
    waiting = Port(board.url, silence_s=0.01, wait=0.1)  # `wait` also sets the time for the first byte
    for silent, start_up in ((port, "0.05"), (waiting, "0.1")):
        with silent, pytest.raises(PortLost, match=f"no data for {start_up} s"):
            next(iter(silent))


def test_closing_a_port_leaves_dtr_set(board):
    """With HUPCL, the system would clear DTR at the end, and the next opening would restart an Arduino."""
    reader = os.open(board.url, os.O_RDWR | os.O_NOCTTY)
    attributes = termios.tcgetattr(reader)
    attributes[2] |= termios.HUPCL
    termios.tcsetattr(reader, termios.TCSANOW, attributes)
    with Port(board.url):
        pass
    control_modes = termios.tcgetattr(reader)[2]
    os.close(reader)
    assert not control_modes & termios.HUPCL


def test_second_program_that_reads_the_port_is_named(board, monkeypatch):
    """The bytes arrive, but the other program reads them first."""
    with Port(board.url) as port:
        monkeypatch.setattr("select.select", lambda read, *_: (read, [], []))
        with pytest.raises(PortLost, match="another program reads this port") as caught:
            next(iter(port))
    assert "cable" not in str(caught.value)


def test_bytes_that_waited_during_a_stall_are_few_chunks(board):
    """A terminal returns at most 4 kB at a time."""
    with Port(board.url) as port:
        remaining_bytes = sum(100 * board.write_whole(b"x" * 100) for _ in range(100))  # there is room for some of them
        assert remaining_bytes > 2000
        time.sleep(0.1)
        for chunk in islice(port, 5):
            remaining_bytes -= len(chunk.data)
            if remaining_bytes == 0:
                break
    assert remaining_bytes == 0


def test_program_that_reads_more_slowly_than_the_board_sends_causes_one_warning(board, monkeypatch, caplog):
    monkeypatch.setattr("isocharge.serve.port.source.MAX_READ_BYTES", 8)
    with Port(board.url) as port:
        chunks = iter(port)
        for length, n_warning in ((8, 0), (1, 0), (8, 0), (8, 1), (8, 1), (1, 1), (8, 1), (8, 1)):
            board.write_whole(bytes(length))
            assert len(next(chunks).data) == length
            assert caplog.text.count("reads more slowly than the board sends") == n_warning


def test_reading_a_port_that_is_not_open_is_an_error(board):
    with pytest.raises(PortError, match="not open"):
        next(iter(Port(board.url)))


def test_port_without_a_descriptor_is_read_by_pyserial(monkeypatch):
    """The port `loop://` of pyserial returns the bytes that are written to it. Reading changes no setting of the port.

    A changed setting of a port `rfc2217://` takes at least 50 ms, because the server must accept it.
    """
    with Port("loop://") as port:
        monkeypatch.setattr(port._line._serial, "_reconfigure_port", None)
        assert port.read(0.01) is None
        port._line.write(b"1,2\n")
        assert next(iter(port)).data == b"1,2\n"


@pytest.mark.parametrize("scheme", ["socket", "tcp"])
def test_socket_returns_all_bytes_until_it_is_closed(scheme):
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(10.0)
        with Port(f"{scheme}://127.0.0.1:{server.getsockname()[1]}", silence_s=5.0) as port:
            with server.accept()[0] as client:
                client.sendall(b"x" * 1000)
                time.sleep(0.05)
                assert next(iter(port)).data == b"x" * 1000
            with pytest.raises(PortLost, match="the other end has closed"):
                next(iter(port))


def test_outage_is_measured_and_logged_once(tmp_path, caplog):
    """The port is tried several times while the device is unplugged."""
    link = tmp_path / "film"
    board = PseudoPort()
    new_board = PseudoPort()
    has_arrived = threading.Event()

    def plug_in():
        link.symlink_to(new_board.url)
        while not has_arrived.wait(0.02):  # bytes before the opening of the port are lost
            new_board.write_whole(b"after")

    link.symlink_to(board.url)
    with Port(str(link), reconnect=True) as port:
        chunks = iter(port)
        board.write_whole(b"before")
        assert next(chunks) == (b"before", mock.ANY, mock.ANY, 0.0)
        board.close()
        link.unlink()
        plugging = threading.Timer(0.5, plug_in)
        plugging.start()
        first_chunk = next(chunks)
        assert next(chunks).outage_s == 0.0
        has_arrived.set()
        plugging.join()
    new_board.close()
    assert first_chunk.data.startswith(b"after")
    assert 0.4 < first_chunk.outage_s < 30.0
    (warning,) = caplog.messages
    assert warning.startswith(f"{link}: the port disappeared while it was read")


def test_source_of_a_dash_is_stdin(monkeypatch):
    reader, writer = os.pipe()
    os.write(writer, b"hello")
    os.close(writer)
    with os.fdopen(reader) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        with open_source("-") as source:
            assert [chunk.data for chunk in source] == [b"hello"]


@pytest.fixture
def address():
    """Return a UDP address that is not in use."""
    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()


@contextmanager
def udp_port(address, *datagrams):
    """Open a port to which a board then sends datagrams."""
    with Port(f"udp://127.0.0.1:{address[1]}") as port, socket.socket(type=socket.SOCK_DGRAM) as board:
        for datagram in datagrams:
            board.sendto(datagram, address)
        yield port


@pytest.mark.parametrize(
    ("datagrams", "lengths"),
    [([b"1,2,3\n"] * 20, [120]), ([b"\0" * 12, b"\0" * 5, b"\0" * 12], [12, 5, 12])],
)
def test_binary_datagrams_that_waited_are_not_joined(address, datagrams, lengths):
    """A datagram of another length would otherwise make the frames of the other datagrams unreadable."""
    with udp_port(address, *datagrams) as port:
        assert [len(chunk.data) for chunk in islice(port, len(lengths))] == lengths


def test_second_udp_sender_causes_one_warning(address, caplog):
    with udp_port(address, b"1,2,3\n") as port, socket.socket(type=socket.SOCK_DGRAM) as second_board:
        for _ in range(3):
            second_board.sendto(b"4,5,6\n", address)
        assert next(iter(port)).data == b"1,2,3\n" + 3 * b"4,5,6\n"
    assert caplog.text.count("give each board its own UDP port") == 1


TEXT = (b'{"A": 1}', b"A:1\tB:2", "1 µC".encode())
BYTES = (b"\xaa\x00", b"\xaa\x55", b"1\x002", b"\x7f", b"\x02\n")


@pytest.mark.parametrize(
    ("sent", "chunks"),
    [
        # Lines without an end get one, unless the board ends its lines itself, also after a message.
        ((*TEXT, *BYTES), (*(line + b"\n" for line in TEXT), *BYTES)),
        ((b"1,2\n", b"3,", b"4\n"), (b"1,2\n", b"3,", b"4\n")),
        ((b"tared\n", *[b"1,2"] * 10), (b"tared\n", *[b"1,2"] * 8, *[b"1,2\n"] * 2)),
        ((b"1,2\0",), (b"1,2\0\n",)),  # C string
    ],
)
def test_datagrams_are_chunks(address, sent, chunks):
    with udp_port(address) as port, socket.socket(type=socket.SOCK_DGRAM) as board:
        for datagram, chunk in zip(sent, chunks, strict=True):
            board.sendto(datagram, address)
            assert port.read(10.0).data == chunk


def test_udp_url_without_a_host_receives_on_every_address(address):
    """An empty datagram is ignored."""
    with Port(f"udp://:{address[1]}") as port, socket.socket(type=socket.SOCK_DGRAM) as board:
        board.sendto(b"", address)
        board.sendto(b"1,2\n", address)
        assert port.read(1.0).data == b"1,2\n"


def test_udp_port_of_a_board_that_needs_requests_is_refused(address):
    with pytest.raises(InputError, match=r"request.* use tcp://"):
        Port(f"udp://127.0.0.1:{address[1]}", request=Request(b"?"))


def test_udp_address_in_use_is_refused(address):
    with Port(f"udp://127.0.0.1:{address[1]}"), pytest.raises(PortError, match="in use"):
        Port(f"udp://127.0.0.1:{address[1]}").__enter__()


@pytest.mark.parametrize(
    ("answers", "waits_s"),
    [
        ([(0.003, b"1,2\n"), (0.0069, b"3\n")], [REPEAT_TIME_s, 0.007, QUIET_TIME_s]),
        ([(0.5 * REPEAT_TIME_s, b"")] * 2, [REPEAT_TIME_s, 0.5 * REPEAT_TIME_s, 0.0]),
        # The board first sends the request back.
        ([(0.001, b"?\n"), (0.05, b"1,2\n")], [REPEAT_TIME_s, REPEAT_TIME_s - 0.001, QUIET_TIME_s]),
    ],
)
def test_the_next_request_waits(answers, waits_s, monkeypatch):
    clock = SimpleNamespace(now_s=100.0)
    monkeypatch.setattr(serial_line, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    requester = Requester(None, Request(b"?\n"))
    assert requester.wait_s() == 0.0
    assert requester.next_request() == b"?\n"
    waited_s = [requester.wait_s()]
    for pause_s, answer in answers:
        clock.now_s += pause_s
        assert requester.remove_echo(answer) == answer.removeprefix(b"?\n")
        waited_s.append(requester.wait_s())
    assert waited_s == pytest.approx(waits_s)


@settings(derandomize=True)
@given(st.binary(min_size=1, max_size=8), st.binary(max_size=20), st.lists(st.integers(0, 28), max_size=5))
def test_echo_is_removed_however_it_is_split(request_bytes, answer, cuts):
    requester = Requester(None, Request(request_bytes))
    requester.next_request()
    stream = request_bytes + answer
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    pieces = [requester.remove_echo(stream[start:stop]) for start, stop in pairwise(edges)]
    assert b"".join(pieces) == answer


def test_answer_with_the_first_bytes_of_the_request_is_no_echo():
    requester = Requester(None, Request(b"\x01\x04\x00"))
    requester.next_request()
    assert [requester.remove_echo(part) for part in (b"\x01", b"\x04", b"\x02", b"\x10")] == [
        b"",
        b"",
        b"\x01\x04\x02",
        b"\x10",
    ]


def test_request_is_sent_for_each_frame(board):
    """The board answers each request with the echo of the request and a line."""
    lines = [b"%d" % number for number in range(10)]

    def answer():
        for line in lines:
            assert os.read(board._writer, 100) == b"?"
            os.write(board._writer, b"?" + line + b"\n")

    os.set_blocking(board._writer, True)
    answering = threading.Thread(target=answer)
    answering.start()
    with Port(board.url, request=Request(b"?", 200.0), silence_s=5.0) as port:
        received_bytes = b""
        chunks = iter(port)
        while received_bytes.count(b"\n") < len(lines):
            received_bytes += next(chunks).data
    answering.join()
    assert received_bytes.split() == lines


CHUNK = Chunk(b"1,2,3\n", 1e9, 0)


class Bus(list):
    is_live = True


def test_installed_package_adds_a_source(monkeypatch):
    def open_bus(url):
        return nullcontext(Bus([CHUNK, CHUNK._replace(data=url.encode())]))

    def entry_points(group, name):
        assert group == "isocharge.sources"
        return [SimpleNamespace(value="can:open_bus", load=lambda: open_bus)] if name == "can" else []

    monkeypatch.setattr("isocharge.serve.port.source.entry_points", entry_points)
    with open_source("can://vcan0") as source:
        assert [received.data for received in source] == [CHUNK.data, b"can://vcan0"]
    assert isinstance(open_source("can"), Port)  # a path


@pytest.mark.parametrize(
    "load",
    [
        sys.exit,
        object,
        lambda: lambda _: nullcontext([]),
        lambda: lambda _: nullcontext(Bus([CHUNK._replace(data="abcd")])),  # no recording could contain such a chunk
    ],
)
def test_added_source_that_fails_is_an_error_with_its_entry_point(monkeypatch, load):
    entry_point = SimpleNamespace(value="can:open_bus", load=load)
    monkeypatch.setattr("isocharge.serve.port.source.entry_points", lambda **_: [entry_point])
    message = r"can://x: the source can:open_bus failed \(.+\); correct or uninstall its package"
    with pytest.raises(PluginError, match=message), open_source("can://x") as source:
        list(source)
