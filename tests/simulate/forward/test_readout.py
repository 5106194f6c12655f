"""From stress to charge: the mean over an electrode, the paper's edges, polygons, and what is not modelled."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SensorError
from isocharge.simulate import (
    Calibration,
    Circle,
    Electrode,
    Piezo,
    Polygon,
    Sensor,
    contact_charge,
    load_sensor,
    press,
    pretension_charge,
    thermal_charge,
    touch_charge,
)
from isocharge.simulate.forward.readout import COARSE, FINE, ReadoutPoints

AREA, D31, D32 = 9e-6, 20e-12, 2e-12


def charge_of(sensor: Sensor, stress, per_side: int = FINE) -> np.ndarray:
    """Charges under a made-up stress field, a function of x and y that returns (s11, s22, s12)."""
    readout = ReadoutPoints.of(sensor, per_side)
    return readout.charge(np.stack(np.broadcast_arrays(*stress(*np.moveaxis(readout.points, -1, 0))), axis=-1))


@pytest.fixture(params=["area", "edge"])
def sensor(request) -> Sensor:
    return replace(load_sensor("four-25um-uniaxial"), readout=request.param)


@pytest.mark.parametrize("per_side", [1, COARSE, FINE])
def test_uniform_stress(sensor, per_side):
    """Q = A (d31 s11 + d32 s22); shear gives nothing."""
    charge = charge_of(sensor, lambda x, y: (10e6 + 0 * x, 4e6 + 0 * y, 7e6), per_side)
    np.testing.assert_allclose(charge, AREA * (D31 * 10e6 + D32 * 4e6), rtol=1e-13)


def test_uniform_stress_through_the_public_function(sensor, made_up):
    """The same, from a linear displacement field: strain e11 = 0.3 A^2, nothing else."""
    gradient = np.array([[0.3, 0.0, 0.0], [0.0, 0.0, 0.0]])
    stretched = made_up(lambda x: x @ gradient, amplitude2=1e-9)
    s11 = sensor.film.young * 1e-9 * 0.3 / (1.0 - 0.34**2)
    np.testing.assert_allclose(touch_charge(sensor, stretched), AREA * (D31 + D32 * 0.34) * s11, rtol=1e-8)


def test_linear_stress_is_read_at_the_centre(sensor):
    """Mean over a square, or over two opposite edges, of a linear function: its value in the middle."""
    charge = charge_of(sensor, lambda x, y: (1e6 + 3e9 * x - 2e9 * y, -4e9 * x + 1e9 * y, 1e9 * x))
    expected = [
        AREA * (D31 * (1e6 + 3e9 * x - 2e9 * y) + D32 * (-4e9 * x + 1e9 * y))
        for x, y in (electrode.centre for electrode in sensor.electrodes)
    ]
    np.testing.assert_allclose(charge, expected, rtol=1e-12, atol=1e-20)


def test_edges_are_the_papers():
    """Quadratic stresses tell the edges apart: s11 over left and right, s22 over lower and upper (eq. 3)."""
    square = Electrode.of_square("A", (5e-3, -2e-3), 3e-3)
    sensor = replace(load_sensor("four-25um-uniaxial"), electrodes=(square,), readout="edge")
    h2 = (1.5e-3) ** 2

    def over_x(x, y):
        return 1e12 * (x - 5e-3) ** 2, 1e12 * (x - 5e-3) ** 2, 0 * y

    def over_y(x, y):
        return 1e12 * (y + 2e-3) ** 2, 1e12 * (y + 2e-3) ** 2, 0 * x

    np.testing.assert_allclose(charge_of(sensor, over_x), AREA * 1e12 * (D31 * h2 + D32 * h2 / 3), rtol=1e-12)
    np.testing.assert_allclose(charge_of(sensor, over_y), AREA * 1e12 * (D31 * h2 / 3 + D32 * h2), rtol=1e-12)
    area = replace(sensor, readout="area")
    np.testing.assert_allclose(charge_of(area, over_x), AREA * 1e12 * (D31 + D32) * h2 / 3, rtol=1e-12)


def test_polygon_with_the_corners_of_a_square_is_the_square(film):
    square = load_sensor("four-25um-uniaxial")
    polygons = tuple(Electrode(e.name, e.corners) for e in square.electrodes)
    solved = press(film, Circle(1e-3), (4e-3, 3e-3), 1.0)
    charge = touch_charge(replace(square, electrodes=polygons), solved)
    np.testing.assert_allclose(charge, touch_charge(square, solved), rtol=5e-6)


def test_corners_may_start_anywhere(film):
    """A hexagon, each corner first in turn: another fan of triangles, the same charge."""
    angle = 2.0 * np.pi * np.arange(6) / 6 + 0.2
    corners = [(9e-3 + 2e-3 * float(np.cos(a)), 2e-3 * float(np.sin(a))) for a in angle]
    solved, sensor = press(film, Circle(1e-3), (0.0, 3e-3), 1.0), load_sensor("four-25um-uniaxial")
    charges = [
        touch_charge(replace(sensor, electrodes=(Electrode("A", tuple(corners[i:] + corners[:i])),)), solved)[0]
        for i in range(6)
    ]
    np.testing.assert_allclose(charges, charges[0], rtol=1e-6)


def test_polygon_integrates_polynomials_exactly():
    """Triangle (0, 0), (6, 0), (0, 3) mm: the mean of x^2 is b^2 / 6, of x y is b h / 12."""
    triangle = Electrode("A", ((0.0, 0.0), (6e-3, 0.0), (0.0, 3e-3)))
    sensor = replace(load_sensor("four-25um-uniaxial"), electrodes=(triangle,))
    charge = charge_of(sensor, lambda x, y: (1e12 * x**2, 1e12 * x * y, 0 * x))
    assert charge[0] == pytest.approx(9e-6 * 1e12 * (D31 * 36e-6 / 6 + D32 * 18e-6 / 12), rel=1e-12)


def test_electrodes_of_different_kinds_together(film):
    """A square and a triangle have different numbers of points; padding must not add charge."""
    sensor = load_sensor("four-25um-uniaxial")
    triangle = Electrode("T", ((-12e-3, 4e-3), (-8e-3, 4e-3), (-10e-3, 8e-3)))
    both = (sensor.electrodes[0], triangle)
    solved = press(film, Circle(1e-3), (4e-3, 3e-3), 1.0)
    together = touch_charge(replace(sensor, electrodes=both), solved)
    alone = [touch_charge(replace(sensor, electrodes=(electrode,)), solved)[0] for electrode in both]
    np.testing.assert_allclose(together, alone, rtol=1e-13)


def test_charge_is_linear_in_the_coefficients(film):
    solved, sensor = press(film, Circle(1e-3), (4e-3, 3e-3), 1.0), load_sensor("four-25um-uniaxial")
    first = touch_charge(replace(sensor, piezo=Piezo(1e-12, 0.0)), solved)
    second = touch_charge(replace(sensor, piezo=Piezo(0.0, 1e-12)), solved)
    np.testing.assert_allclose(touch_charge(sensor, solved), 20.0 * first + 2.0 * second, rtol=1e-12)


def test_pretension_cancels_in_the_touch_charge(film):
    """A feather's touch on a film under 1 MPa: the tension's own 400 pC do not show."""
    taut = replace(load_sensor("four-25um-biaxial"), film=replace(film, pretension=1e6))
    assert np.abs(touch_charge(taut, press(taut.film, Circle(1e-3), (3e-3, 1e-3), 1e-6))).max() < 1e-17


def test_fine_and_coarse_rules_agree_away_from_the_probe(film):
    """The forward map uses the coarse rule for electrodes more than 3 mm from the probe."""
    sensor = load_sensor("four-25um-uniaxial")
    solved = press(film, Circle(1e-3), (3.9e-3, 0.0), 1.0)
    stress = [
        rule.charge(solved.touch_stress(rule.points.reshape(-1, 2)).reshape(*rule.points.shape[:2], 3))
        for rule in (ReadoutPoints.of(sensor, COARSE), ReadoutPoints.of(sensor, 40))
    ]
    np.testing.assert_allclose(stress[0], stress[1], rtol=3e-5)


def test_another_film_is_refused(film):
    sensor = load_sensor("three-25um-biaxial")
    other = press(replace(film, young=2.5e9), Circle(1e-3), (0.0, 0.0), 1.0)
    with pytest.raises(SensorError, match=r"another film: expected Film\(.*young=3000000000.*got .*young=2500000000"):
        touch_charge(sensor, other)


# Contact pressure, d33


def with_d33(name: str = "four-25um-uniaxial", d33: float = -30e-12, **changes) -> Sensor:
    sensor = load_sensor(name)
    return replace(sensor, piezo=replace(sensor.piezo, d33=d33), **changes)


@pytest.mark.parametrize(
    ("probe", "at_mm", "covered_mm2"),
    [
        (Circle(1e-3), (10.0, 0.0), np.pi),  # the whole footprint on A
        (Circle(5e-3), (10.0, 0.0), 9.0),  # the whole electrode under it
        (Circle(1e-3), (8.5, 0.0), 0.5 * np.pi),  # about an edge
        (Circle(1e-3), (8.5, 1.5), 0.25 * np.pi),  # about a corner
        (Circle(1e-3), (5.0, 0.0), 0.0),
        (Polygon.rectangle(2e-3, 1e-3), (8.5, 0.0), 1.0),
        (Polygon.rectangle(2e-3, 1e-3, np.pi / 2), (8.5, 1.5), 0.5),
        (Polygon.rectangle(2e-3, 2e-3, np.pi / 4), (8.5, 0.0), 2.0),
        (Polygon.triangle(1e-3), (10.0, 0.0), np.sqrt(3) / 4),
    ],
)
def test_contact_pressure_counts_where_it_lies_on_the_electrode(probe, at_mm, covered_mm2):
    """Q = -d33 F / (footprint) * overlap: positive for PVDF's negative d33; nothing on the others."""
    at = (at_mm[0] * 1e-3, at_mm[1] * 1e-3)
    charge = contact_charge(with_d33(), probe, at, 0.7)
    assert charge[0] == pytest.approx(30e-12 * 0.7 / probe.area * covered_mm2 * 1e-6, rel=1e-9, abs=1e-24)
    np.testing.assert_allclose(charge[1:], 0.0, atol=1e-24)


