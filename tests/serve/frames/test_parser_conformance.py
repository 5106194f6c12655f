"""Properties that the parsers of all formats must have, and gaps, repeats and restarts of frame numbers.

The division into chunks never changes frames or counters. Bytes between two intact frames never damage a frame. With a
checksum, damaged bytes never result in a wrong frame.
"""

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from isocharge.serve import AutoParser, BinaryParser, Frame, device_from_table, encode_frame
from isocharge.serve.frames.frame import Parser
from isocharge.serve.frames.text import TextParser
from layout_encoder import TEXT_ENCODERS, encode_layout

HEAD = [{"name": "seq", "type": "u16"}, {"name": "t_us", "type": "u32"}]
FLOATS = [{"name": name, "type": "f32"} for name in "ABC"]
TRIPLES = [{"type": "pad", "value": "0C"}, *({"name": name, "type": "i24"} for name in "ABC")]
SYNCED = {"format": "described", "sync": "AA 55", "length": 22, "checksum": "crc-16/x-25", "fields": HEAD + FLOATS}
BITS_24 = SYNCED | {
    "sync": "A5 5A",
    "length": 16,
    "byte_order": "big",
    "checksum": "crc-16/ccitt-false",
    "checksum_from": 2,
}
STUFFED = {"format": "described", "framing": "slip", "length": 20, "checksum": "crc-16/modbus", "fields": HEAD + FLOATS}


class Format(NamedTuple):
    """A format of frames.

    Attributes:
        parser: Function that returns a new parser.
        encode: Function that returns the bytes of a frame.
        frames: Strategy of frames that the format can contain.
        junk: Strategy of bytes before a frame that do not damage the frame.
        lead: Bytes after which the format is recognised.
        tail: Bytes after which the last frame is complete, independently of the bytes before it.
    """

    parser: Callable[[], Parser]
    encode: Callable[[Frame], bytes]
    frames: st.SearchStrategy
    junk: st.SearchStrategy
    lead: bytes = b""
    tail: bytes = b""


SEQ = st.integers(0, 2**16 - 1)
T_US = st.integers(0, 2**32 - 1)
THREE = st.builds(Frame, seq=SEQ, t_us=T_US, values=st.tuples(*[st.floats(-1e4, 1e4, width=32)] * 3))
PIECES = st.binary(min_size=1, max_size=40).map(lambda data: data.replace(b"\0", b"\x01") + b"\0")
LINES = st.binary(max_size=20).map(lambda data: b"\x80" + data.replace(b"\n", b"\r") + b"\n")
SLIP_JUNK = st.binary(min_size=1, max_size=12).map(lambda data: data.replace(b"\xc0", b"\x01") + b"\xc0")


def binary(make=BinaryParser, lead=b""):
    floats = st.lists(st.floats(width=32, allow_nan=False), max_size=8).map(tuple)
    frames = st.builds(Frame, seq=SEQ, t_us=T_US, values=floats, bits=st.integers(0, 255))
    return Format(make, encode_frame, frames, PIECES, lead)


def text(notation, make=TextParser):
    encode = TEXT_ENCODERS[notation]
    return Format(make, encode, THREE, LINES, b"\n" + encode(Frame(0, 0, (1.0, 2.0, 3.0))) * 3)


def described(table):
    """Return a described format. The bytes before its frames often contain the sync pattern."""
    layout = device_from_table({"frames": table}, "test").frames
    values = st.tuples(*[st.integers(-32768, 32767).map(float)] * 3)
    noise = st.one_of(st.just(layout.sync), st.just(layout.sync[:1]), st.binary(max_size=6))
    return Format(
        layout.parser,
        partial(encode_layout, layout),
        st.builds(Frame, seq=SEQ, t_us=T_US, values=values),
        st.lists(noise, min_size=1, max_size=5).map(b"".join),
        tail=bytes(layout.length),
    )


