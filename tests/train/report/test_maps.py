"""Where the errors are: bins against planted errors."""

import numpy as np

from isocharge.simulate import Domain
from isocharge.train.data.presses import draw_contacts
from isocharge.train.report.studies import by_force

DOMAIN = Domain(8.0, (0.05, 2.0))


def test_errors_fall_into_the_bins_of_their_forces():
    truth = draw_contacts(np.random.default_rng(0), DOMAIN, 3000)
    edges = np.geomspace(0.05, 2.0, 13)
    strong = (truth[:, 2] > edges[10]) & (truth[:, 2] < edges[11])
    found = by_force(
        DOMAIN, truth, {"method": truth + np.where(strong, 0.5, 0.1)[:, None] * [0.6, 0.8, 0.0]}, truth[:, 0]
    )
    np.testing.assert_allclose(found["position_rms_mm"]["method"], [0.1] * 10 + [0.5, 0.1], rtol=1e-3)
    np.testing.assert_allclose(found["force_N"][10] ** 2, edges[10] * edges[11], rtol=1e-3)


def test_error_by_force_of_a_shift():
    truth = draw_contacts(np.random.default_rng(0), DOMAIN, 3000)
    found = by_force(DOMAIN, truth, {"method": truth + np.array([0.3, 0.4, 0.0])}, np.full(3000, 0.2))
    np.testing.assert_allclose(found["position_rms_mm"]["method"], 0.5, rtol=1e-3)
    np.testing.assert_allclose(found["position_rms_mm"]["Cramér-Rao"], 0.2, rtol=1e-3)
