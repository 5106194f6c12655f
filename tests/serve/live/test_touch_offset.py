"""Standard deviations of contacts whose touches may have an offset of all charges: the section `[touch_offset]`."""

import numpy as np
import pytest

from isocharge.common.errors import DeviceError
from isocharge.serve import Chunk, Frame, Predictor, TouchStream, device_from_table, encode_frame

LIGHT_pC = np.array([60.0, 80.0, 50.0, 70.0])
"""Charges of a light press, shape (4,), pC."""

STRONG_pC = 8.0 * LIGHT_pC
"""Charges of a strong press, shape (4,), pC."""


@pytest.fixture(scope="module")
def predictor() -> Predictor:
    return Predictor("four-25um-biaxial")


def held_record(predictor, charge_pC, **sections):
    """Return the last record of a press.

    Args:
        predictor: The model.
        charge_pC: Charges of the press, shape (4,), pC. The film is at rest before the press.
        sections: Sections of the device file.
    """
    stream = TouchStream(predictor, device_from_table(sections, "test"))
    rows = np.vstack([np.zeros((110, 4)), np.tile(charge_pC, (5, 1))])
    records = []
    for number, row in enumerate(rows):
        frame = Frame(number, 5000 * number, tuple(row.tolist()))
        records += stream.feed(Chunk(encode_frame(frame), 1.7e9 + 0.005 * number, 0))
    return records[-1]


def stds(record):
    """Return the standard deviations of x and y, mm, and of the force, N, of a record."""
    return np.array([record.x_std_mm, record.y_std_mm, record.force_std_N])


@pytest.mark.parametrize("charge_pC", [LIGHT_pC, STRONG_pC], ids=["light", "strong"])
def test_touch_offset_adds_the_scatter_that_random_offsets_cause(predictor, charge_pC):
    offset_pC = np.random.default_rng(0).normal(scale=3.0, size=2000)
    shifted = np.asarray(predictor.predict_batch(charge_pC + offset_pC[:, None]))[:, :3]
    without = stds(held_record(predictor, charge_pC))
    expected = np.hypot(without, shifted.std(axis=0))
    record = held_record(predictor, charge_pC, touch_offset={"std_pC": 3.0})
    np.testing.assert_allclose(stds(record), expected, rtol=0.1)


@pytest.mark.parametrize("value", [-1.0, "much"])
def test_touch_offset_that_is_no_charge_is_refused(value):
    with pytest.raises(DeviceError, match=r"touch_offset\.std_pC"):
        device_from_table({"touch_offset": {"std_pC": value}}, "test")
