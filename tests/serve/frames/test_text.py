"""Parsing of lines of text: examples of each notation, recognition of the layout, and damaged lines."""

import pickle
from functools import reduce
from operator import xor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve import AutoParser
from isocharge.serve.frames.device_clock import DeviceClock
from isocharge.serve.frames.line_notation import clean_text
from isocharge.serve.frames.text import TextParser
from isocharge.serve.frames.text_lines import line_values, parse_line
from isocharge.serve.port.file_source import Chunk

README_OF_TELEPLOT = [
    *(
        (f">myValue:{value}", ("myValue",), (1234.0,))
        for value in ("1234", "1234|", "12.34e+2", "1234§km²", "5;6;1234")
    ),
    (">myValue:1627551892437:1234", ("t_ms", "myValue"), (1627551892437.0, 1234.0)),
    (">myValue:1627551892444:1;1627551892555:2;1627551892666:3", ("t_ms", "myValue"), (1627551892666.0, 3.0)),
    (">myValue:1627551892437:1234§km²|g", ("t_ms", "myValue"), (1627551892437.0, 1234.0)),
]
"""Lines in the README of Teleplot. On a serial port, each line begins with >."""


def names_and_values(text):
    line = parse_line(clean_text(text))
    return line.names, line_values(line.pattern, line.text)


@pytest.mark.parametrize(
    ("text", "names", "values"),
    [
        *README_OF_TELEPLOT,
        ("ch[0] 7 ch[1] 3", ("ch[0]", "ch[1]"), (7.0, 3.0)),
        ("A=1.5&B=-2", ("A", "B"), (1.5, -2.0)),
        ("Sample #7: A=1.5 unit=nC t_ms=2", ("Sample", "A_nC", "t_ms"), (7.0, 1.5, 2.0)),
        ("1.5,-2*3A", ("", ""), (1.5, -2.0)),
        ("B=-2 C=3 T=23.5 C", ("B", "C", "T"), (-2.0, 3.0, 23.5)),  # C is an electrode, and then a degree
        ("A: 512 (3.5 pC), B: 498 (-2 pC)", ("", "A", "", "B"), (512.0, 3.5, 498.0, -2.0)),
        ('{"A":{"raw":5,"nC":3},"B":{"raw":4,"nC":2}}', ("", "A_nC", "", "B_nC"), (5.0, 3.0, 4.0, 2.0)),
        *((text, ("A",), (4.3,)) for text in ("A:4,3", "A = 4,3 pC", ">A:4,3", "T:25.11.2026 12:34:56 A:4,3")),
        (">A:1000:4,3§pC|g", ("t_ms", "A"), (1000.0, 4.3)),
        ("[00:00:12.345,678] A:1,5 B:2,5", ("t_s", "A", "B"), (12.345678, 1.5, 2.5)),
    ],
)
def test_names_and_values_of_a_line(text, names, values):
    assert names_and_values(text) == (names, values)


@pytest.mark.parametrize(
    "text", [">myValue:hello|t", ">trajectory:12.3:45.67|xy", ">path:1:2|xy,clr", "", "  \r", "# a comment: 12"]
)
def test_blank_and_comment_lines_are_no_readings(text):
    assert clean_text(text) == ""


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("801\x1b[2J,799", "printable characters"),
        ("$PZT,1*00", "checksum"),
    ],
)
def test_damaged_line_of_text_is_refused_with_the_reason(text, reason):
    with pytest.raises(ValueError, match=reason):
        parse_line(clean_text(text))


@pytest.mark.parametrize("text", ["booting v1.2 on ESP32-S3", "{", "ch3,A0", "10.0.0.1", "1_0", ">A", "ch-1,ch-2"])
def test_digits_in_words_are_no_numbers(text):
    assert parse_line(text).names == ()


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("A: + 3.5, B: - 2.5", (3.5, -2.5)),  # a board that prints each sign and then the magnitude
        ("- 3, -4,- 5", (-3.0, -4.0, -5.0)),
        ("-3.476E+00-3.443e+00+5.764E-01", (-3.476, -3.443, 0.5764)),
        ("A - 3.5 B - 2", (3.5, 2.0)),
        *((f"{start}{dash}1.5,2", (-1.5, 2.0)) for start in ("", "A:") for dash in "\u2212\u2013"),
        ("12:34:56.5 - 3.5", (45296.5, 3.5)),
    ],
)
def test_sign_with_blanks_before_its_number(text, values):
    """A minus between a word and a number may also be a dash."""
    assert names_and_values(text)[1] == values


