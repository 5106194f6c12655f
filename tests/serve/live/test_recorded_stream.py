"""A recording gives the same records again, whatever happened meanwhile."""

import base64
import json
import os
import time
from itertools import count

import numpy as np
import pytest

from isocharge.common.errors import RecordingError
from isocharge.serve import (
    Chunk,
    Frame,
    Predictor,
    RecordedClock,
    Recorder,
    Recording,
    TouchStream,
    device_from_table,
    encode_frame,
    find_model,
    load_model,
)
from isocharge.serve.live.recorded_stream import RecordedStream, replay
from isocharge.serve.port.recording import Marker, NewModel

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


def following(path, chunks, predictor, table):
    """Lines of JSON as they go out while recording, with a new tare before chunk 30."""
    stream = TouchStream(predictor, device_from_table(table, "test"))
    with Recorder(path, predictor.metadata.label, "every", table) as recorder:
        live = RecordedStream(stream, recorder)

        def asking():
            for number, chunk in enumerate(chunks):
                if number == 30:
                    live.request_tare()
                yield chunk

        yield from (record.to_json() for record in live.follow(asking()))


def record(path, film, predictor):
    return list(following(path, chunks(film), predictor, DEVICE))


def played(path, predictor):
    """Lines of a recording that is played again."""
    recording, clock = Recording(path), RecordedClock()
    stream = TouchStream(predictor, device_from_table(recording.device, "recording"), now_ns=clock)
    return [record.to_json() for record in replay(recording, stream, clock)]


def test_replay_repeats_the_records_bit_for_bit(tmp_path, film, predictor):
    path = tmp_path / "touch.rec"
    lines = record(path, film, predictor)
    assert len(lines) > 60
    assert {flag for line in lines for flag in json.loads(line)["flags"]} >= {"tare", "reconnected"}
    assert any(json.loads(line)["contact"] for line in lines)
    assert all(json.loads(line)["latency_us"] > 0 for line in lines)
    assert sum(event.chunk is None for event in Recording(path).events()) == 1
    assert played(path, predictor) == lines


@pytest.mark.parametrize("leak", [{}, {"leak": {"tau_s": 10.0}}])
def test_replay_of_a_warming_film_repeats_the_records_bit_for_bit(tmp_path, leak):
    """A released model of four electrodes; the common charge rises to 60 pC while one press is held."""
    path, model = tmp_path / "touch.rec", load_model(find_model("four-25um-uniaxial"))
    predictor, press = Predictor("four-25um-uniaxial"), model.golden.charge_pC[0].astype(float)
    rows = [np.zeros(4)] * 200 + [press + 60.0 * k / 300 for k in range(300)]
    data = [encode_frame(Frame(k, 5000 * k, tuple(row.tolist()))) for k, row in enumerate(rows)]
    arrived = [Chunk(frame, 1e9 + 0.005 * k, time.perf_counter_ns()) for k, frame in enumerate(data)]
    lines = list(following(path, arrived, predictor, {"tare": {"frames": 10}, "common_mode": {}} | leak))
    assert "thermal" in json.loads(lines[-1])["flags"]
    assert played(path, predictor) == lines


@pytest.mark.parametrize("where", ["base64.b64encode", "json.dumps", "os.lseek", "os.write"])
def test_replay_of_an_interrupted_recording_ends_with_the_last_record(tmp_path, film, predictor, monkeypatch, where):
    """Ctrl-C while the thirtieth chunk is written: before a part of it, or after."""
    path, calls = tmp_path / "touch.rec", count()
    module, name = where.split(".")
    act = getattr({"base64": base64, "json": json, "os": os}[module], name)

    def interrupted(*arguments, **options):
        done = act(*arguments, **options) if where == "os.write" else None
        if next(calls) == 30:
            raise KeyboardInterrupt
        return done if where == "os.write" else act(*arguments, **options)

    monkeypatch.setattr(where, interrupted)
    lines = []
    with pytest.raises(KeyboardInterrupt):
        lines.extend(following(path, chunks(film), predictor, DEVICE))
    monkeypatch.undo()
    assert 10 < len(lines) < 60
    assert played(path, predictor) == lines


