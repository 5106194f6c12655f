"""Listening to a port at several baud rates, and with requests."""

from typing import ClassVar

import pytest

from isocharge.serve import examine
from isocharge.serve.examination import listening
from isocharge.serve.port.file_source import Chunk


class PortOfOneSpeed:
    """A serial port that returns lines at 57600 bit/s, and other bytes at other speeds. A read advances its clock."""

    start_up_s = 10.0
    opened: ClassVar[list] = []
    now_s = 0.0

    def __init__(self, url, *, baud, request, wait):  # noqa: ARG002
        self.baud = baud
        self.lines = 0
        self.opened.append((url, baud, request))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def read(self, timeout_s):
        type(self).now_s += min(timeout_s, 0.01)
        self.lines += 2
        numbers = (self.lines, self.lines + 1)
        data = b"".join(b"A:%d.5,B:%d.25,C:7.5\n" % (number % 7, number % 5) for number in numbers)
        return Chunk(data if self.baud == 57600 else b"\xf8\x80\xfe\xff", 1e9 + self.now_s, 0)


@pytest.fixture
def opened(monkeypatch):
    """Return the list of the URLs, baud rates and requests of the ports that are opened."""
    monkeypatch.setattr(listening, "Port", PortOfOneSpeed)
    monkeypatch.setattr(listening.time, "monotonic", lambda: PortOfOneSpeed.now_s)
    monkeypatch.setattr(PortOfOneSpeed, "opened", [])
    return PortOfOneSpeed.opened


@pytest.mark.parametrize(
    ("bauds", "tried", "good"),
    [
        ((115200, 57600, 9600), [115200, 57600, 57600], 400),
        ((115200, 9600), [115200, 9600, 115200], 0),
        ((57600,), [57600], 400),
    ],
    ids=["found", "none is right", "one is not tried"],
)
def test_baud_rate_is_found(opened, bauds, tried, good):
    report = examine("/dev/ttyUSB9", bauds=bauds, seconds=2.0)
    assert report.baud == tried[-1]
    assert report.good == pytest.approx(good, abs=5)
    assert report.seconds == pytest.approx(2.0)
    assert [baud for _, baud, _ in opened] == tried
    assert good or "another baud rate" in report.missing[0]


def test_board_that_restarts_when_the_port_is_opened_is_heard_at_its_baud_rate(monkeypatch, opened):
    """An Arduino sends nothing for some seconds after each opening."""
    original_read = PortOfOneSpeed.read

    def read_after_restart(port, timeout_s):
        if port.lines == 0:
            PortOfOneSpeed.now_s += min(timeout_s, 6.0)
            if timeout_s < 6.0:
                return None
        return original_read(port, timeout_s)

    monkeypatch.setattr(PortOfOneSpeed, "read", read_after_restart)
    report = examine("/dev/ttyUSB9", bauds=(115200, 57600, 9600), seconds=2.0)
    assert [baud for _, baud, _ in opened] == [115200, 57600, 57600]
    assert report.seconds == pytest.approx(2.0)
