"""A released network for all films, whose family of solves the small fits share, and one with random weights."""

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

MODELS = Path(__file__).parents[3] / "models"


@pytest.fixture(scope="session")
def films() -> FilmsModel:
    return read_films(MODELS / "four-25um-biaxial-films" / "1")


@pytest.fixture(scope="session")
def random_films(films):
    """For any sensor: weights that nobody trained, all of them in use; with the same networks in torch."""

    def of(sensor):
        prior, domain = FilmPrior(sensor, films.prior.probe), Domain(8.0, (0.05, 2.0))
        inputs = FilmInputs.fit(
            FilmScaling(prior, domain), draw_film_presses(prior, films.family, domain, 8, 16, seed=3)
        )
        torch.manual_seed(5)
        n_electrode, n_context = inputs.mean.size, inputs.scaling.statistics.mean.size
        parts = [ConditionalPerceptron(n_electrode, (12, 10), outputs, n_context) for outputs in (6, n_electrode)]
        for part in parts:
            for parameter in part.parameters():
                torch.nn.init.normal_(parameter, std=0.2)
        weights = [ConditionalWeights(part.to_arrays()) for part in parts]
        noise = noise_model("reference")
        model = FilmsModel(films.family, inputs.scaling, inputs.mean, inputs.whitening, *weights, noise)
        return model, inputs, parts

    return of


@pytest.fixture(scope="session")
def drawn(films):
    """Parameters of films, shape (6, n_parameter)."""
    return films.prior.draw(np.random.default_rng(17), 6)
