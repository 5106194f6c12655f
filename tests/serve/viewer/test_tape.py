"""Samples of the live page: storage in a tape, transmission between the processes, and the position of a replay."""

import time
from contextlib import closing

import numpy as np
import pytest

from isocharge.serve.viewer.link import make_link
from isocharge.serve.viewer.messages import Play, SampleFormat
from isocharge.serve.viewer.playhead import Playhead
from isocharge.serve.viewer.tape import MAX_PIECES, RecordedTape, Tape

FORMAT = SampleFormat(("A",))


@pytest.fixture
def recorded():
    """Return an empty tape of a recording."""
    with closing(RecordedTape(FORMAT.dtype)) as tape:
        yield tape


def samples(times, force_N=0.0):
    """Return samples with times, s, and forces, N."""
    rows = np.zeros(len(times), FORMAT.dtype)
    rows["timestamp"] = times
    rows["force_N"] = force_N
    return rows


def test_live_tape_stores_the_latest_samples():
    tape = Tape(FORMAT.dtype, capacity=10)
    for first in range(0, 35, 7):
        tape.append(samples(np.arange(first, first + 7.0)))
    assert tape.oldest == 25
    assert tape.total == 35
    assert tape.first_number_after(30.5) == 31
    assert tape.samples(0, 35)["timestamp"].tolist() == list(range(25, 35))
    tape.append(samples(np.arange(35.0, 60.0)))
    assert tape.samples(tape.oldest, tape.total)["timestamp"].tolist() == list(range(50, 60))


def test_recorded_tape_stores_all_samples(recorded):
    tape = recorded
    assert tape.span() == (0.0, 0.0)
    for first in range(0, 3000, 1000):
        tape.append(samples(1e9 + 0.01 * np.arange(first, first + 1000)))
    assert tape.total == 3000
    assert len(tape.samples(0, 3000)) == 3000
    assert tape.span() == (1e9, 1e9 + 29.99)
    assert tape.first_number_after(1e9 + 15.001) == 1501


def test_recorded_tape_replaces_times_that_go_back(recorded):
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
        tape.append(samples(1e9 + 1e-3 * np.arange(first, first + len(part)), part))
    overview = tape.overview()
    assert len(overview) <= MAX_PIECES
    assert overview.index(1.5) / len(overview) == pytest.approx(0.5, abs=0.01)
    assert sum(force > 0 for force in overview) == 1


SAMPLE = bytes(range(64))


def test_link_delivers_complete_samples_in_order():
    reader, page = make_link()
    for number in range(100):
        reader.send_sample(bytes([number]) * 64)
    assert page.receive_samples(64) == b"".join(bytes([number]) * 64 for number in range(100))

    reader.send_sample(SAMPLE + SAMPLE[:40])
    assert page.receive_samples(64) == SAMPLE
    assert page.receive_samples(64) == b""
    reader.send_sample(SAMPLE[40:])
    assert page.receive_samples(64) == SAMPLE
    assert page.is_open
    reader.close()
    page.close_here()


def test_link_is_closed_if_the_reader_ends_in_the_middle_of_a_sample():
    """The bytes of the incomplete sample are not mistaken for data of a reader that is still there."""
    reader, page = make_link()
    reader.send_sample(SAMPLE + SAMPLE[:40])
    assert page.receive_samples(64) == SAMPLE
    assert page.is_open
    reader.close()
    assert page.receive_samples(64) == b""
    assert not page.is_open
    page.close_here()


def test_reader_does_not_wait_for_a_page_that_reads_nothing():
    reader, page = make_link()
    begin_s = time.perf_counter()
    for _ in range(40_000):
        reader.send_sample(SAMPLE)
    sent_count = sum(reader.send_message(counters={"frames": 1}, note="x" * 500) for _ in range(2000))
    assert time.perf_counter() - begin_s < 5.0
    assert reader.dropped > 0
    assert sent_count < 2000
    received = b"".join(iter(lambda: page.receive_samples(64), b""))
    assert len(received) // 64 + reader.dropped == 40_000
    assert len(page.receive_messages()) == sent_count
    reader.close()
    page.close_here()


def test_replay_stops_at_the_end_and_play_restarts_it():
    """While the recording is still being read, the replay waits at the end of the samples that are known so far."""
    playhead = Playhead(speed=4.0)
    assert not playhead.advance(0.5, 10.0, is_complete=True)
    assert not playhead.advance(0.5, 3.0, is_complete=False)
    assert playhead.advance(0.5, 3.0, is_complete=True)
    assert not playhead.advance(0.5, 3.0, is_complete=True)
    playhead.apply(Play(), 3.0)
    assert playhead == Playhead(speed=4.0)
