"""A released network for all films, whose family of solves the small trainings share, and one with random weights."""

from pathlib import Path

import numpy as np
import pytest
import torch

from isocharge.simulate import FilmPrior, noise_model
from isocharge.train import FilmsConfig, FilmsModel, read_films
from isocharge.train.data.domain import ContactDomain
from isocharge.train.films.conditional_network import ConditionalPerceptron
from isocharge.train.films.film_presses import draw_film_presses
from isocharge.train.films.film_scaling import FilmScaling
from isocharge.train.films.fit import FilmsFit
from isocharge.train.films.inputs import FilmInputs

MODELS = Path(__file__).parents[3] / "models"

TINY = FilmsConfig(
    hidden=(24, 24), misfit_hidden=(16, 16), films=48, presses=32, watched=8, steps=300, misfit_films=3,
    misfit_charges=24, near_films=4, misfit_steps=40, batch_films=16, batch_presses=32,
)  # fmt: skip


@pytest.fixture(scope="session")
def films() -> FilmsModel:
    return read_films(MODELS / "four-25um-biaxial-films" / "1")


@pytest.fixture(scope="session")
def random_films(films):
    """For any sensor: weights that nobody trained, all of them in use; and their torch twins."""

    def of(sensor):
        prior = FilmPrior(sensor, films.prior.probe)
        domain = ContactDomain(8.0, (0.05, 2.0))
        presses = draw_film_presses(prior, films.family, domain, 8, 16, seed=3)
        inputs = FilmInputs.fit(FilmScaling(prior, domain), presses)
        torch.manual_seed(5)
        n_electrode, n_context = inputs.mean.size, inputs.scaling.standard[0].size
        parts = [ConditionalPerceptron(n_electrode, (12, 10), outputs, n_context) for outputs in (6, n_electrode)]
        for part in parts:
            for parameter in part.parameters():
                torch.nn.init.normal_(parameter, std=0.2)
        fit = FilmsFit(inputs, films.family, *(part.to_arrays() for part in parts), TINY)
        return FilmsModel.of(fit, noise_model("reference")), inputs, parts

    return of


@pytest.fixture(scope="session")
def drawn(films):
    """Parameters of films, shape (6, n_parameter)."""
    return films.prior.draw(np.random.default_rng(17), 6)


@pytest.fixture(scope="session")
def tiny() -> FilmsConfig:
    return TINY
