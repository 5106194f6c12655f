"""Parsing of lines of text: examples of each notation, recognition of the layout, and damaged lines."""

import math
import pickle
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve import AutoParser, Frame, encode_frame, encode_text
from isocharge.serve.frames.frame import SequenceGaps
from isocharge.serve.frames.text import TextParser
from isocharge.serve.frames.text_lines import TEXT_FORMATS, Notation, parse_line
from isocharge.serve.port.device_clock import DeviceClock
from isocharge.serve.port.source import Chunk

README_OF_TELEPLOT = [
    ("myValue:1234", ("myValue",), (1234.0,)),
    ("myValue:1234|", ("myValue",), (1234.0,)),
    ("myValue:12.34e+2", ("myValue",), (1234.0,)),
    ("myValue:1627551892437:1234", ("t_ms", "myValue"), (1627551892437.0, 1234.0)),
    ("myValue:1234§km²", ("myValue",), (1234.0,)),
    ("myValue:1627551892444:1;1627551892555:2;1627551892666:3", ("t_ms", "myValue"), (1627551892666.0, 3.0)),
    ("myValue:1234;5678;9012", ("myValue",), (9012.0,)),
    ("myValue:1627551892437:1234§km²|g", ("t_ms", "myValue"), (1627551892437.0, 1234.0)),
]


@pytest.mark.parametrize(("text", "names", "values"), README_OF_TELEPLOT)
def test_documented_teleplot_lines(text, names, values):
    """According to the README of Teleplot, each line on a serial port begins with >."""
    assert parse_line(f">{text}\r".encode()) == (Notation.teleplot, names, values)


@pytest.mark.parametrize("text", [">myValue:hello|t", ">trajectory:12.3:45.67|xy", "", "  \r", "# a comment: 12"])
def test_blank_and_comment_lines_are_no_readings(text):
    assert parse_line(text.encode()).notation is Notation.nothing


@pytest.mark.parametrize(
    ("text", "names", "values"),
    [
        ("801.2,799.5,-803.3", (), (801.2, 799.5, -803.3)),
        ("801.2, 799.5 , 803.3,", (), (801.2, 799.5, 803.3)),
        ("801;799;803", (), (801.0, 799.0, 803.0)),
        ("801\t799 803", (), (801.0, 799.0, 803.0)),
        ("[801, 799.5, 1e3]", (), (801.0, 799.5, 1000.0)),
        ("A:801.2,B:-7", ("A", "B"), (801.2, -7.0)),
        ("A: 801.2  B: 7", ("A", "B"), (801.2, 7.0)),
        ("A=801.2; B=7", ("A", "B"), (801.2, 7.0)),
        ('{"seq": 3, "A": 1.5, "note": "x", "ok": true}', ("seq", "A"), (3.0, 1.5)),
        ('{"charge": {"A": 1, "B": 2}, "q": [3, 4]}', ("charge.A", "charge.B", "q.0", "q.1"), (1.0, 2.0, 3.0, 4.0)),
        ("seq,t_us,A,B", ("seq", "t_us", "A", "B"), ()),
    ],
)
def test_lines_of_each_notation(text, names, values):
    assert parse_line(text.encode())[1:] == (names, values)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("801.2,,803", "could not convert string to float: ''"),
        ("1_0,2", "expected a number, got '1_0'"),
        ("A:1,A:2", "expected name:value, got 'A:2'"),
        ("A:1:2,B", "expected name:value, got 'A:1:2,B'"),
        (">A", "expected >name:value, got '>A'"),
        (">A:1:2:3", "expected >name:time:value, got '>A:1:2:3'"),
        ('{"A": "x"}', "expected numbers, got"),
        ("{", "Expecting property name"),
        ("1,two,3", "could not convert string to float: 'two'"),
        ("\xff\xfe", "can't decode byte 0xff"),
    ],
)
def test_damaged_line_of_text_is_refused_with_the_reason(text, reason):
    with pytest.raises(ValueError, match=reason):
        parse_line(text.encode("latin-1"))


def feed(*lines, parser=None):
    """Return the frames in whole lines. A line feed comes first, because a parser drops an incomplete first line."""
    return (parser or TextParser()).feed("".join(f"\n{line}" for line in lines).encode() + b"\n")


@pytest.mark.parametrize("line", ['{"A": %s, "B": 1, "C": 2}', "[%s, 1, 2]", "A:%s,B:1,C:2", "%s,1,2"])
def test_number_of_hundreds_of_digits_is_infinite_in_every_notation(line):
    assert parse_line((line % ("9" * 400)).encode()).values == (math.inf, 1.0, 2.0)


