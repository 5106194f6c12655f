"""The paper's way of drawing, on fields whose contours are circles."""

import numpy as np
import pytest

from isocharge.common.errors import ChargeError, SensorError
from isocharge.simulate import load_sensor
from isocharge.simulate.contours.charge_curves import Curves, Mapping
from isocharge.simulate.contours.fix import Meeting
from isocharge.simulate.contours.graphical_method import DrawnTriangulation, draw_contour

LAYOUTS = {name: load_sensor(f"{name}-25um-biaxial") for name in ("three", "four")}


def charge_at(distance: np.ndarray) -> np.ndarray:
    """A cubic of the distance, which a polynomial along a line meets exactly; falls up to 20 mm."""
    d = distance / 20.0
    return 1e3 * (2.0 - 2.5 * d + 1.6 * d**2 - 0.45 * d**3)


def curves_of(sensor, name: str) -> Curves:
    mapping = Mapping.lines(sensor, name)
    centres = np.array([e.centre for e in sensor.electrodes])
    distance = np.linalg.norm(mapping.points[:, :, None] - centres, axis=3)
    return Curves(mapping, sensor.electrode_names, 1.0, charge_at(distance))


def charges_of(sensor, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    centres = np.array([e.centre for e in sensor.electrodes])
    return charge_at(np.hypot(x[:, None] - centres[:, 0], y[:, None] - centres[:, 1]))


@pytest.fixture(params=LAYOUTS)
def layout(request):
    sensor = LAYOUTS[request.param]
    return sensor, [curves_of(sensor, name) for name in sensor.electrode_names]


def test_roots_of_a_round_field_lie_on_a_circle():
    sensor = LAYOUTS["three"]
    contour = draw_contour(curves_of(sensor, "A"), float(charge_at(np.array(9.0))), degree=3)
    away = np.linalg.norm(contour.knots - sensor.electrodes[0].centre, axis=1)
    np.testing.assert_allclose(away, 9.0, rtol=1e-9)
    inner = contour.points[16:-16]  # a natural spline straightens its ends
    np.testing.assert_allclose(np.linalg.norm(inner - sensor.electrodes[0].centre, axis=1), 9.0, rtol=2e-4)


def test_draw_contour_of_an_unreached_charge_is_none():
    assert draw_contour(curves_of(LAYOUTS["three"], "A"), 5e3) is None


def test_contours_cross_at_the_crossings_of_circles():
    """In the press and in its mirror image in the line through both electrodes, once each."""
    sensor = LAYOUTS["three"]
    z = 1.0 + 2.0j
    charges = zip("AB", charges_of(sensor, np.array([z.real]), np.array([z.imag]))[0], strict=False)
    one, other = (draw_contour(curves_of(sensor, name), float(charge), degree=3) for name, charge in charges)
    a, b = (complex(*electrode.centre) for electrode in sensor.electrodes[:2])
    mirrored = a + np.conj((z - a) / (b - a)) * (b - a)
    np.testing.assert_allclose(np.sort_complex(one.crossings(other) @ [1.0, 1.0j]), [z, mirrored], atol=0.01)


def test_graphical_method_locates_presses(layout):
    sensor, curves = layout
    rng = np.random.default_rng(1)
    r = 7.0 * np.sqrt(rng.random(20))
    angle = 2.0 * np.pi * rng.random(20)
    x, y = r * np.cos(angle), r * np.sin(angle)
    fix = DrawnTriangulation(curves, degree=3).locate(charges_of(sensor, x, y))
    error = np.hypot(fix.contact[:, 0] - x, fix.contact[:, 1] - y)[fix.found]
    assert fix.found.mean() > 0.9
    assert np.median(error) < 2e-3
    assert np.all(fix.contact[:, 2] == 1.0)


def test_graphical_method_reports_the_status_of_presses_without_a_position(layout):
    sensor, curves = layout
    charge = charges_of(sensor, np.array([1.0]), np.array([2.0]))
    drawn = DrawnTriangulation(curves, degree=3)
    too_large = drawn.locate(10.0 * charge)
    apart = drawn.locate(1.2 * charge)
    assert [*too_large.status, *apart.status] == [Meeting.no_contour, Meeting.apart]
    assert np.isnan([too_large.contact[0, :2], apart.contact[0, :2]]).all()


@pytest.mark.parametrize(
    ("electrodes", "charge", "error", "message"),
    [
        (4, np.ones((1, 2)), ChargeError, r"charges of shape \(n, [34]\) for \(.+\), got shape \(1, 2\)"),
        (3, np.full((1, 3), np.nan), ChargeError, "charge of 'A' in press 0: expected a finite number, got nan"),
        (2, np.ones((1, 2)), SensorError, "at least three electrodes"),
    ],
)
def test_wrong_input_of_the_graphical_method_raises_an_error(layout, electrodes, charge, error, message):
    with pytest.raises(error, match=message):
        DrawnTriangulation(layout[1][:electrodes]).locate(charge)
