"""Training data of the networks for all films.

The contact network is trained on presses on many films. Gains and piezoelectric coefficients are exact factors of the
charges, so training draws them again in every step. The charges are therefore stored for the described coefficients, in
separate parts for d31, d32 and d33.

The misfit network is trained on charges of many kinds with their nearest contacts, and on good presses.
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
from isocharge.train.data.misfit_charges import ExampleOptions, draw_misfit_examples
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE, LabelledPresses, draw_contacts

CHUNK = 16
"""Number of films that one task computes."""

MAX_NEGATIVE_FRACTION = 0.2
"""Largest fraction of presses with a charge that is not positive, as light presses on taut uniaxial films have.

Charges below 1 pC are clipped to 1 pC, and only the other electrodes then carry information.
"""

N_CANDIDATES = 512
"""Number of contacts among which the search for the nearest contact starts.

A candidate costs more here than for a single film, so there are fewer.
"""

D31 = SHARED.index("d31")
"""Index of ln d31 among the parameters."""

D32 = SHARED.index("d32")
"""Index of ln d32 among the parameters."""

GAINS = slice(len(SHARED), None)
"""Indices of the logarithms of the gains among the parameters."""


@dataclass(frozen=True)
class FilmPresses:
    """Presses on films.

    Attributes:
        parameters: Parameters of the films, shape (n_film, n_parameter).
        contact: Contacts (x, y, F), shape (n_film, n_press, 3), mm and N, float32.
        response: Charges for the described gains, in parts for d31, d32 and d33 alone with their described values,
            shape (n_film, n_press, n_electrode, 3), pC, float32.
    """

    parameters: Array
    contact: Singles
    response: Singles

    def __len__(self) -> int:
        return len(self.parameters)

    def charge(self) -> Array:
        """Compute the charges of the films without noise.

        The parts of the charges for d31, d32 and d33 are multiplied by the factors of the film and added. The sums are
        multiplied by the gains of the electrodes:

            charge = gain factor * sum over the parts (part factor * part).

        Returns:
            Charges, shape (n_film, n_press, n_electrode), pC.
        """
        d31_factor = np.exp(self.parameters[:, D31])
        d32_factor = np.exp(self.parameters[:, D32])
        d33_factor = np.ones(len(self))  # d33 is the same for all films
        part_factors = np.stack([d31_factor, d32_factor, d33_factor], axis=1)
        gain_factors = np.exp(self.parameters[:, GAINS])
        # Sum over the parts c, for each film f, press p and electrode e.
        return np.asarray(np.einsum("fpec,fc,fe->fpe", self.response.astype(float), part_factors, gain_factors))


def draw_film_presses(
    prior: FilmPrior,
    family: FilmFamily,
    domain: Domain,
    films: int,
    presses: int,
    seed: int,
    executor: Executor | None = None,
) -> FilmPresses:
    """Draw films from the prior, and draw presses on each film.

    Positions are uniformly distributed over the disk, and forces are log-uniform.

    Args:
        prior: Distribution of the films.
        family: Forward maps of the films.
        domain: Contacts.
        films: Number of films.
        presses: Number of presses on each film.
        seed: Seed of films and presses.
        executor: Executor of the tasks; None for this process.

    Returns:
        Contacts, and the charges of each film in parts; see `FilmPresses`.

    Raises:
        DatasetError: If too many charges are not positive.
    """
    # The number after the seed makes this sequence independent of the sequences of the presses.
    parameters = prior.draw(np.random.default_rng([seed, 0]), films)
    jobs = [(first_film, parameters[first_film : first_film + CHUNK]) for first_film in range(0, films, CHUNK)]
    press_films = partial(_press_films, prior, family, domain, presses, seed)
    chunks = list(track(in_order(executor, press_films, jobs), "pressing films", len(jobs)))

    # The third axis contains the contact and then the response of each electrode.
    contact, response = np.split(np.concatenate(chunks), [1], axis=2)
    drawn = FilmPresses(parameters, contact[:, :, 0], response)
    _check_charges_are_positive(drawn)
    return drawn


def _press_films(
    prior: FilmPrior, family: FilmFamily, domain: Domain, presses: int, seed: int, job: tuple[int, Array]
) -> Singles:
    """Compute presses on some films.

    A job returns a single array to the executor, so the contacts and the responses are joined in one array.

    Args:
        prior: Distribution of the films.
        family: Forward maps of the films.
        domain: Contacts.
        presses: Number of presses on each film.
        seed: Seed of the presses.
        job: Index of the first film among all films, and parameters of the films, shape (n_film, n_parameter).

    Returns:
        Contacts and then responses of the electrodes, shape (n_film, presses, 1 + n_electrode, 3).
    """
    first_film, parameters = job
    # The numbers after the seed make this sequence independent of those of the films and of other jobs.
    rng = np.random.default_rng([seed, 1, first_film])
    contacts = np.stack([draw_contacts(rng, domain, presses) for _ in parameters])
    responses = np.stack(
        [
            _response(prior, family, film_parameters, film_contacts)
            for film_parameters, film_contacts in zip(parameters, contacts, strict=True)
        ]
    )
    return np.concatenate([contacts[:, :, None], responses], axis=2).astype(np.float32)


def _response(prior: FilmPrior, family: FilmFamily, parameters: Array, contact: Array) -> Array:
    """Compute the parts of the charges of one film that are due to d31, to d32 and to d33.

    The piezoelectric coefficients and the gains are those of the sensor file. The coefficients and gains of the film
    are factors of the parts, which `FilmPresses.charge` applies.

    Args:
        prior: Distribution of the films.
        family: Forward maps of the films.
        parameters: Parameters of the film, shape (n_parameter,).
        contact: Contacts, shape (n_press, 3), mm and N.

    Returns:
        Parts for d31, d32 and d33, shape (n_press, n_electrode, 3), pC.
    """
    # The coefficients and the gains are logarithms of factors, so zero stands for the values in the sensor file.
    without_factors = parameters.copy()
    without_factors[[D31, D32]] = 0.0
    without_factors[GAINS] = 0.0
    sensor, probe = prior.film(without_factors)
    forward_map = family.forward_map(sensor, probe)
    piezo = prior.sensor.piezo
    no_charge = np.zeros((len(contact), len(prior.sensor.electrodes)))

    def charges(d31: float, d32: float, d33: float = 0.0) -> Array:
        """Return the charges of the film with other piezoelectric coefficients, shape (n_press, n_electrode), pC."""
        if d31 == 0.0 and d32 == 0.0:  # the sensor file has no such coefficient, so this part is zero
            return no_charge
        other_sensor = replace(forward_map.sensor, piezo=Piezo(d31, d32, d33))
        return replace(forward_map, sensor=other_sensor).charges(contact)

    d31_part = charges(piezo.d31, 0.0)
    d32_part = charges(0.0, piezo.d32)
    d33_part = no_charge
    if piezo.d33 != 0.0:
        # The charge is a sum of three parts. No charge is computed for d33 alone, so its part is what remains.
        all_parts = charges(piezo.d31, piezo.d32, piezo.d33)
        d33_part = all_parts - d31_part - d32_part
    return np.stack([d31_part, d32_part, d33_part], axis=-1)


def _check_charges_are_positive(drawn: FilmPresses) -> None:
    """Check that at most the fraction `MAX_NEGATIVE_FRACTION` of the presses has a charge that is zero or negative.

    The network learns from the logarithms of the charges, so it needs positive charges.

    Args:
        drawn: The drawn presses.

    Raises:
        DatasetError: If there are more such presses. The message describes the first one.
    """
    charge = drawn.charge()
    is_unusable = (charge <= 0.0).any(axis=-1)  # shape (n_film, n_press)
    unusable_fraction = is_unusable.mean()
    if unusable_fraction <= MAX_NEGATIVE_FRACTION:
        return
    film_index, press_index = np.argwhere(is_unusable)[0]
    first_contact = drawn.contact[film_index, press_index].tolist()
    first_charge = charge[film_index, press_index].tolist()
    raise DatasetError(
        f"{unusable_fraction:.0%} of the presses have an electrode whose charge is zero or negative, expected at most "
        f"{MAX_NEGATIVE_FRACTION:.0%}, because the network learns from logarithms; the first such press is on film "
        f"{film_index}, at {first_contact} (mm, mm, N), with {first_charge} pC; check d31 and d32, or give a smaller "
        "radius"
    )


@dataclass(frozen=True)
class FilmsSource:
    """Films and contacts from which the training data of the misfit network are drawn.

    Attributes:
        prior: Distribution of the films.
        family: Forward maps of the films.
        domain: Contacts.
        noise: Noise of good presses.
    """

    prior: FilmPrior
    family: FilmFamily
    domain: Domain
    noise: NoiseModel

    def charge_map(self, parameters: Array) -> FunctionMap:
        """Return the map of one film from contacts to charges.

        The charges are clipped to the limits of the input features.
        """
        forward_map = self.family.forward_map(*self.prior.film(parameters))

        def charges(contact: Array) -> Array:
            """Return the clipped charges of contacts (x, y, F), shape (n, n_electrode), pC."""
            return np.clip(forward_map.charges(contact), LOWEST_CHARGE, HIGHEST_CHARGE)

        return FunctionMap(charges, forward_map.electrodes, self.domain)


@dataclass(frozen=True)
class DrawnFilms:
    """Training data of the misfit network.

    Attributes:
        parameters: Parameters of the films, shape (n_film, n_parameter).
        charge: Charges, shape (n_film, n, n_electrode), pC.
        target: Residuals or projections from which the targets are computed, shape (n_film, n, n_electrode, ...).
    """

    parameters: Array
    charge: Array
    target: Array


def draw_misfit_films(
    source: FilmsSource, films: int, charges: int, seed: int, executor: Executor | None = None
) -> DrawnFilms:
    """Draw films and charges of every kind on each film.

    Args:
        source: Films and contacts.
        films: Number of films.
        charges: Number of charges on each film.
        seed: Seed of films and charges.
        executor: Executor of the tasks; None for this process.

    Returns:
        Films and charges. The target is (Q - Q(c)) / sigma at the nearest contact c, in standard deviations of the
        noise, shape (films, charges, n_electrode).
    """
    parameters = source.prior.draw(np.random.default_rng([seed, 2]), films)
    jobs = in_order(executor, partial(_charges_of_every_kind, source, charges, seed), enumerate(parameters))
    charge, residual = np.stack(list(track(jobs, "searching nearest contacts", films)), axis=1)
    return DrawnFilms(parameters, charge, residual)


def _charges_of_every_kind(source: FilmsSource, charges: int, seed: int, job: tuple[int, Array]) -> Array:
    """Draw charges of every kind on one film, from good presses to charges that no contact explains.

    Args:
        source: Films, domain and noise.
        charges: Number of charges.
        seed: Seed of the random numbers.
        job: Number of the film, and its parameters, shape (n_parameter,).

    Returns:
        Charges, pC, and residuals, shape (2, charges, n_electrode).
    """
    film_number, parameters = job
    charge_map = source.charge_map(parameters)
    # The numbers after the seed make this sequence independent of those of other films and other purposes.
    rng = np.random.default_rng([seed, 3, film_number])
    contact = draw_contacts(rng, source.domain, charges)
    presses = LabelledPresses(contact, charge_map.charges(contact))
    options = ExampleOptions(candidates=N_CANDIDATES)
    return draw_misfit_examples(presses, charge_map, source.noise, charges, seed + film_number, options=options)


def draw_near_films(
    source: FilmsSource, films: int, presses: int, seed: int, executor: Executor | None = None
) -> DrawnFilms:
    """Draw films and good presses on each film, with matrices that compute the residuals of the presses.

    The nearest contact of a good press is found without a search, because the charges are linearised about the true
    contact.

    Args:
        source: Films and contacts.
        films: Number of films.
        presses: Number of presses on each film.
        seed: Seed of films and presses.
        executor: Executor of the tasks; None for this process.

    Returns:
        Films and charges without noise. The target is a projection matrix, shape (films, presses, n_electrode,
        n_electrode). To first order, it maps a deviation in standard deviations of the noise to the residual at the
        nearest contact, so new noise costs nothing.
    """
    parameters = source.prior.draw(np.random.default_rng([seed, 4]), films)
    jobs = in_order(executor, partial(_good_presses, source, presses, seed), enumerate(parameters))
    drawn = np.stack(list(track(jobs, "drawing good presses", films)))
    # The last axis contains the charge and then the row of the projection matrix of each electrode.
    charge, projection = np.split(drawn, [1], axis=-1)
    return DrawnFilms(parameters, charge[..., 0], projection)


def _good_presses(source: FilmsSource, presses: int, seed: int, job: tuple[int, Array]) -> Array:
    """Draw good presses on one film, with the matrices that compute their residuals from their noise.

    Args:
        source: Films, domain and noise.
        presses: Number of presses.
        seed: Seed of the random numbers.
        job: Number of the film, and its parameters, shape (n_parameter,).

    Returns:
        Charges, pC, and then projection matrices, shape (presses, n_electrode, 1 + n_electrode).
    """
    film_number, parameters = job
    # The numbers after the seed make this sequence independent of those of other films and other purposes.
    rng = np.random.default_rng([seed, 5, film_number])
    contact = draw_contacts(rng, source.domain, presses)
    charge, slopes = linearised(source.charge_map(parameters), contact)
    scaled_slopes = slopes / source.noise.sigma(charge)[:, :, None]
    # The projection removes the changes of the charges that a change of the contact explains. These changes are
    # combinations of the columns of `scaled_slopes`, for which QR gives an orthonormal basis B. The projection is
    # I - B B'.
    basis, _ = np.linalg.qr(scaled_slopes)
    projection = np.eye(charge.shape[1]) - basis @ basis.transpose(0, 2, 1)
    return np.concatenate([charge[:, :, None], projection], axis=2)
