"""The fast tables against the exact rows they are built from."""

import numpy as np
import pytest

from isocharge.simulate.layout.place_table import PlaceTable

PRESSES = np.array([[0.0, 0.0], [1.1e-3, 2.3e-3], [-2.3e-3, 1.1e-3], [2.3e-3, -1.1e-3], [-1.7e-3, -3.2e-3]])


def compare(table, charges, centre, side, tolerance):
    rows, by_square = table.rows(np.array(centre), side)
    pressed = charges.under(PRESSES)
    exact = pressed.layout(np.array([centre]), np.array([side]))[:, 0]
    wide = tolerance * np.array([1.0, 1.0, 1.0, 1.0, 30.0, 60.0, 1.0])  # the probe hardly changes it
    assert (np.abs(rows - exact) <= wide * np.abs(exact).max(axis=0)).all()
    gradient = pressed.layout_gradient(np.array([centre]), np.array([side]))[:, 0, 0]
    assert by_square[:, 0, :2] == pytest.approx(gradient[:, :2], abs=20 * tolerance * np.abs(gradient).max())
    return by_square, gradient


@pytest.mark.parametrize("centre", [(7e-3, 3e-3), (-0.4e-3, 8e-3), (-11e-3, -5e-3), (4e-3, -21e-3)])
def test_rows_of_a_film_that_is_the_same_in_all_directions(charges, centre):
    """Presses share tables: four of the five are mirror images of two."""
    table = PlaceTable.build(charges, PRESSES, (3e-3, 3e-3))
    assert len(table.origin) == 3
    compare(table, charges, centre, 3e-3, 3e-3)


def test_rows_of_a_drawn_film_share_fewer_tables(uniaxial):
    table = PlaceTable.build(uniaxial, PRESSES, (3e-3, 3e-3))
    assert len(table.origin) == 4
    compare(table, uniaxial, (-7e-3, 4e-3), 3e-3, 3e-3)


def test_sides_between_the_tabulated_ones(charges):
    table = PlaceTable.build(charges, PRESSES, (2e-3, 4e-3))
    by_square, gradient = compare(table, charges, (7e-3, -5e-3), 2.7e-3, 3e-3)
    assert by_square[:, 0, 2] == pytest.approx(gradient[:, 2], rel=0.02)
