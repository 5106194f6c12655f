"""Typed structs from TOML and JSON. Errors state the position, the expected value and the given value."""

import json
import math
import re
from functools import partial
from typing import Annotated, Literal

import msgspec
import numpy as np
import pytest
from msgspec import Meta

from isocharge.common.errors import MAX_VALUE_CHARACTERS, DeviceError, SensorError
from isocharge.common.structs import (
    MAX_TOML_BYTES,
    Finite,
    NotNegative,
    Positive,
    Settings,
    Text,
    WrongKey,
    convert,
    parse_json,
    parse_toml,
    plain_values,
    read_json,
    read_toml,
)


class Auto(Settings, tag_field="format", tag="auto", frozen=True):
    columns: tuple[str, ...] = ()


class Binary(Settings, tag_field="format", tag="binary", frozen=True):
    length: Annotated[int, Meta(ge=1, le=100)]


class Part(Settings, frozen=True):
    name: Text
    at: Annotated[tuple[float, float], Meta(description="[x, y] in mm")] = (0.0, 0.0)


class Board(Settings, frozen=True):
    radius: Positive = 1.0
    share: NotNegative = 0.0
    offset: Finite = 0.0
    poisson: Annotated[float, Meta(gt=-1.0, le=0.5)] = 0.3
    frames: Auto | Binary = Auto()
    gain: Positive | dict[str, Positive] = 1.0
    order: Literal["little", "big"] = "little"
    parts: tuple[Part, ...] = ()
    pair: Annotated[tuple[Positive, ...], Meta(min_length=2, max_length=2)] = (1.0, 1.0)
    on: bool = True
    low: int = 0
    high: int = 1

    def __post_init__(self):
        if self.low > self.high:
            raise WrongKey("low", f"at most high ({self.high})", self.low)


class File(Settings, frozen=True):
    board: Board
    names: tuple[str, ...] = ()


def test_a_value_that_fits_is_taken():
    text = 'board = {radius = 2, gain = {A = 1.5, B = 2}, frames = {format = "binary", length = 3}}'
    board = parse_toml(text.encode("utf-8-sig"), "mine.toml", SensorError, File).board
    assert (board.radius, board.gain, board.frames, board.share) == (2.0, {"A": 1.5, "B": 2.0}, Binary(length=3), 0.0)
    assert parse_json(msgspec.json.encode(File(board=board)), "", SensorError, File).board == board


@pytest.mark.parametrize(
    ("board", "message"),
    [
        ({"radius": math.nan}, "board.radius: expected a positive number, got nan"),
        ({"offset": math.inf}, "board.offset: expected a finite number, got inf"),
        (
            {"offset": 10**400},
            f"board.offset: expected a finite number, got {'1' + '0' * (MAX_VALUE_CHARACTERS - 1)}...",
        ),
        ({"poisson": 0.6}, "board.poisson: expected a number above -1 to 0.5, got 0.6"),
        ({"low": 3, "high": 2}, "board.low: expected at most high (2), got 3"),
        ({"order": "odd"}, "board.order: expected one of big, little, got 'odd'"),
        ({"gain": {"A": 1, "B": 0}}, "board.gain.B: expected a positive number, got 0"),
        ({"frames": {"format": "morse"}}, "board.frames.format: expected one of auto, binary, got 'morse'"),
        ({"parts": [{"name": "a"}, {"name": ""}]}, "board.parts[1].name: expected a text of 1 to 1000 characters"),
        ({"parts": [{"name": "a", "at": [1]}]}, "board.parts[0].at: expected [x, y] in mm, got [1]"),
        ({"pair": [1, 2, 3]}, "board.pair: expected a list of 2 numbers, got [1, 2, 3]"),
        ({"radus": 1}, "unknown key 'board.radus'; did you mean 'radius'? Known are radius, share"),
        (3, "board: expected a table, got 3"),
    ],
)
def test_what_does_not_fit_is_named(board, message):
    with pytest.raises(SensorError, match=rf"^mine\.toml: {re.escape(message)}"):
        convert({"board": board}, File, "mine.toml", SensorError)
    if not isinstance(board, dict) or all(value == value and value not in (math.inf,) for value in board.values()):
        with pytest.raises(SensorError, match=rf"^mine\.json: {re.escape(message)}"):
            parse_json(msgspec.json.encode({"board": board}), "mine.json", SensorError, File)


def test_the_table_itself_is_named_without_a_path():
    for table, where, expected in (
        ({}, "mine.toml", "mine.toml: key 'board' is missing"),
        (3, "", "expected a table, got 3"),
    ):
        with pytest.raises(SensorError, match=f"^{expected}$"):
            convert(table, File, where, SensorError)


def test_messages_stay_short():
    nested: list = []
    for _ in range(100_000):
        nested = [nested]
    for value in ("x" * 1_000_000, nested, {f"key{i}": i for i in range(10_000)}):
        with pytest.raises(SensorError) as caught:
            convert({"board": value}, File, "", SensorError)
        assert len(str(caught.value)) < 3 * MAX_VALUE_CHARACTERS


TOML = partial(read_toml, description="a device file", error_class=DeviceError, target_type=dict)
JSON = partial(read_json, description="a list", error_class=DeviceError, target_type=list)


@pytest.mark.parametrize(
    ("read", "content", "message"),
    [
        (TOML, b"a = x", "not a TOML file: .*line 1"),
        (TOML, b"\xff", "not a TOML file: 'utf-8' codec can't decode byte 0xff in position 0"),
        (TOML, b"#" * (MAX_TOML_BYTES + 1), r"cannot be read \(larger than 262144 bytes\); expected a device file in"),
        (TOML, b"a = " + b"[" * 100_000, "not a TOML file"),
        (TOML, b"a." * 100_000 + b"a = 1", "not a TOML file: a key of more than 32 parts"),
        (TOML, b"'a b' . " * 30_000 + b"a = 1", "not a TOML file: a key of more than 32 parts"),
        *((JSON, data, "expected JSON, got") for data in (b"{", b"[" * 100_000, b"NaN", b"\xef", b"1" * 5000)),
    ],
)
def test_files_that_are_none(tmp_path, read, content, message):
    (tmp_path / "board").write_bytes(content)
    for path, expected in ((tmp_path / "board", message), (tmp_path, "cannot be read")):
        with pytest.raises(DeviceError, match=rf"^{path}: {expected}"):
            read(path)


@pytest.mark.parametrize("path", ["$.zzz", "$[0]", "$[...]"])
def test_key_that_imitates_the_path_of_a_message_is_named(path):
    key = f"a` - at `{path}"
    with pytest.raises(DeviceError, match=re.escape(key)):
        convert([{"name": "x", key: 1}], list[Part], "board.toml", DeviceError)


def test_nested_values_become_json_and_values_without_a_notation_null():
    value = {
        1.0: np.array([[1.0, np.nan], [np.inf, 4.0]]),
        "counts": (np.int64(3), np.bool_(True)),
        "deep": [{"x": np.float64(-np.inf)}, "text", None],
    }
    text = json.dumps(plain_values(value), allow_nan=False)
    assert json.loads(text) == {
        "1.0": [[1.0, None], [None, 4.0]],
        "counts": [3, True],
        "deep": [{"x": None}, "text", None],
    }
