"""Recordings, records, tables and MCAP files given as a port or for a replay: messages state the right command."""

from contextlib import nullcontext

import pytest

from isocharge.common.errors import InputError
from isocharge.serve import Port, Recorder, Recording, open_source
from isocharge.serve.port.file_source import Chunk, FileSource
from isocharge.serve.record.formats import csv_header


def recording(path):
    with Recorder(path, "linear/1", {}) as recorder:
        recorder.event(chunk=Chunk(b"A:1,B:2,C:3\n", 1.7e9, 0))


def table(text):
    return lambda path: path.write_text(text)


FOREIGN = {
    "touch.rec": (recording, r"got a recording; play it with: isocharge serve replay \S*touch.rec$"),
    "touch.jsonl": (
        table('{"timestamp": 1.0, "charge_pC": {}, "tare_pC": {}, "frame_id": "film"}\n'),
        r"got records of `serve stream`; .*--record touch\.rec",
    ),
    "touch.mcap": (
        lambda path: path.write_bytes(b"\x89MCAP0\r\n"),
        "got an MCAP file; .*isocharge serve replay touch.rec",
    ),
    "measured.txt": (
        table("x_mm,y_mm,force_N,A,B,C\n1,2,3,4,5,6\n"),
        "got a table of presses; .*isocharge serve predict MODEL .*--port - <",
    ),
    "semicolons.csv": (table("x_mm;y_mm;force_N;A;B;C\n1;2;0,5;4;5;6\n"), "got a table of presses"),
    "touch.csv": (table(csv_header("ABC", ("track", "follow")) + "\n"), "got records of `serve stream`"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_foreign_file_as_a_port_is_refused_with_the_command_that_reads_it(name, tmp_path):
    write, message = FOREIGN[name]
    write(tmp_path / name)
    with pytest.raises(InputError, match=message), open_source(str(tmp_path / name)):
        pass
    with pytest.raises(InputError, match=message) if name != "touch.rec" else nullcontext():
        Recording(tmp_path / name)


def test_lines_with_the_names_of_a_table_are_read_from_stdin_but_a_recording_is_not(tmp_path):
    """The error of the file advises this."""
    path = tmp_path / "board.csv"
    path.write_text("A,B,C,flags\n1,2,3,0\n")
    with pytest.raises(InputError, match="--port - <"), open_source(str(path)):
        pass
    with path.open("rb") as file:
        assert next(iter(FileSource(file.fileno(), "-"))).data == path.read_bytes()
    recording(tmp_path / "touch.rec")
    with (tmp_path / "touch.rec").open("rb") as file, pytest.raises(InputError, match="got a recording"):
        next(iter(FileSource(file.fileno(), "-")))


@pytest.mark.parametrize(
    "text",
    [
        "seq,t_us,A,B,C\n1,2,3,4,5\n",
        "801.2,799.5,803.3\n",
        "A,B,C\n1,2,3\n",
        '{"seq": 1, "A": 801.2}\n',
        '{"timestamp": 1.5, "charge_pC": [1, 2, 3]}\n',
        "\x01\x02\x03\x00",
    ],
)
def test_bytes_of_a_board_in_a_file_are_read_by_a_stream_only(tmp_path, text):
    for name in ("lines.csv", "lines.txt"):
        path = tmp_path / name
        path.write_text(text)
        with open_source(str(path)) as source:
            assert b"".join(chunk.data for chunk in source) == text.encode()
    with pytest.raises(InputError, match="expected a port, got a file; only `isocharge serve stream`"), Port(str(path)):
        pass
