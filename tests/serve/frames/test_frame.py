"""The counters that all parsers share."""

from isocharge.serve.frames.frame import FrameCounts


def test_a_resynchronisation_is_a_good_frame_after_damage():
    counts = FrameCounts()
    counts.accept()
    counts.refuse(10)
    counts.refuse(5, damaged=True)
    counts.accept()
    counts.accept()
    assert (counts.frames, counts.malformed, counts.crc_errors, counts.bytes_dropped, counts.resyncs) == (
        3,
        1,
        1,
        15,
        1,
    )
