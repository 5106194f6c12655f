"""Ports that are there, are not, fall silent and vanish."""

import threading
import time

import pytest
import serial

from isocharge.errors import PortError, PortLost
from isocharge.serve import Port
from isocharge.serve.pseudo_port import PORT_BUFFER, PseudoPort


@pytest.fixture
def board():
    port = PseudoPort()
    yield port
    port.close()


def test_bytes_and_time_of_arrival(board):
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


def test_silence(board):
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
    """A device that vanishes between the first byte and the question how many more there are."""

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