def slip(frame):
    """Return a frame with the byte stuffing of RFC 1055."""
    data = encode_layout(device_from_table({"frames": STUFFED}, "test").frames, frame)
    return data.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + b"\xc0"


FORMATS = {
    "binary": binary(),
    "described": described(SYNCED),
    "described with 24 bits": described(BITS_24 | {"fields": HEAD[:1] + TRIPLES}),
    "slip": described(STUFFED)._replace(encode=slip, frames=THREE, junk=SLIP_JUNK, tail=b""),
    **{name: text(name) for name in TEXT_ENCODERS},
    "auto binary": binary(AutoParser, encode_frame(Frame(0, 0, (1.0, 2.0, 3.0)))),
    "auto pairs": text("pairs", AutoParser),
}
every_format = pytest.mark.parametrize("name", FORMATS)
ANY_BYTES = st.one_of(
    st.binary(max_size=30), st.text(max_size=20).map(str.encode), st.sampled_from([b"A,B,C\n", b"1,2\n", b"\0", b"\n"])
)


@every_format
@settings(derandomize=True, max_examples=30)
@given(data=st.data())
def test_chunks_never_change_frames_or_counters(name, data):
    form = FORMATS[name]
    pieces = data.draw(st.lists(st.one_of(form.frames.map(form.encode), form.junk, ANY_BYTES), max_size=12))
    stream = data.draw(st.sampled_from([b"", form.lead])) + b"".join(pieces)
    cuts = data.draw(st.lists(st.integers(0, len(stream)), max_size=10))
    whole_parser = form.parser()
    frames = whole_parser.feed(stream)
    for edges in ([0, *sorted(cuts), len(stream)], range(len(stream) + 1)):
        parser = form.parser()
        frames_of_chunks = []
        for start, stop in pairwise(edges):
            frames_of_chunks += parser.feed(stream[start:stop])
        assert frames_of_chunks == frames
        assert parser.counts == whole_parser.counts


def alone(form, frame):
    """Return the frames that a parser reads from the bytes of a single frame."""
    parser = form.parser()
    parser.feed(form.lead)
    return parser.feed(form.encode(frame))


@every_format
@settings(derandomize=True, database=None, phases=[Phase.generate], max_examples=40)
@given(data=st.data())
def test_bytes_between_two_frames_damage_no_frame(name, data):
    form = FORMATS[name]
    pairs = data.draw(st.lists(st.tuples(st.none() | form.junk, form.frames), min_size=1, max_size=8))
    parser = form.parser()
    parser.feed(form.lead)
    stream = b"".join((junk or b"") + form.encode(frame) for junk, frame in pairs)
    expected = [alone(form, frame) for _, frame in pairs]
    assert all(len(frames) == 1 for frames in expected)
    assert [[frame] for frame in parser.feed(stream + form.tail)] == expected


@pytest.mark.parametrize(
    ("numbers", "modulus", "counts", "flags"),
    [
        ((65534, 65535, 0, 1), 65536, (0, 0, 0), [()] * 4),
        (
            (65530, 65533, 2, 2, 3, 0, 1),
            65536,
            (2 + 4, 1, 1),
            [(), ("gap",), ("gap",), ("repeat",), (), ("restart",), ()],
        ),
        ((254, 255, 0, 3), 256, (2, 0, 0), [(), (), (), ("gap",)]),
        ((None, 5, None, 8), 65536, (2, 0, 0), [(), (), (), ("gap",)]),
    ],
    ids=["wrap", "gaps, a repeat and a restart", "one byte", "some without a number"],
)
def test_sequence_gaps_repeats_and_restarts(numbers, modulus, counts, flags):
    parser = BinaryParser()
    parser.seq_modulus = modulus
    assert [parser.sequence_flags(seq) for seq in numbers] == flags
    assert (parser.counts.lost, parser.counts.repeated, parser.counts.restarts) == counts
    parser.reset()
    assert parser.sequence_flags(100) == ()
