"""Rung 7: turning the load turns the charges, mirrors mirror, and units do not matter."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.simulate import STANDARD, Circle, Film, Sensor, load_sensor, press, touch_charge
from isocharge.simulate.template import Placement, template


def charges(sensor: Sensor, x: float, y: float, force: float = 0.8) -> np.ndarray:
    return touch_charge(sensor, press(sensor.film, Circle(1e-3), (x, y), force))


def turned(x: float, y: float, degrees: float) -> tuple[float, float]:
    z = complex(x, y) * np.exp(1j * np.deg2rad(degrees))
    return z.real, z.imag


@pytest.mark.parametrize("readout", ["area", "edge"])
@pytest.mark.parametrize("name", ["four-25um-biaxial", "four-25um-uniaxial"])
def test_half_turn_swaps_opposite_electrodes(name, readout):
    sensor, (x, y) = replace(load_sensor(name), readout=readout), (6e-3, 2.5e-3)
    np.testing.assert_allclose(charges(sensor, -x, -y), charges(sensor, x, y)[[2, 3, 0, 1]], rtol=1e-9)


def test_quarter_turn_passes_the_charges_on():
    sensor = load_sensor("four-25um-biaxial")
    first, second = charges(sensor, 6e-3, 2.5e-3), charges(sensor, *turned(6e-3, 2.5e-3, 90.0))
    np.testing.assert_allclose(second, np.roll(first, 1), rtol=1e-9)


def test_quarter_turn_of_an_uniaxial_film_swaps_the_coefficients():
    """What s11 was is s22 now: turning the press and exchanging d31 and d32 passes the charges on."""
    sensor = load_sensor("four-25um-uniaxial")
    exchanged = replace(sensor, piezo=replace(sensor.piezo, d31=sensor.piezo.d32, d32=sensor.piezo.d31))
    first, second = charges(sensor, 6e-3, 2.5e-3), charges(exchanged, *turned(6e-3, 2.5e-3, 90.0))
    np.testing.assert_allclose(second, np.roll(first, 1), rtol=1e-9)


@pytest.mark.parametrize("name", ["four-25um-biaxial", "four-25um-uniaxial"])
def test_mirror_of_the_four(name):
    """About y: A and C change places, B and D stay."""
    sensor = load_sensor(name)
    np.testing.assert_allclose(charges(sensor, -6e-3, 2.5e-3), charges(sensor, 6e-3, 2.5e-3)[[2, 1, 0, 3]], rtol=1e-7)


@pytest.mark.parametrize("name", ["three-25um-biaxial", "three-25um-uniaxial"])
def test_mirror_of_the_three(name):
    sensor = load_sensor(name)
    np.testing.assert_allclose(charges(sensor, -4e-3, -3e-3), charges(sensor, 4e-3, -3e-3)[[0, 2, 1]], rtol=1e-7)


def test_third_of_a_turn_nearly_passes_the_charges_on():
    """The squares stay along the axes, so three electrodes are not exactly three-fold; small ones are."""
    sensor = load_sensor("three-25um-biaxial")
    tiny = tuple(replace(e, corners=_shrunk(e.corners, 0.01)) for e in sensor.electrodes)
    sensor = replace(sensor, electrodes=tiny)
    first, second = charges(sensor, 1e-3, 4e-3), charges(sensor, *turned(1e-3, 4e-3, 120.0))
    np.testing.assert_allclose(second, np.roll(first, 1), rtol=1e-4)


def _shrunk(corners: tuple[tuple[float, float], ...], share: float) -> tuple[tuple[float, float], ...]:
    centre = np.mean(corners, axis=0)
    return tuple((float(x), float(y)) for x, y in centre + share * (np.array(corners) - centre))


@pytest.mark.parametrize("name", ["three-25um-biaxial", "four-25um-biaxial"])
def test_centred_press_gives_equal_electrodes_equal_charges(name):
    charge = charges(load_sensor(name), 0.0, 0.0)
    np.testing.assert_allclose(charge, charge[0], rtol=1e-4)


def test_field_is_mirror_symmetric_about_the_axis_of_the_press(film):
    """U1 and W even, U2 odd in y, found by looking nodes up at their mirror images."""
    solved = press(film, Circle(1e-3), (9e-3, 0.0), 1.0)
    z = template(STANDARD).node_points(solved.placement.rho)
    order, mirror = np.lexsort((z.imag.round(9), z.real.round(9))), np.lexsort((-z.imag.round(9), z.real.round(9)))
    np.testing.assert_allclose(z[order], np.conj(z[mirror]), atol=1e-8)
    np.testing.assert_allclose(solved.field[order], solved.field[mirror] * [1.0, -1.0, 1.0], atol=1e-9)


def test_centred_press_is_the_same_in_every_direction(film):
    """The eight sectors of the mesh do not show."""
    solved = press(film, Circle(1e-3), (0.0, 0.0), 1.0)
    angle = np.linspace(0.0, 2.0 * np.pi, 33)
    for radius in (5e-4, 3e-3, 20e-3, 40e-3):
        w = solved.deflection(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        np.testing.assert_allclose(w, w[0], rtol=2e-5)


SCALES = {
    "larger": (7.0, 1.0, 1.0),
    "stiffer": (1.0, 40.0, 1.0),
    "thicker": (1.0, 1.0, 3.0),
    "all": (0.2, 1e-3, 0.5),
    "other units": (1e3, 1e-6, 1e3),  # millimetres and megapascals: forces stay in newtons
}


@pytest.mark.parametrize(("length", "modulus", "thickness"), SCALES.values(), ids=SCALES.keys())
def test_same_dimensionless_scene_gives_the_same_digits(length, modulus, thickness):
    """Lengths in the plane, modulus and thickness scaled; force and pretension with them, F ~ E h a."""
    sensor = load_sensor("four-25um-uniaxial")
    film = replace(sensor.film, pretension=0.3e6)
    other = Film(
        film.radius * length,
        film.thickness * thickness,
        film.young * modulus,
        film.poisson,
        film.pretension * modulus,
    )
    electrodes = tuple(
        replace(e, corners=tuple((length * x, length * y) for x, y in e.corners)) for e in sensor.electrodes
    )
    first = press(film, Circle(1e-3), (4e-3, 6e-3), 0.5)
    second = press(other, Circle(1e-3 * length), (4e-3 * length, 6e-3 * length), 0.5 * modulus * thickness * length)
    np.testing.assert_allclose(second.field, first.field, atol=1e-12)
    assert second.iterations == first.iterations
    np.testing.assert_allclose(
        touch_charge(replace(sensor, film=other, electrodes=electrodes), second),
        touch_charge(replace(sensor, film=film), first) * modulus * length**2,
        rtol=1e-10,
    )


def test_slack_film_follows_the_power_two_thirds():
    """Charge / F^(2/3) is constant over five decades, to the size of A^2 (design, section 4: within 0.05 %)."""
    sensor = load_sensor("three-25um-biaxial")
    ratio = np.array([charges(sensor, 3e-3, 1e-3, force) / force ** (2 / 3) for force in (1e-4, 1e-2, 1.0, 5.0)])
    np.testing.assert_allclose(ratio / ratio[0], 1.0, rtol=3e-3)
    np.testing.assert_allclose(ratio[1] / ratio[0], 1.0, rtol=1e-4)


def test_placement_of_many_is_each_of_them():
    distance = np.array([0.0, 0.2, 0.7])
    many = Placement.of_circle(distance, 0.05)
    for i, one in enumerate(distance):
        alone = Placement.of_circle(float(one), 0.05)
        assert (many.c[i], many.rho[i]) == (alone.c, alone.rho)