@pytest.mark.parametrize("text", ["3.5  - 2.5   1.5", "3.5 pC - 2.5 pC", "3.5+ 2.5- 1.5+", "A:18,537 B:18,402 T:23.5"])
def test_minus_or_comma_that_may_be_a_part_of_a_number_or_a_separator_is_not_read(text):
    assert parse_line(clean_text(text)).names == ()


def feed(*lines, parser=None):
    """Return the frames in whole lines. A line feed comes first, because a parser drops an incomplete first line."""
    return (parser or TextParser()).feed("".join(f"\n{line}" for line in lines).encode() + b"\n")


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_unit_and_degrees_in_two_encodings(encoding):
    text = "".join(f"\nA: {k} µC, B: -2.5 µC, T: 23.5 °C" for k in range(12)) + "\n"
    frames = TextParser().feed(text.encode(encoding))
    assert [frame.values for frame in frames] == [(k, -2.5, 23.5) for k in range(12)]
    assert frames[-1].names == ("A_µC", "B_µC", "T")


def test_layout_is_recognised_from_the_first_good_lines():
    parser = TextParser()
    assert feed("booting v1.2 ...", "3.3,801.2", "801.0,799.0,803.0", "801.1,799.1,803.1", parser=parser) == []
    frames = feed("801.2,799.2,803.2", "801.3,799.3,803.3", parser=parser)
    assert [frame.values[0] for frame in frames] == [801.0, 801.1, 801.2, 801.3]
    assert (parser.counts.frames, parser.counts.malformed) == (4, 1)
    assert TextParser(("B", "A")).feed(b"\n801.0,799.0,803.0" * 9) == []


def test_lines_without_numbers_are_counted_if_they_are_too_many_for_headers():
    """Otherwise, a stream of such lines would wait for ever instead of reporting that it contains no frame."""
    parser = TextParser()
    feed("\nno sensor" * 70, parser=parser)
    assert parser.counts.malformed == 7


UNNAMED_NOTATIONS = [
    "{a};{b};{c}",
    "array([{a}, {b}, {c}])",
    "{{{a}, {b}, {c}}}",
    "{a} pC, {b} pC, {c} pC",
    "{a}pC {b}pC {c}pC",
    "{a} | {b} | {c}",
    "{a}/{b}/{c}",
    "Data: {a}, {b}, {c}",
    "RAW {a} {b} {c} END",
    "<{a},{b},{c}>",
    "{a},{b},{c},OK",
    ">{a},{b},{c},t",
    "touch;{a};{b};{c};idle",
    ">>> {a}, {b}, {c}",
    '"{a}","{b}","{c}"',
    "{a},{b},{c}\0",
    "\x02{a},{b},{c}\x03",
    "\x1b[2J\x1b[H{a} {b} {c}\x1b[K",
    "{a}\u00a0pC\u00a0{b}\u00a0pC\u00a0{c}\u00a0pC",
    "2026-11-25T12:34:56.789Z,{a},{b},{c}",
    "2026-11-25 12:34:56,789 INFO {a} {b} {c}",
    "[00:00:12.345,678] <inf> app: {a} {b} {c}",
    "\x1b[0;32mI (1234) film: {a}, {b}, {c}\x1b[0m",
]
"""Notations of a frame without names of the channels."""

