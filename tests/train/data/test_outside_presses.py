"""Presses between the working area and the clamp, and the shares that are measured on them."""

import numpy as np
import pytest

from isocharge.simulate import Domain, FunctionMap, load_sensor
from isocharge.train.data.outside_presses import N_SECTORS, OutsidePresses

FILM = FunctionMap(lambda contact: np.abs(contact) + 1.0, ("A", "B", "C"), Domain(40.0, (0.05, 2.0)))
OUTSIDE = OutsidePresses(FILM, 10.0)


def test_presses_are_uniform_over_the_ring():
    contact = OUTSIDE.draw(20_000, seed=1).contact
    distance = np.hypot(contact[:, 0], contact[:, 1])
    assert distance.min() >= 10.0
    assert distance.max() <= 40.0
    assert np.mean(distance < 25.0) == pytest.approx((25.0**2 - 10.0**2) / (40.0**2 - 10.0**2), abs=0.01)
    assert np.mean(contact[:, 2] < np.sqrt(0.05 * 2.0)) == pytest.approx(0.5, abs=0.01)
    assert np.mean(contact[:, 0] > 0.0) == pytest.approx(0.5, abs=0.01)


def test_unnoticed_shares_are_those_of_the_places():
    """Presses with y > 0 beyond 25 mm are unnoticed; these are half of the outer rings and none of the inner rings."""
    contact = OUTSIDE.grid().contact
    distance = np.hypot(contact[:, 0], contact[:, 1])
    unnoticed = OUTSIDE.unnoticed_shares((contact[:, 1] > 0.0) & (distance > 25.0))
    assert (unnoticed.from_mm, unnoticed.to_mm, unnoticed.force_N) == (10.0, 40.0, (0.2, 2.0))
    outer_ring = unnoticed.share[-1]
    assert outer_ring == (1.0,) * (N_SECTORS // 2) + (0.0,) * (N_SECTORS // 2)
    assert sum(unnoticed.share[0]) == 0.0
    expected = 0.5 * (40.0**2 - 25.0**2) / (40.0**2 - 10.0**2)
    assert unnoticed.total_share == pytest.approx(expected, abs=1e-3)
    assert f"{100.0 * expected:.0f} % of the presses outside the working area, from 10 to 40 mm" in unnoticed.summary


def test_presses_beyond_a_working_area():
    beyond = OUTSIDE.beyond(20.0)
    distance = np.hypot(*beyond.draw(1000, seed=1).contact[:, :2].T)
    assert (distance.min() >= 20.0, distance.max() <= 40.0) == (True, True)
    assert OUTSIDE.beyond(39.5) is None  # the working area nearly reaches the clamp


def test_a_probe_as_wide_as_the_film_leaves_no_presses_outside():
    assert OutsidePresses.simulate(load_sensor("four-25um-biaxial"), ("circle:22",), (0.05, 2.0)) is None
