"""The file with several streams."""

from pathlib import Path

import pytest

from isocharge.common.errors import ConfigError
from isocharge.serve.viewer.streams_file import StreamSettings, read_streams

ONE = '[[stream]]\nmodel = "linear"\nport = "board"\n'


def write(tmp_path, text):
    path = tmp_path / "streams.toml"
    path.write_text(text)
    return path


def test_streams_are_read(tmp_path):
    text = ONE + '[[stream]]\nname = "left"\nmodel = "m/linear"\nport = "socket://h:1"\nbaud = 9600\nrecord = "l.rec"\n'
    first, second = read_streams(write(tmp_path, text))
    assert first == StreamSettings("linear", "linear", str(tmp_path / "board"))
    assert second == StreamSettings(
        "left", str(tmp_path / "m/linear"), "socket://h:1", baud=9600, record=tmp_path / "l.rec"
    )


def test_absolute_ports_stay(tmp_path):
    (stream,) = read_streams(write(tmp_path, ONE.replace("board", "/dev/ttyACM0")))
    assert Path(stream.port) == Path("/dev/ttyACM0")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "'stream' is missing"),
        ("stream = []", "1 to 8"),
        (ONE.replace("port", "prot"), "unknown key"),
        (ONE + ONE, "name: expected another one"),
        (ONE + ONE.replace("linear", "other"), "port: expected another one"),
        (ONE + "baud = 0", "baud"),
        (ONE + 'name = "a\\nb"', "name: expected 1 to 100 printable characters"),
        (ONE + f'name = "{"x" * 101}"', "name: expected 1 to 100 printable characters"),
        ("".join(ONE.replace("linear", f"m{k}").replace("board", f"p{k}") for k in range(9)), "1 to 8"),
    ],
)
def test_wrong_files_say_why(tmp_path, text, reason):
    with pytest.raises(ConfigError, match=reason):
        read_streams(write(tmp_path, text))