def test_recording_on_a_full_disk_remains_readable(tmp_path, film, predictor, fill_disk, caplog):
    """The disk takes half a line and then no more; the live path goes on."""
    path = tmp_path / "touch.rec"
    fill_disk(9000)
    lines = record(path, film, predictor)
    assert len(lines) > 60
    assert path.stat().st_size < 9000
    assert path.read_bytes().endswith(b"}\n")
    assert [entry.levelname for entry in caplog.records] == ["ERROR"]
    assert "recording stopped (No space left on device)" in caplog.text
    again = played(path, predictor)
    assert 3 < len(again) < len(lines)
    assert again == lines[: len(again)]


@pytest.mark.parametrize("real_time", [False, True])
def test_replay_in_real_time_waits_between_chunks(tmp_path, film, predictor, monkeypatch, real_time):
    path, now = tmp_path / "touch.rec", [5e9]
    record(path, film, predictor)
    recording, clock = Recording(path), RecordedClock()
    monkeypatch.setattr(time, "time", lambda: now[0])
    monkeypatch.setattr(time, "sleep", lambda seconds: now.append(now.pop() + seconds))
    stream = TouchStream(predictor, device_from_table(recording.device, "recording"), now_ns=clock)
    assert sum(1 for _ in replay(recording, stream, clock, real_time=real_time)) > 60
    count = sum(event.chunk is not None for event in recording.events())
    assert now[0] - 5e9 == pytest.approx(0.0063 * (count - 1) if real_time else 0.0, abs=1e-5)


@pytest.mark.parametrize(("asked_for", "taken_since"), [("linear/1", []), ("linear/2", [NewModel("linear/1")])])
def test_recording_that_begins_later_restarts_the_stream(film, predictor, tmp_path, asked_for, taken_since):
    """Begun and ended on request, with a marker: its replay gives its records, and the totals go on."""
    path, device = tmp_path / "later.rec", device_from_table(DEVICE, "test")
    stream, pieces = TouchStream(predictor, device), chunks(film)
    live = RecordedStream(stream)

    def asking():
        for number, chunk in enumerate(pieces):
            if number == 20:
                for name in ("never.rec", "later.rec"):  # what is asked for anew takes the place of what waits
                    live.request_recording(Recorder(tmp_path / name, asked_for, "every", DEVICE))
            if number == 30:
                live.request_marker(Marker(1e9, "now"))
            if number == 60:
                live.request_recording(None)
            yield chunk

    lines = [record.to_json() for record in live.follow(asking()) if live.recorder is not None]
    assert len(lines) > 20
    assert stream.totals().frames == 78  # outage and beginning cut a frame in two each
    clock, markers = RecordedClock(), []
    again = TouchStream(predictor, device, now_ns=clock)
    events = replay(Recording(path), again, clock, on_marker=markers.append, load=lambda _: predictor)
    replayed = [record.to_json() for record in events]
    assert [event for event in Recording(path).events() if isinstance(event, NewModel)] == taken_since
    assert (replayed, markers, [*tmp_path.iterdir()]) == (lines, [Marker(1e9, "now")], [path])


@pytest.mark.parametrize("marker", ['["x", "y"]', "[1.0]", "[1.0, 2]", '[1e300, "y"]', "1", f'[1.0, "{"x" * 2000}"]'])
def test_damaged_marker_raises_an_error_with_the_reason(film, predictor, tmp_path, marker):
    path = tmp_path / "touch.rec"
    record(path, film, predictor)
    path.write_text(path.read_text() + f'{{"marker": {marker}}}\n')
    with pytest.raises(RecordingError, match="marker"):
        list(Recording(path).events())
