"""Bytes in, records out, without a port."""

import math
import time

import numpy as np
import pytest

from isocharge.common.errors import ChargeError, ModelError, PortError
from isocharge.serve import (
    Chain,
    Chunk,
    Frame,
    Policy,
    Predictor,
    TouchStream,
    device_from_table,
    encode_frame,
    open_source,
    stream,
)
from isocharge.serve.frames.frame import SequenceGaps
from isocharge.serve.signal_chain.tare import TareRule

OFFSET = np.array([12.0, -7.0, 3.0])
CHAIN = Chain(tare=TareRule(frames=10))


def chunk(*frames):
    return Chunk(b"".join(map(encode_frame, frames)), time.time(), time.perf_counter_ns())


def frames(rows, first=0):
    return [Frame((first + i) % 65536, 5000 * i, tuple(row)) for i, row in enumerate(np.asarray(rows).tolist())]


@pytest.fixture
def play(predictor):
    """Records of raw charges, after ten frames of rest."""

    def play(*later, **options):
        rest = frames(np.tile(OFFSET, (10, 1)))
        return list(stream([chunk(*rest), *(chunk(f) for f in later)], predictor, chain=CHAIN, **options))[10:]

    return play


def pressed(film, x_mm=2.0, y_mm=-3.0, force_N=0.5):
    return film.charge_pC(np.array([x_mm]), np.array([y_mm]), np.array([force_N]))[0]


def test_timestamps_of_a_file_follow_the_clock_of_the_board(predictor, tmp_path):
    path = tmp_path / "frames"
    path.write_bytes(chunk(*frames(np.tile(OFFSET, (600, 1)))).data)
    with open_source(str(path)) as source:
        times = [record.timestamp for record in stream(source, predictor)]
    np.testing.assert_allclose(np.diff(times), 0.005, atol=1e-6)


def test_device_file_of_the_board_is_used(predictor):
    """Numbers of another unit, whose tare is two frames."""
    device = device_from_table({"gain": {"pC_per_unit": 2.0}, "tare": {"frames": 2}}, "test")
    *_, record = stream([chunk(*frames(np.tile(OFFSET, (3, 1))))], predictor, device)
    assert record.tare_pC == {"A": 24.0, "B": -14.0, "C": 6.0}


def test_record_of_a_press(film, play):
    raw = pressed(film) + OFFSET
    (record,) = play(Frame(10, 50_000, tuple(raw.tolist())))
    assert (record.x_mm, record.y_mm, record.force_N) == pytest.approx((2.0, -3.0, 0.5), rel=1e-5)
    assert (record.contact, record.flags, record.seq, record.t_device_us) == (True, (), 10, 50_000)
    assert record.charge_pC == pytest.approx(dict(zip("ABC", pressed(film), strict=True)), rel=1e-5)
    assert record.charge_raw_pC == pytest.approx(dict(zip("ABC", raw, strict=True)), rel=1e-6)
    assert record.tare_pC == {"A": 12.0, "B": -7.0, "C": 3.0}
    assert (record.model, record.frame_id) == ("linear/1", "linear-film")
    assert abs(record.timestamp - time.time()) < 5.0
    assert 0.0 < record.latency_us < 5e6


def test_policy_latest_passes_flags_of_skipped_frames_on(predictor):
    """Frames without a record pass on what they say of the stream; what they say of themselves goes with them."""
    touch = TouchStream(predictor, chain=CHAIN, policy=Policy.latest)
    list(touch.feed(chunk(*frames(np.tile(OFFSET, (10, 1))))))
    at = lambda seq, *values: Frame(seq, 5000 * seq, values or tuple(OFFSET.tolist()))  # noqa: E731
    (record,) = touch.feed(chunk(at(20), at(20), at(3), at(4, math.nan, 0.0, 0.0), at(5)))
    assert record.flags == ("gap", "repeat", "restart")
    (record,) = touch.feed(chunk(at(6), at(7)))
    assert record.flags == ()
    (record,) = touch.feed(chunk(at(8), at(9), at(11))._replace(outage_s=2.0))
    assert (record.flags, touch.counts.skipped) == (("reconnected", "gap", "tare"), 9 + 4 + 1 + 2)


def test_use_another_model_of_the_same_electrodes(film, make_film, predictor, tmp_path):
    touch = TouchStream(predictor, chain=CHAIN, frame_id="left")
    rest = list(touch.feed(chunk(*frames(np.tile(OFFSET, (10, 1))))))
    touch.use(Predictor(film.write(tmp_path, version=2)))
    (record,) = touch.feed(chunk(Frame(10, 50_000, tuple((pressed(film) + OFFSET).tolist()))))
    assert (rest[-1].model, record.model, record.flags, record.frame_id) == ("linear/1", "linear/2", (), "left")
    assert record.force_N == pytest.approx(0.5, rel=1e-5)
    with pytest.raises(ModelError, match=r"linear/1: expected the electrodes \('A', 'B', 'C'\) of linear/2"):
        touch.use(Predictor(make_film(4).write(tmp_path / "four")))
    assert touch.predictor.metadata.label == "linear/2"


