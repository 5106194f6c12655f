"""Tests of the stream from chunks of bytes to records, without a port."""

import time

import numpy as np
import pytest

from isocharge.common.errors import ChargeError, PortError
from isocharge.serve import (
    Chunk,
    Frame,
    Predictor,
    TouchStream,
    device_from_table,
    encode_frame,
    open_source,
    stream,
)

OFFSET = np.array([12.0, -7.0, 3.0])
"""Charges at rest, shape (3,), pC."""

BOARD = device_from_table({"tare": {"frames": 10}}, "board")
"""Board with a short tare."""


def chunk(*frames):
    """Return a chunk that contains frames and arrives now."""
    return Chunk(b"".join(map(encode_frame, frames)), time.time(), time.perf_counter_ns())


def frames_of(charges_pC, n, first=0):
    """Return n frames with the touch charges of three electrodes, pC, and the charges at rest."""
    values = tuple((OFFSET + charges_pC).tolist())
    return [Frame(number, 5000 * number, values) for number in range(first, first + n)]


@pytest.fixture
def record_after_rest(predictor):
    """Return a function that processes a frame after ten frames at rest, and returns its record."""

    def process(frame):
        *_, record = stream([chunk(*frames_of(0.0, 10)), chunk(frame)], predictor, BOARD)
        return record

    return process


@pytest.fixture
def press_pC(film):
    """Touch charges of a press of 0.5 N at (2, -3) mm, shape (3,), pC."""
    return film.charge_pC([2.0], [-3.0], [0.5])[0]


def test_timestamps_of_a_file_follow_the_clock_of_the_board(predictor, tmp_path):
    path = tmp_path / "frames"
    path.write_bytes(chunk(*frames_of(0.0, 600)).data)
    with open_source(str(path)) as source:
        times = [record.timestamp for record in stream(source, predictor)]
    np.testing.assert_allclose(np.diff(times), 0.005, atol=1e-6)


def test_tare_follows_the_drift_in_a_file_without_a_clock(predictor):
    """With 200 frames per second, the charge of A rises by 1 pC/s."""
    chunks = [Chunk(b"A=%g B=0 C=0\n" % (n / 200), 1e9, 0) for n in range(2000)]
    assert not any(record.contact for record in stream(chunks, predictor))


def test_record_of_a_press(press_pC, record_after_rest):
    record = record_after_rest(*frames_of(press_pC, 1, first=10))
    assert (record.x_mm, record.y_mm, record.force_N) == pytest.approx((2.0, -3.0, 0.5), rel=1e-5)
    assert (record.contact, record.flags, record.seq, record.t_device_us) == (True, (), 10, 50_000)
    assert [*record.charge_pC.values()] == pytest.approx(press_pC.tolist(), rel=1e-5)
    assert [*record.charge_raw_pC.values()] == pytest.approx((press_pC + OFFSET).tolist(), rel=1e-6)
    assert record.tare_pC == {"A": 12.0, "B": -7.0, "C": 3.0}
    assert (record.model, record.frame_id) == ("linear/1", "linear-film")
    assert abs(record.timestamp - time.time()) < 5.0
    assert 0.0 < record.latency_us < 5e6


def test_record_out_of_contact(record_after_rest):
    record = record_after_rest(*frames_of(1.0, 1, first=10))
    assert (record.contact, record.force_N, record.flags) == (False, 0.0, ())
    assert {record.x_mm, record.y_mm, record.x_std_mm, record.y_std_mm, record.force_std_N, record.misfit} == {None}
    assert record.charge_pC == {"A": 1.0, "B": 1.0, "C": 1.0}


def test_record_before_the_tare(predictor):
    for record in stream([chunk(*frames_of(0.0, 10))], predictor, BOARD):
        assert record.flags == ("tare",)
        assert (record.contact, record.force_N, record.charge_pC, record.tare_pC) == (False, 0.0, None, None)
        assert record.charge_raw_pC == {"A": 12.0, "B": -7.0, "C": 3.0}


@pytest.mark.parametrize(
    ("first", "later", "message"),
    [
        (b"\n" + b"1,2,3\n" * 9, b"A=1 B=2 C=3\n" * 300, ", such as 'A=1 B=2 C=3'; expected text: 3 columns"),
        (encode_frame(Frame(1, 2, (1.0, 2.0, 3.0))), b"\n" * 3600, "; expected binary frames"),
    ],
)
def test_board_that_sends_other_bytes_from_now_on_is_reported_once(predictor, caplog, first, later, message):
    """For example, its program was replaced while the stream runs."""
    list(stream([Chunk(piece, 1e9, 0) for piece in (b"boot\n\0", first, *[later] * 5)], predictor))
    assert caplog.text.count(f" bytes{message}") == 1


@pytest.mark.parametrize("data", [b"", b"hello, film\n"])
def test_file_without_a_frame_raises_an_error(predictor, data):
    """An error is raised even if the file is empty, because an empty file does not mean that nothing touches."""
    with pytest.raises(PortError, match=f"no intact frame among the first {len(data)} bytes"):
        list(stream([Chunk(data, 1e9, 0)] if data else [], predictor))


SENSORS_OF_ANY_SIGN = [
    {"name": "presses-alone"},
    {"name": "opposite-poling", "film": {"radius_mm": 45.0}, "piezo": {"d31": -8.0, "d32": -8.0}},
    {"name": "shear", "film": {"radius_mm": 45.0}, "piezo": {"d31": 0, "d32": 0, "d12": 5.0}},
]


@pytest.mark.parametrize("sensor", SENSORS_OF_ANY_SIGN)
@pytest.mark.parametrize("is_replaced", [False, True])
def test_touch_with_negative_charges(film, predictor, press_pC, sensor, is_replaced, tmp_path):
    """The model is the first one of the stream, or it replaces the model of a film with positive charges."""
    film.write(tmp_path, name="other", sensor=sensor)
    other = Predictor("other", models=tmp_path)
    touch = TouchStream(predictor if is_replaced else other, BOARD)
    records = list(touch.feed(chunk(*frames_of(0.0, 10))))
    if is_replaced:
        touch.use(other)
    records += touch.feed(chunk(*frames_of(-press_pC, 5, first=10)))
    assert [record.contact for record in records] == [False] * 10 + [True] * 5
    with pytest.raises(ChargeError, match=r"model other/1 expects 3 charges .*, frame \d+ has"):
        list(touch.feed(chunk(Frame(15, 75_000, (1.0, 2.0)))))


@pytest.mark.parametrize("number", ["", "seq={} "])
def test_board_that_restarts_has_the_flag_restart_by_its_clock(predictor, number):
    """The sequence number of one byte is 200 before the restart, which looks like a wrap after lost frames."""
    touch = TouchStream(predictor)
    flags = []
    for i in range(657):
        line = f"{number.format(i % 457 % 256)}t_us={5000 * (i % 457)} A=0.1 B=0.2 C=0.3\n".encode()
        flags += [record.flags for record in touch.feed(Chunk(line, 1e9 + 0.005 * i, 5_000_000 * i))]
    assert [index for index, words in enumerate(flags) if "restart" in words] == [457]
    assert touch.parser.counts.restarts == 1
