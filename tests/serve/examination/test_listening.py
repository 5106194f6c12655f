"""Listening at one speed after the other, on a port whose speed is not known."""

import random
import time

import pytest

from isocharge.serve import examine
from isocharge.serve.examination import listening
from isocharge.serve.port.serial_port import Chunk


class PortOfOneSpeed:
    """A serial port that gives lines at 57600 bit/s, and something else at other speeds; times are by the clock."""

    def __init__(self, url, *, baud, request):
        self.baud, self.opened, self.sent, self.random = baud, time.monotonic(), 0, random.Random(baud)
        assert url == "/dev/ttyUSB9"
        assert request is None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def read(self, timeout_s):
        time.sleep(min(timeout_s, 0.01))
        due = int((time.monotonic() - self.opened) * 200)
        lines = b"".join(b"A:%d.5,B:%d.25,C:7.5\n" % (k % 7, k % 5) for k in range(self.sent, due))
        self.sent = due
        data = lines if self.baud == 57600 else self.random.randbytes(len(lines) // 3)
        return Chunk(data, time.time(), 0) if data else None


@pytest.mark.parametrize("seconds", [0.6, 1.3])
def test_the_speed_is_found(monkeypatch, seconds):
    """What was heard in deciding is a part of the listening: the right speed takes no longer than asked for."""
    monkeypatch.setattr(listening, "Port", PortOfOneSpeed)
    report = examine("/dev/ttyUSB9", bauds=(115200, 57600, 9600), seconds=seconds)
    assert (report.baud, report.good > 100) == (57600, True)
    assert report.seconds == pytest.approx(seconds, abs=0.1)


def test_no_speed_is_right(monkeypatch):
    monkeypatch.setattr(listening, "Port", PortOfOneSpeed)
    report = examine("/dev/ttyUSB9", bauds=(115200, 9600), seconds=0.6)
    assert (report.good, report.baud) == (0, 115200)
    assert "another baud rate" in report.missing[0]


@pytest.mark.parametrize(
    ("url", "has"),
    [("/dev/ttyUSB9", True), ("udp://127.0.0.1:9", False), ("socket://x:1", False), ("/dev/pts/1", False)],
)
def test_what_has_a_speed(url, has):
    assert listening.has_speed(url) == has
