"""Bytes that nobody meant: damaged streams and noise in every format. No crash, no growth, nothing taken for granted.

The short runs are part of every test run; 10 million bytes for each format are in `make test-all`.
"""

import tracemalloc
from functools import partial

import numpy as np
import pytest

from isocharge.serve import (
    AutoParser,
    BinaryParser,
    DescribedParser,
    Frame,
    TextParser,
    encode_frame,
    encode_text,
    frame_layout,
)
from isocharge.serve.virtual_sensor.faults import corrupt

LAYOUT = frame_layout(
    {
        "sync": "AA 55",
        "length": 22,
        "checksum": "crc-16/x-25",
        "fields": [{"name": "seq", "type": "u16"}, {"name": "t_us", "type": "u32"}]
        + [{"name": name, "type": "f32"} for name in "ABC"],
    },
    "test",
)
FORMATS = {
    "binary": (BinaryParser, encode_frame),
    "described": (partial(DescribedParser, LAYOUT), LAYOUT.encode),
    "csv": (TextParser, partial(encode_text, notation="csv")),
    "pairs": (TextParser, partial(encode_text, notation="pairs")),
    "teleplot": (TextParser, partial(encode_text, notation="teleplot")),
    "json": (TextParser, partial(encode_text, notation="json")),
    "auto": (AutoParser, encode_frame),
}


def frames(n, seed):
    values = np.random.default_rng(seed).normal(0, 800, (n, 3)).astype(np.float32)
    return [Frame(k % 65536, 1000 * k, tuple(row)) for k, row in enumerate(values.tolist())]


@pytest.mark.parametrize("name", ["binary", "described"])
@pytest.mark.parametrize("seed", range(4))
def test_one_percent_of_bytes_damaged(name, seed):
    """No wrong frame is taken, and none is lost that is intact between intact neighbours."""
    make, encode = FORMATS[name]
    rng, sent = np.random.default_rng(seed), frames(2000, seed)
    damaged = [corrupt(encode(frame), 0.01, rng) for frame in sent]
    got = make().feed(b"".join(damaged) + encode(sent[0]))
    key = lambda frame: (frame.seq, frame.t_us, frame.values)  # noqa: E731
    assert set(map(key, got)) <= set(map(key, sent))
    after_intact_end = [True, *(data.endswith(b"\0") or name != "binary" for data in damaged)]
    intact = [f for f, data, ok in zip(sent, damaged, after_intact_end, strict=False) if ok and data == encode(f)]
    assert 1000 < len(intact) < 1900
    assert {key(frame) for frame in intact} <= set(map(key, got))


def fuzz(name, size, seed=0):
    """Feed damaged frames, noise, and both cut anyhow; the most memory that the parser needed, bytes."""
    make, encode = FORMATS[name]
    rng, parser, fed = np.random.default_rng(seed), make(), 0
    clean = b"".join(map(encode, frames(2000, seed)))
    tracemalloc.start()
    try:
        while fed < size:
            share = rng.choice([0.0, 0.001, 0.01, 0.1])
            data = corrupt(clean, share, rng) if rng.random() < 0.7 else rng.bytes(len(clean))
            tracemalloc.reset_peak()
            for chunk in np.split(np.frombuffer(data, np.uint8), np.sort(rng.integers(0, len(data), 40))):
                parser.feed(chunk.tobytes())
            fed += len(data)
            held = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    return parser, held


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_a_little_fuzz(name):
    parser, _ = fuzz(name, 200_000)
    assert parser.counts.frames > 0


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", sorted(FORMATS))
def test_ten_million_bytes(name):
    parser, held = fuzz(name, 10_000_000, seed=1)
    assert parser.counts.frames > 10_000
    assert held < 2_000_000
