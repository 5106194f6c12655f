"""Presses on many films: the parts of the charges add up to what the film itself gives."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import DatasetError
from isocharge.simulate import FilmPrior, Piezo, load_sensor
from isocharge.train.films import film_presses
from isocharge.train.films.film_presses import draw_film_presses


def charges(prior, family, parameters, contact):
    """Of one film, by its own forward map."""
    return family.forward_map(*prior.film(parameters)).charges(contact.astype(float))


@pytest.mark.parametrize("d33", [0.0, -20.0])
def test_parts_gains_and_coefficients_give_the_films_charges(films, d33):
    sensor = load_sensor("four-25um-uniaxial")
    prior = FilmPrior(replace(sensor, piezo=replace(sensor.piezo, d33=d33)), films.prior.probe)
    drawn = draw_film_presses(prior, films.family, films.domain, 3, 40, seed=1)
    for parameters, contact, charge in zip(drawn.parameters, drawn.contact, drawn.charge(), strict=True):
        np.testing.assert_allclose(charge, charges(prior, films.family, parameters, contact), rtol=2e-5)
    assert np.hypot(drawn.contact[..., 0], drawn.contact[..., 1]).max() <= films.domain.radius * (1 + 1e-6)


def test_films_drawn_anew_are_films(films):
    """Other coefficients and gains on stored presses: the same as that film's own charges."""
    drawn = draw_film_presses(films.prior, films.family, films.domain, 2, 20, seed=2)
    others = drawn.parameters.copy()
    others[:, 3:5] += [0.2, -0.3]
    others[:, 9:] -= 0.07
    for parameters, contact, charge in zip(
        others, drawn.contact, replace(drawn, parameters=others).charge(), strict=True
    ):
        np.testing.assert_allclose(charge, charges(films.prior, films.family, parameters, contact), rtol=2e-5)


def test_the_draw_does_not_depend_on_who_draws(films, monkeypatch):
    monkeypatch.setattr(film_presses, "CHUNK", 2)
    with ThreadPoolExecutor(2) as pool:
        here, there = (
            draw_film_presses(films.prior, films.family, films.domain, 5, 8, 2, executor) for executor in (None, pool)
        )
    np.testing.assert_array_equal(here.response, there.response)


def test_charges_that_are_not_positive_are_refused(films):
    prior = FilmPrior(replace(films.prior.sensor, piezo=Piezo(8.0, -60.0)), films.prior.probe)
    with pytest.raises(
        DatasetError, match=r"of the presses give an electrode no positive charge, expected at most 20%"
    ):
        draw_film_presses(prior, films.family, films.domain, 2, 30, seed=2)