NAMED_NOTATIONS = [
    "A: {a} pC, B: {b} pC, C: {c} pC",
    "A {a} pC B {b} pC C {c} pC",
    "A={a} B={b} C={c}",
    "A{a:+}B{b:+}C{c:+}",
    "A{a:e} B{b:e} C{c:e}",
    "A = {a} | B = {b} | C = {c} |",
    "A -> {a}, B -> {b}, C -> {c}",
    "A,{a},B,{b},C,{c}",
    "A;{a};B;{b};C;{c};OK",
    '"A",{a},"B",{b},"C",{c}',
    "$FILM,A,{a},B,{b},C,{c}",
    "A[{a}] B[{b}] C[{c}]",
    "A({a}), B({b}), C({c})",
    "{a} A, {b} B, {c} C",
    "{a},A,{b},B,{c},C",
    "12:34:56,A,{a},B,{b},C,{c}",
    "12:34:56 {a} A, {b} B, {c} C",
    "A,{a}\nB,{b}\nC,{c}",
    "12:34:56;A;{a}\n12:34:56;B;{b}\n12:34:56;C;{c}",
    "Sensor A: {a}, Sensor B: {b}, Sensor C: {c}",
    "{{'A': {a}, 'B': {b}, 'C': {c}}}",
    "Reading(A={a}, B={b}, C={c})",
    "A:{a};B={b};C {c}",
    '{{"A": "{a} pC", "B": "{b} pC", "C": "{c} pC"}}',
    ">A:{a},B:{b},C:{c}",
    "A......{a} B......{b} C......{c}",
    '{{"A":"{a}","B":"{b}","C":"{c}","state":"idle"}}',
    '<film A="{a}" B="{b}" C="{c}"/>',
    "<A>{a}</A><B>{b}</B><C>{c}</C>",
    '{{"q": {{"A": {a}, "B": {b}, "C": {c}}}, "state": "idle 3"}}',
    '{{"A": {{"q": {a}}}, "B": {{"q": {b}}}, "C": {{"q": {c}}}}}',
    "[12:34:56.789] A:{a} B:{b} C:{c}",
    "I (1234) film: A:{a}, B:{b}, C:{c}",
    'I (1234) film: {{"A": {a}, "B": {b}, "C": {c}}}',
]
"""Notations of a frame that name the channels A, B and C."""

NOTATIONS = {
    **dict.fromkeys(UNNAMED_NOTATIONS, ()),
    **dict.fromkeys(NAMED_NOTATIONS, "ABC"),
    "{a} uV\t{b} uV\t{c} uV": ("ch1_uV", "ch2_uV", "ch3_uV"),
    '[{{"unit": "nC", "q": {a}}}, {{"unit": "nC", "q": {b}}}, {{"unit": "nC", "q": {c}}}]': (
        "ch1_nC",
        "ch2_nC",
        "ch3_nC",
    ),
    "A: {a} C, B: {b} C, C: {c} C": ("A_coulomb", "B_coulomb", "C_coulomb"),
    **dict.fromkeys(
        [
            "A nC: {a} B nC: {b} C nC: {c}",
            "Film A [nC]: {a}, Film B [nC]: {b}, Film C [nC]: {c}",
            "A: {a} [nC], B: {b} [nC], C: {c} [nC]",
            "nC: A={a} B={b} C={c}",
            '{{"A": {{"q": {a}, "unit": "nC"}}, "B": {{"q": {b}, "unit": "nC"}}, "C": {{"q": {c}, "unit": "nC"}}}}',
            '{{"unit": "nC", "A": {a}, "B": {b}, "C": {c}}}',
        ],
        ("A_nC", "B_nC", "C_nC"),
    ),
    "Q[0]:{a} Q[1]:{b} Q[2]:{c}": ("Q[0]", "Q[1]", "Q[2]"),
    "Channel 1 = {a} nC, Channel 2 = {b} nC, Channel 3 = {c} nC": ("1_nC", "2_nC", "3_nC"),
    "CH 1: {a}\nCH 2: {b}\nCH 3: {c}": "123",
    "12:34:56.789 -> {{1: {a}, 4: {b}, 7: {c}}}": "147",
    "pad #0 {a} pC pad #1 {b} pC pad #2 {c} pC": "012",
    "[1] {a} [2] {b} [3] {c}": "123",
    "ch 1[{a}] ch 2[{b}] ch 3[{c}]": "123",
    '<ch id="1">{a}</ch><ch id="2">{b}</ch><ch id="3">{c}</ch>': "123",
}
"""Names of the channels by the notation of a frame."""

DECIMAL_COMMAS = [
    "{a};{b}; {c}",
    "2026-11-25 12:34:56.789;{a};{b};{c}",
    "{a} {b}\t{c}",
    "A:  {a}, B: {b}, C: {c}",
    "(A: {a}; B: {b}; C: {c})",
    '"A",{a},"B",{b},"C",{c}',
]
"""Notations that are also read with decimal commas."""

STATES = ["12 <{state}> {a} {b} {c}", "12 {state} {a} {b} {c}", "{state} -> {a}, {b}, {c}", "{a} ({state}) {b} {c}"]


@pytest.mark.parametrize("notation", STATES)
def test_word_that_changes_is_no_name(notation):
    lines = [notation.format(state=state, a=k, b=2, c=3) for k, state in enumerate(["idle", "touch"] * 6)]
    assert len(feed(*lines)) == 12


