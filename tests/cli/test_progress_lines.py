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


def test_the_last_progress_line_shows_the_end_of_a_long_computation(clock, capsys):
    """Each step takes 3 s, and there is at most one line in 5 s. Step 7 of 7 follows 3 s after the line of step 6."""
    with terminal.shown_progress():
        for _ in track(range(7), "pressing"):
            clock[0] += 3.0
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "pressing: 2 of 7"
    assert lines[-1] == "pressing: 7 of 7"


def test_a_short_computation_has_no_progress_lines(clock, capsys):
    with terminal.shown_progress():
        for _ in track(range(7), "pressing"):
            clock[0] += 0.1
    assert capsys.readouterr().err == ""
