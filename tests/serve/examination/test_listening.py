"""Listening to a port at several baud rates, and with requests."""

from typing import ClassVar

import pytest

from isocharge.serve import examine
from isocharge.serve.examination import listening
from isocharge.serve.port.file_source import Chunk


class PortOfOneSpeed:
    """A serial port that returns lines at 57600 bit/s, and other bytes at other speeds. A read advances its clock."""

    start_up_s = 10.0
    silence_s = 0.0
    bauds: ClassVar[list] = []
    now_s = 0.0

    def __init__(self, url, *, baud, request, wait):  # noqa: ARG002
        self.baud = baud
        self.lines = 0
        self.bauds.append(baud)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def read(self, timeout_s):
        silence_s = 0.01 if self.lines else max(self.silence_s, 0.01)
        type(self).now_s += min(timeout_s, silence_s)
        if timeout_s < self.silence_s and self.lines == 0:
            return None
        self.lines += 2
        numbers = (self.lines, self.lines + 1)
        data = b"".join(b"A:%d.5,B:%d.25,C:7.5\n" % (number % 7, number % 5) for number in numbers)
        return Chunk(data if self.baud == 57600 else b"\xf8\x80\xfe\xff", 1e9 + self.now_s, 0)


@pytest.fixture
def tried_bauds(monkeypatch):
    """Return the list of the baud rates of the ports that are opened."""
    monkeypatch.setattr(listening, "Port", PortOfOneSpeed)
    monkeypatch.setattr(listening.time, "monotonic", lambda: PortOfOneSpeed.now_s)
    monkeypatch.setattr(PortOfOneSpeed, "bauds", [])
    return PortOfOneSpeed.bauds


@pytest.mark.parametrize(
    ("silence_s", "bauds", "tried", "good"),
    [
        (0.0, (115200, 57600, 9600), [115200, 57600, 57600], 400),
        (0.0, (115200, 9600), [115200, 9600, 115200], 0),
        (0.0, (57600,), [57600], 400),
        (6.0, (115200, 57600, 9600), [115200, 57600, 57600], 400),
    ],
    ids=["found", "none is right", "one is not tried", "an Arduino, which restarts at each opening"],
)
def test_baud_rate_is_found(tried_bauds, monkeypatch, silence_s, bauds, tried, good):
    monkeypatch.setattr(PortOfOneSpeed, "silence_s", silence_s)
    report = examine("/dev/ttyUSB9", bauds=bauds, seconds=2.0)
    assert report.baud == tried[-1]
    assert report.good == pytest.approx(good, abs=5)
    assert report.seconds == pytest.approx(2.0)
    assert tried_bauds == tried
    assert good or "another baud rate" in report.missing[0]
