"""Samples of fixed size: what is written is what a reader of the documented layout reads."""

import math
import struct

import numpy as np
import pytest

from isocharge.serve import flags
from isocharge.serve.viewer.sample import CONTACT_BIT, FLAG_BITS, NUMBERS, SampleFormat


@pytest.mark.parametrize("electrodes", [("A", "B"), ("A", "B", "C"), ("A", "B", "C", "D")])
def test_layout_is_the_documented_one(record, electrodes):
    form = SampleFormat(electrodes)
    charges = {name: 10.0 + k for k, name in enumerate(electrodes)}
    data = form.pack(record(charge_pC=charges, y_mm=-2.5, force_N=1.5, misfit=0.25, flags=("gap", "outside")))
    assert len(data) == form.dtype.itemsize
    assert len(data) % 8 == 0
    timestamp, x, y, force, *_, bits, count = struct.unpack_from("<d8fII", data)
    assert timestamp == 1763600000.1234567
    assert (x, y, force) == (np.float32(1.23456789), -2.5, 1.5)
    assert bits == CONTACT_BIT | FLAG_BITS["gap"] | FLAG_BITS["outside"]
    assert count == 1
    assert struct.unpack_from(f"<{len(electrodes)}f", data, 48) == tuple(charges.values())


def test_numpy_reads_the_same(record):
    form = SampleFormat(("A", "B"))
    sample = np.frombuffer(form.pack(record(latency_us=12.0)), form.dtype)[0]
    assert sample["charge_pC"][0] == 800.0625
    assert math.isnan(sample["charge_pC"][1])
    assert sample["latency_us"] == 12.0
    assert all(math.isnan(sample[name]) for name in NUMBERS[1:7])


def test_what_no_float32_holds_is_clipped(record):
    form = SampleFormat(("A",))
    sample = np.frombuffer(form.pack(record(charge_pC={"A": -1e300}, misfit=1e200)), form.dtype)[0]
    assert sample["charge_pC"][0] == -np.finfo(np.float32).max
    assert sample["misfit"] == np.finfo(np.float32).max


def test_every_flag_has_a_bit_of_its_own():
    words = {value for name, value in vars(flags).items() if name.isupper() and isinstance(value, str)}
    assert set(FLAG_BITS) == words
    assert len(set(FLAG_BITS.values())) == len(words)
    assert max(FLAG_BITS.values()) < CONTACT_BIT
