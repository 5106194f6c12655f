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


def test_chunk_has_the_bytes_unchanged_and_the_time_of_arrival(board):
    board.write_whole(b"stale: what is there at opening is forgotten")
    time.sleep(0.02)
    everything, got = bytes(range(256)), []
    with Port(board.url) as port:
        sent = time.time()
        board.write_whole(everything)
        for chunk in port:
            got.append(chunk)
            if sum(len(chunk.data) for chunk in got) >= 256:
                break
    assert b"".join(chunk.data for chunk in got) == everything
    assert sent <= got[0].timestamp <= time.time()
    assert 0 <= time.perf_counter_ns() - got[-1].clock_ns < 60e9
    assert got[0].outage_s == 0.0


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
    with Port(board.url, silence_s=0.05) as port:
        assert port.read(0.01) is None
        with pytest.raises(PortLost, match=r"no data for 0.05 s; check that"):
            next(iter(port))


def test_port_that_is_not_open(board):
    with pytest.raises(PortError, match="not open"):
        next(iter(Port(board.url)))


def test_port_that_vanishes():
    board = PseudoPort()
    with Port(board.url) as port:
        board.close()
        with pytest.raises(PortLost, match=f"{board.url}: went away while it was read"):
            next(iter(port))


class Device:
    """What pyserial opens on a system whose ports are no file descriptors; it may vanish while it is read."""

    def __init__(self, waiting):
        self.waiting, self.timeout, self.sent, self.low_latency = waiting, None, b"", []

    def read(self, size):
        data, self.sent = self.sent[:size], self.sent[size:]
        return data

    @property
    def in_waiting(self):
        if self.waiting is None:
            raise OSError(5, "Input/output error")
        return self.waiting

    def reset_input_buffer(self):
        self.sent = b"hello"

    def set_low_latency_mode(self, on):
        self.low_latency.append(on)

    def close(self):
        pass


@pytest.mark.parametrize("waiting", [4, None])
def test_a_port_without_a_descriptor_is_read_by_pyserial(monkeypatch, waiting):
    device = Device(waiting)
    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: device)
    with Port("COM3") as port:
        if waiting is None:
            with pytest.raises(PortLost, match="COM3: went away"):
                next(iter(port))
        else:
            assert port.read(0.25).data == b"hello"
            assert device.timeout == 0.25
            assert port.read(0.25) is None
    assert device.low_latency == [True]


def test_pseudo_port_withholds_whole_frames(board):
    frame, sent = b"\x01" * 24 + b"\0", 0
    while board.write_whole(frame):
        sent += 1
        time.sleep(0.0005)
    assert PORT_BUFFER - 50 < sent * 25 <= PORT_BUFFER
    assert not board.write_whole(frame)


@pytest.fixture
def server():
    """A TCP server for one client at a time; `server.accept()` waits for the client."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(10.0)
        yield listening


@pytest.mark.parametrize("scheme", ["socket", "tcp"])
def test_socket_gives_all_that_is_there_until_it_is_closed(server, scheme):
    with Port(f"{scheme}://127.0.0.1:{server.getsockname()[1]}", silence_s=5.0) as port:
        with server.accept()[0] as client:
            client.sendall(b"x" * 1000)
            time.sleep(0.05)
            assert next(iter(port)).data == b"x" * 1000
        with pytest.raises(PortLost, match="the other end has closed"):
            next(iter(port))


def test_socket_that_comes_back(server, caplog):
    def send_one_by_one():
        for message in (b"one", b"two", b"three"):
            with server.accept()[0] as client:
                time.sleep(0.05)  # until the port has dropped what it found at opening
                client.sendall(message)
                time.sleep(0.05)

    serving = threading.Thread(target=send_one_by_one)
    serving.start()
    with Port(f"tcp://127.0.0.1:{server.getsockname()[1]}", silence_s=5.0, reconnect=True) as port:
        assert [chunk.data for chunk in itertools.islice(port, 3)] == [b"one", b"two", b"three"]
    serving.join()
    assert port.outages == 2
    assert [record.levelname for record in caplog.records] == ["WARNING"] * 2
    assert "went away while it was read" in caplog.text


def talk(board, word, heard):
    """Say it until it is heard: what comes before a port is open is lost."""
    while not heard.wait(0.02):
        board.write_whole(word)


def test_outage_is_measured_and_logged_once(tmp_path, caplog):
    """A device that is away for longer than several tries."""
    link, board, heard = tmp_path / "film", PseudoPort(), threading.Event()

    def plug_in():
        back = PseudoPort()
        link.symlink_to(back.url)
        talk(back, b"after", heard)
        back.close()

    link.symlink_to(board.url)
    with Port(str(link), reconnect=True) as port:
        chunks = iter(port)
        board.write_whole(b"before")
        assert next(chunks) == (b"before", mock.ANY, mock.ANY, 0.0)
        board.close()
        link.unlink()
        again = threading.Timer(0.5, plug_in)
        again.start()
        chunk = next(chunks)
        assert next(chunks).outage_s == 0.0
        heard.set()
        again.join()
    assert chunk.data[:5] == b"after"
    assert 0.4 < chunk.outage_s < 30.0
    assert (port.outages, len(caplog.records)) == (1, 1)


def test_silence_is_an_outage(board, caplog):
    heard = threading.Event()
    with Port(board.url, silence_s=0.2, reconnect=True) as port:
        talking = threading.Timer(0.5, talk, (board, b"late", heard))
        talking.start()
        chunk = next(iter(port))
    heard.set()
    talking.join()
    assert (chunk.data[:4], port.outages, len(caplog.records)) == (b"late", 1, 1)
    assert 0.4 < chunk.outage_s < 30.0
