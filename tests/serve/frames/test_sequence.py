"""Frame numbers: gaps, repeats and restarts."""

from isocharge.serve.frames.sequence import SequenceGaps


def follow(*numbers):
    gaps = SequenceGaps()
    flags = [gaps.update(seq) for seq in numbers]
    return (gaps.lost, gaps.repeated, gaps.restarts), flags


def test_sequence_without_gaps_wraps():
    counts, flags = follow(65534, 65535, 0, 1)
    assert (counts, flags) == ((0, 0, 0), [()] * 4)


def test_sequence_gaps_repeats_and_restarts():
    counts, flags = follow(65530, 65533, 2, 2, 3, 0, 1)
    assert counts == (2 + 4, 1, 1)
    assert flags == [(), ("gap",), ("gap",), ("repeat",), (), ("restart",), ()]


def test_numbers_of_one_byte_wrap_at_256():
    gaps = SequenceGaps()
    assert [gaps.update(seq, 256) for seq in (254, 255, 0, 3)] == [(), (), (), ("gap",)]
    assert gaps.lost == 2


def test_no_number_is_no_gap():
    gaps = SequenceGaps()
    assert [gaps.update(None), gaps.update(5), gaps.update(None), gaps.update(6)] == [()] * 4


def test_a_new_connection_is_no_gap():
    gaps = SequenceGaps()
    gaps.update(5)
    gaps.forget()
    assert gaps.update(900) == ()
