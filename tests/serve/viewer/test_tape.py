"""Samples by number: the latest of a stream, all of a recording."""

from contextlib import closing

import numpy as np
import pytest

from isocharge.serve.viewer.samples import SampleFormat
from isocharge.serve.viewer.tape import PIECES, RecordedTape, Tape

FORM = SampleFormat(("A",))


@pytest.fixture
def recorded():
    with closing(RecordedTape(FORM.dtype)) as tape:
        yield tape


def samples(times, force_N=0.0):
    rows = np.zeros(len(times), FORM.dtype)
    rows["timestamp"] = times
    rows["force_N"] = force_N
    return rows


def test_a_live_tape_keeps_the_latest():
    tape = Tape(FORM.dtype, most=10)
    for first in range(0, 35, 7):
        tape.append(samples(np.arange(first, first + 7.0)))
    assert (tape.oldest, tape.total) == (25, 35)
    assert tape.samples(0, 35)["timestamp"].tolist() == list(range(25, 35))
    assert tape.index(30.5) == 31
    tape.append(samples(np.arange(35.0, 60.0)))
    assert tape.samples(tape.oldest, tape.total)["timestamp"].tolist() == list(range(50, 60))


def test_a_recorded_tape_keeps_all(recorded):
    tape = recorded
    assert tape.span() == (0.0, 0.0)
    for first in range(0, 3000, 1000):
        tape.append(samples(1e9 + 0.01 * np.arange(first, first + 1000)))
    assert tape.total == 3000
    assert tape.span() == (1e9, 1e9 + 29.99)
    assert tape.index(1e9 + 15.001) == 1501
    assert len(tape.samples(0, 3000)) == 3000


def test_times_never_go_back(recorded):
    tape = recorded
    tape.append(samples([10.0, 12.0, 11.0]))
    tape.append(samples([5.0, 13.0]))
    assert tape.samples(0, 5)["timestamp"].tolist() == [10, 12, 12, 12, 13]


def test_overview_has_the_largest_force_of_each_piece(recorded):
    tape = recorded
    force_N = np.zeros(60_000)
    force_N[30_000] = 1.5
    for first in range(0, 60_000, 777):
        part = force_N[first : first + 777]
        tape.append(samples(1e-3 * np.arange(first, first + len(part)), part))
    overview = tape.overview()
    assert len(overview) <= PIECES
    assert overview.index(1.5) / len(overview) == pytest.approx(0.5, abs=0.01)
    assert sum(force > 0 for force in overview) == 1
