"""The choice of candidates for the nearest contact, compared with a complete sort."""

import numpy as np
import pytest

from isocharge.simulate.identifiability.nearest_contact import _nearest_rows


def random_charges():
    """Return charges, their standard deviations, charges of candidates, and the order of the candidates by distance."""
    rng = np.random.default_rng(0)
    charge = rng.uniform(-50.0, 900.0, (40, 4))
    sigma = rng.uniform(1.0, 3.0, charge.shape)
    candidate_charges = rng.uniform(-50.0, 900.0, (300, 4))
    distance = np.linalg.norm((charge[:, None] - candidate_charges) / sigma[:, None], axis=2)
    return charge, sigma, candidate_charges, np.argsort(distance, axis=1)


@pytest.mark.parametrize("count", [1, 3])
def test_the_nearest_candidates_are_the_first_of_all_sorted_distances(count):
    charge, sigma, candidate_charges, order = random_charges()
    only_itself = np.eye(300, dtype=bool)
    found = _nearest_rows(charge, sigma, candidate_charges, only_itself, count)
    np.testing.assert_array_equal(found, order[:, :count])


def test_the_starts_of_a_search_are_not_neighbours_of_each_other():
    """Candidates with the same remainder of a division by 50 are neighbours."""
    charge, sigma, candidate_charges, order = random_charges()
    group = np.arange(300) % 50
    found = _nearest_rows(charge, sigma, candidate_charges, group[:, None] == group, 3)
    for row, starts in zip(order, found, strict=True):
        _, first_of_each_group = np.unique(group[row], return_index=True)
        np.testing.assert_array_equal(starts, row[np.sort(first_of_each_group)[:3]])
