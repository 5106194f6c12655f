"""Position errors of a layout, compared with the Cramer-Rao limits of `identifiability`."""

import numpy as np
import pytest

from isocharge.simulate import NoiseModel
from isocharge.simulate.identifiability.cramer_rao import cramer_rao
from isocharge.simulate.layout.case import NO_NUISANCES, Nuisances
from isocharge.simulate.layout.position_error import ErrorModel, squared_errors_with_candidates

REFERENCE = NoiseModel("reference", 1.0, 2e-3)
UNKNOWN = Nuisances(0.3, 0.1, 0.0)


@pytest.fixture
def rows():
    """Rows with charges of about 500 pC that change by about 100 pC/mm."""
    rng = np.random.default_rng(3)
    size = np.array([500.0, 100.0, 100.0, 330.0, 10.0, 100.0])
    return size * (np.array([1.0, 0, 0, 1, 0, 0]) + 0.5 * rng.standard_normal((20, 5, 6)))


def test_errors_without_nuisances_are_cramer_rao_limits(rows):
    limits = cramer_rao(rows[..., 0], rows[..., 1:4], REFERENCE)
    assert np.sqrt(ErrorModel.of(REFERENCE, NO_NUISANCES).squared_errors(rows)) == pytest.approx(
        limits.position, rel=1e-3
    )


def test_squared_errors_with_candidates_agree_with_the_errors_of_the_extended_layout(rows):
    model = ErrorModel.of(REFERENCE, UNKNOWN)
    sensitivity = model.sensitivity(rows)
    updated = squared_errors_with_candidates(sensitivity[:, :3], sensitivity[:, 3:].swapaxes(1, 2))
    for number in (3, 4):
        assert updated[:, number - 3] == pytest.approx(model.squared_errors(rows[:, [0, 1, 2, number]]), rel=1e-6)
