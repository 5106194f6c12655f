"""Many samples as few: nothing is counted twice or left out, and a short tap is seen."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from isocharge.serve.viewer.coalesce import coalesce
from isocharge.serve.viewer.sample import CONTACT_BIT, SampleFormat

FORM = SampleFormat(("A", "B", "C"))


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
