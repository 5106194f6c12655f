"""Recordings, records, tables, MCAP and Parquet files given as a port, whose messages state the right command."""

import pytest

from isocharge.common.errors import InputError, RecordingError
from isocharge.serve import Port, Recording, open_source
from isocharge.serve.port.file_source import FileSource
from isocharge.serve.record.formats import csv_header

RECORDING = b'{"isocharge_recording": 1, "model": "linear/1", "device": {}}\n'

FOREIGN = {
    "touch.rec": (RECORDING, r"got a recording; play it with: isocharge serve replay \S*touch.rec$"),
    "touch.jsonl": (
        b'{"timestamp": 1.0, "charge_pC": {}, "tare_pC": {}, "frame_id": "film"}\n',
        r"got records of `serve stream`; .*--record touch\.rec",
    ),
    "touch.mcap": (b"\x89MCAP0\r\n", "got an MCAP file; .*isocharge serve replay touch.rec"),
    "presses.parquet": (b"PAR1", "got a Parquet file; .*isocharge serve predict MODEL"),
    "measured.txt": (
        b"x_mm,y_mm,force_N,A,B,C\n1,2,3,4,5,6\n",
        "got a table of presses; .*isocharge serve predict MODEL .*--port - <",
    ),
    "semicolons.csv": (b"x_mm;y_mm;force_N;A;B;C\n1;2;0,5;4;5;6\n", "got a table of presses"),
    "touch.csv": (csv_header(("A", "B", "C")).encode(), "got a table of presses"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_foreign_file_as_a_port_is_refused_with_the_command_that_reads_it(name, tmp_path):
    content, message = FOREIGN[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message), open_source(str(tmp_path / name)):
        pass


def test_recording_on_stdin_is_refused(tmp_path):
    (tmp_path / "touch.rec").write_bytes(RECORDING)
    with (tmp_path / "touch.rec").open("rb") as file, pytest.raises(InputError, match="got a recording"):
        FileSource(file.fileno(), "-")


def test_lines_of_a_board_with_a_name_of_a_table_are_read_from_stdin(tmp_path):
    """The error of the file advises this."""
    path = tmp_path / "board.csv"
    path.write_text("A,B,C,flags\n1,2,3,0\n")
    with pytest.raises(InputError, match="--port - <"), open_source(str(path)):
        pass
    with path.open("rb") as file:
        assert next(iter(FileSource(file.fileno(), "-"))).data == path.read_bytes()


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("lines.csv", "seq,t_us,A,B,C\n1,2,3,4,5\n"),
        ("lines.csv", "801.2,799.5,803.3\n"),
        ("lines.txt", "A,B,C\n1,2,3\n"),
        ("lines.txt", '{"seq": 1, "A": 801.2}\n'),
        ("lines.txt", '{"timestamp": 1.5, "charge_pC": [1, 2, 3]}\n'),
        ("frames.bin", "\x01\x02\x03\x00"),
    ],
)
def test_bytes_of_a_board_in_a_file_are_read(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    with open_source(str(path)) as source:
        assert b"".join(chunk.data for chunk in source) == text.encode()


def test_file_of_bytes_is_refused_as_a_port(tmp_path):
    path = tmp_path / "frames.bin"
    path.write_bytes(b"\x01\x02")
    with pytest.raises(InputError, match="expected a port, got a file; only `isocharge serve stream`"), Port(str(path)):
        pass


def test_replay_of_an_mcap_file_names_the_kind_of_the_file(tmp_path):
    path = tmp_path / "touch.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + bytes(range(256)))
    with pytest.raises(RecordingError, match=r"got an MCAP file; MCAP files hold results.*serve replay touch\.rec"):
        Recording(path)
