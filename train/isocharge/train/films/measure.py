"""Errors of the network for all films: told each film, and without being told."""

from collections.abc import Mapping

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.data.noise import with_noise
from isocharge.train.data.presses import LabelledPresses, position_error
from isocharge.train.films.film_presses import draw_contacts, film_charge
from isocharge.train.films.films_model import FilmsModel

FILMS, PRESSES = 64, 256
"""Fresh films that errors are measured on, and presses of each."""

SEED = 90_001
"""Of the fresh films: no training draws with it."""

FreshFilms = list[tuple[Array, LabelledPresses, Array]]
"""Parameters, presses, and noisy charges of each film."""


def fresh_films(films: FilmsModel, count: int = FILMS, presses: int = PRESSES, seed: int = SEED) -> FreshFilms:
    """Films drawn from the prior, with presses that no training saw."""
    rng = np.random.default_rng(seed)
    drawn = []
    for parameters in films.prior.draw(rng, count):
        contact = draw_contacts(rng, films.domain, presses)
        charge = film_charge(films.prior, films.family, parameters, contact)
        drawn.append((parameters, LabelledPresses(contact, charge), with_noise(charge, films.noise, rng)))
    return drawn


def films_errors(films: FilmsModel, fresh: FreshFilms, assumed: Array | None = None) -> Mapping[str, float]:
    """Errors over fresh films.

    Args:
        films: The network.
        fresh: Films and presses.
        assumed: Parameters that the network is told for every film, shape (n_parameter,); each its true ones if absent.

    Returns:
        Position errors in mm and relative force errors in percent over all presses, the rms of the median film and of
        the worst, and the coverage of the 68 and 95 % intervals (share of coordinates, 0 to 1).
    """
    answers = [films.fold(parameters if assumed is None else assumed).predict(noisy) for parameters, _, noisy in fresh]
    truth = np.stack([presses.contact for _, presses, _ in fresh])
    contact, std = np.stack([answer[0] for answer in answers]), np.stack([answer[1] for answer in answers])
    flat = (contact.reshape(-1, 3), truth.reshape(-1, 3))
    position = position_error(*flat).reshape(truth.shape[:2])
    force = contact[..., 2] / truth[..., 2] - 1.0
    by_film = np.sqrt((position**2).mean(axis=1))
    deviation = np.abs(contact - truth) / std
    errors = {
        "position_median_mm": np.median(position),
        "position_rms_mm": rms(position),
        "position_p95_mm": np.percentile(position, 95),
        "position_rms_median_film_mm": np.median(by_film),
        "position_rms_worst_film_mm": by_film.max(),
        "force_median_percent": 100.0 * np.median(np.abs(force)),
        "force_rms_percent": 100.0 * rms(force),
        "coverage_68": np.mean(deviation < 1.0),
        "coverage_95": np.mean(deviation < 1.96),
    }
    return {name: float(f"{value:.4g}") for name, value in errors.items()}
