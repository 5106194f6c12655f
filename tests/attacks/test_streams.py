"""Frames of every format with faults in them: a parser takes any bytes in any pieces, and what comes out is a frame."""

import json
import math
import struct
from functools import partial

import pytest

import frame_formats
from attacks.faults import mutated
from isocharge.serve import (
    Chunk,
    Frame,
    Predictor,
    TouchStream,
    device_from_table,
    encode_frame,
)
from isocharge.serve.frames.text import TextParser
from isocharge.serve.recognition.recognise import recognise
from layout_encoder import encode_layout

FRAMES = [Frame(seq, 5000 * seq, (800.0 + seq, 700.0 - seq, 900.5), 0, ("A", "B", "C")) for seq in range(6)]

DATAGRAMS = device_from_table({"frames": frame_formats.SYNCED | {"framing": "datagram"}}, "attack").frames
JSON = {"charge": {"A": 1.5, "B": [2, 3], "": {"": 4}}}

FORMATS = {
    **{
        name: (form.parser, form.lead + b"".join(map(form.encode, FRAMES)))
        for name, form in frame_formats.FORMATS.items()
    },
    "datagram": (DATAGRAMS.parser, b"".join(encode_layout(DATAGRAMS, frame) for frame in FRAMES)),
    "sentences": (TextParser, b"".join(b"$PZT,%d,1.5,2.5*%02X\r\n" % (k, 0x4F ^ k) for k in range(6))),
    "other names": (
        partial(TextParser, meanings={"n": "seq", "ms": "t_ms"}),
        b"".join(b"n:%d,ms:%d,A:1.5\n" % (k % 3, 65534 + k & 0xFFFF) for k in range(9)),
    ),
    "nested json": (TextParser, b"".join(json.dumps({"seq": k} | JSON).encode() + b"\n" for k in range(6))),
}
"""Function that returns a new parser of a format, and bytes of good frames."""


@pytest.mark.parametrize("name", FORMATS)
def test_frames_with_faults(name, attack):
    make_parser, good = FORMATS[name]

    def read(pieces):
        parser, size = make_parser(), 0
        for piece in pieces:
            size += len(piece)
            for frame in parser.feed(piece):
                assert frame.seq is None or isinstance(frame.seq, int)
                assert all(isinstance(value, float) for value in frame.values)
        parser.reset()
        assert parser.counts.bytes_dropped <= size

    def pieces(rng):
        data = mutated(rng, good)
        cut = rng.randrange(len(data) + 1)
        return data[:cut], data[cut:]

    attack(f"frames {name}", read, pieces, 90_000)


def test_recognition_of_frames_with_faults(attack):
    """Whatever a board sends, what is recognised of it is a device file, or nothing."""
    goods = [data for _, data in FORMATS.values()]

    def read(chunks):
        table = recognise(chunks, 1.0, are_datagrams=len(chunks) > 1)
        if table is not None:
            parser = device_from_table({"frames": table}, "attack").parser()
            for chunk in chunks:
                parser.feed(chunk)

    def chunks(rng):
        data = mutated(rng, rng.choice(goods) * rng.choice((1, 3, 10)))
        return [data] if rng.random() < 0.7 else [data[at : at + 40] for at in range(0, len(data), 40)]

    attack("recognition", read, chunks, 2_000, longest_s=5.0)


REPEATED = (b"[", b'{"":', b'{"a":', b"1", b"1,", b"A:1,", b">", b" ", b"\xff", b"\xa5\x5a", b"\xa5")


def test_bombs(attack):
    """Endless lines, deep objects, numbers without end: nothing is gathered that is too long to be a frame."""

    def bomb(rng):
        piece, count = rng.choice(REPEATED), rng.choice((600, 700, 900, 5000, 50_000))
        closed = b"1" + b"}" * count + b"\n"
        return piece * count + rng.choice((b"", b"\n", closed))

    def read(data):
        for make_parser in {make_parser for make_parser, _ in FORMATS.values()}:
            parser = make_parser()
            parser.feed(data)
            parser.reset()

    attack("frames bombs", read, bomb, 2_000)


WILD = (0.0, -0.0, 1e-45, 3.4e38, -3.4e38, math.inf, -math.inf, math.nan, 1e30, 100.0, 800.0)


def test_frames_that_are_intact_and_absurd(attack):
    """Whatever numbers a board sends, the whole path gives records that are JSON, or refuses."""
    predictor = Predictor("three-25um-biaxial")
    devices = [
        device_from_table(table, "attack")
        for table in ({}, {"leak": {"tau_s": 10.0}, "hum": {}, "tare": {"frames": 3}}, {"tare": {"on": False}})
    ]

    def values(rng):
        return [
            struct.unpack("<f", rng.randbytes(4))[0]
            if rng.random() < 0.3
            else rng.choice(WILD) * rng.choice((1, 1, 0.5))
            for _ in range(3)
        ]

    def frames(rng):
        clocks = (0, 1, 1 << 31, (1 << 32) - 1, rng.randrange(1 << 32))
        sent = [Frame(rng.randrange(1 << 16), rng.choice(clocks), tuple(values(rng))) for _ in range(8)]
        return rng.choice(devices), b"".join(map(encode_frame, sent))

    def read(case):
        device, data = case
        path = TouchStream(predictor, device)
        for record in path.feed(Chunk(data, 1e9, 0)):
            json.loads(record.to_json(), parse_constant=lambda name: pytest.fail(name))

    attack("frames absurd", read, frames, 8_000)
