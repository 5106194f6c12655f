"""What `serve stream --live` passes to the page: every record, and from time to time the state of the stream."""

from types import SimpleNamespace

import pytest

from isocharge.cli.shared import live_page
from isocharge.cli.shared.live_page import STATE_INTERVAL_S, PageFeed
from isocharge.serve.frames.frame import FrameCounts


class FakePage:
    """Page that keeps what it gets."""

    def __init__(self):
        self.records = []
        self.states = []
        self.tape = SimpleNamespace(rate_Hz=lambda: 100.0)

    def add(self, record):
        self.records.append(record)

    def update(self, **state):
        self.states.append(state)


@pytest.mark.parametrize(
    ("recorder", "name", "failed"),
    [(None, None, False), (False, "touch.rec", False), (True, "touch.rec", True)],
)
def test_state_is_sent_four_times_per_second(monkeypatch, tmp_path, recorder, name, failed):
    clock_s = [1000.0]
    monkeypatch.setattr(live_page.time, "monotonic", lambda: clock_s[0])
    page = FakePage()
    if recorder is not None:
        recorder = SimpleNamespace(path=tmp_path / "touch.rec", failed=recorder)
    stream = SimpleNamespace(recorder=recorder)
    feed = PageFeed(page, SimpleNamespace(totals=FrameCounts), stream)
    record = SimpleNamespace(model="three/1", film=None, tare_pC=None)
    for _ in range(101):
        feed.write(record)
        clock_s[0] += 0.01
    assert len(page.records) == 101
    assert len(page.states) == pytest.approx(1.0 / STATE_INTERVAL_S, abs=1)
    assert (page.states[0]["recording"], page.states[0]["recording_failed"]) == (name, failed)
