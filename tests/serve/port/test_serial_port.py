"""Ports that exist, do not, fall silent and vanish."""

import itertools
import socket
import threading
import time
from unittest import mock

import pytest
import serial

from isocharge.common.errors import PortError, PortLost
from isocharge.serve import Port
from isocharge.serve.virtual_sensor.pseudo_port import PORT_BUFFER, PseudoPort

pytestmark = pytest.mark.xdist_group("clock")


@pytest.fixture
def board():
    port = PseudoPort()
    yield port
    port.close()


def test_chunk_has_bytes_and_time_of_arrival(board):
    with Port(board.url) as port:
        sent = time.time()
        board.write_whole(b"hello")
        chunk = next(iter(port))
    assert chunk.data == b"hello"
    assert sent <= chunk.timestamp <= time.time()
    assert abs(time.perf_counter_ns() - chunk.clock_ns) < 5e9


def test_stale_bytes_are_forgotten_at_opening(board):
    board.write_whole(b"stale")
    time.sleep(0.05)
    with Port(board.url) as port:
        board.write_whole(b"fresh")
        assert next(iter(port)).data == b"fresh"


def test_raw_bytes_pass_unchanged(board):
    everything, got = bytes(range(256)), b""
    with Port(board.url) as port:
        board.write_whole(everything)
        for chunk in port:
            got += chunk.data
            if len(got) >= 256:
                break
    assert got == everything


@pytest.mark.parametrize("url", ["/dev/ttyNone", "socket://127.0.0.1:1", "telepathy://x", "/etc/hostname"])
def test_port_that_cannot_be_opened(url):
    with (
        pytest.raises(PortError, match=f"{url}: cannot be opened at 115200 baud .*check the cable") as caught,
        Port(url),
    ):
        pass
    assert caught.value.__cause__ is not None


def test_port_that_another_program_holds(board):
    with Port(board.url), pytest.raises(PortError, match=r"lock.*no other program has it open"), Port(board.url):
        pass


def test_port_that_is_silent(board):
    with Port(board.url, silence_s=0.05) as port, pytest.raises(PortError, match=r"no data for 0.05 s; check that"):
        next(iter(port))


def test_port_that_is_not_open(board):
    with pytest.raises(PortError, match="not open"):
        next(iter(Port(board.url)))


def test_port_that_vanishes():
    board = PseudoPort()
    with Port(board.url) as port:
        threading.Timer(0.05, board.close).start()
        with pytest.raises(PortLost, match=f"{board.url}: went away while it was read"):
            next(iter(port))


class _Vanishing:
    """A device that vanishes between the first byte and the question how many more have come."""

    def read(self, size):
        return b"x" * size

    @property
    def in_waiting(self):
        raise OSError(5, "Input/output error")

    def reset_input_buffer(self):
        pass

    def close(self):
        pass


def test_plain_os_error_of_a_vanished_device(monkeypatch):
    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: _Vanishing())
    with Port("/dev/ttyX") as port, pytest.raises(PortLost, match="/dev/ttyX: went away"):
        next(iter(port))


def test_pseudo_port_withholds_whole_frames(board):
    frame, sent = b"\x01" * 24 + b"\0", 0
    while board.write_whole(frame):
        sent += 1
        time.sleep(0.0005)
    assert PORT_BUFFER - 50 < sent * 25 <= PORT_BUFFER
    assert not board.write_whole(frame)


def test_loop_of_pyserial():
    with Port("loop://", silence_s=1.0) as port:
        port._serial.write(b"hello")
        assert next(iter(port)).data == b"hello"


@pytest.fixture
def server():
    """A TCP server for one client at a time; `server.accept()` waits for the client."""
    listening = socket.create_server(("127.0.0.1", 0))
    listening.settimeout(5.0)
    yield listening
    listening.close()


def url_of(server):
    return f"socket://127.0.0.1:{server.getsockname()[1]}"


def test_socket_of_pyserial_gives_all_that_is_there(server):
    with Port(url_of(server), silence_s=1.0) as port, server.accept()[0] as client:
        client.sendall(b"x" * 1000)
        time.sleep(0.05)
        assert next(iter(port)).data == b"x" * 1000


def test_socket_that_is_closed(server):
    with Port(url_of(server), silence_s=1.0) as port:
        server.accept()[0].close()
        with pytest.raises(PortLost, match="the other end has closed"):
            next(iter(port))


def test_socket_that_comes_back(server, caplog):
    serving = threading.Thread(target=send_one_by_one, args=(server, [b"one", b"two", b"three"]))
    serving.start()
    with Port(url_of(server), silence_s=1.0, reconnect=True) as port:
        assert [chunk.data for chunk in itertools.islice(port, 3)] == [b"one", b"two", b"three"]
    serving.join()
    assert port.outages == 2
    assert [record.levelname for record in caplog.records] == ["WARNING"] * 2
    assert "went away while it was read" in caplog.text


def send_one_by_one(server, messages):
    """A client for each message; its connection is closed after it has had the time to read it."""
    for message in messages:
        with server.accept()[0] as client:
            time.sleep(0.05)
            client.sendall(message)
            time.sleep(0.05)


def test_outage_is_measured_and_logged_once(tmp_path, caplog):
    """A device that is away for longer than several tries."""
    link, board = tmp_path / "film", PseudoPort()
    link.symlink_to(board.url)
    with Port(str(link), reconnect=True) as port:
        chunks = iter(port)
        board.write_whole(b"before")
        assert next(chunks) == (b"before", *next_times())
        board.close()
        link.unlink()
        heard = threading.Event()
        again = threading.Timer(0.8, plug_in, (link, heard))
        again.start()
        chunk = next(chunks)
        heard.set()
        again.join()
    assert chunk.data[:5] == b"after"
    assert 0.75 < chunk.outage_s < 30.0
    assert (port.outages, len(caplog.records)) == (1, 1)


def next_times():
    """Equal to any time of arrival without an outage."""
    return mock.ANY, mock.ANY, 0.0


def plug_in(link, heard):
    board = PseudoPort()
    link.symlink_to(board.url)
    talk(board, b"after", heard)
    board.close()


def test_silence_is_an_outage(board, caplog):
    with Port(board.url, silence_s=0.2, reconnect=True) as port:
        chunks = iter(port)
        heard = threading.Event()
        talking = threading.Timer(0.6, talk, (board, b"late", heard))
        talking.start()
        chunk = next(chunks)
    heard.set()
    talking.join()
    assert (chunk.data[:4], port.outages, len(caplog.records)) == (b"late", 1, 1)
    assert 0.5 < chunk.outage_s < 30.0


def talk(board, word, heard):
    """Say it until it is heard: what comes before a port is open is lost."""
    while not heard.wait(0.02):
        board.write_whole(word)


def test_low_latency_is_set_where_it_exists(monkeypatch):
    asked = []
    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", lambda _, on: asked.append(on))
    board = PseudoPort()
    with Port(board.url):
        pass
    board.close()
    assert asked == [True]
