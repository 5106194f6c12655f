"""Tests of recordings: a replay computes the same records, also after interruptions and errors."""

import json
import os
import time
from itertools import count, islice

import pytest

from boards import encoded_frames, taps
from isocharge.common.errors import PortError
from isocharge.serve import (
    Chunk,
    Recorder,
    Recording,
    TouchStream,
    device_from_table,
    stream,
)
from isocharge.serve.live.recorded_stream import RecordedStream, replay
from isocharge.serve.port.recording import Marker

DEVICE = {"tare": {"frames": 10}, "leak": {"tau_s": 10.0}, "hum": {"frequency_Hz": 50.0}}
"""Content of the device file."""

CHUNK_BYTES = 37
"""Size of a chunk."""

CHUNK_INTERVAL_S = 0.0063
"""Time between two chunks, s."""


def chunks_of_presses(film):
    """Return the chunks of a stream with two presses, and an outage before chunk 40, between the presses.

    The chunks do not end at the ends of frames.
    """
    data = b"".join(encoded_frames(islice(taps(film, rest=21, press=19), 80)))
    chunks = []
    for begin in range(0, len(data), CHUNK_BYTES):
        time_s = CHUNK_INTERVAL_S * len(chunks)
        outage_s = 1.5 if len(chunks) == 40 else 0.0
        chunks.append(Chunk(data[begin : begin + CHUNK_BYTES], 1e9 + time_s, round(1e9 * time_s), outage_s))
    return chunks


def with_requests(chunks, requests):
    """Yield chunks. Before the chunks with some numbers, call the functions that make requests."""
    for number, chunk in enumerate(chunks):
        if number in requests:
            requests[number]()
        yield chunk


def record_presses(path, film, predictor):
    """Record the stream of `chunks_of_presses`, and yield its records as JSON. A new tare is requested at chunk 30."""
    live = RecordedStream(TouchStream(predictor, device_from_table(DEVICE, "test")))
    live.request_recording(Recorder(path, predictor.metadata.label, DEVICE))
    for record in live.follow(with_requests(chunks_of_presses(film), {30: live.request_tare})):
        yield record.to_json()


def replayed_lines(path, predictor):
    """Return the records of the replay of a recording as JSON."""
    recording = Recording(path)
    stream = TouchStream(predictor, device_from_table(recording.device, "recording"))
    return [record.to_json() for record in replay(recording, stream)]


def test_replay_repeats_the_records_bit_for_bit(tmp_path, film, predictor):
    path = tmp_path / "touch.rec"
    lines = [*record_presses(path, film, predictor)]
    assert len(lines) > 60
    records = [json.loads(line) for line in lines]
    assert {flag for record in records for flag in record["flags"]} >= {"tare", "reconnected"}
    assert any(record["contact"] for record in records)
    assert all(record["latency_us"] > 0 for record in records)
    assert [event.tare for event in Recording(path).events()].count(True) == 1
    assert replayed_lines(path, predictor) == lines


def test_replay_with_the_right_description_yields_the_records_that_the_recording_lacks(tmp_path, film, predictor):
    live = RecordedStream(TouchStream(predictor, device_from_table({"frames": {"format": "text"}}, "wrong")))
    live.request_recording(Recorder(tmp_path / "wrong.rec", predictor.metadata.label, {}))
    chunks = chunks_of_presses(film)
    with pytest.raises(PortError):
        list(live.follow(chunks))
    replayed = list(replay(Recording(tmp_path / "wrong.rec"), TouchStream(predictor), yields_all=True))
    assert len(replayed) == len(list(stream(chunks, predictor))) > 60


@pytest.mark.parametrize("function", ["lseek", "write"])
def test_replay_of_an_interrupted_recording_ends_with_the_last_record(tmp_path, film, predictor, monkeypatch, function):
    """Ctrl-C interrupts the recording of a chunk in a system call, before it has an effect; `write` has its effect."""
    path = tmp_path / "touch.rec"
    call_numbers = count()
    original_function = getattr(os, function)

    def interrupted_function(*arguments, **options):
        is_interrupted = next(call_numbers) == 30
        if function == "write" or not is_interrupted:
            result = original_function(*arguments, **options)
        if is_interrupted:
            raise KeyboardInterrupt
        return result

    monkeypatch.setattr(os, function, interrupted_function)
    lines = []
    with pytest.raises(KeyboardInterrupt):
        lines.extend(record_presses(path, film, predictor))
    monkeypatch.undo()
    assert 10 < len(lines) < 60
    assert replayed_lines(path, predictor) == lines


