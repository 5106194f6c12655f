"""What a sensor may be, and what calibration does to it."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SensorError
from isocharge.simulate import Calibration, Circle, Electrode, Film, Piezo, Sensor, load_sensor, press, touch_charge


@pytest.fixture
def three() -> Sensor:
    return load_sensor("three-25um-biaxial")


@pytest.fixture
def four() -> Sensor:
    return load_sensor("four-25um-uniaxial")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"radius": 0.0}, "film radius: expected a positive number, got 0 m"),
        ({"radius": -1.0}, "film radius: expected a positive number, got -1 m"),
        ({"thickness": 0.0}, "film thickness: expected a positive number, got 0 m"),
        ({"thickness": np.nan}, "film thickness: expected a positive number, got nan"),
        ({"young": np.inf}, "film young: expected a positive number, got inf Pa"),
        ({"poisson": 0.5}, "film poisson: expected 0 <= poisson < 0.5, got 0.5"),
        ({"poisson": -0.1}, "film poisson: expected 0 <= poisson < 0.5, got -0.1"),
        ({"poisson": np.nan}, "film poisson: .* got nan"),
        ({"pretension": -1e6}, r"film pretension: expected zero or tension .* got -1000000\.0"),
        ({"thickness": 5e-3}, r"film thickness: expected at most a tenth of the radius \(45\.0 mm\), got 5000\.0 um"),
    ],
)
def test_impossible_films(film, changes, message):
    with pytest.raises(SensorError, match=message):
        replace(film, **changes)


@pytest.mark.parametrize("name", ["d31", "d32", "d33", "pyro"])
def test_coefficients_are_finite(name):
    with pytest.raises(SensorError, match=f"piezo {name}: expected a finite number, got nan"):
        Piezo(**({"d31": 1e-12, "d32": 1e-12} | {name: np.nan}))


def test_area_and_centre():
    square = Electrode.of_square("A", (2e-3, -1e-3), 3e-3)
    assert square.area == pytest.approx(9e-6)
    assert square.centre == pytest.approx((2e-3, -1e-3))
    triangle = Electrode("T", ((0.0, 0.0), (4e-3, 0.0), (0.0, 3e-3)))
    assert triangle.area == pytest.approx(6e-6)
    assert not triangle.square


CONVEX = r"electrode 'A': expected a convex polygon with its corners anticlockwise, got \[\["


@pytest.mark.parametrize(
    "corners",
    [
        ((0, 0), (0, 3), (3, 3), (3, 0)),  # clockwise
        ((0, 0), (3, 0), (1, 1), (0, 3)),  # a dent
        ((0, 0), (1, 0), (2, 0), (0, 2)),  # three in a row
        ((0, 0), (3, 3), (3, 0), (0, 3)),  # a bow
        tuple((3 * np.cos(0.8 * np.pi * i), 3 * np.sin(0.8 * np.pi * i)) for i in range(5)),  # a star
    ],
)
def test_only_convex_electrodes(three, corners):
    corners = tuple((1e-3 * float(x), 1e-3 * float(y)) for x, y in corners)
    with pytest.raises(SensorError, match=CONVEX):
        replace(three, electrodes=(Electrode("A", corners),))


@pytest.mark.parametrize("corners", [((0.0, 0.0), (1e-3, 0.0)), ((0.0, 0.0), (1e-3, 0.0), (0.0, np.nan)), ()])
def test_electrodes_need_three_corners(three, corners):
    with pytest.raises(SensorError, match="electrode 'A': expected at least three corners"):
        replace(three, electrodes=(Electrode("A", corners),))


def test_square_that_is_none_is_refused(three):
    triangle = ((0.0, 0.0), (4e-3, 0.0), (0.0, 3e-3))
    with pytest.raises(SensorError, match="electrode 'A': expected the corners of a square along the axes"):
        replace(three, electrodes=(Electrode("A", triangle, square=True),))
    replace(three, electrodes=(Electrode.of_square("A", (1.5e-3, 1.5e-3), 3e-3),))


def test_electrode_off_the_film(three):
    electrodes = (*three.electrodes[:2], Electrode.of_square("C", (40e-3, 25e-3), 3e-3))
    message = (
        r"^electrode 'C' lies outside the film: centre \(40\.0, 25\.0\) mm, half side 1\.5 mm, film radius 45\.0 mm$"
    )
    with pytest.raises(SensorError, match=message):
        replace(three, electrodes=electrodes)


def test_polygon_off_the_film(three):
    corners = ((44e-3, 0.0), (48e-3, 0.0), (46e-3, 3e-3))
    with pytest.raises(SensorError, match=r"'C' .* centre \(46\.0, 1\.0\) mm, corners up to 2\.23607 mm from it"):
        replace(three, electrodes=(Electrode("C", corners),))


def test_electrode_that_calibration_moves_off_the_film(three):
    with pytest.raises(SensorError, match=r"'A' lies outside the film: centre \(0\.0, -45\.0\) mm"):
        replace(three, calibration=Calibration(shift=(0.0, -35e-3)))
    with pytest.raises(SensorError, match=r"'A' lies outside the film: centre \(nan, -10\.0\) mm"):
        replace(three, calibration=Calibration(shift=(np.nan, 0.0)))


@pytest.mark.parametrize("centre", [(0.0, -10e-3), (2e-3, -9e-3), (-2.9e-3, -12.9e-3)])
def test_overlapping_electrodes(three, centre):
    with pytest.raises(SensorError, match="electrodes 'A' and 'D' overlap; move one of them"):
        replace(three, electrodes=(*three.electrodes, Electrode.of_square("D", centre, 3e-3)))


@pytest.mark.parametrize(
    "other",
    [
        Electrode.of_square("D", (3e-3, -10e-3), 3e-3),  # touching edges
        Electrode("D", ((1.6e-3, -13e-3), (3e-3, -11.5e-3), (1.6e-3, -10e-3))),
        Electrode("D", ((1.5e-3, -8e-3), (2e-3, -9e-3), (2.5e-3, -6e-3))),  # apart along a slanted line only
    ],
)
def test_neighbours_do_not_overlap(three, other):
    assert len(replace(three, electrodes=(three.electrodes[0], other)).electrodes) == 2


def test_edge_readout_needs_squares(three):
    triangle = Electrode("T", ((0.0, 0.0), (4e-3, 0.0), (0.0, 3e-3)))
    with pytest.raises(SensorError, match="readout 'edge' needs square electrodes, but 'T' is a polygon"):
        replace(three, electrodes=(*three.electrodes, triangle), readout="edge")


@pytest.mark.parametrize(("changes", "got"), [({"readout": "mean"}, "mean"), ({"surface": "inside"}, "inside")])
def test_unknown_readout_or_surface(three, changes, got):
    with pytest.raises(SensorError, match=rf"expected one of \(.*\), got '{got}'"):
        replace(three, **changes)


@pytest.mark.parametrize("name", ["A", "", "side_mm"])
def test_electrodes_have_names_of_their_own(three, name):
    electrodes = (*three.electrodes, Electrode.of_square(name, (0.0, 0.0), 1e-3))
    with pytest.raises(SensorError, match=rf"expected different names, none empty or 'side_mm', got .*'{name}'"):
        replace(three, electrodes=electrodes)


@pytest.mark.parametrize("gain", [0.0, -1.0, np.nan, np.inf])
def test_gains_are_positive(three, gain):
    with pytest.raises(SensorError, match=f"calibration gain: expected positive numbers, got .*{gain}"):
        replace(three, calibration=Calibration(gain={"A": gain}))


def test_film_without_any_effect_is_refused():
    with pytest.raises(SensorError, match="piezo d31 and d32 are both 0: such a film gives no charge"):
        Piezo(d31=0.0, d32=0.0, d33=-30e-12)


def test_sensor_without_electrodes_is_refused(three):
    with pytest.raises(SensorError, match="electrodes: expected at least one, got none"):
        replace(three, electrodes=())


def test_gain_of_an_unknown_electrode(three):
    with pytest.raises(SensorError, match=r"calibration gain: no electrode named \['E'\], have \('A', 'B', 'C'\)"):
        replace(three, calibration=Calibration(gain={"E": 1.1}))


# Calibration


def test_gain_multiplies_the_charge(four):
    solved = press(four.film, Circle(1e-3), (3e-3, 1e-3), 1.0)
    calibrated = replace(four, calibration=Calibration(gain={"A": 1.02, "C": 0.95}))
    ratio = touch_charge(calibrated, solved) / touch_charge(four, solved)
    np.testing.assert_allclose(ratio, [1.02, 1.0, 0.95, 1.0], rtol=1e-14)


def test_place_turns_then_shifts():
    """(1, 0) turned by 90 degrees anticlockwise is (0, 1)."""
    calibration = Calibration(shift=(0.5, 0.0), rotation=np.pi / 2)
    np.testing.assert_allclose(
        calibration.place(np.array([[1.0, 0.0], [0.0, 2.0]])), [[0.5, 1.0], [-1.5, 0.0]], atol=1e-15
    )


def test_shift_of_the_electrodes_is_the_press_moved_the_other_way(four):
    """To first order, near the centre of a large film: the film's rim does not move along."""
    large = replace(four, film=replace(four.film, radius=0.45))
    shift, at = np.array([0.2e-3, -0.1e-3]), np.array([2e-3, 1e-3])

    def charge(sensor: Sensor, at: np.ndarray) -> np.ndarray:
        return touch_charge(sensor, press(sensor.film, Circle(1e-3), (float(at[0]), float(at[1])), 1.0))

    there = charge(large, at)
    electrodes_moved = charge(replace(large, calibration=Calibration(shift=(0.2e-3, -0.1e-3))), at) - there
    press_moved = charge(large, at - shift) - there
    assert np.abs(press_moved / there).max() > 5e-3
    np.testing.assert_allclose(electrodes_moved, press_moved, atol=0.02 * np.abs(press_moved).max())


