"""A recording gives the same records again, whatever happened while it was made."""

import errno
import json
import os
import time
from itertools import islice

import numpy as np
import pytest

from isocharge.errors import OutputError, OutputExists, RecordingError
from isocharge.serve import Chunk, Frame, Policy, RecordedClock, Recorder, Recording, TouchStream, encode_frame
from isocharge.serve.live.device import ANY_BOARD
from isocharge.serve.live.device_file import device_from_table

DEVICE = {"tare": {"frames": 10}, "leak": {"tau_s": 10.0}, "hum": {"frequency_Hz": 50.0}}


def chunks(film, cuts=37, outage_at=40):
    """Rest, a press, an outage, rest and a press, cut anyhow."""
    rng = np.random.default_rng(3)
    press = film.charge_pC([2.0], [1.0], [0.5])[0]
    rows = [rng.normal(0, 1, 3) + (press if k % 40 > 20 else 0.0) for k in range(80)]
    data = b"".join(encode_frame(Frame(k, 5000 * k, tuple(row))) for k, row in enumerate(rows))
    pieces = [data[i : i + cuts] for i in range(0, len(data), cuts)]
    return [
        Chunk(piece, 1e9 + 0.0063 * k, time.perf_counter_ns(), 1.5 if k == outage_at else 0.0)
        for k, piece in enumerate(pieces)
    ]


def record(path, film, predictor, stop=None):
    """Lines of JSON as they went out while recording."""
    touch, out = TouchStream(predictor, device_from_table(DEVICE, "test")), []
    with Recorder(path, "linear/1", "every", DEVICE) as recorder:
        for number, chunk in enumerate(chunks(film)):
            if number == 30:
                touch.tare()
                recorder.tare()
            lines = [made.to_json() for made in touch.feed(chunk)]
            recorder.chunk(chunk, lines)
            out += lines
            if number == stop:
                break
    return out


def replay(path, predictor):
    recording, clock, out = Recording(path), RecordedClock(), []
    touch = TouchStream(predictor, device_from_table(recording.device, "recording"), now_ns=clock)
    for event in recording.events():
        clock.set(event)
        if event.chunk is None:
            touch.tare()
        else:
            out += [made.to_json() for made in touch.feed(event.chunk)]
    return out


def test_replay_is_the_same_bit_for_bit(tmp_path, film, predictor):
    path = tmp_path / "touch.rec"
    lines = record(path, film, predictor)
    assert len(lines) > 60
    assert {flag for line in lines for flag in json.loads(line)["flags"]} >= {"tare", "reconnected"}
    assert any(json.loads(line)["contact"] for line in lines)
    assert all(json.loads(line)["latency_us"] > 0 for line in lines)
    assert replay(path, predictor) == lines


def test_header_says_how_it_was_made(tmp_path, film, predictor):
    path = tmp_path / "touch.rec"
    record(path, film, predictor)
    recording = Recording(path)
    assert (recording.model, recording.policy, recording.device) == ("linear/1", "every", DEVICE)


@pytest.mark.parametrize("cut", [1, 10, 100, 500])
def test_a_line_that_was_not_finished_is_ignored(tmp_path, film, predictor, cut):
    path = tmp_path / "touch.rec"
    lines = record(path, film, predictor)
    path.write_bytes(path.read_bytes()[:-cut])
    again = replay(path, predictor)
    assert again[: len(again) - 3] == lines[: len(again) - 3]
    assert len(again) > len(lines) - 6


def test_a_full_disk_leaves_a_readable_file(tmp_path, film, predictor, monkeypatch, caplog):
    """The disk takes half a line and then no more; the live path goes on."""
    path, write, room = tmp_path / "touch.rec", os.write, [9000]

    def write_until_full(descriptor, data):
        if not room[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        taken = write(descriptor, bytes(data)[: room[0]])
        room[0] -= taken
        return taken

    monkeypatch.setattr("isocharge.serve.port.recording.os.write", write_until_full)
    lines = record(path, film, predictor)
    assert len(lines) > 60
    assert path.stat().st_size < 9000
    assert path.read_bytes().endswith(b"}\n")
    assert [entry.levelname for entry in caplog.records] == ["ERROR"]
    assert "recording stopped (No space left on device)" in caplog.text
    again = replay(path, predictor)
    assert 3 < len(again) < len(lines)
    assert again == lines[: len(again)]


def test_nothing_is_overwritten(tmp_path):
    path = tmp_path / "touch.rec"
    path.write_text("mine")
    with pytest.raises(OutputExists), Recorder(path, "m/1", "every", {}):
        pass
    assert path.read_text() == "mine"


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(OutputError, match="cannot be written"), Recorder(tmp_path / "no" / "x", "m/1", "every", {}):
        pass


@pytest.mark.parametrize("text", ["", "hello\n", "{}\n", "[1]\n", '{"isocharge_recording": 1}\n'])
def test_what_is_no_recording(tmp_path, text):
    path = tmp_path / "touch.rec"
    path.write_text(text)
    with pytest.raises(RecordingError, match="expected a recording of `serve stream --record`"):
        Recording(path)
    with pytest.raises(RecordingError):
        Recording(tmp_path / "none")


def test_another_version(tmp_path):
    path = tmp_path / "touch.rec"
    path.write_text('{"isocharge_recording": 9, "model": "m/1", "policy": "every", "device": {}}\n')
    with pytest.raises(RecordingError, match=r"version 9 is not supported \(this version reads 1\)"):
        Recording(path)


def test_a_damaged_line_in_the_middle_is_said(tmp_path, film, predictor):
    path = tmp_path / "touch.rec"
    record(path, film, predictor)
    lines = path.read_text().split("\n")
    path.write_text("\n".join([*lines[:5], "garbage", *lines[5:]]))
    with pytest.raises(RecordingError, match="line 6: damaged"):
        replay(path, predictor)


@pytest.mark.parametrize(
    "line",
    [
        "5",
        "null",
        "[1]",
        "{}",
        '{"timestamp": 1.0}',
        '{"timestamp": 1.0, "latency_us": "soon"}',
        '{"chunk": [1.0, 2]}',
        '{"chunk": [1.0, 2, 0.0, "no base64!"]}',
        '{"chunk": [1.0, 1e999, 0.0, "AAAA"]}',
    ],
)
def test_a_line_of_json_that_is_none_of_ours_is_damaged_too(tmp_path, film, predictor, line):
    path = tmp_path / "touch.rec"
    record(path, film, predictor)
    first, *lines = path.read_text().split("\n")
    path.write_text("\n".join([first, line, *lines]))
    with pytest.raises(RecordingError, match="line 2: damaged"):
        list(Recording(path).events())


def test_latest_gives_a_record_for_the_newest_frame_of_a_chunk(predictor):
    path = TouchStream(predictor, ANY_BOARD, policy=Policy.latest)
    data = b"".join(encode_frame(Frame(k, 5000 * k, (0.0, 0.0, 0.0))) for k in range(10))
    assert [made.seq for made in path.feed(Chunk(data, 0.0, 0))] == [9]
    assert (path.counts.records, path.counts.skipped) == (1, 9)
    every = TouchStream(predictor, ANY_BOARD)
    assert [made.seq for made in islice(every.feed(Chunk(data, 0.0, 0)), 20)] == list(range(10))
