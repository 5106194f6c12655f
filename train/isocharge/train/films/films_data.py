"""Training data of the networks for all films.

The contact network learns from simulated presses on many films. Each charge is proportional to the gain of its
electrode, and is a linear function of the piezoelectric coefficients. The training can therefore draw new gains and
coefficients in every step without a new simulation. For this purpose, each charge is stored as three parts, which are
due to d31, d32 and d33. The parts are computed with the gains and coefficients of the sensor file.

The misfit network learns from charges of many kinds and from charges of good presses. The targets of its training
follow from the residuals of the charges at the nearest contact.
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
from isocharge.simulate.forward.charge_map import Domain, FunctionMap, linearised, one_sided_differences
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.sensor.film_prior import SHARED, FilmPrior
from isocharge.train.data.misfit_charges import ExampleOptions, draw_misfit_examples
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE, LabelledPresses, draw_contacts

CHUNK = 16
"""Number of films whose presses one task of the executor computes."""

MAX_NEGATIVE_FRACTION = 0.2
"""Largest accepted fraction of presses with a charge that is zero or negative.

Light presses on taut uniaxial films can have such charges. The network clips charges below 1 pC to 1 pC, so that only
the other electrodes of these presses carry information.
"""

N_CANDIDATES = 512
"""Number of contacts among which the starts of a search for the nearest contact are chosen.

