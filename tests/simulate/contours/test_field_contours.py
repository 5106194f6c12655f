"""Contours from the field: on them the charge is constant, and of a round field they are circles."""

import json
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import brentq

from isocharge.common.errors import SceneError, SensorError
from isocharge.simulate import (
    Circle,
    ContourField,
    Electrode,
    ForwardMap,
    Resolution,
    Sensor,
    SolveSettings,
    Theory,
    load_sensor,
)
from isocharge.simulate.forward.charge_spline import ChargeSpline

SENSOR = load_sensor("three-25um-biaxial")
QUICK = SolveSettings(theory=Theory(stretching=True, bending=False, pretensioned=False), resolution=Resolution(4, 8, 4))
RADIUS = 9e-3


@dataclass(frozen=True)
class RoundMap:
    """Stands in for a forward map: charge falls with the distance from each electrode."""

    sensor: Sensor
    radius: float = RADIUS
    force_range: tuple[float, float] = (1.0, 1.0)

    def forward(self, x, y, force):
        """Charges of presses."""
        centre = np.array([e.centre for e in self.sensor.electrodes])
        distance = np.hypot(x[:, None] - centre[:, 0], y[:, None] - centre[:, 1])
        return 1e-9 * np.asarray(force)[:, None] ** (2.0 / 3.0) / (1.0 + (distance / 10e-3) ** 2)


@pytest.fixture(scope="module")
def round_field() -> ContourField:
    forward_map = RoundMap(SENSOR)
    table = ChargeSpline.fit(
        forward_map.forward, SENSOR.electrode_names, SENSOR.film, RADIUS, np.array([1.0]), (1.0, 1.0), 0.6e-3
    )
    return ContourField(forward_map, table, 1.0)


@pytest.fixture(scope="module")
def field() -> ContourField:
    return ContourField.of(ForwardMap.build(SENSOR, Circle(1e-3), RADIUS, (1.0, 1.0), QUICK), 1.0)


@pytest.mark.parametrize(("name", "distance_mm"), [("A", 6.0), ("B", 9.0), ("C", 13.0)])
def test_contours_of_a_round_field_are_circles(round_field, name, distance_mm):
    charge = 1e-9 / (1.0 + (distance_mm / 10.0) ** 2)
    (contour,) = round_field.contours(name, charge)
    centre = SENSOR.electrodes["ABC".index(name)].centre
    np.testing.assert_allclose(1e3 * np.linalg.norm(contour.points - centre, axis=1), distance_mm, atol=1e-4)
    assert not contour.closed
    assert np.linalg.norm(contour.points[[0, -1]], axis=1).min() > RADIUS - 0.05e-3  # as far as the edge


def test_a_contour_inside_is_closed():
    sensor = Sensor("one", SENSOR.film, SENSOR.piezo, (Electrode.of_square("A", (1e-3, 2e-3), 3e-3),))
    forward_map = RoundMap(sensor)
    table = ChargeSpline.fit(forward_map.forward, ("A",), sensor.film, RADIUS, np.array([1.0]), (1.0, 1.0), 0.6e-3)
    (contour,) = ContourField(forward_map, table, 1.0).contours("A", 1e-9 / (1.0 + 0.4**2))
    assert contour.closed
    assert len(np.unique(np.round(contour.points, 12), axis=0)) > 50


def test_the_charge_is_constant_on_a_contour(field):
    """Within 1e-4 mm: against the forward map, and across it against brentq."""
    for charge in (700e-12, 1200e-12):
        (contour,) = field.contours("B", charge)
        x, y = contour.points.T
        charges = field.forward_map.forward(x, y, np.ones(x.size))[:, 1]
        slope = np.linalg.norm(field.table.first_order(contour.points, 1.0)[1][:, 1], axis=1)
        assert np.abs((charges - charge) / slope).max() < 1e-7
        for i in (5, len(x) // 2, -6):
            uphill = field.table.first_order(contour.points[[i]], 1.0)[1][0, 1]
            across = uphill / np.linalg.norm(uphill)

            def miss(step, point=contour.points[i], across=across, charge=charge):
                x, y = point + step * across
                return field.forward_map.forward(np.array([x]), np.array([y]), np.array([1.0]))[0, 1] - charge

            assert abs(brentq(miss, -0.2e-3, 0.2e-3)) < 1e-7


def test_neighbours_on_a_contour_are_close(field):
    (contour,) = field.contours("A", 800e-12)
    assert np.linalg.norm(np.diff(contour.points, axis=0), axis=1).max() < 0.4e-3


def test_threefold_symmetry(field):
    contours = [field.contours(name, 900e-12)[0].points for name in "ABC"]
    turn = np.exp(2j * np.pi / 3.0)
    for first, second in pairwise(contours):
        turned = (first[:, 0] + 1j * first[:, 1]) * turn
        away = np.abs(turned[:, None] - (second[:, 0] + 1j * second[:, 1])).min(axis=1)
        assert away.max() < 0.2e-3  # points lie elsewhere along the same curve


def test_even_charges_are_reached(field):
    low, high = field.reach("A")
    charges = field.even_charges("A", 5)
    assert low < min(charges) < max(charges) < high
    np.testing.assert_allclose(np.diff(np.log(charges)), np.diff(np.log(charges))[0], rtol=1e-9)
    assert all(field.contours("A", charge) for charge in charges)


def test_a_charge_that_is_not_reached_has_no_contour(field):
    assert field.contours("A", 9e-9) == ()
    assert field.contours("A", 0.0) == ()
    assert field.contours("A", -5e-10) == ()


def test_wrong_input_is_shown(field):
    with pytest.raises(SensorError, match="no electrode 'Q'"):
        field.contours("Q", 1e-9)
    with pytest.raises(SceneError, match="charge of 'A': expected a finite number, got nan pC"):
        field.contours("A", np.nan)
    with pytest.raises(SceneError, match="expected 1 to 1 N, which the forward map covers, got 2 N"):
        ContourField.of(field.forward_map, 2.0)
    with pytest.raises(SceneError, match="up to the forward map's 9 mm, got 10 mm"):
        ContourField.of(field.forward_map, 1.0, 10e-3)


def test_contours_as_json_are_in_mm_and_pC(field):
    low, high = field.reach("A")
    charges = {"A": (float(np.sqrt(low * high)), 2.0 * high), "C": (field.reach("C")[0] * 1.1,)}
    contours = {name: [field.contours(name, charge) for charge in charges[name]] for name in charges}
    report = json.loads(json.dumps(field.to_dict(charges, contours)))
    assert list(report) == ["probe", "force_N", "radius_mm", "reached_pC", "contours"]
    assert (report["probe"], report["force_N"], report["radius_mm"]) == ("circle:1.0", 1.0, pytest.approx(9.0))
    assert report["reached_pC"]["A"] == pytest.approx([1e12 * low, 1e12 * high])
    assert list(report["reached_pC"]) == ["A", "B", "C"]
    rows = report["contours"]
    assert [row["electrode"] for row in rows] == ["A", "A", "C"]
    assert [row["charge_pC"] for row in rows] == pytest.approx([1e12 * q for name in charges for q in charges[name]])
    assert rows[1]["pieces_mm"] == rows[1]["closed"] == []
    for row, pieces in ((rows[0], contours["A"][0]), (rows[2], contours["C"][0])):
        assert row["closed"] == [piece.closed for piece in pieces]
        for points_mm, piece in zip(row["pieces_mm"], pieces, strict=True):
            np.testing.assert_allclose(points_mm, 1e3 * piece.points)
