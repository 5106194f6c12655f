"""Samples of fixed size: what is written is what a reader of the documented layout reads; and many as few."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from isocharge.serve import flags
from isocharge.serve.viewer.samples import CONTACT_BIT, FLAG_BITS, SampleFormat, coalesce

FORM = SampleFormat(("A", "B", "C"))


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


def samples(force_N, bits=None):
    """Samples 1 ms apart, contacts where the force is above zero."""
    rows = np.zeros(len(force_N), FORM.dtype)
    rows["timestamp"] = 1e-3 * np.arange(len(rows))
    rows["force_N"] = force_N
    rows["flags"] = np.where(np.array(force_N) > 0, CONTACT_BIT, 0) | (0 if bits is None else np.array(bits))
    rows["records"] = 1
    rows["latency_us"] = np.arange(len(rows))
    return rows


@given(
    force_N=st.lists(st.floats(0, 2, width=32), min_size=1, max_size=400),
    most=st.integers(1, 50),
    seed=st.integers(0, 1000),
)
def test_runs_stand_for_all(force_N, most, seed):
    bits = np.random.default_rng(seed).integers(0, 1 << 12, len(force_N))
    rows = samples(force_N, bits)
    shown = coalesce(rows, most)
    assert len(shown) == min(most, len(rows))
    assert shown["records"].sum() == len(rows)
    assert np.bitwise_or.reduce(shown["flags"]) == np.bitwise_or.reduce(rows["flags"])
    assert shown["latency_us"][-1] == len(rows) - 1
    assert (np.diff(shown["timestamp"]) > 0).all()
    assert set(shown["force_N"].tolist()) <= set(rows["force_N"].tolist())


@given(start=st.integers(0, 90), most=st.integers(1, 30))
def test_a_tap_is_shown(start, most):
    force_N = np.zeros(100)
    force_N[start : start + 3] = (0.5, 1.0, 0.4)
    touching = coalesce(samples(force_N), most)
    assert (touching["flags"] & CONTACT_BIT).any()
    assert touching["force_N"].max() >= 0.4


def test_the_newest_contact_counts():
    """While something touches, what is shown is where it is now, not where it was pressed hardest."""
    shown = coalesce(samples(np.linspace(2.0, 1.0, 64)), 1)
    assert shown["timestamp"][0] == 0.063
