"""Sampling of the presses of a sweep: ranges, uniform distribution and seeds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from isocharge.common.errors import SceneError
from isocharge.simulate import Circle, Polygon, Sweep

PROBES = (Circle(1.0), Polygon.rectangle(4.0, 2.0), Polygon.triangle(4.0))

sweeps = st.builds(
    Sweep,
    radius=st.floats(0.1, 40.0),
    force_range=st.tuples(st.floats(1e-5, 10.0), st.floats(1e-5, 10.0)).map(lambda pair: (min(pair), max(pair))),
    samples=st.integers(3, 700),
    seed=st.integers(0, 2**40),
    orientation=st.sampled_from(["fixed", "random"]),
)


@settings(deadline=None, max_examples=50)
@given(sweeps, st.integers(1, 3))
def test_presses_lie_within_the_ranges_and_have_the_requested_number(sweep, count):
    presses = sweep.presses(PROBES[:count])
    low, high = sweep.force_range
    x, y, force = presses.contact.T
    assert np.hypot(x, y).max() <= sweep.radius * (1.0 + 1e-15)
    assert low <= force.min() <= force.max() <= high
    assert 0.0 <= presses.rotation.min() <= presses.rotation.max() < 2.0 * np.pi
    assert sweep.orientation == "random" or not presses.rotation.any()
    assert len(presses) == len(presses.contact) == len(presses.rotation) == sweep.samples
    np.testing.assert_array_equal(presses.probe, np.arange(sweep.samples) % count)


def test_presses_are_uniform_in_the_logarithm_of_the_force():
    _, _, force = Sweep(samples=4000, seed=1, force_range=(0.05, 2.0)).contacts().T
    assert stats.kstest(np.log(force), "uniform", args=(np.log(0.05), np.log(40.0))).pvalue > 0.05


def test_presses_depend_on_seed_and_probe():
    first, other = (Sweep(samples=100, seed=seed).contacts() for seed in (5, 6))
    assert np.all(first != other)
    two = Sweep(samples=100).presses((Circle(1.0), Circle(1.0))).contact
    assert np.all(two[::2] != two[1::2])


# Refused


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"radius": np.nan}, "radius: expected a positive number"),
        ({"seed": -1}, "seed: expected 0 or more, got -1"),
        ({"samples": 10_000_001}, "samples: expected 1 to 10000000 presses, got 10000001"),
        ({"orientation": "Random"}, "orientation: expected 'fixed' or 'random', got 'Random'"),
        ({"force_range": (0.0, 1.0)}, "force range: expected 0 < MIN <= MAX in N"),
        ({"force_range": (2.0, 1.0)}, "force range: expected 0 < MIN <= MAX in N"),
        ({"force_range": (1.0, np.inf)}, "force range: expected 0 < MIN <= MAX in N"),
        ({}, "probes: expected at least one, got none"),
    ],
)
def test_impossible_sweep_raises_scene_error(settings, message):
    with pytest.raises(SceneError, match=message):
        Sweep(**settings).presses(PROBES if settings else ())
