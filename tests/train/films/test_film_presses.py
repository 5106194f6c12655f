"""Presses on many films: the parts of the charges add up to what the film itself gives."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import DatasetError
from isocharge.simulate import FilmPrior, Piezo, load_sensor
from isocharge.train.films import film_presses
from isocharge.train.films.film_presses import draw_film_presses, film_charge, total_charge


@pytest.mark.parametrize("d33", [0.0, -20.0])
def test_parts_gains_and_coefficients_give_the_films_charges(films, d33):
    sensor = load_sensor("four-25um-uniaxial")
    sensor = replace(sensor, piezo=Piezo(sensor.piezo.d31, sensor.piezo.d32, d33 * 1e-12))
    prior = FilmPrior(sensor, films.prior.probe)
    drawn = draw_film_presses(prior, films.family, films.domain, 3, 40, seed=1)
    for parameters, contact, charge in zip(drawn.parameters, drawn.contact, drawn.charge_pC(), strict=True):
        direct = film_charge(prior, films.family, parameters, contact.astype(float))
        np.testing.assert_allclose(charge, direct, rtol=2e-5)


def test_films_drawn_anew_are_films(films):
    """Other coefficients and gains on stored presses: the same as that film's own charges."""
    drawn = draw_film_presses(films.prior, films.family, films.domain, 2, 20, seed=2)
    others = drawn.parameters.copy()
    others[:, 3:5] += [0.2, -0.3]
    others[:, 9:] -= 0.07
    charge = total_charge(drawn.response_pC.astype(float), others)
    for k in range(2):
        direct = film_charge(films.prior, films.family, others[k], drawn.contact[k].astype(float))
        np.testing.assert_allclose(charge[k], direct, rtol=2e-5)


def test_the_draw_does_not_depend_on_who_draws(films, monkeypatch):
    monkeypatch.setattr(film_presses, "CHUNK", 2)
    drawn = [
        draw_film_presses(films.prior, films.family, films.domain, 5, 8, seed=2, map_jobs=jobs)
        for jobs in (map, lambda function, jobs: [function(job) for job in list(jobs)])
    ]
    np.testing.assert_array_equal(drawn[0].response_pC, drawn[1].response_pC)
    radius = np.hypot(drawn[0].contact[..., 0], drawn[0].contact[..., 1])
    assert radius.max() <= films.domain.radius_mm * (1 + 1e-6)


def test_charges_that_are_not_positive_are_refused(films):
    prior = FilmPrior(replace(films.prior.sensor, piezo=Piezo(8e-12, -60e-12)), films.prior.probe)
    with pytest.raises(
        DatasetError, match=r"of the presses give an electrode no positive charge, expected at most 20%"
    ):
        draw_film_presses(prior, films.family, films.domain, 2, 30, seed=2)
