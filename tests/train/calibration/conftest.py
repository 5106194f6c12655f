"""Fixtures for the tests of the calibration: a synthetic film in place of a solved film, and a rig that presses it."""

import numpy as np
import pytest
from tests.benchmarks.measured_films import measured_presses, with_rig_errors
from tests.train.calibration.synthetic_film import SyntheticFilm

from isocharge.train.calibration import calibrate as calibrate_module
from isocharge.train.calibration import estimator
from isocharge.train.calibration.film_estimate import FilmEstimate
from isocharge.train.data.presses import draw_contacts


@pytest.fixture(scope="session")
def synthetic(problem):
    """Charges of similar films by a closed formula."""
    return SyntheticFilm(problem.prior.layout.prior, problem.solved_domain)


@pytest.fixture
def never_solved(monkeypatch):
    """The synthetic film is exact for all properties, and is never solved again."""
    monkeypatch.setattr(calibrate_module, "SAME_FILM_STD", np.inf)


FEW_VALUES = {
    "IMPERFECTION_SCALES": (((0.1, 0.1), 0.5), ((1.5, 1.5), 0.5)),
    "DISCREPANCY_SIZES": ((0.001, 0.5), (0.01, 0.5)),
    "FORCE_SCATTERS": (((0.0, 0.0), 0.9), ((0.03, 0.0), 0.1)),
    "POSITION_RATIOS": ((1.0, 0.9), (3.0, 0.1)),
    "NOISE_RATIOS": ((1.0, 0.5), (8.0, 0.5)),
}
"""Values and probabilities of the hypotheses of `use_few_hypotheses`, by their names in the estimator."""


def use_few_hypotheses(patch):
    """To save time, let the estimator compare 256 hypotheses instead of 6,480."""
    for name, values_and_probabilities in FEW_VALUES.items():
        patch.setattr(estimator, name, values_and_probabilities)


@pytest.fixture
def few_hypotheses(monkeypatch):
    use_few_hypotheses(monkeypatch)


def rig(problem, charges, count, seed, values=None):
    """Press a film with the errors of a rig.

    Returns:
        Properties of the film, shape (n_property,); true contacts, shape (count, 3); and the measured presses.
    """
    rng = np.random.default_rng(seed)
    if values is None:
        values = problem.prior.layout.prior.draw(rng, 1)[0]
    contact = draw_contacts(rng, problem.domain, count)
    charge = problem.noise.add(charges.charges(values, contact), rng)
    return values, contact, measured_presses(problem, with_rig_errors(contact, rng), charge)


def rig_presses(*arguments, **options):
    """Return the measured presses of `rig`."""
    _, _, presses = rig(*arguments, **options)
    return presses


def film_values(prior, **changes):
    """Return the mean properties of films, shape (n_property,), with other values of some named properties."""
    values = prior.mean.copy()
    for name, value in changes.items():
        values[prior.index(name)] = value
    return values


def uneven_film(problem):
    """Return the estimate of a film whose tension is uneven, without uncertainty."""
    layout = problem.prior.layout
    values = problem.prior.mean.copy()
    values[layout.film] = film_values(layout.prior, pretension=1.2, tension_difference=-0.25)
    return FilmEstimate(layout, values, np.zeros((len(values), len(values))))