def test_layout_is_recognised_from_the_first_good_lines():
    parser = TextParser()
    assert feed("booting v1.2 ...", "3.3,801.2", "801.0,799.0,803.0", "801.1,799.1,803.1", parser=parser) == []
    frames = feed("801.2,799.2,803.2", "801.3,799.3,803.3", parser=parser)
    assert [frame.values[0] for frame in frames] == [801.0, 801.1, 801.2, 801.3]
    assert parser.format == "text, CSV: 3 columns without names"
    counts = parser.counts
    assert (counts.frames, counts.malformed, counts.resyncs) == (4, 2, 1)


def test_header_names_the_columns():
    rows = [f"{number},{number * 1000},1,2,3" for number in range(4)]
    frames = feed("seq,t_us,A,B,C", *rows)
    assert frames[0] == Frame(0, 0, (1.0, 2.0, 3.0), names=("A", "B", "C"))
    assert [(frame.seq, frame.t_us) for frame in frames] == [(0, 0), (1, 1000), (2, 2000), (3, 3000)]


def test_repeated_header_after_a_reset_of_the_board_is_ignored():
    frames = feed("A,B", "1,2", "3,4", "5,6", "A,B", "7,8")
    assert [frame.values for frame in frames] == [(1, 2), (3, 4), (5, 6), (7, 8)]


def test_columns_are_named_by_the_device_file():
    frames = feed("7,12.5,801", "8,13.5,801", "9,14.5,801", parser=TextParser(("seq", "t_ms", "A")))
    assert frames[1] == Frame(8, 13500, (801.0,), names=("A",))


def cycles_of_lines(count):
    """Return the lines of cycles A, B, C with increasing times, ms. Their values are 0, 1, 2, then 100, 101, 102."""
    lines = []
    for cycle in range(count):
        for position, name in enumerate("ABC"):
            lines.append(f">{name}:{1000 + cycle}:{100 * cycle + position}")
    return lines


def test_frames_are_complete_cycles_if_the_first_line_is_missing():
    """A parser that starts with the line B must not join B and C of one cycle with A of the next cycle."""
    frames = feed(*cycles_of_lines(6)[1:])
    assert [frame.values for frame in frames[-3:]] == [(300, 301, 302), (400, 401, 402), (500, 501, 502)]
    assert [frame.t_us for frame in frames[-3:]] == [1003000, 1004000, 1005000]
    assert all(frame.values[0] + 2 == frame.values[2] for frame in frames)


def test_lost_line_of_a_cycle_costs_its_cycle_only():
    parser = TextParser()
    lines = cycles_of_lines(6)
    frames = feed(*lines[:12], *lines[13:], parser=parser)  # the fifth A is lost
    assert [frame.values[0] for frame in frames] == [0, 100, 200, 300, 500]
    assert parser.counts.malformed == 1


def test_line_of_another_layout_is_dropped_and_counted():
    parser = TextParser()
    frames = feed("1,2,3", "1,2,3", "1,2,3", "1,2", "A:1", "1,2,3", parser=parser)
    assert len(frames) == 4
    assert (parser.counts.malformed, parser.counts.resyncs) == (2, 1)


FRAMES = st.builds(
    Frame,
    seq=st.integers(0, 2**16 - 1),
    t_us=st.integers(0, 2**32 - 1),
    values=st.tuples(*[st.floats(-1e4, 1e4, width=32)] * 3),
)


@settings(derandomize=True)
@given(FRAMES, st.sampled_from(sorted(TEXT_FORMATS)))
def test_text_lines_round_trip_in_every_notation(frame, notation):
    parsed = TextParser().feed(b"\n" + encode_text(frame, notation) * 3)
    assert len(parsed) == 3
    latest = parsed[-1]
    assert latest.values == pytest.approx(frame.values, rel=1e-6)
    if notation != "csv":
        assert latest.names == ("A", "B", "C")
        assert (latest.seq, latest.t_us) == (frame.seq, frame.t_us)


def test_unrecognised_lines_use_bounded_memory():
    parser = TextParser()
    parser.feed(b"8" * 100_000 + b"\n")
    for number in range(3000):
        parser.feed(f"A{number}:1\n".encode())
    assert len(pickle.dumps(parser)) < 20_000
    assert feed("1,2,3", "1,2,3", "1,2,3", parser=parser)[-1].values == (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    ("first_line", "frame_count", "malformed_count"),
    [("", 9, 1), ("A,B\n", 10, 0), ("# board\n", 10, 0), ("\n", 10, 0)],
)
def test_first_line_of_a_pipe_or_file_is_malformed_only_without_a_header_comment_or_blank_line(
    first_line, frame_count, malformed_count
):
    """Without such a line, the first numbers may be the rest of a line whose beginning is missing."""
    parser = AutoParser()
    frames = parser.feed((first_line + "801.2,799.5\n" * 10).encode())
    assert len(frames) == frame_count
    assert parser.counts.malformed == malformed_count


