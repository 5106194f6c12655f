"""Properties that the parsers of all formats must have, and gaps, repeats and restarts of frame numbers.

The division into chunks never changes frames or counters. Bytes between two intact frames never damage a frame. With a
checksum, damaged bytes never result in a wrong frame.
"""

from itertools import pairwise

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from frame_formats import FORMATS
from isocharge.serve import BinaryParser

every_format = pytest.mark.parametrize("name", FORMATS)
ANY_BYTES = st.one_of(
    st.binary(max_size=30), st.text(max_size=20).map(str.encode), st.sampled_from([b"A,B,C\n", b"1,2\n", b"\0", b"\n"])
)


@every_format
@settings(derandomize=True, max_examples=20)
@given(data=st.data())
def test_chunks_never_change_frames_or_counters(name, data):
    form = FORMATS[name]
    pieces = data.draw(st.lists(form.frames.map(form.encode) | form.junk | ANY_BYTES, max_size=12))
    stream = data.draw(st.sampled_from([b"", form.lead])) + b"".join(pieces)
    cuts = data.draw(st.lists(st.integers(0, len(stream)), max_size=10))
    results = []
    for edges in ([0, len(stream)], [0, *sorted(cuts), len(stream)], range(len(stream) + 1)):
        parser = form.parser()
        frames = []
        for start, stop in pairwise(edges):
            frames += parser.feed(stream[start:stop])
        results.append((frames, parser.counts))
    assert results[1:] == results[:1] * 2


@every_format
@settings(derandomize=True, database=None, phases=[Phase.generate], max_examples=25)
@given(data=st.data())
def test_bytes_between_two_frames_damage_no_frame(name, data):
    """The frames are those that a parser reads from the bytes of each single frame."""
    form = FORMATS[name]
    pairs = data.draw(st.lists(st.tuples(st.none() | form.junk, form.frames), min_size=1, max_size=8))
    expected = []
    stream = b""
    for junk, frame in pairs:
        parser = form.parser()
        parser.feed(form.lead)
        (alone,) = parser.feed(form.encode(frame))
        expected.append(alone)
        stream += (junk or b"") + form.encode(frame)
    parser = form.parser()
    parser.feed(form.lead)
    assert parser.feed(stream + form.tail) == expected


@pytest.mark.parametrize(
    ("numbers", "counts", "flags"),
    [
        ((65530, 65533, 2, 2, 3, 0, 1), (6, 1, 1), ["", "gap", "gap", "repeat", "", "restart", ""]),
        ((60_000, 60_001, 0, 1, 30_000), (29_998, 0, 1), ["", "", "restart", "", "gap"]),
        ((65_500, 60), (95, 0, 0), ["", "gap"]),
        ((30, 32, 31, 33), (0, 0, 0), ["", "gap", "gap", ""]),  # a late number
        ((65_534, 0, 1, 65_535, 2), (0, 0, 0), ["", "gap", "", "gap", ""]),  # a late number after a wrap
        ((3, 4, 0, 1, 2), (0, 0, 1), ["", "", "restart", "", ""]),
    ],
)
def test_sequence_gaps_repeats_and_restarts(numbers, counts, flags):
    parser = BinaryParser()
    assert [" ".join(parser.sequence_flags(seq)) for seq in numbers] == flags
    assert (parser.counts.lost, parser.counts.repeated, parser.counts.restarts) == counts
    parser.reset()
    assert parser.sequence_flags(100) == ()
