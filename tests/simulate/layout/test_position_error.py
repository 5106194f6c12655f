"""Errors against the Cramer-Rao limits of `identifiability` and a Schur complement written out."""

import numpy as np
import pytest

from isocharge.simulate import NoiseModel
from isocharge.simulate.identifiability.cramer_rao import cramer_rao
from isocharge.simulate.layout.position_error import ErrorModel
from isocharge.simulate.layout.scene import Nuisances

REFERENCE = NoiseModel("reference", 1e-12, 2e-3)
UNKNOWN = Nuisances(0.3e-3, 0.29, 0.1e6, 0.0)


@pytest.fixture
def rows():
    """Charges of some 500 pC that change by some 100 pC/mm."""
    rng = np.random.default_rng(3)
    size = np.array([500e-12, 1e-7, 1e-7, 330e-12, 1e-8, 3e-12, 1e-16])
    return size * (np.array([1.0, 0, 0, 1, 0, 0, 0]) + 0.5 * rng.standard_normal((20, 5, 7)))


def test_with_everything_known_they_are_cramer_rao_limits(rows):
    limits = cramer_rao(rows[..., 0], rows[..., 1:4], REFERENCE)
    assert np.sqrt(ErrorModel.of(REFERENCE, Nuisances.none()).squared(rows)) == pytest.approx(limits.position, rel=1e-3)


def test_nuisances_are_marginalised(rows):
    """The covariance of the charges grows by what nobody knows; that is the same as the Schur complement."""
    squared = ErrorModel.of(REFERENCE, UNKNOWN).squared(rows)
    for row, value in zip(rows, squared, strict=True):
        unknown = row[:, 4:] * [0.3e-3, 0.29, 0.1e6]
        covariance = np.diag(1.0 / REFERENCE.information(row[:, 0])) + unknown @ unknown.T
        information = row[:, 1:4].T @ np.linalg.solve(covariance, row[:, 1:4])
        expected = np.linalg.inv(information)[:2, :2].trace()
        assert value == pytest.approx(expected, rel=1e-2)


def test_unknown_gains_are_noise(rows):
    known = ErrorModel.of(NoiseModel("more", 1e-12, float(np.hypot(2e-3, 1e-2))), Nuisances.none())
    unknown = ErrorModel.of(REFERENCE, Nuisances(0.0, 0.0, 0.0, 1e-2))
    assert unknown.squared(rows) == pytest.approx(known.squared(rows), rel=1e-12)


def test_derivatives_by_the_rows(rows):
    model = ErrorModel.of(REFERENCE, UNKNOWN)
    squared, slopes = model.gradient(rows)
    assert squared == pytest.approx(model.squared(rows))
    rng = np.random.default_rng(4)
    for _ in range(10):
        change = 1e-5 * rows * rng.standard_normal(rows.shape)
        difference = 0.5 * (model.squared(rows + change) - model.squared(rows - change))
        assert (slopes * change).sum(axis=(1, 2)) == pytest.approx(difference, rel=1e-4, abs=1e-7 * squared.max())


def test_the_displacement_is_that_of_a_least_squares_step(rows):
    moved = ErrorModel.of(REFERENCE, Nuisances.none()).displacement(rows)
    for row, shift in zip(rows, moved, strict=True):
        weight = np.sqrt(REFERENCE.information(row[:, 0]))
        step = np.linalg.pinv(row[:, 1:4] * weight[:, None]) * weight
        assert shift == pytest.approx(step[:2], rel=1e-3, abs=1e-3 * np.abs(step[:2]).max())