def test_first_line_without_its_beginning_is_dropped():
    parser = TextParser()
    frames = parser.feed(b"01.2,799,803\n801.2,799,803\n801.2,799,803\n801.2,799,803\n")
    assert [frame.values[0] for frame in frames] == [801.2] * 3
    parser.feed(b"801.2,799,8")
    parser.reset()
    assert parser.feed(b"3,9,8\n801.2,799,803\n")[0].values[0] == 801.2


def sentence(content):
    """Return a sentence as in NMEA 0183, with the exclusive or of the bytes between $ and * as its checksum."""
    checksum = 0
    for byte in content.encode():
        checksum ^= byte
    return f"${content}*{checksum:02X}"


def test_sentences_with_their_checksum():
    parser = TextParser()
    good_lines = [sentence(f"PZT,{number},801.2,-799.5") for number in range(4)]
    line_with_invalid_checksum = sentence("PZT,9,1,2")[:-1] + "g"
    frames = feed(*good_lines, line_with_invalid_checksum, parser=parser)
    assert [frame.values for frame in frames] == [(number, 801.2, -799.5) for number in range(4)]

    line_with_wrong_checksum = sentence("PZT,9,1,2").replace("9", "8")
    line_without_checksum = "$PZT,9,1,2"
    frames = feed(line_with_wrong_checksum, line_without_checksum, parser=parser)
    assert frames[0].values == (9, 1, 2)
    assert parser.counts.malformed == 2


@pytest.mark.parametrize(
    ("name", "unit", "modulus"),
    [
        ("t_ms", 1, 1 << 16),
        ("t_ms", 1, 1 << 32),
        ("t_us", 1000, 1 << 16),
        ("t_us", 1000, 1 << 32),
        ("t_s", 0.001, 4294.967296),
        ("t_ms", 1, 4294967.296),
    ],
)
def test_clock_in_text_that_wraps(name, unit, modulus):
    """The width of the clock is not stated, for example if `millis()` has 16 bits. The time still increases."""
    start = modulus - 300 * unit
    parser = TextParser()
    clock = DeviceClock()
    times_us = []
    for number in range(200):
        sent = (start + 5 * number * unit) % modulus
        frames = feed(f"{name}:{sent:.6f},A:1", parser=parser)
        times = clock.read(Chunk(b"", 0.0, 0), [frame.t_us for frame in frames], parser.t_us_modulus)
        times_us += [time.device_us for time in times]
    assert clock.restarts == 0
    step_us = 5 * unit if name == "t_us" else 5000.0
    np.testing.assert_allclose(np.diff(times_us), step_us, atol=1.1)


def test_clock_in_text_that_restarts_has_not_wrapped():
    parser = TextParser()
    clock = DeviceClock()
    for number in [*range(1000, 1200), *range(20)]:
        frames = feed(f"t_ms:{5 * number},A:1", parser=parser)
        clock.read(Chunk(b"", 0.0, 0), [frame.t_us for frame in frames], parser.t_us_modulus)
    assert clock.restarts == 1


@pytest.mark.parametrize(
    ("begin", "end", "restarts"), [*((modulus - 20, modulus, 0) for modulus in (100, 256, 1000, 65536)), (290, 301, 1)]
)
def test_frame_counter_in_text_that_wraps_or_restarts(begin, end, restarts):
    parser = TextParser()
    gaps = SequenceGaps()
    for seq in [*range(begin, end), *range(20)]:
        for frame in feed(f"seq:{seq},A:1", parser=parser):
            gaps.update(frame.seq, parser.seq_modulus)
    assert (gaps.lost, gaps.repeated, gaps.restarts) == (0, 0, restarts)


ENCODERS = {"binary": encode_frame} | {name: partial(encode_text, notation=name) for name in TEXT_FORMATS}


@pytest.mark.parametrize("name", ENCODERS)
@pytest.mark.parametrize("start", [0, 7, 19])
def test_format_is_recognised_from_anywhere(name, start):
    frames = [Frame(seq, 1000 * seq, (800.0 + seq, -7.5, 3.25)) for seq in range(20)]
    data = b"".join(map(ENCODERS[name], frames))
    parser = AutoParser()
    parsed = parser.feed(data[start:])
    assert len(parsed) >= 17
    assert [frame.values[0] for frame in parsed] == [frame.values[0] for frame in frames[-len(parsed) :]]
    assert ("binary" if name == "binary" else "text") in parser.format


def test_bytes_before_recognition_count_as_dropped():
    parser = AutoParser()
    parser.feed(b"\xf0\x9f" * 500)
    assert (parser.counts.frames, parser.counts.bytes_dropped) == (0, 1000)
    assert parser.format == "nothing recognised yet"


def test_moduli_are_those_of_the_recognised_text():
    parser = AutoParser()
    for number in range(12):
        seq = (250 + number) % 256
        t_ms = (65_530 + number) % 65_536
        parser.feed(b"seq:%d,t_ms:%d,A:1\n" % (seq, t_ms))
    assert (parser.seq_modulus, parser.t_us_modulus) == (256, 65_536_000)
