"""The domain check against shapes whose inside is known without it."""

import numpy as np
import pytest

from isocharge.serve import Contact, Contacts, Predictor, Validity
from isocharge.serve.prediction.validity import MISFIT_LIMIT, inside_polygon

GOOD = Contact(1.0, -2.0, 0.5, 0.1, 0.1, 0.01, 0.3)


def test_inside_polygon_of_a_disk():
    angle, rng = 2 * np.pi * np.arange(720) / 720, np.random.default_rng(1)
    x, y = rng.uniform(-2, 2, (2, 5000))
    r = np.hypot(x, y)
    clear = np.abs(r - 1.0) > 1e-4
    inside = inside_polygon(x, y, np.column_stack([np.cos(angle), np.sin(angle)]))
    np.testing.assert_array_equal(inside[clear], r[clear] < 1.0)


def test_inside_polygon_of_a_notched_square():
    corners = np.array([[0, 0], [4, 0], [4, 4], [2, 1], [0, 4], [0, 0]], dtype=float)
    inside = inside_polygon(np.array([2.0, 2.0, 0.5, 3.5, -1.0]), np.array([0.5, 2.0, 2.0, 2.0, 0.0]), corners)
    assert inside.tolist() == [True, False, True, True, False]


@pytest.mark.parametrize(
    ("changes", "flags"),
    [
        ({}, ()),
        ({"x_mm": 8.1}, ("outside",)),
        ({"force_N": 0.04}, ("outside",)),
        ({"force_N": 2.1}, ("outside",)),
        ({"misfit": MISFIT_LIMIT * 1.01}, ("misfit",)),
        ({"misfit": 99.0, "y_mm": -9.0}, ("outside", "misfit")),
        ({"force_N": 5.9}, ("outside",)),
        ({"force_N": 6.1}, ("outside", "beyond")),
        ({"x_mm": 14.0, "y_mm": -19.0}, ("outside",)),
        ({"x_mm": 15.0, "y_mm": -20.0}, ("outside", "beyond")),
        ({"x_mm": 3e38, "force_N": 0.0}, ("outside", "beyond")),
        ({"force_N": 55_088.0, "misfit": 826.0}, ("outside", "beyond", "misfit")),
    ],
)
def test_flags_of_a_contact(film, changes, flags):
    assert Validity.of(film.metadata()).flags(GOOD._replace(**changes)) == flags


@pytest.mark.parametrize("name", ["three-25um-biaxial", "four-25um-uniaxial"])
def test_no_absurd_charge_goes_without_a_flag(name):
    """Charges of any size and sign: none that no press can give passes as one."""
    predictor, rng = Predictor(name), np.random.default_rng(0)
    size = (20_000, len(predictor.metadata.electrodes))
    charge_pC = 10 ** rng.uniform(-1, 10, size) * rng.choice([1, 1, -1], size)
    charge_pC[:100] = 10 ** rng.uniform(5, 10, (100, 1))  # the same on all electrodes
    flags = predictor.validity.batch_flags(predictor.predict_batch(charge_pC))
    impossible = (charge_pC < 1.0).any(axis=1) | (charge_pC > 1e4).any(axis=1)  # 3,900 pC: 1 N on an electrode
    assert all(words for words, wrong in zip(flags, impossible, strict=True) if wrong)
    assert all("beyond" in words for words in flags[:100])


def test_flags_of_one_contact_equal_those_in_a_batch():
    """One contact takes a short cut where it is well inside; it must not show."""
    rng = np.random.default_rng(0)
    square = Validity(np.array([[-4.0, -3.0], [6.0, -3.0], [6.0, 5.0], [-4.0, 5.0]]), (0.05, 2.0))
    away = Validity(square.corners_mm + 20.0, (0.05, 2.0))
    for x, y, force, misfit in zip(*rng.uniform(-8, 8, (2, 500)), *rng.uniform(0, [[2.5], [6]], (2, 500)), strict=True):
        contact = Contact(x, y, force, 0.1, 0.1, 0.01, misfit)
        for domain in (square, away):
            batch = Contacts(*np.array(contact)[:, np.newaxis])
            assert domain.flags(contact) == domain.batch_flags(batch)[0]
    assert (square.safe_mm2, away.safe_mm2) == (9.0, 0.0)
