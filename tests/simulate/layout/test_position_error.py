"""Errors against the Cramer-Rao limits of `identifiability` and a covariance written out."""

import numpy as np
import pytest

from isocharge.simulate import NoiseModel
from isocharge.simulate.identifiability.cramer_rao import cramer_rao
from isocharge.simulate.layout.case import KNOWN, Nuisances
from isocharge.simulate.layout.position_error import ErrorModel, with_one_more

REFERENCE = NoiseModel("reference", 1.0, 2e-3)
UNKNOWN = Nuisances(0.3, 0.1, 0.0)


@pytest.fixture
def rows():
    """Charges of some 500 pC that change by some 100 pC/mm."""
    rng = np.random.default_rng(3)
    size = np.array([500.0, 100.0, 100.0, 330.0, 10.0, 100.0])
    return size * (np.array([1.0, 0, 0, 1, 0, 0]) + 0.5 * rng.standard_normal((20, 5, 6)))


def test_with_everything_known_they_are_cramer_rao_limits(rows):
    limits = cramer_rao(rows[..., 0], rows[..., 1:4], REFERENCE)
    assert np.sqrt(ErrorModel.of(REFERENCE, KNOWN).squared(rows)) == pytest.approx(limits.position, rel=1e-3)


def test_one_more_electrode_is_as_if_it_had_been_there(rows):
    model = ErrorModel.of(REFERENCE, UNKNOWN)
    sensitivity = model.sensitivity(rows)
    quick = with_one_more(sensitivity[:, :3], sensitivity[:, 3:].swapaxes(1, 2))
    for number in (3, 4):
        assert quick[:, number - 3] == pytest.approx(model.squared(rows[:, [0, 1, 2, number]]), rel=1e-6)
