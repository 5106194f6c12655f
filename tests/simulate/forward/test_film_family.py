"""Families of films: comparison with direct solves, exact scaling, arrays and released files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from isocharge.common.errors import InputError, SceneError
from isocharge.simulate import Circle, Domain, FilmPrior, ForwardMap, load_sensor, press, touch_charge
from isocharge.simulate.forward import film_family
from isocharge.simulate.forward.film_family import FilmFamily

RELEASED = sorted((Path(__file__).parents[3] / "models").glob("*-films/*/films.npz"))


@pytest.fixture
def prior(film_family) -> FilmPrior:
    return film_family[0]


@pytest.fixture
def family(film_family) -> FilmFamily:
    return film_family[1]


def charges(family, sensor, probe, *contact):
    return family.forward_map(sensor, probe).charges(np.array([contact]))[0]


def test_family_maps_agree_with_direct_solves_between_the_grid_nodes(prior, family):
    rng = np.random.default_rng(7)
    for parameters in prior.draw(rng, 4):
        sensor, probe = prior.film(parameters)
        (x, y), force = rng.uniform(-2.0, 2.0, 2), rng.uniform(0.8, 1.2)
        direct = touch_charge(sensor, press(sensor.film, probe, (x, y), force))
        np.testing.assert_allclose(charges(family, sensor, probe, x, y, force), direct, rtol=1.5e-3)


def test_family_check_covers_all_forces_and_distances(prior, family, monkeypatch):
    checked = []
    monkeypatch.setattr(film_family, "direct_charges", lambda *_: np.zeros(3))
    monkeypatch.setattr(ForwardMap, "relative_error", lambda _, check, __: checked.append(check) or 1e-4 * len(checked))
    assert film_family._check_against_solves(family, prior, Domain(3.0, (0.2, 1.2))) == 1e-4 * film_family.CHECK_COUNT
    distance, _, force, _ = np.array(checked).T
    assert (0.2 <= force.min() < 0.3, 0.8 < force.max() <= 1.2) == (True, True)
    assert (distance.min() < 1.0, distance.max()) == (True, 3.0)


def test_modulus_and_loads_scale_exactly(prior, family):
    """Twice the modulus, pretension and force give the same deflection with twice the stress."""
    sensor, probe = prior.film(prior.mean)
    film = sensor.film
    twice = replace(sensor, film=replace(film, young=2.0 * film.young, pretension=2.0 * film.pretension))
    single = charges(family, sensor, probe, 2.0, 1.0, 0.9)
    np.testing.assert_allclose(charges(family, twice, probe, 2.0, 1.0, 1.8), 2.0 * single, rtol=1e-12)


def test_family_arrays_round_trip(prior, family):
    again = FilmFamily.from_arrays(family.to_arrays())
    film = prior.film(prior.mean)
    for x in (0.0, 2.5):
        expected = charges(family, *film, x, -1.0, 1.0)
        np.testing.assert_allclose(charges(again, *film, x, -1.0, 1.0), expected, rtol=1e-4)
    assert (again.limits, again.resolution, again.layer) == (family.limits, family.resolution, family.layer)


@pytest.mark.parametrize("path", RELEASED, ids=lambda path: path.parts[-3])
def test_released_families_agree_with_direct_solves(path):
    """Files of earlier versions; dimensionless, so that no unit can change them."""
    with np.load(path) as file:
        arrays = {name.removeprefix("family."): file[name] for name in file.files if name.startswith("family.")}
    sensor = load_sensor(path.parts[-3].removesuffix("-films"))
    sensor = replace(sensor, film=replace(sensor.film, pretension=0.5))
    family = FilmFamily.from_arrays(arrays)
    direct = touch_charge(sensor, press(sensor.film, Circle(1.0), (3.0, -2.0), 0.5))
    np.testing.assert_allclose(charges(family, sensor, Circle(1.0), 3.0, -2.0, 0.5), direct, rtol=2e-3)
    again = FilmFamily.from_arrays(family.to_arrays())
    np.testing.assert_array_equal(again.to_arrays()["coefficients"], arrays["coefficients"])


@pytest.mark.parametrize("name", ["coefficients", "grid", "modes", "limits", "surface", "resolution"])
def test_missing_or_truncated_arrays_raise_input_error(family, name):
    arrays = family.to_arrays()
    with pytest.raises(InputError, match="film family"):
        FilmFamily.from_arrays({key: value for key, value in arrays.items() if key != name})
    if name != "surface":
        with pytest.raises(InputError, match="film family"):
            FilmFamily.from_arrays(arrays | {name: arrays[name][:1]})


@pytest.mark.parametrize(
    ("change", "name"),
    [({"pretension": 5.0}, "tension"), ({"thickness": 0.05}, "thickness"), ({"poisson": 0.3}, "Poisson")],
)
def test_film_or_probe_outside_the_family_raises_scene_error(prior, family, change, name):
    sensor = replace(prior.sensor, film=replace(prior.sensor.film, **change))
    with pytest.raises(SceneError, match=name):
        family.forward_map(sensor, prior.probe)
    with pytest.raises(SceneError, match="reach"):
        family.forward_map(prior.sensor, Circle(2.0))