@pytest.mark.parametrize(("columns", "header"), [((), "n,T,A,B"), (("n", "T", "A", "B"), "")])
def test_names_of_the_counter_and_the_clock_in_a_header_have_their_meaning(columns, header):
    parser = TextParser(columns, {"n": "seq", "T": "t_ms"})
    frames = feed("", header, *[f"{k},{5 * k},{k}.5,-1.5" for k in range(5)], parser=parser)
    for k, frame in enumerate(frames):
        assert (frame.seq, frame.t_us, frame.values, frame.names) == (k, 5000 * k, (k + 0.5, -1.5), ("A", "B"))
    assert len(frames) == 5


LEVELS = st.tuples(*[st.integers(-9999, 9999).map(lambda value: value / 10)] * 3)


@pytest.mark.parametrize("notation", [*NOTATIONS, *DECIMAL_COMMAS])
@settings(derandomize=True, max_examples=4)
@given(st.lists(LEVELS, min_size=12, max_size=12), st.sampled_from(["\n", "\r\n", "\r"]))
def test_numbers_are_taken_out_of_any_text(notation, rows, line_end):
    lines = [notation.format(a=a, b=b, c=c) for a, b, c in rows]
    if notation in DECIMAL_COMMAS:
        lines = [line.replace(".", ",") for line in lines]
    frames = TextParser().feed((line_end + line_end.join(lines) + line_end).encode())
    assert [frame.values for frame in frames] == rows
    assert frames[-1].names == tuple(NOTATIONS.get(notation, "ABC" if "A" in notation else ()))
    has_time = "789" in notation or ":00:" in notation or "(1234)" in notation
    assert (frames[-1].t_us is not None) == has_time  # a time in whole seconds is too coarse for a clock


@pytest.mark.parametrize("message", ["OK", "the tare is done", "ready ; go"])
@pytest.mark.parametrize("lines_before", [0, 3])
def test_header_and_no_message_names_the_frames_after_it(message, lines_before):
    lines = [f"{k},2,3,4" for k in range(5)]
    lines.insert(lines_before, "b,a,c,d")
    frames = feed(message, *lines[:4], message, *lines[4:])
    assert [frame.names for frame in frames] == [()] * lines_before + [("b", "a", "c", "d")] * (5 - lines_before)


MESSAGES = ["Sensor 1 ready", "Sensor 2 ready", "Sensor 3 ready"] + ["load:0x3fcd6100,len:0x1798"] * 3


@pytest.mark.parametrize(
    ("lines", "values"),
    [
        # a header after a reset
        (["A,B", "1,2", "3,4", "5,6", "A,B", "7,8"], [(1, 2), (3, 4), (5, 6), (7, 8)]),
        # messages of a board that starts
        ([*MESSAGES, "1,2,3", "4,5,6", "7,8,9"], [(1, 2, 3), (4, 5, 6), (7, 8, 9)]),
        # an echo
        (["READ 1", "0,2", "READ 1", "1,2", "READ 1", "1,2"], [(0, 2), (1, 2), (1, 2)]),
        # two frames, and then a temperature
        (["ch1,1;ch2,2", "ch1,3;ch2,4", "T 5"] * 12, [(1, 2), (3, 4)] * 12),
        (["5,0x1F", "8,-0x20"] * 5, [(5, 31), (8, -32)] * 5),
        ([f"seq=0x{n:X} A=-{n}" for n in range(12)], [(-n,) for n in range(12)]),
        # two values behind each name, which are no index and value
        (["x 0 7 y 1 8", "x 0 7 y 2 8", "x 1 7 y 2 8"] * 4, [(0, 7, 1, 8), (0, 7, 2, 8), (1, 7, 2, 8)] * 4),
    ],
)
def test_lines_that_are_frames(lines, values):
    assert [frame.values for frame in feed(*lines)] == values


@pytest.mark.parametrize("numbers", [(0, 1, 2), (1, 2, 3, 4), range(14, 22)])
@pytest.mark.parametrize(
    "notation",
    ["{t},{n},{q}", "{q};{n:.2f};{t}", "ch 0x{n:X} {q}", "ADC1 Channel[{n}] Raw Data: {q}", "ch={n} A={q} B={t}"],
)
def test_line_with_the_number_and_the_charge_of_one_channel_is_no_frame(notation, numbers):
    lines = [notation.format(t=1000 + k, n=n, q=n + k % 7 / 4) for k in range(20) for n in numbers]
    del lines[7::10]  # lost lines
    assert feed(*lines) == []


