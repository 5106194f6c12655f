"""Samples of the live page: their numbers, their storage in a tape, and coalescing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from isocharge.serve.record.record import OtherContact, TrackedContact
from isocharge.serve.viewer.tape import (
    FLAG_BITS,
    MAX_DRAWN_SAMPLES,
    RecordedTape,
    Tape,
    coalesce,
    sample_type,
    sample_values,
)

TYPE = sample_type(("A", "B", "C"))


def sample_of(record):
    """Return the sample of a record."""
    tape = Tape(TYPE)
    tape.append(sample_values(record, ("A", "B", "C")))
    return tape.samples(0, 1)[0]


def test_unknown_numbers_of_a_record_are_nan(record):
    sample = sample_of(
        record(charge_pC={"A": -1e300}, misfit=1e200, y_mm=None, flags=("gap", "misfit", "of a later version"))
    )
    assert (sample["charge_pC.A"], sample["misfit"], sample["contact"]) == (-1e300, 1e200, 1.0)
    assert sample["flags"] == FLAG_BITS["gap"] + FLAG_BITS["misfit"]
    assert np.isnan([sample["y_mm"], sample["charge_pC.B"]]).all()


def test_sample_contains_the_tracked_contact(record):
    tracked = TrackedContact(2.0, 3.0, 0.4, 0.01, 0.02, 0.001, 0.0, 0.0, 0.1)
    other = OtherContact(5.0, -1.0, 1.0, 0.25)
    sample = sample_of(record(x_mm=1.0, misfit=0.5, xy_correlation=0.25, tracked=tracked, other=other))
    assert (sample["x_mm"], sample["misfit"], sample["xy_correlation"], sample["x_std_mm"]) == (2.0, 0.5, 0.25, 0.01)
    assert (sample["other_x_mm"], sample["other_y_mm"]) == (5.0, -1.0)


def samples(times_s, force_N=0.0, bits=0):
    """Return samples with times, s, and forces, N. They are contacts if the force is above zero."""
    rows = np.zeros(len(times_s), TYPE)
    rows["timestamp"] = times_s
    rows["force_N"] = force_N
    rows["contact"] = rows["force_N"] > 0.0
    rows["flags"] = bits
    rows["records"] = 1
    return rows


@given(count=st.integers(1, 400), max_samples=st.integers(1, 50), seed=st.integers(0, 1000))
def test_coalesced_samples_represent_all_records(count, max_samples, seed):
    rng = np.random.default_rng(seed)
    force_N = rng.choice([0.0, 0.5, 1.0], count)
    bits = rng.integers(0, 1 << 12, count)
    shown = coalesce(samples(1e-3 * np.arange(count), force_N, bits), max_samples)
    assert len(shown) == min(max_samples, count)
    assert shown["records"].sum() == count
    assert np.bitwise_or.reduce(shown["flags"].astype(int)) == np.bitwise_or.reduce(bits)
    assert (np.diff(shown["timestamp"]) > 0).all()
    assert shown["contact"].any() == (force_N > 0.0).any()


def test_short_tap_is_not_lost_by_coalescing():
    """The contact with the largest force represents a run that ends without a contact."""
    force_N = np.zeros(100)
    force_N[40:43] = (0.5, 1.0, 0.4)
    shown = coalesce(samples(np.arange(100.0), force_N), 2)
    assert shown[["timestamp", "force_N"]].tolist() == [(41.0, 1.0), (99.0, 0.0)]


def test_coalescing_shows_the_latest_contact_of_a_run():
    """During a touch, the latest contact is shown, not the contact with the largest force."""
    shown = coalesce(samples(np.arange(64.0), np.linspace(2.0, 1.0, 64)), 1)
    assert shown["timestamp"][0] == 63.0


def append(tape, times_s, force_N=0.0):
    for time_s, force in zip(times_s, np.broadcast_to(force_N, len(times_s)), strict=True):
        tape.append((time_s, *(force if name == "force_N" else 0.0 for name in TYPE.names[1:])))


def test_live_tape_stores_the_latest_samples():
    tape = Tape(TYPE, capacity=10)
    assert tape.rate_Hz() is None
    append(tape, np.arange(35.0))
    assert (tape.oldest, tape.total) == (25, 35)
    assert tape.first_number_after(30.5) == 31
    assert tape.samples(0, 35)["timestamp"].tolist() == list(range(25, 35))
    assert tape.rate_Hz() == pytest.approx(1.0)


@pytest.fixture
def recorded():
    """Return an empty tape of a recording."""
    return RecordedTape(TYPE)


def test_recorded_tape_replaces_times_that_go_back(recorded):
    """The page could not show a recording that ends before its beginning."""
    append(recorded, [10.0, 12.0, 2.0, 13.0])
    assert recorded.samples(0, 4)["timestamp"].tolist() == [10, 12, 12, 13]


def test_recorded_tape_stores_all_samples_and_the_largest_force_of_each_piece(recorded):
    force_N = np.zeros(36_000)
    force_N[18_000] = 1.5
    append(recorded, 1e9 + 1e-3 * np.arange(36_000), force_N)
    assert len(recorded.samples(0, 36_000)) == recorded.total == 36_000
    assert recorded.span() == (1e9, 1e9 + 35.999)
    assert recorded.first_number_after(1e9 + 15.0005) == 15_001
    overview = recorded.extent()["overview"]
    assert len(overview) == MAX_DRAWN_SAMPLES
    assert overview.index(1.5) / MAX_DRAWN_SAMPLES == pytest.approx(0.5, abs=0.01)
    assert sum(force > 0 for force in overview) == 1