def test_recording_on_a_full_disk_remains_readable(tmp_path, film, predictor, fill_disk, caplog):
    """The disk becomes full in the middle of a line. The recording stops, but the stream continues."""
    path = tmp_path / "touch.rec"
    fill_disk(9000)
    lines = [*record_presses(path, film, predictor)]
    assert len(lines) > 60
    assert path.stat().st_size < 9000
    assert path.read_bytes().endswith(b"}\n")
    assert [entry.levelname for entry in caplog.records] == ["ERROR"]
    assert "recording stopped (No space left on device)" in caplog.text
    replayed = replayed_lines(path, predictor)
    assert 3 < len(replayed) < len(lines)
    assert replayed == lines[: len(replayed)]


def test_replay_in_real_time_ignores_a_step_of_the_wall_clock(tmp_path, predictor, monkeypatch):
    """A step by 8e10 s is longer than `time.sleep` accepts."""
    path = tmp_path / "touch.rec"
    with Recorder(path, predictor.metadata.label, {}) as recorder:
        for number, wall_s in enumerate((0.0, 0.1, 3600.2, 8e10, 0.4)):
            recorder.event(chunk=Chunk(b"A:1,B:2,C:3\n", wall_s, 10**8 * number))
    slept_s = []
    monkeypatch.setattr(time, "monotonic", lambda: sum(slept_s))
    monkeypatch.setattr(time, "sleep", slept_s.append)
    list(replay(Recording(path), TouchStream(predictor), real_time=True))
    assert sum(slept_s) == pytest.approx(0.4)


def test_recording_that_begins_later_restarts_the_stream(film, predictor, tmp_path):
    """A recording begins and ends on request, and has a marker. The replay gives the same records."""
    path = tmp_path / "later.rec"
    device = device_from_table(DEVICE, "test")
    stream = TouchStream(predictor, device)
    live = RecordedStream(stream)
    requests = {
        20: lambda: live.request_recording(Recorder(path, "linear/1", DEVICE)),
        30: lambda: live.request_marker(Marker(1e9, "now")),
        60: lambda: live.request_recording(None),
    }
    records = live.follow(with_requests(chunks_of_presses(film), requests))
    lines = [record.to_json() for record in records if live.recorder is not None]
    assert len(lines) > 20
    # The counters are those of the whole stream. The beginning of the recording and the outage each cut a frame.
    assert (stream.parser.counts.frames, stream.parser.counts.reconnects) == (78, 1)

    markers = []
    replayed = replay(Recording(path), TouchStream(predictor, device), on_marker=markers.append)
    assert [record.to_json() for record in replayed] == lines
    assert markers == [Marker(1e9, "now")]
    assert list(tmp_path.iterdir()) == [path]


def test_recording_that_begins_later_contains_the_header_of_the_board(film, predictor, tmp_path):
    """The film is held when the recording begins, for longer than a first tare is searched.

    An earlier recording was ended before any byte arrived.
    """
    path = tmp_path / "later.rec"
    live = RecordedStream(TouchStream(predictor))
    rows = taps(film, rest=300, press=1_000)
    lines = [b"C,A,B\n", *(f"{c:.3f},{a:.3f},{b:.3f}\n".encode() for a, b, c in islice(rows, 2_500))]
    chunks = [Chunk(line, 1e9 + 0.0125 * i, 12_500_000 * i) for i, line in enumerate(lines)]

    begin = lambda name: live.request_recording(Recorder(tmp_path / name, "linear/1", {}))  # noqa: E731
    requests = {150: lambda: (begin("empty.rec"), live.request_recording(None)), 400: lambda: begin(path.name)}
    records = list(live.follow(with_requests(chunks, requests)))
    for record in (records[350], records[-1]):
        assert (record.x_mm, record.y_mm) == pytest.approx((3.0, -2.0), abs=0.1)
    replayed = replayed_lines(path, predictor)
    assert replayed == [record.to_json() for record in records[-len(replayed) :]]
    assert len(replayed) == len(lines) - 400 - 1  # the first line may be incomplete
    assert list(Recording(tmp_path / "empty.rec").events()) == []
