"""Formats of frames, with strategies of the frames that they can contain and of bytes that damage no frame."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from cobs import cobs
from hypothesis import strategies as st

from isocharge.serve import AutoParser, BinaryParser, Frame, device_from_table, encode_frame
from isocharge.serve.frames.frame import Parser
from isocharge.serve.frames.text import TextParser
from layout_encoder import TEXT_ENCODERS, encode_layout

HEAD = [{"name": "seq", "type": "u16"}, {"name": "t_us", "type": "u32"}]
FLOATS = [{"name": name, "type": "f32"} for name in "ABC"]
MIXED = [{"name": "A", "type": "i16", "scale": 0.1}, {"name": "B", "type": "f32"}, {"name": "C", "type": "i32"}]
TRIPLES = [{"type": "pad", "value": "0C"}, *({"name": name, "type": "i24"} for name in "ABC")]
SYNCED = {"format": "described", "sync": "AA 55", "length": 20, "checksum": "crc-16/x-25", "fields": HEAD + MIXED}
BITS_24 = SYNCED | {
    "sync": "A5 5A",
    "length": 16,
    "byte_order": "big",
    "checksum": "crc-16/ccitt-false",
    "checksum_from": 2,
}
STUFFED = {"format": "described", "length": 20, "checksum": "crc-16/modbus", "fields": HEAD + FLOATS}
STUFFINGS = {
    "cobs": (b"\0", cobs.encode),
    "slip": (b"\xc0", lambda data: data.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc")),
    "hdlc": (b"~", lambda data: data.replace(b"}", b"}]").replace(b"~", b"}^")),
}
"""Delimiter and byte stuffing of each framing, by their definitions (RFC 1055 and RFC 1662) and another library."""


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


def stuffed(framing):
    """Return a described format with byte stuffing."""
    delimiter, stuff = STUFFINGS[framing]
    form = described(STUFFED | {"framing": framing})
    junk = st.binary(min_size=1, max_size=12).map(lambda data: data.replace(delimiter, b"\x01") + delimiter)
    return form._replace(encode=lambda frame: stuff(form.encode(frame)) + delimiter, frames=THREE, junk=junk, tail=b"")


FORMATS = {
    "binary": binary(),
    "described": described(SYNCED),
    "described with 24 bits": described(BITS_24 | {"fields": HEAD[:1] + TRIPLES}),
    **{framing: stuffed(framing) for framing in STUFFINGS},
    **{name: text(name) for name in TEXT_ENCODERS},
    "auto binary": binary(AutoParser, encode_frame(Frame(0, 0, (1.0, 2.0, 3.0)))),
    "auto pairs": text("pairs", AutoParser),
}
