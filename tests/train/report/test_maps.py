"""Where the errors are: cells and bins against brute force."""

import numpy as np

from isocharge.train.data.domain import ContactDomain
from isocharge.train.report.maps import FORCES, RINGS, SECTORS, _cell_limits, _cells, by_force, force_bins

DOMAIN = ContactDomain(8.0, (0.05, 2.0))


def presses(count):
    rng = np.random.default_rng(0)
    radius, angle = 8.0 * np.sqrt(rng.random(count)), 2.0 * np.pi * rng.random(count)
    force = np.exp(rng.uniform(*np.log(DOMAIN.force_range_N), count))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), force])


def test_cells_hold_the_presses_that_their_words_say():
    truth = presses(2000)
    cells = _cells(DOMAIN, truth)
    assert cells.min() >= 0
    assert cells.max() < RINGS * SECTORS * FORCES
    radius, angle = np.hypot(*truth[:, :2].T), np.rad2deg(np.arctan2(truth[:, 1], truth[:, 0])) % 360.0
    for cell in np.unique(cells):
        words, here = _cell_limits(DOMAIN, int(cell)), cells == cell
        columns = {"radius_mm": radius, "angle_deg": angle, "force_N": truth[:, 2]}
        for values, (low, high) in ((columns[name], words[name]) for name in columns):
            assert (values[here] >= low * 0.99 - 1e-9).all()
            assert (values[here] <= high * 1.01 + 1e-9).all()


def test_force_bins_by_a_loop():
    truth = presses(500)
    middle, number = force_bins(DOMAIN, truth[:, 2], 6)
    edges = np.geomspace(0.05, 2.0, 7)
    for force, k in zip(truth[:, 2], number, strict=True):
        assert edges[k] * (1 - 1e-12) <= force <= edges[k + 1] * (1 + 1e-12)
    np.testing.assert_allclose(middle**2, edges[:-1] * edges[1:])


def test_error_by_force_of_a_shift():
    truth = presses(3000)
    found = by_force(DOMAIN, truth, {"method": truth + np.array([0.3, 0.4, 0.0])}, np.full(3000, 0.2))
    np.testing.assert_allclose(found["position_rms_mm"]["method"], 0.5, rtol=1e-3)
    np.testing.assert_allclose(found["position_rms_mm"]["Cramér-Rao"], 0.2, rtol=1e-3)
