"""Presses on many films, with the charges that d31 and d32 give kept apart.

Gains and piezoelectric coefficients act on the charges exactly, so that training draws them anew in every step: the
presses are stored for the described coefficients, one part of the charge for each.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError
from isocharge.common.progress import Progress
from isocharge.simulate.execution.checkpointed_map import JobMap
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.forward.solve_family import report_each
from isocharge.simulate.sensor.film import Piezo
from isocharge.simulate.sensor.film_prior import SHARED, FilmPrior
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.noise import PC

CHUNK = 16
"""Films that one job computes."""

MOST_NEGATIVE = 0.2
"""Share of the presses that may give some electrode no positive charge: light ones on taut uniaxial films do. What is
below 1 pC counts as 1 pC, and the other electrodes have to say it."""

D31, D32 = SHARED.index("d31"), SHARED.index("d32")
"""Places of the coefficients among the parameters."""


@dataclass(frozen=True)
class FilmPresses:
    """Presses on films.

    Attributes:
        parameters: Of the films, shape (n_film, n_parameter).
        contact: (x_mm, y_mm, force_N), shape (n_film, n_press, 3), float32.
        response_pC: Charges with the described gains, by d31, d32 and d33 alone as described, shape
            (n_film, n_press, n_electrode, 3), float32.
    """

    parameters: Array
    contact: np.ndarray
    response_pC: np.ndarray

    def __len__(self) -> int:
        return len(self.parameters)

    def charge_pC(self) -> Array:
        """Clean charges of the films as they are, shape (n_film, n_press, n_electrode), pC."""
        return total_charge(self.response_pC.astype(float), self.parameters)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return dict(vars(self))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> "FilmPresses":
        """The inverse of `to_arrays`."""
        return cls(arrays["parameters"], arrays["contact"], arrays["response_pC"])


def part_factors(parameters: Array) -> Array:
    """What multiplies each part of the response: (n_film, n_parameter) to (n_film, 3)."""
    return np.stack([np.exp(parameters[:, D31]), np.exp(parameters[:, D32]), np.ones(len(parameters))], axis=1)


def gains_of(parameters: Array) -> Array:
    """Factors of the electrodes: (n_film, n_parameter) to (n_film, n_electrode)."""
    gains: Array = np.exp(parameters[:, len(SHARED) :])
    return gains


def total_charge(response_pC: Array, parameters: Array) -> Array:
    """Charges (n_film, n_press, n_electrode) of responses (n_film, n_press, n_electrode, 3)."""
    charge: Array = np.einsum("fpec,fc,fe->fpe", response_pC, part_factors(parameters), gains_of(parameters))
    return charge


def draw_film_presses(
    prior: FilmPrior,
    family: FilmFamily,
    domain: ContactDomain,
    films: int,
    presses: int,
    seed: int,
    *,
    map_jobs: JobMap = map,
    progress: Progress | None = None,
) -> FilmPresses:
    """Draw films from the prior, and presses on each: uniform over the disk, forces log-uniform.

    Raises:
        DatasetError: If too many charges are not positive.
    """
    parameters = prior.draw(np.random.default_rng([seed, 0]), films)
    jobs = [(start, parameters[start : start + CHUNK]) for start in range(0, films, CHUNK)]
    work = partial(_some_films, prior, family, domain, presses, seed)
    parts = list(report_each(map_jobs(work, jobs), len(jobs), progress))
    drawn = FilmPresses(parameters, *(np.concatenate([part[k] for part in parts]) for k in range(2)))
    _check_positive(drawn)
    return drawn


def draw_contacts(rng: np.random.Generator, domain: ContactDomain, count: int) -> Array:
    """Contacts (x_mm, y_mm, force_N), shape (count, 3): uniform over the disk, forces log-uniform."""
    radius, angle = domain.radius_mm * np.sqrt(rng.random(count)), 2.0 * np.pi * rng.random(count)
    low, high = np.log(domain.force_range_N)
    force = np.exp(rng.uniform(low, high, count))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), force], axis=1)


def film_charge(prior: FilmPrior, family: FilmFamily, parameters: Array, contact: Array) -> Array:
    """Clean charges of one film, pC: contacts (n, 3) to (n, n_electrode)."""
    charge: Array = PC * family.forward_map(*prior.film(parameters)).forward(*(contact * [1e-3, 1e-3, 1.0]).T)
    return charge


def _some_films(
    prior: FilmPrior,
    family: FilmFamily,
    domain: ContactDomain,
    presses: int,
    seed: int,
    job: tuple[int, Array],
) -> tuple[np.ndarray, np.ndarray]:
    start, parameters = job
    rng = np.random.default_rng([seed, 1, start])
    contacts = np.stack([draw_contacts(rng, domain, presses) for _ in parameters])
    response = np.stack([_response(prior, family, *film) for film in zip(parameters, contacts, strict=True)])
    return contacts.astype(np.float32), response.astype(np.float32)


def _response(prior: FilmPrior, family: FilmFamily, parameters: Array, contact: Array) -> Array:
    """Charges by part for the described coefficients and gains, shape (n_press, n_electrode, 3), pC."""
    plain = parameters.copy()
    plain[[D31, D32]] = plain[len(SHARED) :] = 0.0
    forward_map, piezo = family.forward_map(*prior.film(plain)), prior.sensor.piezo
    at = (contact * [1e-3, 1e-3, 1.0]).T
    none = np.zeros((len(contact), len(prior.sensor.electrodes)))

    def charge(d31: float, d32: float, d33: float = 0.0) -> Array:
        """Charges in C, zero without coefficients."""
        if d31 == d32 == 0.0:
            return none
        sensor = replace(forward_map.sensor, piezo=Piezo(d31, d32, d33))
        return replace(forward_map, sensor=sensor).forward(*at)

    parts = [charge(piezo.d31, 0.0), charge(0.0, piezo.d32), none]
    if piezo.d33 != 0.0:
        parts[2] = charge(piezo.d31, piezo.d32, piezo.d33) - parts[0] - parts[1]
    response: Array = PC * np.stack(parts, axis=-1)
    return response


def _check_positive(drawn: FilmPresses) -> None:
    useless = (drawn.charge_pC() <= 0.0).any(axis=-1)
    if useless.mean() > MOST_NEGATIVE:
        film, row = (int(index) for index in np.argwhere(useless)[0])
        raise DatasetError(
            f"{useless.mean():.0%} of the presses give an electrode no positive charge, expected at most "
            f"{MOST_NEGATIVE:.0%} (the features are logarithms); the first: film {film}, "
            f"{drawn.contact[film, row].tolist()} (mm, mm, N), {drawn.charge_pC()[film, row].tolist()} pC; check d31 "
            "and d32, or ask for a smaller radius"
        )
