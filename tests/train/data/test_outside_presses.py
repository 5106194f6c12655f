"""Presses between the working area and the clamp, and the shares that are measured on them."""

from types import SimpleNamespace

import numpy as np
import pytest

from isocharge.serve import Predictor
from isocharge.simulate import Domain, noise_model
from isocharge.train.data.outside_presses import OutsidePresses
from isocharge.train.data.presses import LabelledPresses, draw_contacts
from isocharge.train.model_release.evaluate import unnoticed_presses

FORCES_N = (0.05, 2.0)


def presses(count, inner, outer):
    """Presses that are uniformly distributed over a ring."""
    contact = draw_contacts(np.random.default_rng(1), Domain(outer, FORCES_N), count)
    ring = LabelledPresses(contact, np.abs(contact) + 1.0)
    return ring[ring.distance > inner]


INSIDE = presses(20_000, 0.0, 10.0)
OUTSIDE = presses(16_000, 10.0, 40.0)


def test_presses_for_training_and_for_measuring_are_different_presses_beyond_the_area():
    """The network has a smaller working area than the dataset. The presses beyond it are outside, too."""
    found = OutsidePresses.of(Domain(5.0, FORCES_N), INSIDE, OUTSIDE)
    for part in (found.train, found.test):
        assert 5.0 < part.distance.min() < 5.1
        assert part.distance.max() > 39.5
    assert found.test.contact[:, 2].min() >= 0.2
    places = {tuple(contact) for contact in found.train.contact}
    assert not places & {tuple(contact) for contact in found.test.contact}


def test_unnoticed_shares_are_those_of_the_places():
    """Presses with y > 0 beyond 25 mm are unnoticed; these are half of the outer rings and none of the inner rings."""
    found = OutsidePresses.of(Domain(10.0, FORCES_N), INSIDE, OUTSIDE)
    unnoticed = found.unnoticed_shares((found.test.contact[:, 1] > 0.0) & (found.test.distance > 25.0))
    assert (unnoticed.from_mm, unnoticed.force_N) == (10.0, (0.2, 2.0))
    assert unnoticed.to_mm == pytest.approx(40.0, abs=0.01)
    upper, lower = np.split(np.array(unnoticed.share[-2]), 2)
    assert upper[2:-2].min() == 1.0
    assert lower[2:-2].max() == 0.0
    expected = 0.5 * (40.0**2 - 25.0**2) / (40.0**2 - 10.0**2)
    assert unnoticed.total_share == pytest.approx(expected, abs=0.01)


def test_few_presses_leave_no_presses_outside():
    assert OutsidePresses.of(Domain(10.0, FORCES_N), INSIDE) is None
    assert OutsidePresses.of(Domain(10.0, FORCES_N), INSIDE, OUTSIDE[:10]) is None


def test_answers_wrong_by_more_than_four_standard_deviations_without_a_flag_are_unnoticed():
    """The answers for y > 0 are wrong, and those for x > 0 have the flag `misfit`."""
    outside = OutsidePresses.of(Domain(10.0, FORCES_N), INSIDE, OUTSIDE)
    truth = outside.test.contact
    is_flagged, is_wrong, _ = np.hsplit(truth > 0.0, 3)
    contact = truth * [0.1, 0.1, 0.9]
    std = np.abs(contact - truth) / np.where(is_wrong, 4.1, 3.9)
    answers = (contact, std, 100.0 * is_flagged)
    fitted = SimpleNamespace(outside=outside, noise=noise_model("reference"), predict=lambda _: answers)
    unnoticed = unnoticed_presses(fitted, Predictor("three-25um-biaxial").metadata)
    assert unnoticed == outside.unnoticed_shares((is_wrong & ~is_flagged).ravel())
