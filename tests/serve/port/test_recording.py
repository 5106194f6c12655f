"""Files of recordings: their content, incomplete last lines, and files that are refused."""

import json
import os

import pytest

from isocharge.common.errors import OutputError, OutputExists, RecordingError
from isocharge.serve import Chunk, Recorder, Recording

CHUNKS = [
    Chunk(bytes([number, 255 - number]), 1e9 + 0.1 * number, 1000 * number, outage_s=1.5 if number == 3 else 0.0)
    for number in range(5)
]


@pytest.fixture
def recorded(tmp_path):
    """Return a recording of five chunks with 0 to 4 records. Before the third chunk, a new tare is requested."""
    path = tmp_path / "touch.rec"
    with Recorder(str(path), "linear/1", {"tare": {"frames": 10}}) as recorder:
        for number, chunk in enumerate(CHUNKS):
            if number == 2:
                recorder.event(tare=True)
            recorder.event(chunk=chunk)
            for _ in range(number):
                recorder.write('{"timestamp": 1.0, "latency_us": -1e15}')  # from a clock that begins in 1970
    return path


@pytest.mark.parametrize("cut", [1, 10, 30])
def test_unfinished_line_is_ignored(recorded, cut):
    *events, _last_record = Recording(str(recorded)).events()
    recorded.write_bytes(recorded.read_bytes()[:-cut])
    assert list(Recording(recorded).events()) == events


def test_recorder_refuses_a_file_that_exists_a_missing_folder_and_a_name_that_could_not_be_read(tmp_path):
    path = tmp_path / "touch.rec"
    path.write_text("mine")
    refused = ((path, "a", OutputExists), (tmp_path / "no" / "x", "a", OutputError), (tmp_path, "a\n", RecordingError))
    for refused_path, name, error in refused:
        with pytest.raises(error), Recorder(refused_path, "m/1", {}, name):
            pass
    assert path.read_text() == "mine"


HEADER = '"model": "m/1", "device": {}'
"""Keys of the first line of a recording besides its version."""


NO_RECORDING = "expected a recording of `serve stream --record`"


@pytest.mark.parametrize(
    ("first", "message"),
    [
        *(
            (first, NO_RECORDING)
            for first in (None, "", "hello", "\x89HDF", "{}", "[1]", "[" * 100_000, "x" * 3_000_000)
        ),
        *(
            (f'{{"isocharge_recording": {keys}}}', NO_RECORDING)
            for keys in (
                "1",
                '1, "model": 5, "device": {}',
                '1, "model": "m/1", "policy": "every", "device": {}',
                '1, "model": "m/1", "device": []',
                f"[], {HEADER}",
            )
        ),
        (f'{{"isocharge_recording": 9, {HEADER}}}', r"version 9 is not supported \(this version reads 1\)"),
    ],
)
def test_file_that_is_no_recording_is_refused(tmp_path, first, message):
    path = tmp_path / "touch.rec"
    if first is not None:
        path.write_text(f"{first}\n")
    with pytest.raises(RecordingError, match=message) as caught:
        Recording(path)
    assert len(str(caught.value)) < 600


def test_pipe_is_refused_instead_of_losing_its_first_chunks(tmp_path):
    os.mkfifo(tmp_path / "touch.rec")
    with pytest.raises(RecordingError, match="no regular file of that name"):
        Recording(tmp_path / "touch.rec")


NOT_LABELS = ["/any/path", "../x", "models/m/1", "m/../../x", "m", "m/1\n", "file://m/1", "~/m"]


@pytest.mark.parametrize("path", NOT_LABELS)
def test_recording_whose_model_is_a_path_is_refused(recorded, tmp_path, path):
    other = tmp_path / "other.rec"
    other.write_text(recorded.read_text().replace('"linear/1"', json.dumps(path), 1))
    with recorded.open("a") as file:
        file.write(json.dumps({"use": path}) + "\n")
    for key, recording in (("model", other), ("use", recorded)):
        with pytest.raises(RecordingError, match=f"{key}: expected the label NAME/VERSION of a model"):
            list(Recording(recording).events())


@pytest.mark.parametrize(
    "line",
    [
        "garbage",
        "5",
        "null",
        "[1]",
        "[" * 100_000,
        '{"timestamp": 1.0, "latency_us": "soon"}',
        '{"timestamp": 1, "latency_us": 1e300}',
        '{"chunk": [1.0, 2]}',
        '{"marker": [1e300, "y"]}',
        '{"chunk": ["no base64!", 1.0, 2, 0.0]}',
        '{"chunk": ["YWJj", 1e300, 5, 0.0]}',
        '{"chunk": ["YWJj", 1e9, 11111111111111111111111, 0.0]}',
        '{"chunk": ["YWJj", 1e9, 5, -1.0]}',
        '{"chunk": ["' + "A" * 3_000_000 + '", 1e9, 5, 0.0]}',
    ],
)
def test_error_message_contains_the_number_of_a_damaged_line(recorded, line):
    lines = recorded.read_text().split("\n")
    recorded.write_text("\n".join([*lines[:5], line, *lines[5:]]))
    with pytest.raises(RecordingError, match="line 6: damaged") as caught:
        list(Recording(recorded).events())
    assert len(str(caught.value)) < 600