def test_record_out_of_contact(play):
    (record,) = play(Frame(10, 50_000, tuple((OFFSET + 1.0).tolist())))
    assert (record.contact, record.force_N, record.flags) == (False, 0.0, ())
    assert {record.x_mm, record.y_mm, record.x_std_mm, record.y_std_mm, record.force_std_N, record.misfit} == {None}
    assert record.charge_pC == {"A": 1.0, "B": 1.0, "C": 1.0}


def test_record_before_the_tare(predictor):
    records = list(stream([chunk(*frames(np.tile(OFFSET, (10, 1))))], predictor, chain=CHAIN))
    assert {(r.flags, r.contact, r.force_N, r.charge_pC, r.tare_pC) for r in records} == {
        (("tare",), False, 0.0, None, None)
    }
    assert records[0].charge_raw_pC == {"A": 12.0, "B": -7.0, "C": 3.0}


@pytest.mark.parametrize(
    ("press", "flags"),
    [({"x_mm": 9.0}, ("outside",)), ({"force_N": 2.5}, ("outside",)), ({"force_N": 0.049}, ("outside",)), ({}, ())],
)
def test_press_outside_the_domain_is_flagged(film, play, press, flags):
    assert play(Frame(10, 0, tuple((pressed(film, **press) + OFFSET).tolist())))[0].flags == flags


def test_flags_of_the_frame_are_in_the_record(film, play):
    charges = tuple((pressed(film) + OFFSET).tolist())
    gaps = SequenceGaps()
    records = play(
        Frame(10, 0, charges), Frame(13, 0, charges, flags=1), Frame(13, 0, charges), Frame(2, 0, charges), gaps=gaps
    )
    late = "saturated"  # until the press is over
    assert [r.flags for r in records] == [(), ("gap", late), ("repeat", late), ("restart", late)]
    assert (gaps.lost, gaps.repeated, gaps.restarts) == (2, 1, 1)


@pytest.mark.parametrize("damaged", [1.01e9, -1e38, 1e300, -1.7e308, math.inf])
def test_value_that_is_no_charge_makes_only_its_frame_invalid(film, predictor, damaged):
    """Text has no checksum: a digit more in the exponent must stop neither the stream nor the sums of the chain."""
    device = device_from_table(
        {"gain": {"pC_per_unit": 2.0}, "leak": {"tau_s": 1.0}, "hum": {"frequency_Hz": 50.0}}, ""
    )
    good = (pressed(film) / 2.0).tolist()

    def play(*odd):
        rows = [(0.0, 0.0, 0.0)] * 400 + [good] * 50 + [(good[0], value, good[2]) for value in odd] + [good] * 50
        lines = (",".join(f"{value:.9g}" for value in row) + "\n" for row in rows)
        path = TouchStream(predictor, device)
        return [r for k, line in enumerate(lines) for r in path.feed(Chunk(line.encode(), 1e9 + 0.005 * k, 0))]

    *_, expected = play()
    records = play(damaged)
    bad = next(r for r in records if "invalid" in r.flags)
    assert (bad.contact, bad.force_N, bad.charge_pC) == (False, None, None)
    assert records[-1].charge_pC == pytest.approx(expected.charge_pC, rel=1e-2)
    assert records[-1].contact


@pytest.mark.parametrize("data", [b"", b"hello, film\n"])
def test_file_without_a_frame_raises_an_error(predictor, data):
    """However short it is: silence must not be taken for a film that is left alone."""
    with pytest.raises(PortError, match=f"no intact frame among the first {len(data)} bytes"):
        list(stream([Chunk(data, 1e9, 0)] if data else [], predictor))


def test_wrong_number_of_charges_raises_an_error(play):
    with pytest.raises(ChargeError, match=r"model linear/1 expects 3 charges \('A', 'B', 'C'\), frame 10 has 4"):
        play(Frame(10, 0, (1.0, 2.0, 3.0, 4.0)))


def test_bytes_without_frames_raise_an_error(predictor):
    noise = [Chunk(bytes(range(128, 256)) * 4, 0.0, 0)] * 50
    with pytest.raises(
        PortError, match=r"no intact frame among the first \d+ bytes .*nothing recognised yet: check baud"
    ):
        list(stream(noise, predictor))
