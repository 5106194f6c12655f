"""A family of films: its maps against direct solves, exact scales, and its arrays."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import InputError, SceneError
from isocharge.simulate import Circle, FilmFamily, FilmPrior, FilmSpread, load_sensor, press, touch_charge

SPREAD = FilmSpread(pretension=0.2e6, young=0.02, thickness=0.02, probe_radius=0.03e-3)
PRIOR = FilmPrior(load_sensor("three-25um-biaxial"), Circle(1e-3), SPREAD)


@pytest.fixture(scope="module")
def family() -> FilmFamily:
    return FilmFamily.build(PRIOR, radius=3e-3, force_range=(0.8, 1.2), counts=(3, 3, 3, 2, 2))


def charges(family, sensor, probe, x, y, force):
    forward_map = family.forward_map(sensor, probe)
    return forward_map.forward(np.array([x]), np.array([y]), np.array([force]))[0]


def test_maps_agree_with_direct_solves_on_films_that_were_not_solved(family):
    rng = np.random.default_rng(7)
    for parameters in PRIOR.draw(rng, 4):
        sensor, probe = PRIOR.film(parameters)
        x, y = rng.uniform(-2e-3, 2e-3, 2)
        force = rng.uniform(0.8, 1.2)
        direct = touch_charge(sensor, press(sensor.film, probe, (x, y), force))
        np.testing.assert_allclose(charges(family, sensor, probe, x, y, force), direct, rtol=1.5e-3)


def test_modulus_and_loads_scale_exactly(family):
    """Twice the modulus, pretension and force is the same shape with twice the stress."""
    sensor, probe = PRIOR.film(PRIOR.mean)
    twice = replace(
        sensor, film=replace(sensor.film, young=2.0 * sensor.film.young, pretension=2.0 * sensor.film.pretension)
    )
    single = charges(family, sensor, probe, 2e-3, 1e-3, 0.9)
    np.testing.assert_allclose(charges(family, twice, probe, 2e-3, 1e-3, 1.8), 2.0 * single, rtol=1e-12)


def test_arrays_give_the_family_back(family):
    again = FilmFamily.from_arrays(family.to_arrays())
    sensor, probe = PRIOR.film(PRIOR.mean)
    for x in (0.0, 1e-3, 2.5e-3):
        expected = charges(family, sensor, probe, x, -1e-3, 1.0)
        np.testing.assert_allclose(charges(again, sensor, probe, x, -1e-3, 1.0), expected, rtol=1e-4)
    assert (again.limits, again.resolution, again.layer) == (family.limits, family.resolution, family.layer)


@pytest.mark.parametrize("name", ["coefficients", "grid", "modes", "limits", "surface", "resolution"])
def test_missing_or_cut_arrays_are_refused(family, name):
    arrays = family.to_arrays()
    with pytest.raises(InputError, match="film family"):
        FilmFamily.from_arrays({key: value for key, value in arrays.items() if key != name})
    if name != "surface":
        with pytest.raises(InputError, match="film family"):
            FilmFamily.from_arrays(arrays | {name: arrays[name][:1]})


@pytest.mark.parametrize(
    ("change", "words"),
    [({"pretension": 5e6}, "tension"), ({"thickness": 50e-6}, "thickness"), ({"poisson": 0.3}, "Poisson")],
)
def test_a_film_outside_is_refused(family, change, words):
    sensor = replace(PRIOR.sensor, film=replace(PRIOR.sensor.film, **change))
    with pytest.raises(SceneError, match=words):
        family.forward_map(sensor, PRIOR.probe)


def test_a_probe_outside_is_refused(family):
    with pytest.raises(SceneError, match="reach"):
        family.forward_map(PRIOR.sensor, Circle(2e-3))
