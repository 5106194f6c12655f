"""Air behind the film and static pressure, compared with a closed form and with scikit-fem."""

import json

import numpy as np
import pytest

from axisymmetric_membrane import harmonic
from isocharge.simulate import (
    Circle,
    ForwardMap,
    Resolution,
    Sensor,
    SolveSettings,
    Theory,
    deflection,
    load_sensor,
    press,
    touch_charge,
)
from kept import ROOT
from solved_charges import relative_error, solved_charge, with_film

PROBE = Circle(1.0)
ATMOSPHERE = 0.101325
"""Pressure of the atmosphere, MPa."""

CAVITY = 20.0 * np.pi * 45.0**2
"""Volume of a cavity of 20 mm behind the film, mm^3."""

SKFEM_CASES = json.loads((ROOT / "tests/data/film_cases_air_skfem.json").read_text())
"""Charges by an independent finite-element program; see the entry `method` of the file."""

MEMBRANE = SolveSettings(theory=Theory(bending=False), resolution=Resolution(6, 8, 6))


def sensor_with(**film: object) -> Sensor:
    """Return the biaxial film with four electrodes and 0.8 MPa, with other attributes of the film."""
    return with_film(load_sensor("four-25um-biaxial"), **{"pretension": 0.8, **film})


@pytest.mark.parametrize("volume", [CAVITY, 100.0 * CAVITY, 1000.0])
@pytest.mark.parametrize("at", [(0.0, 0.0), (12.0, -5.0)])
def test_deflection_with_trapped_air_equals_that_of_a_taut_membrane(volume, at):
    """A taut membrane with the tension N under a small force F on a disk of radius R at c, with a pressure p behind it:

    w(z) = F / (2 pi N) ln |(a^2 - conj(c) z) / (a (z - c))| - p (a^2 - |z|^2) / (4 N) outside the disk,
    V = F (a^2 - |c|^2 - R^2 / 2) / (4 N) - pi p a^4 / (8 N),   p = p0 V / V0 minus a negative static pressure.
    """
    static = -1e-10
    film = sensor_with(back_volume=volume, static_pressure=static).film
    a = film.radius
    tension = film.pretension * film.thickness
    force = 1e-6
    centre = complex(*at)
    volume_by_force = force * (a**2 - abs(centre) ** 2 - 0.5) / (4.0 * tension)
    volume_by_pressure = np.pi * a**4 / (8.0 * tension)
    stiffness = ATMOSPHERE / volume
    pressure = (stiffness * volume_by_force - static) / (1.0 + stiffness * volume_by_pressure)

    points = np.array([[-20.0, 3.0], [5.0, 25.0], [30.0, -10.0], [4.0, 1.0]])
    z = points @ np.array([1.0, 1j])
    by_force = force / tension * harmonic(z / a, centre / a)
    expected = by_force - pressure * (a**2 - np.abs(z) ** 2) / (4.0 * tension)
    solved = press(film, PROBE, at, force, MEMBRANE)
    assert relative_error(deflection(solved, points), expected) <= 2e-5


@pytest.mark.first_cases(4)
@pytest.mark.parametrize("case", SKFEM_CASES["cases"])
def test_charges_with_back_pressure_equal_those_of_scikit_fem(case):
    sensor = with_film(
        load_sensor("four-25um-uniaxial"),
        pretension=case["pretension_MPa"],
        back_volume=case["back_volume_mm3"],
        static_pressure=1e-6 * case["static_pressure_Pa"],
    )
    solved = press(sensor.film, Circle(case["probe_radius_mm"]), tuple(case["at_mm"]), case["force_N"])
    assert relative_error(touch_charge(sensor, solved), np.array(case["charge_pC"])) <= 1e-3
    assert deflection(solved, [case["at_mm"]])[0] == pytest.approx(case["deflection_mm"], rel=2e-3)


@pytest.mark.slow  # in `make test`, the presses of a closed back are compared, and maps of other films
def test_forward_map_of_a_film_with_a_closed_back_equals_direct_solves():
    sensor = sensor_with(back_volume=CAVITY, static_pressure=1e-6)
    forward_map = ForwardMap.build(sensor, PROBE, 4.0, (0.3, 0.5))
    charge = solved_charge(sensor, PROBE, (-2.0, 3.2), 0.35)
    np.testing.assert_allclose(forward_map.charges(np.array([[-2.0, 3.2, 0.35]]))[0], charge, rtol=1e-3)
