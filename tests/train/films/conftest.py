"""A released network for all films, whose forward maps the short trainings share, and one with random weights."""

from pathlib import Path

import numpy as np
import pytest
import torch

from isocharge.simulate import Domain, FilmPrior, noise_model
from isocharge.train import FilmsModel, read_films
from isocharge.train.films.conditional_network import ConditionalPerceptron, FilmInputs
from isocharge.train.films.film_scaling import FilmScaling
from isocharge.train.films.films_data import draw_film_presses
from isocharge.train.films.films_model import ConditionalWeights
from isocharge.train.training.folded_network import N_CONTACT_ANSWERS

MODELS = Path(__file__).parents[3] / "models"


@pytest.fixture(scope="session")
def films() -> FilmsModel:
    return read_films(MODELS / "four-25um-biaxial-films" / "1")


@pytest.fixture(scope="session")
def random_films(films):
    """A function from a sensor to a model with random weights, its inputs, and its networks in PyTorch."""

    def random_films_of(sensor):
        prior = FilmPrior(sensor, films.prior.probe)
        domain = Domain(8.0, (0.05, 2.0))
        presses = draw_film_presses(prior, films.family, domain, 8, 16, seed=3)
        inputs = FilmInputs.fit(FilmScaling(prior, domain), presses)
        torch.manual_seed(5)
        n_electrode = inputs.mean.size
        n_context = inputs.scaling.statistics.mean.size
        contact = ConditionalPerceptron(n_electrode, (12, 10), N_CONTACT_ANSWERS, n_context)
        misfit = ConditionalPerceptron(n_electrode, (12, 10), n_electrode, n_context)
        for parameter in [*contact.parameters(), *misfit.parameters()]:
            torch.nn.init.normal_(parameter, std=0.2)
        model = FilmsModel(
            family=films.family,
            scaling=inputs.scaling,
            mean=inputs.mean,
            whitening=inputs.whitening,
            contact=ConditionalWeights(contact.to_arrays()),
            misfit=ConditionalWeights(misfit.to_arrays()),
            noise=noise_model("reference"),
        )
        return model, inputs, [contact, misfit]

    return random_films_of


@pytest.fixture(scope="session")
def drawn(films):
    """Parameters of films, shape (6, n_parameter)."""
    return films.prior.draw(np.random.default_rng(17), 6)