def test_contact_charge_is_in_the_touch_charge(film):
    solved = press(film, Polygon.triangle(3e-3, 0.3), (9e-3, 1e-3), 0.5)
    plain = touch_charge(with_d33(d33=0.0), solved)
    extra = contact_charge(with_d33(), solved.probe, solved.at, 0.5)
    np.testing.assert_allclose(touch_charge(with_d33(), solved) - plain, extra, rtol=1e-9, atol=1e-22)
    assert extra[0] > 1e-12


def test_contact_charge_follows_gain_and_place_of_the_electrodes():
    """A layout that is shifted to where the probe is, read with a gain of two."""
    calibration = Calibration(gain={"A": 2.0}, shift=(2e-3, 0.0))
    still = contact_charge(with_d33(), Circle(1e-3), (8.5e-3, 0.2e-3), 1.0)
    moved = contact_charge(with_d33(calibration=calibration), Circle(1e-3), (10.5e-3, 0.2e-3), 1.0)
    np.testing.assert_allclose(moved, [2.0 * still[0], 0.0, 0.0, 0.0], rtol=1e-9, atol=1e-24)


# Charges without a touch


@pytest.mark.parametrize("readout", ["area", "edge"])
def test_pretension_charge(film, readout):
    """1 MPa both ways on 9 mm^2: (20 + 2) pC/N; with gains."""
    sensor = replace(load_sensor("four-25um-uniaxial"), film=replace(film, pretension=1e6), readout=readout)
    sensor = replace(sensor, calibration=Calibration(gain={"B": 1.5}))
    np.testing.assert_allclose(pretension_charge(sensor), 198e-12 * np.array([1.0, 1.5, 1.0, 1.0]), rtol=1e-12)
    assert not pretension_charge(load_sensor("four-25um-uniaxial")).any()


def test_thermal_charge():
    """30 uC/(m^2 K) on 9 mm^2: 27 pC per 0.1 K (design, section 6), the same on every electrode; more on a larger."""
    sensor = load_sensor("three-25um-biaxial")
    sensor = replace(sensor, piezo=replace(sensor.piezo, pyro=30e-6))
    np.testing.assert_allclose(thermal_charge(sensor, 0.1), 27e-12, rtol=1e-12)
    np.testing.assert_allclose(thermal_charge(sensor, -0.2), -54e-12, rtol=1e-12)
    triangle = Electrode("T", ((-12e-3, 4e-3), (-8e-3, 4e-3), (-10e-3, 8e-3)))
    both = replace(sensor, electrodes=(sensor.electrodes[0], triangle), calibration=Calibration(gain={"T": 0.5}))
    np.testing.assert_allclose(thermal_charge(both, 0.1), [27e-12, 0.5 * 30e-6 * 8e-6 * 0.1], rtol=1e-12)
