"""The format of a board is recognised from its bytes alone."""

from functools import partial

import pytest

from isocharge.serve import AutoParser, Frame, encode_frame, encode_text
from isocharge.serve.frames.text_encoder import TEXT_FORMATS

ENCODERS = {"binary": encode_frame} | {name: partial(encode_text, notation=name) for name in TEXT_FORMATS}


@pytest.mark.parametrize("name", ENCODERS)
@pytest.mark.parametrize("start", [0, 7, 19])
def test_format_is_recognised_from_anywhere(name, start):
    frames = [Frame(k, 1000 * k, (800.0 + k, -7.5, 3.25)) for k in range(20)]
    parser = AutoParser()
    got = parser.feed(b"".join(map(ENCODERS[name], frames))[start:])
    assert len(got) >= 17
    assert [frame.values[0] for frame in got] == [frame.values[0] for frame in frames][-len(got) :]
    assert ("binary" if name == "binary" else "text") in parser.format


def test_bytes_before_recognition_count_as_dropped():
    parser = AutoParser()
    parser.feed(b"\xf0\x9f" * 500)
    assert (parser.counts.frames, parser.counts.bytes_dropped) == (0, 1000)
    assert parser.format == "nothing recognised yet"


def test_moduli_are_those_of_the_recognised_text():
    parser = AutoParser()
    for k in range(12):
        parser.feed(b"seq:%d,t_ms:%d,A:1\n" % ((250 + k) % 256, 65_530 + k & 0xFFFF))
    assert (parser.seq_modulus, parser.t_us_modulus) == (256, 65_536_000)
