"""Validation of sensors, and the effect of the calibration."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SensorError
from isocharge.simulate import Calibration, Electrode, Film, Piezo, Sensor, load_sensor

SQUARE = Electrode.of_square("D", (0.0, 0.0), 3.0)
TRACED = SQUARE.with_trace(((0.0, 0.0), (9.0, 0.0), (9.0, 5.0)), 0.5)


@pytest.fixture
def three() -> Sensor:
    return load_sensor("three-25um-biaxial")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"poisson": 0.5}, "film.poisson: expected 0 to 0.4999, got 0.5"),
        ({"pretension": 5e5}, "film.pretension_MPa: expected -10 to 300 MPa, got 500000 MPa; 500000 Pa are 0.5 MPa$"),
        ({"young_ratio": 0.0}, "film.young_GPa, E1 / E2: expected 0.1 to 10, got 0"),
        ({"deviator": (0.0, 301.0)}, r"film.pretension_MPa, .* and T12: expected -300 to 300 MPa, got 301 MPa"),
        ({"thickness": 5.0}, r"film.thickness_um: expected at most a tenth of the radius \(45 mm\), got 5 mm"),
        ({"radius": 0.045}, r"film.radius_mm: expected 1 to 1000 mm, got 0\.045 mm; 0\.045 m are 45 mm"),
        ({"back_volume": np.nan}, r"film.back_volume_mm3: expected at least 1 mm\^3, got nan"),
        ({"static_pressure": -1.0}, r"film.static_pressure_Pa: expected -10000 to 10000 Pa, got -1e\+06 Pa"),
        ({"expansion": (1e-4, 100.0)}, r"film.expansion_ppm_per_K: expected -1000 to 1000 ppm/K, got 1e\+08 ppm/K"),
        ({"young": 3e6}, "film.young_GPa: .* got 3000 GPa; 3000 MPa are 3 GPa"),
    ],
)
def test_invalid_film_raises_error(film, changes, message):
    """For values that are probably in another unit, the message gives the likely value."""
    with pytest.raises(SensorError, match=message):
        replace(film, **changes)


@pytest.mark.parametrize(
    ("coefficients", "message"),
    [
        ({"d31": np.nan}, r"piezo d31: expected -100000 to 100000 pC/N, got nan"),
        ({"d31": 0.0, "d32": 0.0, "d33": -30.0}, "piezo d31, d32 and d12 are all 0: such a film gives no charge"),
        ({"d32": 8e-12}, r"piezo d32: expected pC/N, got 8e-12 pC/N; if this is the value in C/N, write 8"),
        ({"d33": -30e-12}, r"piezo d33: expected pC/N, .* write -30"),
    ],
)
def test_invalid_piezo_coefficients_raise_error(coefficients, message):
    with pytest.raises(SensorError, match=message):
        Piezo(**({"d31": 1.0, "d32": 1.0} | coefficients))


SIMPLE = r"electrode 'A': expected a polygon that does not cross itself, .* anticlockwise, got \[\["
THREE = "electrode 'A': expected 3 to 256 corners"


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        (((0, 0), (0, 3), (3, 3), (3, 0)), SIMPLE),  # clockwise
        (((0, 0), (3, 0), (0, 3), (3, 3)), SIMPLE),  # an hourglass
        (((0.0, 0.0), (1.0, 0.0), (0.0, np.nan)), SIMPLE),
        ((), THREE),
        (((44.0, 0.0), (48.0, 0.0), (46.0, 3.0)), r"'A' lies outside the film: corner \(48, 0\) mm"),
        (((0, 0), (3e-3, 0), (0, 3e-3)), r"electrode 'A': expected at least 0\.02 mm, .* 0\.003 m are 3 mm"),
    ],
)
def test_invalid_electrodes_raise_error(three, corners, message):
    with pytest.raises(SensorError, match=message):
        replace(three, electrodes=(Electrode("A", tuple((float(x), float(y)) for x, y in corners)),))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"film": Film(45.0, 0.025, 3000.0, 0.34, oval=0.05), "calibration": Calibration(shift=(0.0, -31.5))},
            r"'A' lies outside the film: corner \(-1\.5, -43\) mm, film radius 42\.7555 mm$",
        ),
        ({"calibration": Calibration(shift=(np.nan, 0.0))}, r"'A' lies outside the film: corner \(nan, -11\.5\) mm"),
        ({"calibration": Calibration(gain={"E": 1.1})}, r"no electrode named \['E'\], have \('A', 'B', 'C'\)"),
        ({"calibration": Calibration(gain={"A": -1.0})}, "calibration gain: expected positive numbers, got .*-1.0"),
        ({"electrodes": ()}, r"electrodes: expected 1 to 64 different names, got 0: \(\)"),
        ({"electrodes": (SQUARE, SQUARE)}, "expected 1 to 64 different names, got 2: .*'D'"),
        ({"electrodes": (replace(SQUARE, name="force_N"),)}, "reserved for another column"),
        *(
            ({"electrodes": (replace(SQUARE, name=name),)}, "1 to 100 printable characters, without commas")
            for name in ("", "A,B", "A\0", "A\nB", " A")
        ),
        ({"electrodes": (Electrode("T", SQUARE.corners[:3]),), "readout": "edge"}, "needs square .* 'T' is a polyg"),
        (
            {"electrodes": (SQUARE.with_trace(((0, 0), (46, 0)), 0.5),)},
            r"'D' lies outside the film: .* film radius 45 mm; end its traces before the rim",
        ),
        (
            {"electrodes": (replace(TRACED, back=(((9, 9), (10, 9), (9, 10)),)),)},
            "'D': its front and its back have no area in common",
        ),
        (
            {"electrodes": (replace(TRACED, back=(SQUARE.corners,)), Electrode.of_square("E", (9.0, 4.0), 3.0))},
            "'D' and 'E' overlap",  # a short circuit, though the trace collects nothing there
        ),
        (
            {"electrodes": (replace(TRACED, more=600 * (SQUARE.corners,)),)},
            "'D': expected at most 2048 corners of all polygons, got 2404",
        ),
        ({"surface": "inside"}, r"expected one of \(.*\), got 'inside'"),
    ],
)
def test_invalid_sensor_raises_error(three, changes, message):
    with pytest.raises(SensorError, match=message):
        replace(three, **changes)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (((0.0, 0.0),), r"expected 2 to 128 points \(x, y\), got \(\(0.0, 0.0\),\)"),
        (((0.0, 0.0), (9.0, 0.0), (9.0, 0.0), (9.0, 5.0)), r"repeats a point .*, got \(9.0, 0.0\) mm as point 2"),
        (((0.0, 0.0), (9.0, 0.0), (0.0, 0.0)), r"nor turns back, got \(9.0, 0.0\) mm as point 2"),
        (((0.0, 0.0), (9.0, 0.0), (9.0, 5.0), (4.0, 5.0), (4.0, -5.0)), r"does not cross itself .*\(4.0, -5.0\)\) mm"),
    ],
)
def test_invalid_path_of_a_trace_raises_error(path, message):
    with pytest.raises(SensorError, match=f"^trace of electrode 'D': .*{message}$"):
        SQUARE.with_trace(path, 0.5)


@pytest.mark.parametrize("x", np.linspace(-9.0, 9.0, 25))
def test_electrodes_that_touch_except_for_rounding_do_not_overlap(three, x):
    """The gap between the sectors of a disk is usually left out of a description."""
    left, right, overlapping = (
        Electrode.of_square(name, (x + dx, 0.0), 3.0) for name, dx in (("L", 0.0), ("R", 3.0), ("O", 2.9999))
    )
    assert replace(three, electrodes=(left, right)).electrode_names == ("L", "R")
    with pytest.raises(SensorError, match="'L' and 'O' overlap"):
        replace(three, electrodes=(left, overlapping))


def test_area_of_a_union_counts_overlaps_once_and_only_metal_with_a_back():
    """The area of a trace is its width times the length of its middle line. Overlapping metal counts once."""
    assert TRACED.area == pytest.approx(9.0 + 0.5 * (14.0 - 1.5), rel=1e-12)
    twice = TRACED.with_trace(((9.0, 0.0), (4.0, 0.0)), 0.5)
    assert twice.area == pytest.approx(TRACED.area, rel=1e-12)
    assert twice.centre == (0.0, 0.0)
    quarter = ((0.0, 0.0), (20.0, 0.0), (20.0, 20.0), (0.0, 20.0))  # metal on the back of a quarter of the plane
    assert replace(TRACED, back=(quarter,)).area == pytest.approx(2.25 + 0.25 * 7.75 + 0.5 * 4.75, rel=1e-12)


def test_calibrated_position_is_rotated_anticlockwise_and_then_shifted():
    calibration = Calibration(shift=(0.5, -0.25), rotation=np.pi / 2.0)
    placed = calibration.place(np.array([[1.0, 0.0], [0.0, 2.0]]))
    np.testing.assert_allclose(placed, [[0.5, 0.75], [-1.5, -0.25]], atol=1e-15)
