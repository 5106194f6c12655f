"""Progress of long computations as lines of text, as in a log."""

import pytest

from isocharge.cli.shared import terminal
from isocharge.common.progress import track


@pytest.fixture
def clock(monkeypatch):
    """A clock that tests set, s."""
    times_s = [0.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: times_s[0])
    return times_s


def test_a_long_computation_has_a_line_every_five_seconds(clock, capsys):
    """Each step takes 3 s."""
    with terminal.shown_progress():
        for _ in track(range(7), "pressing"):
            clock[0] += 3.0
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["pressing: 2 of 7", "pressing: 4 of 7", "pressing: 6 of 7"]