@pytest.mark.parametrize("notation", ["{:04X} {:04X}", "{:x},{:x}"])
def test_hexadecimal_numbers_without_their_prefix_are_not_read_as_decimal_numbers(notation):
    assert feed(*(notation.format(2045 + k % 9, 2054 - k % 7) for k in range(200))) == []


def test_damaged_line_that_looks_hexadecimal_does_not_prevent_the_recognition():
    assert len(feed("07FD,2054", *[f"{2045 + k % 9},2054" for k in range(20)])) == 20


@pytest.mark.parametrize("notation", ["{0},5,7", "{1},{2}.5,-{0},{3}", "{4},0,{0}.5", "{2},{3},{4}", "50{1},5,7"])
def test_column_that_counts_or_has_few_values_is_a_column(notation):
    lines = [notation.format(k, k % 4, -k % 3, 5 * k % 7, k // 5) for k in range(12)]
    assert len(feed(*lines)) == 12


@pytest.mark.parametrize("notation", ["A: {} B: 3 pC", "{} 3 pC", "A,{},B,3 pC"])
def test_line_in_another_unit_is_rejected(notation):
    """An instrument with automatic ranges writes 850 pC and then 1.2 nC."""
    parser = TextParser()
    frames = feed(*[notation.format("850 pC")] * 12, notation.format("1.2 nC"), parser=parser)
    assert {frame.values[0] for frame in frames} == {850.0}
    assert parser.counts.malformed == 1


def test_time_of_day_is_the_clock_which_wraps_at_midnight():
    parser = TextParser()
    lines = [f"23:59:59.{ms:03d} -> 1,2" for ms in range(900, 1000, 20)]
    frames = feed(*lines, "00:00:00 -> 1,2", parser=parser)  # some programs omit a fraction that is zero
    assert [frame.t_us for frame in frames[-2:]] == [86_399_980_000, 0]
    assert parser.t_us_modulus == 86_400_000_000
    assert parser.format == "text: t_s, 2 columns without names"


def test_values_that_are_not_numbers_or_out_of_range_are_not_finite():
    frames = feed("A:1,B:nan", "A:ovf,B:-inf", "A:2,B:OVF", "A:3,B:4")
    assert np.isfinite([frame.values for frame in frames]).tolist() == [[1, 0], [0, 0], [1, 0], [1, 1]]


@pytest.mark.parametrize(
    ("header", "line", "names"),
    [
        ("T:time,A,B,C", "T:{n},4.7,-2.2,3.2", "time,A,B,C"),
        ("n,mode,phase,A,B", "{n},bare,stance,4.7,-2.2", "n,A,B"),
        ("state,B,phase,A", "run,{n},idle,-2.2", "B,A"),
        ("t [ms], A [pC], B [pC]", "{n}, 4.7, -2.2", "t [ms],A [pC],B [pC]"),
        ('"A","B"', "{n},4.7", "A,B"),
        ("state,,A,B", "run,{n}.5,4.7,-2.2", ""),
        ("A,B,", "run {n} 4.7", "A,B"),
        ("# | Pad B | Pad A |", "| {n} | 4.7 |", "Pad B,Pad A"),
        ("// B A", "{n} 4.7", "B,A"),
        ("# 3 channels, 24 bits", "{n},4.7", ""),
        ("n\tA B", "{n}\t4.7", "n,A B"),
    ],
)
def test_header_names_the_columns_that_contain_numbers(header, line, names):
    frames = feed("booting ...", header, *(line.format(n=1000 + 7 * n) for n in range(4)))
    assert ",".join(frames[-1].names) == names


@pytest.mark.parametrize(("lost", "cycles", "malformed"), [(0, [1, 2, 3, 4, 5], 2), (12, [0, 1, 2, 3, 5], 2)])
def test_lost_line_of_a_cycle_costs_its_cycle_only(lost, cycles, malformed):
    """A parser that loses a line A must not join B and C of its cycle with A of the next cycle."""
    parser = TextParser()
    lines = [f">{name}:{1000 + cycle}:{cycle}{position}" for cycle in range(6) for position, name in enumerate("ABC")]
    del lines[lost]
    frames = feed(*lines, parser=parser)
    assert [frame.values for frame in frames] == [(10 * cycle, 10 * cycle + 1, 10 * cycle + 2) for cycle in cycles]
    assert [frame.t_us for frame in frames] == [1_000_000 + 1000 * cycle for cycle in cycles]
    assert parser.counts.malformed == malformed


@pytest.mark.parametrize(
    "lines",
    [
        (">C:{ms}:{k}", ">A:{ms}:{k}", ">B:{ms}:{k}"),
        (">C:{ms}.1:{k}", ">A:{ms}.3:{k}", ">B:{ms}.6:{k}"),
        ("t_ms:{ms}", "C:{k}", "A:{k}", "B:{k}"),
    ],
)
def test_frame_in_consecutive_lines_has_the_values_of_one_time(lines):
    frames = feed(*(line.format(ms=1000 + 20 * k, k=k) for k in range(8) for line in lines))
    assert len(frames) >= 7
    for frame in frames:
        assert set(frame.values) == {(frame.t_us // 1000 - 1000) / 20}


def test_unrecognised_lines_use_bounded_memory():
    parser = TextParser()
    parser.feed(b"8" * 100_000 + b"\n")
    for number in range(1500):
        parser.feed(f"A{number}:1\n".encode())
    assert len(pickle.dumps(parser)) < 40_000
    assert feed("1,2,3", "1,2,3", "1,2,3", parser=parser)[-1].values == (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    ("first_line", "frame_count", "malformed_count"),
    [("", 9, 1), ("A,B\n", 10, 0), ("\ufeffA,B\n", 10, 0), ("# board\n", 10, 0), ("\n", 10, 0)],
)
def test_first_line_of_a_pipe_or_file_is_malformed_only_without_a_header_comment_or_blank_line(
    first_line, frame_count, malformed_count
):
    """Without such a line, the first numbers may be the rest of a line whose beginning is missing."""
    parser = AutoParser()
    frames = parser.feed((first_line + "801.2,799.5\n" * 10).encode())
    assert len(frames) == frame_count
    assert parser.counts.malformed == malformed_count


def sentence(content):
    """Return a sentence as in NMEA 0183, with the exclusive or of the bytes between $ and * as its checksum."""
    return f"${content}*{reduce(xor, content.encode()):02X}"


def test_sentences_with_their_checksum():
    parser = TextParser()
    wrong = sentence("PZT,9,1,2").replace("9", "8")
    invalid = wrong[:-1] + "g"
    frames = feed(
        *(sentence(f"PZT,{number},801.2,-799.5") for number in range(4)), invalid, wrong, "$PZT,9,1,2", parser=parser
    )
    assert [frame.values for frame in frames] == [*((number, 801.2, -799.5) for number in range(4)), (9, 1, 2)]
    assert parser.counts.malformed == 2


@pytest.mark.parametrize(
    ("name", "unit", "modulus"), [("t_ms", 1, 1 << 32), ("t_us", 1000, 1 << 32), ("t_s", 0.001, 86_400)]
)
def test_clock_in_text_that_wraps(name, unit, modulus):
    parser = TextParser()
    clock = DeviceClock()
    times_us = []
    for number in range(-60, 140):
        frames = feed(f"{name}:{5 * number * unit % modulus:.6f},A:1", parser=parser)
        clock.stamp(Chunk(b"", 0.0, 0), frames, parser.t_us_modulus)
        times_us += [frame.device_us for frame in frames]
    np.testing.assert_allclose(np.diff(times_us), 5.0 * unit if name == "t_us" else 5000.0, atol=1.1)


@pytest.mark.parametrize(
    ("start", "stop", "then", "lost", "restarts"),
    [
        *((modulus - 20, modulus, range(20), 0, 0) for modulus in (100, 256, 1000, 10_000, 65536)),
        *((start, stop, range(20), 0, 1) for start, stop in ((290, 301), (70, 98), (99_990, 100_000))),
        (290, 301, [700], 399, 0),
        (90, 100, [*range(256), *range(20)], 0, 0),
    ],
)
def test_frame_counter_in_text_that_wraps_or_restarts(start, stop, then, lost, restarts):
    parser = TextParser()
    for seq in (*range(start, stop), *then):
        for frame in feed(f"seq:{seq},A:1", parser=parser):
            parser.sequence_flags(frame.seq)
    assert (parser.counts.lost, parser.counts.repeated, parser.counts.restarts) == (lost, 0, restarts)
