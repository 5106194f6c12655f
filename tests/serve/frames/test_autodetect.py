"""The format of a board is recognised from its bytes alone."""

import pytest

from isocharge.serve import AutoParser, Frame, encode_frame, encode_text
from isocharge.serve.frames.text_encoder import TEXT_FORMATS

ENCODERS = {"binary": encode_frame} | {name: lambda frame, name=name: encode_text(frame, name) for name in TEXT_FORMATS}


def frames(n):
    return [Frame(k, 1000 * k, (800.0 + k, -7.5, 3.25)) for k in range(n)]


@pytest.mark.parametrize("name", sorted(ENCODERS))
@pytest.mark.parametrize("start", [0, 1, 7, 19])
def test_format_is_recognised_from_anywhere(name, start):
    parser = AutoParser()
    got = parser.feed(b"".join(map(ENCODERS[name], frames(20)))[start:])
    assert len(got) >= 17
    assert [frame.values[0] for frame in got] == [frame.values[0] for frame in frames(20)][-len(got) :]
    assert ("binary" if name == "binary" else "text") in parser.format


def test_bytes_before_recognition_count_as_dropped():
    parser = AutoParser()
    parser.feed(b"\xf0\x9f" * 500)
    assert (parser.counts.frames, parser.counts.bytes_dropped, parser.chosen) == (0, 1000, None)
