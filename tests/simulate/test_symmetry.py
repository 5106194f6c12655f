"""Symmetries of the charges: rotated presses, mirrored presses, and other units of length and modulus."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.simulate import (
    Circle,
    Polygon,
    Probe,
    Sensor,
    load_sensor,
    press,
    touch_charge,
)

RECTANGLE = Polygon.rectangle(4.0, 2.0, 0.4)
TRIANGLE = Polygon.triangle(4.0, 0.4)
PROBES = {"circle": Circle(1.0), "rectangle": RECTANGLE, "triangle": TRIANGLE}

EXACT = {"rtol": 2e-6}
"""Tolerance if both presses have the same mesh up to a rotation. Newton's method stops at a residual of 1e-7."""


@pytest.fixture(params=PROBES.values(), ids=PROBES.keys())
def probe(request) -> Probe:
    return request.param


def charges(sensor: Sensor, probe: Probe, at: tuple[float, float], force: float = 0.8) -> np.ndarray:
    return touch_charge(sensor, press(sensor.film, probe, at, force))


def rotated(at: tuple[float, float], degrees: float) -> tuple[float, float]:
    """Return a position that is rotated about the centre of the film."""
    z = complex(*at) * np.exp(1j * np.deg2rad(degrees))
    return z.real, z.imag


AT = (6.0, 2.5)


def test_quarter_turn_of_an_uniaxial_film_swaps_the_coefficients(probe):
    """A rotation of the press by 90 degrees exchanges s11 and s22.

    If d31 and d32 are exchanged as well, each electrode has the charge that its neighbour had before.
    """
    sensor = load_sensor("four-25um-uniaxial")
    exchanged = replace(sensor, piezo=replace(sensor.piezo, d31=sensor.piezo.d32, d32=sensor.piezo.d31))
    second = charges(exchanged, probe.rotated(0.5 * np.pi), rotated(AT, 90.0))
    np.testing.assert_allclose(second, np.roll(charges(sensor, probe, AT), 1), **EXACT)
