"""Change of the charges by properties of the film, compared with direct solves."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import (
    Circle,
    Domain,
    FilmSlopes,
    Polygon,
    Resolution,
    SolveSettings,
    load_sensor,
    press,
)
from isocharge.simulate.forward import derivative_maps
from isocharge.simulate.forward.family import NodeCount
from isocharge.simulate.sensor.film_properties import changed_film
from isocharge.simulate.solver.equilibrium import nodal_stress
from isocharge.simulate.solver.sensitivity import stress_changes
from solved_charges import relative_error, solved_charges, with_film

PROBE = Circle(1.0)
ROUGH = SolveSettings(resolution=Resolution(4, 8, 4))


def drawn_sensor():
    """Return a uniaxial film of 0.8 MPa."""
    return with_film(load_sensor("four-25um-uniaxial"), pretension=0.8)


def slopes_of(sensor, *forces):
    """Return the derivatives of a rough map of a sensor, with few nodes for so small a range of forces."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(derivative_maps, "few_nodes", lambda *_: NodeCount(distances=4, forces=3))
        return FilmSlopes.build(sensor, PROBE, Domain(4.0, forces), ROUGH)


@pytest.fixture(scope="module")
def film_slopes() -> FilmSlopes:
    return slopes_of(drawn_sensor(), 0.5, 0.9)


STEPS = {
    "tension_shear": 0.02,
    "stiffness_x": 0.02,
    "oval_xy": 0.002,
    "pretension": 0.05,
    "tension_difference": 0.02,
    "stiffness_xy": 0.02,
    "oval_x": 0.002,
}
"""Steps of the finite differences, in the units of the properties."""


@pytest.mark.first_cases(3)
@pytest.mark.parametrize("name", STEPS)
def test_derivatives_equal_differences_of_direct_solves(film_slopes, name):
    assert_equal_differences_of_direct_solves(film_slopes, name)


def test_oval_clamp_across_the_press_displaces_no_trapped_air():
    closed = with_film(drawn_sensor(), back_volume=127_000.0)
    assert_equal_differences_of_direct_solves(slopes_of(closed, 0.5, 0.5), "oval_xy")


def assert_equal_differences_of_direct_solves(film_slopes, name):
    sensor = film_slopes.film.sensor
    contact = np.column_stack([[[3.0, -2.0], [-2.5, 2.8]], film_slopes.film.domain.force_range])
    start = sensor.film.pretension if name == "pretension" else 0.0
    charges = [
        solved_charges(*changed_film(sensor, PROBE, {name: start + step}), contact, ROUGH)
        for step in (STEPS[name], -STEPS[name])
    ]
    expected = (charges[0] - charges[1]) / (2.0 * STEPS[name])
    if name.startswith("tension"):
        expected /= sensor.film.pretension  # the property is relative to it, the derivative is not
    jacobian = film_slopes.jacobian(contact)[name]
    assert relative_error(jacobian, expected) <= 1e-2


def test_film_slopes_of_a_square_probe_raises_a_scene_error(film_slopes):
    with pytest.raises(SceneError, match="properties of a film: expected a circular probe"):
        FilmSlopes.build(film_slopes.film.sensor, Polygon.rectangle(2.0, 2.0), film_slopes.film.domain)


def stress_difference(solved, above, below):
    """Return the difference of the nodal stress, MPa, between two films that differ from that of a press."""
    settings = SolveSettings(resolution=solved.mesh.resolution, layer=solved.mesh.layer)
    stresses = []
    for changes in (above, below):
        changed = press(replace(solved.film, **changes), PROBE, solved.at, solved.force, settings, start=solved)
        stresses.append(solved.film.young * changed.groups.squared_amplitude * nodal_stress(changed))
    return stresses[0] - stresses[1]


def test_the_pretension_also_changes_the_stress_under_a_static_pressure_before_the_contact():
    """The touch stress is the difference from the stress before the contact, which depends on the pretension, too."""
    film = replace(load_sensor("four-25um-biaxial").film, pretension=0.8, static_pressure=5e-5)
    solved = press(film, PROBE, (5.0, 0.0), 0.5, ROUGH)
    expected = stress_difference(solved, {"pretension": 0.85}, {"pretension": 0.75}) / 0.1
    change = stress_changes(solved, "middle")[:, :, 1]  # by the mean tension
    stress_unit = film.young * solved.groups.squared_amplitude
    change *= stress_unit / (stress_unit + film.pretension)
    assert relative_error(change, expected) <= 1e-2


def test_stiffness_of_an_orthotropic_film_changes_relative_to_its_own_axes():
    film = replace(load_sensor("four-25um-biaxial").film, pretension=0.8, young_ratio=2.0, axis=0.3)
    solved = press(film, PROBE, (5.0, 0.0), 0.5, ROUGH)
    above, below = ({"young_ratio": 2.0 * np.exp(log_ratio)} for log_ratio in (0.01, -0.01))
    expected = stress_difference(solved, above, below) / 0.02
    even, odd = np.moveaxis(stress_changes(solved, "middle")[:, :, 4:6], 2, 0)  # by the stiffness
    change = np.cos(0.6) * even + np.sin(0.6) * odd  # axis 1 lies at 0.3 rad to the direction of the press
    change *= film.young * solved.groups.squared_amplitude
    assert relative_error(change, expected) <= 5e-3
