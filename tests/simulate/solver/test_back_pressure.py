"""Air behind the film and static pressure, compared with a closed form, a collocation and scikit-fem."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import cumulative_simpson, solve_bvp
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import brentq

from isocharge.simulate import (
    Circle,
    Film,
    Finger,
    ForwardMap,
    Sensor,
    SolveSettings,
    Theory,
    deflection,
    load_sensor,
    press,
    touch_charge,
)
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.solver.error_estimate import mesh_error

ATMOSPHERE = 0.101325
"""Pressure of the atmosphere, MPa."""

CAVITY = 20.0 * np.pi * 45.0**2
"""Volume of a cavity of 20 mm behind the film, mm^3."""

SKFEM_CASES = json.loads((Path(__file__).parents[2] / "data" / "film_cases_air_skfem.json").read_text())
"""Charges by an independent finite-element program; see the entry `method` of the file."""

MEMBRANE = SolveSettings(theory=Theory(bending=False), accuracy=1e-4)


def sensor_with(**film: object) -> Sensor:
    """Return the biaxial film with four electrodes and 0.8 MPa, with other attributes of the film."""
    sensor = load_sensor("four-25um-biaxial")
    return replace(sensor, film=replace(sensor.film, **{"pretension": 0.8, **film}))


@pytest.mark.parametrize("volume", [CAVITY, 100.0 * CAVITY, 1000.0])
@pytest.mark.parametrize("at", [(0.0, 0.0), (12.0, -5.0)])
def test_deflection_with_trapped_air_equals_that_of_a_taut_membrane(volume, at):
    """A taut membrane with the tension N under a small force F on a disk of radius R at c, with a pressure p behind it:

    w(z) = F / (2 pi N) ln |(a^2 - conj(c) z) / (a (z - c))| - p (a^2 - |z|^2) / (4 N) outside the disk,
    V = F (a^2 - |c|^2 - R^2 / 2) / (4 N) - pi p a^4 / (8 N),   p = p0 V / V0.
    """
    film = sensor_with(back_volume=volume).film
    a = film.radius
    tension = film.pretension * film.thickness
    force = 1e-6
    centre = complex(*at)
    volume_by_force = force * (a**2 - abs(centre) ** 2 - 0.5) / (4.0 * tension)
    volume_by_pressure = np.pi * a**4 / (8.0 * tension)
    pressure = volume_by_force / (volume / ATMOSPHERE + volume_by_pressure)

    points = np.array([[-20.0, 3.0], [5.0, 25.0], [30.0, -10.0], [4.0, 1.0]])
    z = points @ np.array([1.0, 1j])
    by_force = force / (2.0 * np.pi * tension) * np.log(np.abs((a**2 - np.conj(centre) * z) / (a * (z - centre))))
    expected = by_force - pressure * (a**2 - np.abs(z) ** 2) / (4.0 * tension)
    solved = press(film, Circle(1.0), at, force, MEMBRANE)
    np.testing.assert_allclose(deflection(solved, points), expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("at", [(12.0, -5.0), (20.0, 8.0)])
def test_estimated_error_holds_for_a_closed_back_off_the_centre(at):
    sensor = sensor_with(back_volume=CAVITY)
    solved = press(sensor.film, Circle(1.0), at, 1.0)
    resolution = solved.mesh.resolution
    fine = SolveSettings(theory=solved.theory, resolution=replace(resolution, order=resolution.order + 2))
    charge = touch_charge(sensor, solved)
    fine_charge = touch_charge(sensor, press(sensor.film, Circle(1.0), at, 1.0, fine))
    relative_error = np.abs(charge - fine_charge).max() / np.abs(fine_charge).max()
    assert relative_error <= mesh_error(solved) <= 1e-3


def axisymmetric_charges(sensor: Sensor, probe_radius: float, force: float, static_pressure: float) -> np.ndarray:
    """Compute the touch charges of a press at the centre by collocation (`scipy.integrate.solve_bvp`)."""
    film = sensor.film

    def trapped_pressure(volume: float) -> float:
        """Pressure of the air on the film, MPa."""
        if film.back_volume is None:
            return 0.0
        return ATMOSPHERE * film.back_volume / (film.back_volume - volume) - ATMOSPHERE

    def state(newtons: float) -> CubicHermiteSpline:
        """Return s11 + s22 over the distance from the centre, with the air in equilibrium."""

        def imbalance(air: float) -> float:
            _, volume = membrane_state(film, probe_radius, newtons, static_pressure - air)
            return trapped_pressure(volume) - air

        air = 0.0 if film.back_volume is None else brentq(imbalance, -1e-3, 1e-3, xtol=1e-13)
        stress_sum, _ = membrane_state(film, probe_radius, newtons, static_pressure - air)
        return stress_sum

    pressed = state(force)
    unpressed = state(0.0) if static_pressure else None
    nodes, weights = np.polynomial.legendre.leggauss(12)
    charges = []
    for electrode in sensor.electrodes:
        x, y = electrode.centre
        distance = np.hypot(x + 1.5 * nodes[:, None], y + 1.5 * nodes[None, :])
        stress_sum = pressed(distance) - 2.0 * film.pretension
        if unpressed is not None:
            stress_sum = pressed(distance) - unpressed(distance)
        charges.append(sensor.piezo.d31 * 1.5**2 * weights @ stress_sum @ weights)
    return np.array(charges)


def membrane_state(film: Film, probe_radius: float, force: float, pressure: float) -> tuple[CubicHermiteSpline, float]:
    """Solve an axisymmetric membrane of St. Venant-Kirchhoff material under a force and a uniform pressure.

    The unknowns are u and P = r S11 (1 + u'). The transverse equilibrium is r h S11 w' = -Q / (2 pi), where Q is the
    force within the radius r.

    Returns:
        s11 + s22 over the distance (MPa over mm), and the volume under the deflection, mm^3.
    """
    a = film.radius
    plane = film.young / (1.0 - film.poisson**2)

    def local_state(r: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the stretch 1 + u', the slope w', S11 and S22."""
        u, momentum = y
        load = force * np.minimum((r / probe_radius) ** 2, 1.0) + pressure * np.pi * r**2
        slope_per_stretch = -load / (2.0 * np.pi * film.thickness * momentum)
        hoop = u / r + 0.5 * (u / r) ** 2
        stretch = np.ones_like(r)
        for _ in range(40):  # Newton's method for S11 = P / (r stretch)
            radial = 0.5 * (stretch**2 * (1.0 + slope_per_stretch**2) - 1.0)
            error = plane * (radial + film.poisson * hoop) + film.pretension - momentum / (r * stretch)
            slope = plane * stretch * (1.0 + slope_per_stretch**2) + momentum / (r * stretch**2)
            stretch = stretch - error / slope
        radial_stress = momentum / (r * stretch)
        radial = 0.5 * (stretch**2 * (1.0 + slope_per_stretch**2) - 1.0)
        hoop_stress = plane * (hoop + film.poisson * radial) + film.pretension
        return stretch, slope_per_stretch * stretch, radial_stress, hoop_stress

    def derivatives(r: np.ndarray, y: np.ndarray) -> np.ndarray:
        stretch, _, _, hoop_stress = local_state(r, y)
        return np.stack([stretch - 1.0, hoop_stress * (1.0 + y[0] / r)])

    def boundary(inner: np.ndarray, outer: np.ndarray) -> np.ndarray:
        stretch, _, _, _ = local_state(np.array([first]), inner[:, None])
        return np.array([inner[0] / first - (stretch[0] - 1.0), outer[0]])

    first = 1e-3
    r = np.unique(np.concatenate([np.linspace(first, probe_radius, 60), np.geomspace(probe_radius, a, 240)]))
    start = np.stack([np.zeros_like(r), r * (film.pretension + 2.0)])
    solved = solve_bvp(derivatives, boundary, r, start, tol=1e-7, max_nodes=40000)
    assert solved.status == 0, solved.message
    _, slope, radial_stress, hoop_stress = local_state(solved.x, solved.y)
    total = radial_stress + hoop_stress
    moment = cumulative_simpson(-np.pi * solved.x**2 * slope, x=solved.x)
    return CubicHermiteSpline(solved.x, total, np.gradient(total, solved.x)), float(moment[-1])


@pytest.mark.first_cases(2)
@pytest.mark.parametrize(
    ("back_volume", "static_pressure", "force"),
    [(10.0 * CAVITY, 2e-6, 0.2), (CAVITY, 0.0, 0.5), (None, -20e-6, 0.5), (CAVITY, 0.0, 0.05), (None, 2e-6, 0.1)],
)
def test_charges_with_back_pressure_equal_those_of_a_collocation(back_volume, static_pressure, force):
    sensor = sensor_with(back_volume=back_volume, static_pressure=static_pressure)
    charge = touch_charge(sensor, press(sensor.film, Circle(1.0), (0.0, 0.0), force, MEMBRANE))
    expected = axisymmetric_charges(sensor, 1.0, force, static_pressure)
    np.testing.assert_allclose(charge, expected, rtol=1e-3)


@pytest.mark.parametrize("case", SKFEM_CASES["cases"])
def test_charges_with_back_pressure_equal_those_of_scikit_fem(case):
    sensor = load_sensor("four-25um-uniaxial")
    film = replace(
        sensor.film,
        pretension=case["pretension_MPa"],
        back_volume=case["back_volume_mm3"],
        static_pressure=1e-6 * case["static_pressure_Pa"],
    )
    solved = press(film, Circle(case["probe_radius_mm"]), tuple(case["at_mm"]), case["force_N"])
    charge = touch_charge(replace(sensor, film=film), solved)
    expected = np.array(case["charge_pC"])
    np.testing.assert_allclose(charge, expected, atol=1e-3 * np.abs(expected).max())
    assert deflection(solved, [case["at_mm"]])[0] == pytest.approx(case["deflection_mm"], rel=2e-3)


@pytest.mark.parametrize(("probe", "at", "force"), [(Circle(1.0), (9.0, 4.5), 0.2), (Finger(5.0), (22.0, 5.0), 0.05)])
def test_slack_film_with_a_closed_back_equals_a_finer_mesh(probe, at, force):
    """The trapped air lifts a slack film beside the probe, so that narrow strips of the film are bent."""
    sensor = sensor_with(pretension=0.0, back_volume=0.75 * CAVITY)
    solved = press(sensor.film, probe, at, force)
    finer = press(sensor.film, probe, at, force, SolveSettings(resolution=Resolution(8, 8, 20, 3)))
    expected = touch_charge(sensor, finer)
    error = np.abs(touch_charge(sensor, solved) - expected).max() / np.abs(expected).max()
    assert error < mesh_error(solved) < 1e-3


@pytest.mark.slow  # in `make test`, the presses of a closed back are compared, and maps of other films
def test_forward_map_of_a_film_with_a_closed_back_equals_direct_solves():
    sensor = sensor_with(back_volume=CAVITY, static_pressure=1e-6)
    forward_map = ForwardMap.build(sensor, Circle(1.0), 4.0, (0.3, 0.5))
    charge = touch_charge(sensor, press(sensor.film, Circle(1.0), (-2.0, 3.2), 0.35))
    np.testing.assert_allclose(forward_map.charges(np.array([[-2.0, 3.2, 0.35]]))[0], charge, rtol=1e-3)
