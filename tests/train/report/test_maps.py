"""Where the errors are: regions and bins against brute force."""

import numpy as np

from isocharge.simulate import Domain
from isocharge.train.data.presses import draw_contacts
from isocharge.train.report.maps import Draws, by_force, force_bins, worst_regions

DOMAIN = Domain(8.0, (0.05, 2.0))


def test_the_worst_region_is_where_the_errors_were_planted():
    truth = draw_contacts(np.random.default_rng(0), DOMAIN, 20_000)
    angle = np.rad2deg(np.arctan2(truth[:, 1], truth[:, 0])) % 360.0
    planted = (np.hypot(*truth[:, :2].T) > 7.0) & (angle >= 60.0) & (angle < 90.0) & (truth[:, 2] > 0.6)
    contact = truth + np.where(planted, 1.0, 0.1)[:, None] * np.array([0.6, 0.8, 0.0])
    regions = worst_regions(
        DOMAIN, Draws(truth, contact, np.ones_like(truth)), truth + np.array([0.1, 0.0, 0.0]), contact, truth
    )
    assert (regions[0]["angle_deg"], regions[0]["radius_mm"]) == ([60, 90], [6.93, 8.0])
    np.testing.assert_allclose(regions[0]["force_N"], [0.05 * 40 ** (2 / 3), 2.0], rtol=5e-3)
    assert 0.9 < regions[0]["position_rms_mm"] <= 1.0
    assert 9.0 < regions[0]["over_bayes"] <= 10.0
    assert all(region["position_rms_mm"] == 0.1 for region in regions[1:])


def test_force_bins_by_a_loop():
    force = draw_contacts(np.random.default_rng(0), DOMAIN, 500)[:, 2]
    middle, number = force_bins(DOMAIN, force, 6)
    edges = np.geomspace(0.05, 2.0, 7)
    for value, k in zip(force, number, strict=True):
        assert edges[k] * (1 - 1e-12) <= value <= edges[k + 1] * (1 + 1e-12)
    np.testing.assert_allclose(middle**2, edges[:-1] * edges[1:])


def test_error_by_force_of_a_shift():
    truth = draw_contacts(np.random.default_rng(0), DOMAIN, 3000)
    found = by_force(DOMAIN, truth, {"method": truth + np.array([0.3, 0.4, 0.0])}, np.full(3000, 0.2))
    np.testing.assert_allclose(found["position_rms_mm"]["method"], 0.5, rtol=1e-3)
    np.testing.assert_allclose(found["position_rms_mm"]["Cramér-Rao"], 0.2, rtol=1e-3)
