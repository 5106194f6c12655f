"""Listening to a port at several baud rates, and with requests."""

from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from isocharge.serve import examine
from isocharge.serve.examination import listening
from isocharge.serve.port.file_source import Chunk
from isocharge.serve.port.serial_line import Request

REQUEST = Request(b"?", 200.0)


@pytest.mark.parametrize(
    ("silence_s", "other_bytes", "bauds", "tried", "good"),
    [
        (0.0, b"\xf8\x80\xfe\xff", (115200, 57600, 9600), [115200, 57600, 57600], 200),
        (0.0, b"\xf8\x80\xfe\xff", (115200, 9600), [115200, 9600, 115200], 0),
        (0.0, b"\xf8\x80\xfe\xff", (57600,), [57600], 200),
        # an Arduino, which restarts at each opening, and a board that needs requests
        (6.0, b"\xf8\x80\xfe\xff", (115200, 57600, 9600), [115200, 57600, 57600], 200),
        (0.0, b"", (115200, 57600, 9600), [115200, 57600, 57600], 200),
    ],
)
def test_baud_rate_is_found(monkeypatch, silence_s, other_bytes, bauds, tried, good):
    """The board sends a line every 10 ms at 57600 bit/s. At other speeds, other bytes arrive. The time is simulated.

    A board that needs requests may send nothing at other speeds.
    """
    clock = SimpleNamespace(now_s=0.0)
    opened_bauds = []

    @contextmanager
    def open_port(url, *, baud, request, wait):  # noqa: ARG001
        assert request is REQUEST
        opened_bauds.append(baud)
        first_s = clock.now_s + silence_s

        def read(timeout_s):
            wait_s = max(first_s - clock.now_s, 0.01)
            clock.now_s += min(wait_s, timeout_s)
            line = b"A:%d.5,B:-2.25,C:7.5\n" % (round(300.0 * clock.now_s) % 7)
            data = line if baud == 57600 else other_bytes
            return Chunk(data, 1e9 + clock.now_s, 0) if data and wait_s <= timeout_s else None

        yield SimpleNamespace(read=read, start_up_s=10.0)

    monkeypatch.setattr(listening, "Port", open_port)
    monkeypatch.setattr(listening.time, "monotonic", lambda: clock.now_s)
    report = examine("/dev/ttyUSB9", bauds=bauds, seconds=2.0, request=REQUEST)
    assert report.baud == tried[-1]
    assert report.good == pytest.approx(good, abs=5)
    assert report.seconds == pytest.approx(2.0)
    assert opened_bauds == tried
    assert good or "another baud rate" in report.missing[0]


@pytest.mark.parametrize("jump_s", [-3600.0, 3600.0])
def test_wall_clock_that_is_set_while_listening_does_not_change_the_time_span(jump_s):
    chunks = [Chunk(b"1", 1e9 + k + jump_s * (k > 2), 1_000_000_000 * k) for k in range(5)]
    assert listening.ReceivedData("/dev/ttyUSB9", 9600, chunks=chunks).span_s == pytest.approx(5.0)
