"""Training data of the networks for all films: charges of each film, nearest contacts, and projections."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from isocharge.common.errors import DatasetError
from isocharge.simulate import FilmPrior, NoiseModel, Piezo, load_sensor
from isocharge.simulate.identifiability.nearest_contact import search
from isocharge.train import FilmsConfig
from isocharge.train.films import films_data
from isocharge.train.films.films_data import (
    DrawnFilms,
    FilmsSource,
    _draw_charges_of_every_kind,
    draw_film_presses,
    draw_misfit_films,
    draw_near_films,
)
from isocharge.train.films.fit import misfit_stage
from isocharge.train.training.network import compress_length


def charges(prior, family, parameters, contact):
    """Compute the charges of one film with its own forward map."""
    return family.forward_map(*prior.film(parameters)).charges(contact.astype(float))


@pytest.mark.parametrize("d33", [0.0, -20.0])
def test_parts_gains_and_coefficients_give_the_films_charges(films, d33):
    sensor = load_sensor("four-25um-uniaxial")
    prior = FilmPrior(replace(sensor, piezo=replace(sensor.piezo, d33=d33)), films.prior.probe)
    drawn = draw_film_presses(prior, films.family, films.domain, 3, 40, seed=1)
    for parameters, contact, charge in zip(drawn.parameters, drawn.contact, drawn.charge(), strict=True):
        np.testing.assert_allclose(charge, charges(prior, films.family, parameters, contact), rtol=2e-5)
    assert np.hypot(drawn.contact[..., 0], drawn.contact[..., 1]).max() <= films.domain.radius * (1 + 1e-6)


def test_the_draw_does_not_depend_on_who_draws(films, monkeypatch):
    monkeypatch.setattr(films_data, "CHUNK", 2)
    with ThreadPoolExecutor(2) as pool:
        here, there = (
            draw_film_presses(films.prior, films.family, films.domain, 5, 8, 2, executor) for executor in (None, pool)
        )
    np.testing.assert_array_equal(here.charge_parts, there.charge_parts)


@pytest.fixture
def source(films):
    return FilmsSource(films.prior, films.family, films.domain, films.noise)


def test_misfit_examples_are_those_of_their_film(source, monkeypatch):
    """The charge without sigma times the residual is the charge of a contact, so its own residual is zero."""
    monkeypatch.setattr(films_data, "N_CANDIDATES", 64)
    drawn = draw_misfit_films(source, 2, 12, seed=1)
    for parameters, charge, residual in zip(drawn.parameters, drawn.charge, drawn.target, strict=True):
        charge_map = source.charge_map(parameters)
        is_near = np.linalg.norm(residual, axis=1) < 5.0
        assert is_near.any()
        nearest_charge = charge[is_near] - source.noise.sigma(charge[is_near]) * residual[is_near]
        contact, new_residual = search(charge_map, nearest_charge, source.noise.sigma(nearest_charge), candidates=64)
        assert np.linalg.norm(new_residual, axis=1).max() < 0.05
        assert (np.hypot(contact[:, 0], contact[:, 1]) <= source.domain.radius * (1 + 1e-9)).all()


def test_a_search_with_fewer_charges_for_each_derivative_finds_the_same_misfits(source, monkeypatch):
    """The search with central differences is the reference."""
    job = (0, source.prior.draw(np.random.default_rng(8), 1)[0])
    charge, residual = _draw_charges_of_every_kind(source, 60, 0, job)
    monkeypatch.setattr(FilmsSource, "search_map", FilmsSource.charge_map)
    reference_charge, reference_residual = _draw_charges_of_every_kind(source, 60, 0, job)
    np.testing.assert_array_equal(charge, reference_charge)
    misfit = np.linalg.norm(residual, axis=1)
    reference_misfit = np.linalg.norm(reference_residual, axis=1)
    assert reference_misfit.max() > 10.0
    np.testing.assert_allclose(misfit, reference_misfit, rtol=2e-3, atol=2e-3)


def test_the_projection_is_perpendicular_to_the_derivatives_of_the_charges(source):
    drawn = draw_near_films(source, 2, 5, seed=1)
    for parameters, charge, projection in zip(drawn.parameters, drawn.charge, drawn.target, strict=True):
        charge_map = source.charge_map(parameters)
        contact, residual = search(charge_map, charge, source.noise.sigma(charge), candidates=256)
        assert np.linalg.norm(residual, axis=1).max() < 0.05
        slopes = charge_map.derivatives(contact) / source.noise.sigma(charge)[:, :, None]
        slopes /= np.linalg.norm(slopes, axis=1, keepdims=True)
        np.testing.assert_allclose(projection @ slopes, 0.0, atol=0.02)
        np.testing.assert_allclose(projection @ projection, projection, atol=1e-9)
        np.testing.assert_allclose(np.trace(projection, axis1=1, axis2=2), 1.0)  # four charges, three unknowns


def test_good_presses_have_up_to_eight_times_the_noise_and_ten_times_the_weight():
    """The charges are 400 pC with a noise of 5 pC, the projection is the identity, and each answer is wrong by 1.

    The factors of the noise are 1 + 7 u^3 with u uniform, so their mean square is 1 + 14 / 4 + 49 / 7.
    """
    clean = np.full((50, 8, 4), 400.0)
    deviations = []
    examples = DrawnFilms(np.zeros((50, 1)), clean, 0.0 * clean)
    good = replace(examples, target=np.broadcast_to(np.eye(4), (50, 8, 4, 4)))
    inputs = SimpleNamespace(values=lambda charge, _: (charge - 400.0) / 5.0, context=torch.tensor)

    def wrong_by_one(deviation, _):
        deviations.append(deviation)
        return compress_length(deviation) + 1.0

    config = FilmsConfig(batch_films=2048)
    stage = misfit_stage(wrong_by_one, inputs, examples, good, NoiseModel("mine", 3.0, 0.01), config)
    loss = stage.loss(0, torch.Generator().manual_seed(0)).item()
    validation_score, _ = stage.score()
    assert loss == pytest.approx(10.0 * 4.0 + 4.0, rel=1e-5)
    assert validation_score == pytest.approx(10.0 * 4.0 + 4.0, rel=1e-5)
    assert [len(films) for films in deviations] == [1024, 1024, 3, 50]  # 6 % of the examples are for validation
    _, good_deviation, *_ = deviations
    assert torch.mean(good_deviation**2).item() == pytest.approx(11.5, rel=0.08)


def test_charges_that_are_not_positive_are_refused(films):
    prior = FilmPrior(replace(films.prior.sensor, piezo=Piezo(8.0, -60.0)), films.prior.probe)
    with pytest.raises(
        DatasetError, match=r"of the presses have an electrode whose charge is zero or negative, expected at most 20%"
    ):
        draw_film_presses(prior, films.family, films.domain, 2, 30, seed=2)
