"""Contours from the field: on them the charge is constant, and of a round field they are circles."""

import numpy as np
import pytest

from isocharge.common.errors import SceneError, SensorError
from isocharge.simulate import (
    Circle,
    Domain,
    ForwardMap,
    FunctionMap,
    Resolution,
    SolveSettings,
    Theory,
    load_sensor,
)
from isocharge.simulate.contours.field_contours import ContourField
from kept import kept

SENSOR = load_sensor("three-25um-biaxial")
QUICK = SolveSettings(theory=Theory(stretching=True, bending=False, pretensioned=False), resolution=Resolution(4, 8, 4))
RADIUS = 9.0
DOMAIN = Domain(RADIUS, (1.0, 1.0))


def round_field(*centres: tuple[float, float]) -> ContourField:
    """Charges that fall with the distance from each centre."""

    def charges(contact):
        distance = np.hypot(*(contact[:, None, :2] - np.array(centres)).transpose(2, 0, 1))
        return 1e3 * contact[:, 2:] ** (2.0 / 3.0) / (1.0 + (distance / 10.0) ** 2)

    return ContourField(FunctionMap(charges, tuple("ABC"[: len(centres)]), DOMAIN), 1.0)


@pytest.fixture(scope="module")
def field() -> ContourField:
    return ContourField(kept(ForwardMap.build, SENSOR, Circle(1.0), RADIUS, (1.0, 1.0), QUICK), 1.0)


@pytest.mark.parametrize(("name", "distance"), [("A", 6.0), ("B", 9.0), ("C", 13.0)])
def test_contours_of_a_round_field_are_circles(name, distance):
    field = round_field(*(electrode.centre for electrode in SENSOR.electrodes))
    (contour,) = field.contours(name, 1e3 / (1.0 + (distance / 10.0) ** 2))
    centre = SENSOR.electrodes["ABC".index(name)].centre
    np.testing.assert_allclose(np.linalg.norm(contour - centre, axis=1), distance, atol=2e-3)
    assert not np.array_equal(contour[0], contour[-1])
    assert np.linalg.norm(contour[[0, -1]], axis=1).min() > RADIUS - 0.05  # as far as the edge


def test_contour_inside_the_disk_is_closed():
    (contour,) = round_field((1.0, 2.0)).contours("A", 1e3 / (1.0 + 0.4**2))
    np.testing.assert_array_equal(contour[0], contour[-1])
    assert len(np.unique(np.round(contour, 9), axis=0)) > 50


def test_charge_is_constant_on_a_contour(field):
    """Within 5e-3 mm, by the slope."""
    for charge in (700.0, 1200.0):
        (contour,) = field.contours("B", charge)
        assert np.linalg.norm(np.diff(contour, axis=0), axis=1).max() < 0.4
        contact = np.column_stack([contour, np.ones(len(contour))])
        slope = field.charge_map.derivatives(contact)[:, 1, :2]
        away = (field.charge_map.charges(contact)[:, 1] - charge) / np.linalg.norm(slope, axis=1)
        assert np.abs(away).max() < 5e-3


def test_even_charges_lie_within_the_charge_range(field):
    low, high = field.charge_range("A")
    charges = field.even_charges("A", 5)
    assert low < min(charges) < max(charges) < high
    np.testing.assert_allclose(np.diff(np.log(charges)), np.diff(np.log(charges))[0], rtol=1e-9)
    assert all(field.contours("A", charge) for charge in charges)


def test_charge_out_of_range_has_no_contour(field):
    assert field.contours("A", 9e3) == field.contours("A", -500.0) == ()


@pytest.mark.parametrize(
    ("ask", "error", "message"),
    [
        (lambda field: field.contours("Q", 1e3), SensorError, "no electrode 'Q'"),
        (lambda field: field.contours("A", np.nan), SceneError, "charge of 'A': expected a finite number, got nan pC"),
        (lambda field: ContourField(field.charge_map, 2.0), SceneError, "expected 1 to 1 N, .* covers, got 2 N"),
    ],
)
def test_wrong_input_is_shown_in_the_error(field, ask, error, message):
    with pytest.raises(error, match=message):
        ask(field)
