"""Tests of the properties of real films: each changes what it names and nothing else."""

import math
from operator import attrgetter
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from isocharge.common.errors import SensorError
from isocharge.simulate import Circle, FilmPrior, load_sensor, parse_probe
from isocharge.simulate.sensor.film_properties import LARGEST_PRETENSION, changed_film
from isocharge.simulate.sensor.sensor_file import sensor_from_dict, sensor_to_dict
from solved_charges import with_film

PROBE = Circle(1.0)
SENSOR = with_film(load_sensor("four-25um-biaxial"), pretension=0.5)
PRIOR = FilmPrior(SENSOR, PROBE)


FILM = SENSOR.film
PIEZO = SENSOR.piezo
EXPECTED = {
    "pretension": (0.7, "film.pretension", 0.7),
    "young": (0.1, "film.young", FILM.young * math.exp(0.1)),
    "thickness": (-0.1, "film.thickness", FILM.thickness * math.exp(-0.1)),
    "d31": (0.2, "piezo.d31", PIEZO.d31 * math.exp(0.2)),
    "d32": (0.2, "piezo.d32", PIEZO.d32 * math.exp(0.2)),
    "d12": (0.3, "piezo.d12", 0.3),
    "shift_x": (0.3, "calibration.shift", (0.3, 0.0)),
    "shift_y": (0.3, "calibration.shift", (0.0, 0.3)),
    "rotation": (0.02, "calibration.rotation", 0.02),
    "tension_difference": (0.2, "film.deviator", (0.2 * FILM.pretension, 0.0)),
    "tension_shear": (0.2, "film.deviator", (0.0, 0.2 * FILM.pretension)),
    "stiffness_x": (-0.2, "film.young_ratio film.axis", (math.exp(0.2), math.pi / 2.0)),
    "stiffness_xy": (0.2, "film.young_ratio film.axis", (math.exp(0.2), math.pi / 4.0)),
    "oval_x": (0.01, "film.oval film.oval_axis", (0.01, 0.0)),
    "oval_xy": (-0.01, "film.oval film.oval_axis", (0.01, -math.pi / 4.0)),
    "crosstalk": (0.01, "calibration.crosstalk", 0.01),
    "probe_radius": (0.2, "probe.radius", 1.2),
    "gain A": (0.05, "calibration.gain", {"A": math.exp(0.05)}),
}
"""Value of each property, the attributes of the sensor or the probe that it changes, and their values."""


@pytest.mark.parametrize("name", EXPECTED)
def test_each_property_changes_what_it_names_and_nothing_else(name):
    value, attributes, expected = EXPECTED[name]
    sensor, probe = changed_film(SENSOR, PROBE, {name: value})
    read = attrgetter(*attributes.split())
    assert read(SimpleNamespace(**vars(sensor), probe=probe)) == pytest.approx(expected, rel=1e-12, abs=1e-15)
    described = vars(SENSOR) | {"probe": PROBE}
    changed = vars(sensor) | {"probe": probe}
    assert len([key for key in described if changed[key] != described[key]]) == 1


@pytest.mark.parametrize("change", [1e-9, -0.2])
def test_shear_modulus_keeps_its_axis_and_changes_with_the_modulus_of_the_film(change):
    """A small change of the stiffness must not turn the axis."""
    prior = FilmPrior(with_film(SENSOR, young_ratio=1.5, axis=0.6, shear=700.0), PROBE)
    even, _ = prior.film(prior.without_imperfections(prior.mean))
    film = changed_film(even, PROBE, {"young": change, "stiffness_x": change})[0].film
    expected = (math.exp(change * math.cos(1.2)), 0.6, 700.0 * math.exp(change))
    assert (film.young_ratio, film.axis, film.shear) == pytest.approx(expected, rel=1e-12)


def test_all_properties_are_tested():
    assert {*PRIOR.names} - {*EXPECTED} == {"gain B", "gain C", "gain D"}


@given(st.integers(0, 10**6))
def test_drawn_films_are_within_their_bounds_and_survive_a_sensor_file(seed):
    (values,) = PRIOR.draw(np.random.default_rng(seed), 1)
    low, high = PRIOR.bounds
    assert ((low <= values) & (values <= high)).all()
    assert not values[PRIOR.is_imperfection].any()
    sensor, probe = PRIOR.film(values)
    table = sensor_to_dict(sensor)
    assert sensor_to_dict(sensor_from_dict(table)) == table
    assert parse_probe(probe.notation).reach == pytest.approx(probe.reach)


def test_draws_have_the_mean_and_the_spread_of_the_prior():
    values = PRIOR.draw(np.random.default_rng(0), 4_000)
    assert values[:, 0].max() <= LARGEST_PRETENSION
    np.testing.assert_allclose(values.mean(axis=0), PRIOR.mean, atol=0.07 * PRIOR.std.max())
    np.testing.assert_allclose(values.std(axis=0), PRIOR.std * ~PRIOR.is_imperfection, rtol=0.1)


@pytest.mark.parametrize("name", ["eight-25um-biaxial-36mm", "six-25um-biaxial-30mm", "four-25um-biaxial"])
def test_electrodes_stay_on_every_film_within_the_bounds(name):
    """A search for the properties of a film may try each corner of the bounds. A sensor refuses electrodes off it."""
    prior = FilmPrior(load_sensor(name), PROBE)
    low, high = prior.bounds
    is_high = np.random.default_rng(0).random((100, low.size)) < 0.5
    for corner in np.where(is_high, high, np.maximum(low, [0.1, *low[1:]])):
        sensor, _ = prior.film(corner)
        assert 0.0 < sensor.film.inner_radius <= SENSOR.film.radius


def test_electrode_near_the_rim_is_refused_with_the_largest_distance():
    sensor = sensor_from_dict(sensor_to_dict(SENSOR) | {"electrodes": {"side_mm": 3.0, "A": [43.3, 0.0]}})
    with pytest.raises(SensorError, match=r"within 44\.5 mm.*reaches 44\.83 mm; move it inwards"):
        FilmPrior(sensor, PROBE)


def test_electrode_beside_the_rim_of_a_large_film_is_accepted():
    """The standard deviation of an oval clamp is 0.9 mm, which is more than the gap of 0.65 mm."""
    film = sensor_to_dict(with_film(SENSOR, radius=150.0))
    sensor = sensor_from_dict(film | {"electrodes": {"side_mm": 3.0, "A": [0.0, 147.84]}})
    assert FilmPrior(sensor, PROBE).changes_stress.sum() == PRIOR.changes_stress.sum()