The charges of these contacts are computed again for each film. The number is therefore smaller than in the training for
a single film.
"""

D31 = SHARED.index("d31")
"""Index of the logarithm of d31 among the parameters of a film."""

D32 = SHARED.index("d32")
"""Index of the logarithm of d32 among the parameters of a film."""

GAINS = slice(len(SHARED), None)
"""Indices of the logarithms of the gains among the parameters of a film."""


@dataclass(frozen=True)
class FilmPresses:
    """Presses on several films, without noise.

    Attributes:
        parameters: Parameters of the films, shape (n_film, n_parameter).
        contact: Contacts (x, y, F), shape (n_film, n_press, 3), mm and N, float32.
        charge_parts: Parts of the charges that are due to d31, to d32 and to d33, for the gains and coefficients of the
            sensor file, shape (n_film, n_press, n_electrode, 3), pC, float32.
    """

    parameters: Array
    contact: Singles
    charge_parts: Singles

    def __len__(self) -> int:
        return len(self.parameters)

    def charge(self) -> Array:
        """Compute the charges of the presses. Each film has its own gains and piezoelectric coefficients.

        The parts of a charge that are due to d31, d32 and d33 are multiplied by factors of the film, and the products
        are added. The sum of the products is multiplied by the gain factor of the electrode:

            charge = gain factor * sum over the parts (part factor * part).

        Returns:
            Charges, shape (n_film, n_press, n_electrode), pC.
        """
        d31_factor = np.exp(self.parameters[:, D31])
        d32_factor = np.exp(self.parameters[:, D32])
        d33_factor = np.ones(len(self))  # all films have the d33 of the sensor file
        part_factors = np.stack([d31_factor, d32_factor, d33_factor], axis=1)
        gain_factors = np.exp(self.parameters[:, GAINS])
        # Sum over the parts c for each film f, press p and electrode e
        charge_parts = self.charge_parts.astype(float)
        return np.asarray(np.einsum("fpec,fc,fe->fpe", charge_parts, part_factors, gain_factors))


def draw_film_presses(
    prior: FilmPrior,
    family: FilmFamily,
    domain: Domain,
    films: int,
    presses: int,
    seed: int,
    executor: Executor | None = None,
) -> FilmPresses:
    """Draw films from the prior, draw presses on each film, and compute their charges.

    The positions of the presses are uniformly distributed over the disk of the domain, and the forces are log-uniform.

    Args:
        prior: Distribution of the films.
        family: Forward maps of the films.
        domain: Working area and range of forces of the presses.
        films: Number of films.
        presses: Number of presses on each film.
        seed: Seed of films and presses.
        executor: Executor that computes the presses of `CHUNK` films in each task; None for this process.

    Returns:
        Contacts, and the charges of each film in parts; see `FilmPresses`.

    Raises:
        DatasetError: If too many presses have a charge that is zero or negative.
    """
    # The number after the seed makes these random numbers independent of those of the presses.
    parameters = prior.draw(np.random.default_rng([seed, 0]), films)
    jobs = [(first_film, parameters[first_film : first_film + CHUNK]) for first_film in range(0, films, CHUNK)]
    press_films = partial(_press_films, prior, family, domain, presses, seed)
    chunks = list(track(in_order(executor, press_films, jobs), "pressing films", len(jobs)))

    contact_and_parts = np.concatenate(chunks)  # shape (films, presses, 1 + n_electrode, 3)
    contact = contact_and_parts[:, :, 0]
    charge_parts = contact_and_parts[:, :, 1:]
    film_presses = FilmPresses(parameters, contact, charge_parts)
    _check_most_charges_are_positive(film_presses)
    return film_presses


def _press_films(
    prior: FilmPrior, family: FilmFamily, domain: Domain, presses: int, seed: int, job: tuple[int, Array]
) -> Singles:
    """Draw presses on some films, and compute the three parts of each charge.

    The contacts and the parts of the charges are joined in one array, because a task of the executor returns a single
    array.

    Args:
        prior: Distribution of the films.
        family: Forward maps of the films.
        domain: Working area and range of forces of the presses.
        presses: Number of presses on each film.
        seed: Seed of the presses.
        job: Index of the first of these films among all films, and parameters of these films, shape (n_film,
            n_parameter).

    Returns:
        Array of shape (n_film, presses, 1 + n_electrode, 3). Along the third axis, it contains the contact (x, y, F)
        and then the three parts of the charge of each electrode.
    """
    first_film, parameters = job
    # The numbers after the seed make these random numbers independent of those of the films and of other jobs.
    rng = np.random.default_rng([seed, 1, first_film])
    contacts = np.stack([draw_contacts(rng, domain, presses) for _ in parameters])
    charge_parts = np.stack(
        [
            _compute_charge_parts(prior, family, film_parameters, film_contacts)
            for film_parameters, film_contacts in zip(parameters, contacts, strict=True)
        ]
    )
    return np.concatenate([contacts[:, :, None], charge_parts], axis=2).astype(np.float32)


def _compute_charge_parts(prior: FilmPrior, family: FilmFamily, parameters: Array, contact: Array) -> Array:
    """For presses on one film, compute the three parts of the charges that are due to d31, d32 and d33.

    The charge of an electrode is the sum of the three parts. The parts are computed with the piezoelectric coefficients
    and the gains of the sensor file. `FilmPresses.charge` later multiplies the parts by factors of the film.

    Args:
        prior: Distribution of the films.
        family: Forward maps of the films.
        parameters: Parameters of the film, shape (n_parameter,).
        contact: Contacts, shape (n_press, 3), mm and N.

    Returns:
        Parts for d31, d32 and d33, shape (n_press, n_electrode, 3), pC.
    """
    # Build the forward map of the film, but with the coefficients and the gains of the sensor file. These parameters
    # are logarithms of factors, so zero stands for the values in the sensor file.
    described_parameters = parameters.copy()
    described_parameters[[D31, D32]] = 0.0
    described_parameters[GAINS] = 0.0
    sensor, probe = prior.film(described_parameters)
    forward_map = family.forward_map(sensor, probe)
    piezo = prior.sensor.piezo
    no_charge = np.zeros((len(contact), len(prior.sensor.electrodes)))

    def charges_with(d31: float, d32: float, d33: float = 0.0) -> Array:
        """Return the charges for the given piezoelectric coefficients, shape (n_press, n_electrode), pC.

        Without d31 and d32, the charges are zero, and the forward map is not evaluated.
        """
        if d31 == 0.0 and d32 == 0.0:
            return no_charge
        other_sensor = replace(forward_map.sensor, piezo=Piezo(d31, d32, d33))
        return replace(forward_map, sensor=other_sensor).charges(contact)

    d31_part = charges_with(piezo.d31, 0.0)
    d32_part = charges_with(0.0, piezo.d32)
    if piezo.d33 == 0.0:
        d33_part = no_charge
    else:
        # `charges_with` needs d31 or d32, so the part of d33 is what remains of the total charge.
        total_charge = charges_with(piezo.d31, piezo.d32, piezo.d33)
        d33_part = total_charge - d31_part - d32_part
    return np.stack([d31_part, d32_part, d33_part], axis=-1)


def _check_most_charges_are_positive(film_presses: FilmPresses) -> None:
    """Check that only a few presses have a charge that is zero or negative.

    The largest accepted fraction of such presses is `MAX_NEGATIVE_FRACTION`. The network learns from the logarithms of
    the charges, so it needs positive charges.

    Args:
        film_presses: Presses on the drawn films.

    Raises:
        DatasetError: If the fraction is larger. The message describes the first press with such a charge.
    """
    charge = film_presses.charge()
    is_unusable = (charge <= 0.0).any(axis=-1)  # shape (n_film, n_press)
    unusable_fraction = is_unusable.mean()
    if unusable_fraction <= MAX_NEGATIVE_FRACTION:
        return
    film_index, press_index = np.argwhere(is_unusable)[0]
    first_contact = film_presses.contact[film_index, press_index].tolist()
    first_charge = charge[film_index, press_index].tolist()
    raise DatasetError(
        f"{unusable_fraction:.0%} of the presses have an electrode whose charge is zero or negative, expected at most "
        f"{MAX_NEGATIVE_FRACTION:.0%}, because the network learns from logarithms; the first such press is on film "
        f"{film_index}, at {first_contact} (mm, mm, N), with {first_charge} pC; check d31 and d32, or give a smaller "
        "radius"
    )


class SearchMap(FunctionMap):
    """Charge map for searches of contacts.

    Its derivatives are one-sided differences, which need fewer charges than the two-sided differences of `FunctionMap`.
    """

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """See `LinearisedMap`."""
        return one_sided_differences(self.function, contact)


@dataclass(frozen=True)
class FilmsSource:
    """Source of the training data of the misfit network: films, contacts and noise.

    Attributes:
        prior: Distribution of the films.
        family: Forward maps of the films.
        domain: Working area and range of forces of the presses.
        noise: Noise of good presses, whose standard deviation is the unit of the residuals.
    """

    prior: FilmPrior
    family: FilmFamily
    domain: Domain
    noise: NoiseModel

    def charge_map(self, parameters: Array) -> FunctionMap:
        """Return the map from contacts to charges of one film.

        The charges are clipped to the limits of the input features.

        Args:
            parameters: Parameters of the film, shape (n_parameter,).
        """
        forward_map = self.family.forward_map(*self.prior.film(parameters))

        def charges(contact: Array) -> Array:
            """Return the clipped charges of contacts (x, y, F), shape (n, n_electrode), pC."""
            return np.clip(forward_map.charges(contact), LOWEST_CHARGE, HIGHEST_CHARGE)

        return FunctionMap(charges, forward_map.electrodes, self.domain)

    def search_map(self, parameters: Array) -> SearchMap:
        """Return the charge map of one film for searches of contacts.

        Args:
            parameters: Parameters of the film, shape (n_parameter,).
        """
        charge_map = self.charge_map(parameters)
        return SearchMap(charge_map.function, charge_map.electrodes, charge_map.domain)


@dataclass(frozen=True)
class DrawnFilms:
    """Charges on several films, with residuals or projection matrices as targets of the misfit network.

    Attributes:
        parameters: Parameters of the films, shape (n_film, n_parameter).
        charge: n sets of charges on each film, shape (n_film, n, n_electrode), pC.
        target: Residuals of the charges, shape (n_film, n, n_electrode), from `draw_misfit_films`; or matrices that
            convert noise into residuals, shape (n_film, n, n_electrode, n_electrode), from `draw_near_films`.
    """

    parameters: Array
    charge: Array
    target: Array


def draw_misfit_films(
    source: FilmsSource, films: int, charges: int, seed: int, executor: Executor | None = None
) -> DrawnFilms:
    """Draw films from the prior, and draw charges of every kind on each film.

    The kinds are charges of good presses, charges of faulty presses, and random charges.

    Args:
        source: Distribution and forward maps of the films, contacts and noise.
        films: Number of films.
        charges: Number of sets of charges on each film.
        seed: Seed of films and charges.
        executor: Executor that draws the data of one film in each task; None for this process.

    Returns:
        Films, charges Q and targets. The targets are the residuals (Q - Q(c)) / sigma at the nearest contact c, with
        the standard deviation sigma of the noise, shape (films, charges, n_electrode).
    """
    # The number after the seed makes these random numbers independent of those of other data sets.
    parameters = source.prior.draw(np.random.default_rng([seed, 2]), films)
    results = in_order(executor, partial(_draw_charges_of_every_kind, source, charges, seed), enumerate(parameters))
    arrays_of_films = list(track(results, "searching nearest contacts", films))  # each contains charges and residuals
    charge, residual = np.stack(arrays_of_films, axis=1)  # both of shape (films, charges, n_electrode)
    return DrawnFilms(parameters, charge, residual)


def _draw_charges_of_every_kind(source: FilmsSource, charges: int, seed: int, job: tuple[int, Array]) -> Array:
    """Draw charges of every kind on one film: of good presses, of faulty presses, and random charges.

    Args:
        source: Distribution and forward maps of the films, contacts and noise.
        charges: Number of sets of charges.
        seed: Seed of the random numbers.
        job: Index of the film, and its parameters, shape (n_parameter,).

    Returns:
        Array of shape (2, charges, n_electrode) with the charges, pC, and then their residuals at the nearest contact.
    """
    film_index, parameters = job
    charge_map = source.search_map(parameters)
    # The numbers after the seed make these random numbers independent of those of other films and other data sets.
    rng = np.random.default_rng([seed, 3, film_index])
    contact = draw_contacts(rng, source.domain, charges)
    presses = LabelledPresses(contact, charge_map.charges(contact))
    options = ExampleOptions(candidates=N_CANDIDATES)
    return draw_misfit_examples(presses, charge_map, source.noise, charges, seed + film_index, options=options)


def draw_near_films(
    source: FilmsSource, films: int, presses: int, seed: int, executor: Executor | None = None
) -> DrawnFilms:
    """Draw films from the prior, draw good presses on each film, and compute their projection matrices.

    The projection matrix of a press converts the noise of its charges into the residuals of the charges at the nearest
    contact. The charges are linearised about the true contact, so that no search for the nearest contact is needed.

    Args:
        source: Distribution and forward maps of the films, contacts and noise.
        films: Number of films.
        presses: Number of presses on each film.
        seed: Seed of films and presses.
        executor: Executor that draws the data of one film in each task; None for this process.

    Returns:
        Films, charges without noise, and projection matrices as targets, shape (films, presses, n_electrode,
        n_electrode). The noise and the residuals of a press are in units of the standard deviation of the noise.
    """
    # The number after the seed makes these random numbers independent of those of other data sets.
    parameters = source.prior.draw(np.random.default_rng([seed, 4]), films)
    results = in_order(executor, partial(_draw_good_presses, source, presses, seed), enumerate(parameters))
    charge_and_projection = np.stack(list(track(results, "drawing good presses", films)))
    # The last axis contains the charge of an electrode, and then the row of the projection matrix for this electrode.
    charge = charge_and_projection[..., 0]
    projection = charge_and_projection[..., 1:]
    return DrawnFilms(parameters, charge, projection)


def _draw_good_presses(source: FilmsSource, presses: int, seed: int, job: tuple[int, Array]) -> Array:
    """Draw good presses on one film, and compute the projection matrix of each press.

    A projection matrix converts the noise of the charges into residuals.

    Args:
        source: Distribution and forward maps of the films, contacts and noise.
        presses: Number of presses.
        seed: Seed of the random numbers.
        job: Index of the film, and its parameters, shape (n_parameter,).

    Returns:
        Array of shape (presses, n_electrode, 1 + n_electrode). Along the last axis, it contains the charge of an
        electrode, pC, and then the row of the projection matrix for this electrode.
    """
    film_index, parameters = job
    # The numbers after the seed make these random numbers independent of those of other films and other data sets.
    rng = np.random.default_rng([seed, 5, film_index])
    contact = draw_contacts(rng, source.domain, presses)
    charge, slopes = linearised(source.charge_map(parameters), contact)
    noise_std = source.noise.sigma(charge)
    scaled_slopes = slopes / noise_std[:, :, None]  # shape (presses, n_electrode, 3)
    # A change of the contact changes the charges by a combination of the columns of `scaled_slopes`. The QR
    # decomposition gives an orthonormal basis B of these columns. The projection I - B B' removes such changes.
    basis, _ = np.linalg.qr(scaled_slopes)
    projection = np.eye(charge.shape[1]) - basis @ basis.transpose(0, 2, 1)
    return np.concatenate([charge[:, :, None], projection], axis=2)
