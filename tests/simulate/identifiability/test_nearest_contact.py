"""The choice of candidates for the nearest contact, against a full sort."""

import numpy as np
import pytest

from isocharge.simulate.identifiability.nearest_contact import _nearest_rows


@pytest.mark.parametrize("count", [1, 3])
def test_the_nearest_candidates_are_the_first_of_all_sorted_distances(count):
    rng = np.random.default_rng(0)
    charge = rng.uniform(-50.0, 900.0, (40, 4))
    sigma = rng.uniform(1.0, 3.0, charge.shape)
    candidate_charges = rng.uniform(-50.0, 900.0, (300, 4))
    distance = np.linalg.norm((charge[:, None] - candidate_charges) / sigma[:, None], axis=2)
    expected = np.argsort(distance, axis=1)[:, :count]
    np.testing.assert_array_equal(_nearest_rows(charge, sigma, candidate_charges, count), expected)
