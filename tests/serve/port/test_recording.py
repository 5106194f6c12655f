"""The file of a recording: what it holds, what ends it, what is refused."""

import pytest

from isocharge.common.errors import OutputError, OutputExists, RecordingError
from isocharge.serve import Chunk, RecordedClock, Recorder, Recording

pytestmark = pytest.mark.xdist_group("clock")

CHUNKS = [Chunk(bytes([k, 255 - k]), 1e9 + 0.1 * k, 1000 * k, 1.5 if k == 3 else 0.0) for k in range(5)]


@pytest.fixture
def recorded(tmp_path):
    """A recording of five chunks with 0 to 4 records and, before the third chunk, a request for a new tare."""
    path = tmp_path / "touch.rec"
    with Recorder(path, "linear/1", "every", {"tare": {"frames": 10}}) as recorder:
        for number, chunk in enumerate(CHUNKS):
            if number == 2:
                recorder.tare()
            recorder.chunk(chunk, [f'{{"timestamp": 1.0, "latency_us": {10.0 * k}}}' for k in range(number)])
    return path


def test_header_says_how_it_was_recorded(recorded):
    recording = Recording(recorded)
    assert (recording.model, recording.policy, recording.device) == ("linear/1", "every", {"tare": {"frames": 10}})


def test_events_are_those_that_were_recorded(recorded):
    events = list(Recording(recorded).events())
    assert [event.chunk for event in events] == [*CHUNKS[:2], None, *CHUNKS[2:]]
    assert [len(event.latencies_us) for event in events] == [0, 1, 0, 2, 3, 4]


def test_clock_of_a_replay_stands_where_it_stood(recorded):
    clock = RecordedClock()
    clock.set(list(Recording(recorded).events())[3])
    assert [clock(), clock(), clock()] == [2000, 2000 + 10_000, 2000]


@pytest.mark.parametrize("cut", [1, 10, 30])
def test_unfinished_line_is_ignored(recorded, cut):
    whole = list(Recording(recorded).events())
    recorded.write_bytes(recorded.read_bytes()[:-cut])
    *events, last = Recording(recorded).events()
    assert events == whole[:-1]
    assert last == (CHUNKS[-1], whole[-1].latencies_us[:-1])


def test_recorder_overwrites_nothing(tmp_path):
    path = tmp_path / "touch.rec"
    path.write_text("mine")
    with pytest.raises(OutputExists), Recorder(path, "m/1", "every", {}):
        pass
    assert path.read_text() == "mine"


def test_recorder_needs_its_folder(tmp_path):
    with pytest.raises(OutputError, match="cannot be written"), Recorder(tmp_path / "no" / "x", "m/1", "every", {}):
        pass


@pytest.mark.parametrize("text", ["", "hello\n", "{}\n", "[1]\n", '{"isocharge_recording": 1}\n'])
def test_recording_that_is_none(tmp_path, text):
    path = tmp_path / "touch.rec"
    path.write_text(text)
    with pytest.raises(RecordingError, match="expected a recording of `serve stream --record`"):
        Recording(path)
    with pytest.raises(RecordingError):
        Recording(tmp_path / "none")


def test_recording_of_another_version(tmp_path):
    path = tmp_path / "touch.rec"
    path.write_text('{"isocharge_recording": 9, "model": "m/1", "policy": "every", "device": {}}\n')
    with pytest.raises(RecordingError, match=r"version 9 is not supported \(this version reads 1\)"):
        Recording(path)


def test_damaged_line_in_the_middle_is_named(recorded):
    lines = recorded.read_text().split("\n")
    recorded.write_text("\n".join([*lines[:5], "garbage", *lines[5:]]))
    with pytest.raises(RecordingError, match="line 6: damaged"):
        list(Recording(recorded).events())


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
def test_line_of_foreign_json_is_damaged(recorded, line):
    first, *lines = recorded.read_text().split("\n")
    recorded.write_text("\n".join([first, line, *lines]))
    with pytest.raises(RecordingError, match="line 2: damaged"):
        list(Recording(recorded).events())


@pytest.mark.parametrize(
    "header",
    [
        "[" * 100_000,
        '{"isocharge_recording": 1, "model": 5, "policy": "every", "device": {}}',
        '{"isocharge_recording": 1, "model": "m/1", "policy": ["every"], "device": {}}',
        '{"isocharge_recording": 1, "model": "m/1", "policy": "some", "device": {}}',
        '{"isocharge_recording": 1, "model": "m/1", "policy": "every", "device": []}',
        '{"isocharge_recording": [], "model": "m/1", "policy": "every", "device": {}}',
        "x" * 3_000_000,
    ],
)
def test_headers_of_the_wrong_types(tmp_path, header):
    path = tmp_path / "touch.rec"
    path.write_text(header + "\n")
    with pytest.raises(RecordingError, match="expected a recording of") as caught:
        Recording(path)
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize(
    "line",
    [
        "[" * 100_000,
        '{"chunk": [1e9, 5, 0.0, 7]}',
        '{"chunk": [1e9, 5, NaN, "YWJj"]}',
        '{"chunk": [1e300, 5, 0.0, "YWJj"]}',
        '{"chunk": [1e9, 11111111111111111111111, 0.0, "YWJj"]}',
        '{"chunk": [true, 5, 0.0, "YWJj"]}',
        '{"timestamp": 1, "latency_us": 1e300}',
        '{"timestamp": 1, "latency_us": "1_0"}',
        '{"chunk": [1e9, 5, 0.0, "' + "A" * 3_000_000 + '"]}',
    ],
)
def test_lines_that_no_recorder_writes(recorded, line):
    head, *rest = recorded.read_text().splitlines()
    recorded.write_text("\n".join([head, line, *rest]) + "\n")
    with pytest.raises(RecordingError, match="line 2: damaged") as caught:
        list(Recording(recorded).events())
    assert len(str(caught.value)) < 600
