"""What the networks for all films learn from.

The contact network: presses on many films, with the charges that d31 and d32 give kept apart. Gains and piezoelectric
coefficients act on the charges exactly, so that training draws them anew in every step: the presses are stored for the
described coefficients, one part of the charge for each.

The misfit network: charges of all kinds with their nearest contacts, and good presses.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from isocharge.common.arrays import Array, Singles
from isocharge.common.errors import DatasetError
from isocharge.common.progress import track
from isocharge.simulate import NoiseModel, Piezo
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.charge_map import Domain, FunctionMap, linearised
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.sensor.film_prior import SHARED, FilmPrior
from isocharge.train.data.misfit_charges import draw_misfit_examples
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE, LabelledPresses, draw_contacts

CHUNK = 16
"""Films that one job computes."""

MOST_NEGATIVE = 0.2
"""Share of the presses that may give some electrode no positive charge: light ones on taut uniaxial films do. What is
below 1 pC counts as 1 pC, and the other electrodes have to say it."""

CANDIDATES = 512
"""Contacts among which the search for the nearest starts; fewer than for one film alone, where a candidate costs less.
"""

D31, D32 = SHARED.index("d31"), SHARED.index("d32")
"""Places of the coefficients among the parameters."""


@dataclass(frozen=True)
class FilmPresses:
    """Presses on films.

    Attributes:
        parameters: Of the films, shape (n_film, n_parameter).
        contact: (x, y, F), shape (n_film, n_press, 3), mm and N, float32.
        response: Charges with the described gains, by d31, d32 and d33 alone as described, shape (n_film, n_press,
            n_electrode, 3), pC, float32.
    """

    parameters: Array
    contact: Singles
    response: Singles

    def __len__(self) -> int:
        return len(self.parameters)

    def charge(self) -> Array:
        """Clean charges of the films as they are, shape (n_film, n_press, n_electrode), pC."""
        d31, d32, gains = (np.exp(self.parameters[:, which]) for which in (D31, D32, slice(len(SHARED), None)))
        parts = np.stack([d31, d32, np.ones(len(self))], axis=1)
        return np.asarray(np.einsum("fpec,fc,fe->fpe", self.response.astype(float), parts, gains))


def draw_film_presses(
    prior: FilmPrior,
    family: FilmFamily,
    domain: Domain,
    films: int,
    presses: int,
    seed: int,
    executor: Executor | None = None,
) -> FilmPresses:
    """Draw films from the prior, and presses on each: uniform over the disk, forces log-uniform.

    Raises:
        DatasetError: If too many charges are not positive.
    """
    parameters = prior.draw(np.random.default_rng([seed, 0]), films)
    jobs = [(start, parameters[start : start + CHUNK]) for start in range(0, films, CHUNK)]
    work = partial(_some_films, prior, family, domain, presses, seed)
    drawn = np.concatenate(list(track(in_order(executor, work, jobs), "pressing films", len(jobs))))
    of_films = FilmPresses(parameters, drawn[:, :, 0], drawn[:, :, 1:])
    _check_positive(of_films)
    return of_films


def _some_films(
    prior: FilmPrior, family: FilmFamily, domain: Domain, presses: int, seed: int, job: tuple[int, Array]
) -> Singles:
    """Contacts and responses side by side, shape (n_film, presses, 1 + n_electrode, 3)."""
    start, parameters = job
    rng = np.random.default_rng([seed, 1, start])
    contacts = np.stack([draw_contacts(rng, domain, presses) for _ in parameters])
    response = np.stack([_response(prior, family, *film) for film in zip(parameters, contacts, strict=True)])
    return np.concatenate([contacts[:, :, None], response], axis=2).astype(np.float32)


def _response(prior: FilmPrior, family: FilmFamily, parameters: Array, contact: Array) -> Array:
    """Charges by part for the described coefficients and gains, shape (n_press, n_electrode, 3), pC."""
    plain = parameters.copy()
    plain[[D31, D32]] = plain[len(SHARED) :] = 0.0
    forward_map, piezo = family.forward_map(*prior.film(plain)), prior.sensor.piezo
    none = np.zeros((len(contact), len(prior.sensor.electrodes)))

    def charges(d31: float, d32: float, d33: float = 0.0) -> Array:
        """Zero without coefficients."""
        if d31 == d32 == 0.0:
            return none
        sensor = replace(forward_map.sensor, piezo=Piezo(d31, d32, d33))
        return replace(forward_map, sensor=sensor).charges(contact)

    parts = [charges(piezo.d31, 0.0), charges(0.0, piezo.d32), none]
    if piezo.d33 != 0.0:
        parts[2] = charges(piezo.d31, piezo.d32, piezo.d33) - parts[0] - parts[1]
    return np.stack(parts, axis=-1)


def _check_positive(drawn: FilmPresses) -> None:
    charge = drawn.charge()
    useless = (charge <= 0.0).any(axis=-1)
    if useless.mean() > MOST_NEGATIVE:
        film, row = (int(index) for index in np.argwhere(useless)[0])
        raise DatasetError(
            f"{useless.mean():.0%} of the presses give an electrode no positive charge, expected at most "
            f"{MOST_NEGATIVE:.0%} (the features are logarithms); the first: film {film}, "
            f"{drawn.contact[film, row].tolist()} (mm, mm, N), {charge[film, row].tolist()} pC; check d31 "
            "and d32, or ask for a smaller radius"
        )


@dataclass(frozen=True)
class FilmsSource:
    """Where examples come from.

    Attributes:
        prior: The films.
        family: Their forward maps.
        domain: The contacts.
        noise: Noise of good presses.
    """

    prior: FilmPrior
    family: FilmFamily
    domain: Domain
    noise: NoiseModel

    def charge_map(self, parameters: Array) -> FunctionMap:
        """The charges of one film as the model sees them, clipped."""
        forward_map = self.family.forward_map(*self.prior.film(parameters))

        def charges(contact: Array) -> Array:
            return np.clip(forward_map.charges(contact), LOWEST_CHARGE, HIGHEST_CHARGE)

        return FunctionMap(charges, forward_map.electrodes, self.domain)


@dataclass(frozen=True)
class DrawnFilms:
    """Charges on films.

    Attributes:
        parameters: Of the films, shape (n_film, n_parameter).
        charge: Shape (n_film, n, n_electrode), pC.
        aim: What the misfit network learns about them; shape (n_film, n, n_electrode, ...).
    """

    parameters: Array
    charge: Array
    aim: Array


def draw_misfit_films(
    source: FilmsSource, films: int, charges: int, seed: int, executor: Executor | None = None
) -> DrawnFilms:
    """Draw films, and charges of every kind on each; `aim` is (Q - Q(c)) / sigma at the nearest contact c."""
    parameters = source.prior.draw(np.random.default_rng([seed, 2]), films)
    jobs = in_order(executor, partial(_of_every_kind, source, charges, seed), enumerate(parameters))
    return DrawnFilms(parameters, *np.stack(list(track(jobs, "searching nearest contacts", films)), axis=1))


def _of_every_kind(source: FilmsSource, charges: int, seed: int, job: tuple[int, Array]) -> Array:
    """Charges and residuals, shape (2, charges, n_electrode)."""
    number, parameters = job
    charge_map = source.charge_map(parameters)
    contact = draw_contacts(np.random.default_rng([seed, 3, number]), source.domain, charges)
    presses = LabelledPresses(contact, charge_map.charges(contact))
    return draw_misfit_examples(presses, charge_map, source.noise, charges, seed + number, candidates=CANDIDATES)


def draw_near_films(
    source: FilmsSource, films: int, presses: int, seed: int, executor: Executor | None = None
) -> DrawnFilms:
    """Draw films, and clean presses on each, about which the nearest contact follows without a search.

    `aim` is a matrix, shape (n_film, n, n_electrode, n_electrode): of a deviation in units of the noise it leaves the
    part that no contact explains, to first order. Noise of many seeds is free then.
    """
    parameters = source.prior.draw(np.random.default_rng([seed, 4]), films)
    jobs = in_order(executor, partial(_good_presses, source, presses, seed), enumerate(parameters))
    drawn = np.stack(list(track(jobs, "drawing good presses", films)))
    return DrawnFilms(parameters, drawn[..., 0], drawn[..., 1:])


def _good_presses(source: FilmsSource, presses: int, seed: int, job: tuple[int, Array]) -> Array:
    """Charges and matrices side by side, shape (presses, n_electrode, 1 + n_electrode)."""
    number, parameters = job
    contact = draw_contacts(np.random.default_rng([seed, 5, number]), source.domain, presses)
    charge, slopes = linearised(source.charge_map(parameters), contact)
    basis = np.linalg.qr(slopes / source.noise.sigma(charge)[:, :, None])[0]
    across = np.eye(charge.shape[1]) - basis @ basis.transpose(0, 2, 1)
    return np.concatenate([charge[:, :, None], across], axis=2)