@pytest.mark.parametrize("degrees", [90.0, -90.0, 180.0])
def test_rotation_by_the_layouts_own_angle_permutes(degrees):
    """The four squares turned onto each other: A stands where B was (+90), and so on. Exactly, unlike the three."""
    sensor = load_sensor("four-25um-biaxial")
    solved = press(sensor.film, Circle(1e-3), (3e-3, 1e-3), 1.0)
    turned = replace(sensor, calibration=Calibration(rotation=np.deg2rad(degrees)))
    expected = np.roll(touch_charge(sensor, solved), -round(degrees / 90.0))
    np.testing.assert_allclose(touch_charge(turned, solved), expected, rtol=1e-12)


def test_rotation_by_120_degrees_permutes_the_three(three):
    """Nearly: the squares themselves are turned as well, by 30 degrees modulo their own symmetry."""
    solved = press(three.film, Circle(1e-3), (2e-3, 3e-3), 1.0)
    turned = replace(three, calibration=Calibration(rotation=np.deg2rad(120.0)))
    np.testing.assert_allclose(touch_charge(turned, solved), np.roll(touch_charge(three, solved), -1), rtol=5e-3)


def test_rotation_turns_the_press_the_other_way_on_a_biaxial_film(three):
    """d31 = d32: only the trace counts, so turning the layout is turning the press back."""
    angle, z = np.deg2rad(25.0), complex(4e-3, 2e-3)
    turned = replace(three, calibration=Calibration(rotation=angle))
    back = z * np.exp(-1j * angle)
    charge = touch_charge(turned, press(three.film, Circle(1e-3), (z.real, z.imag), 1.0))
    expected = touch_charge(three, press(three.film, Circle(1e-3), (back.real, back.imag), 1.0))
    np.testing.assert_allclose(charge, expected, rtol=1e-9)


def test_sensors_are_values(three):
    assert three == load_sensor("three-25um-biaxial")
    assert three != load_sensor("three-25um-uniaxial")
    assert isinstance(three.film, Film)
    assert three.electrode_names == ("A", "B", "C")
    np.testing.assert_array_equal(three.gains, [1.0, 1.0, 1.0])
