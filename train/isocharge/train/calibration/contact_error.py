"""Error of contacts that the remaining uncertainty of a film causes, and the presses that would lower it most.

An estimator that takes a film for another, whose parameters differ by dp, errs by the contact that explains the
difference of the charges best,

    dc = -G dp,   G = (J' W J)^-1 J' W P,

with J and P the derivatives of the charges by contact and parameters, and W one over the noise variance. With the
covariance C of the parameters, the covariance of the contacts is G C G'. Noise alone leaves (J' W J)^-1, the Cramer-Rao
limit. The matrix J' W J includes the prior of a contact, which lies in the working area and the range of forces, so
that the error stays finite where the map folds.

A press adds information about the film, however it turns out, so the best next press is known before it is made.
Presses are chosen one after the other, each the best given those before (A-optimal design, greedily; Pukelsheim 1993).
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.common.measured_presses import FORCE_STD, POSITION_STD_MM
from isocharge.simulate.numerics.disk import sunflower
from isocharge.train.calibration.contacts import derivatives_with_adjusted_contacts
from isocharge.train.calibration.problem import CalibrationProblem, FilmEstimate

CONTACTS = 200
"""Contacts over which the error is taken."""

PLACES = 80
"""Places of presses that are compared."""

FORCES = (0.15, 0.45, 0.95)
"""Forces of presses that are compared, as shares of the range's logarithm from its lower end."""

GOLDEN_SHARE = 0.6180339887
"""Share of the range of forces from one contact to the next, the inverse of the golden ratio: neighbours differ."""

ROUND_MM = 0.5
"""Distance of the grid on which the places of proposed presses lie, so that a person can make them."""

ROUND_N = 0.05
"""Distance of the forces of proposed presses."""

AVOIDED_MM = 1.0
"""Distance from a place to avoid within which nothing is proposed, mm."""


@dataclass(frozen=True)
class ContactError:
    """Root-mean-square errors of contacts.

    Attributes:
        position_mm: Root mean square over the contacts, mm.
        force_percent: The same, % of the force.
        each_mm: Root-mean-square position error of each contact, shape (n,), mm.
    """

    position_mm: float
    force_percent: float
    each_mm: Array

    @classmethod
    def of(cls, covariance: Array) -> "ContactError":
        """Return the errors for covariances of (x, y, ln F), shape (n, 3, 3)."""
        x_variance, y_variance, log_force_variance = np.einsum("nii->in", covariance)
        position_variance = x_variance + y_variance
        return cls(
            position_mm=float(np.sqrt(position_variance.mean())),
            force_percent=100.0 * float(np.sqrt(log_force_variance.mean())),
            each_mm=np.sqrt(position_variance),
        )


@dataclass(frozen=True)
class ContactSensitivity:
    """Response of contacts to noise and to a wrong film, linearised at one film.

    Attributes:
        contact: (x, y, F), shape (n, 3), mm and N.
        by_parameter: -G: (x, y, ln F) by the parameters over their prior standard deviations, and by the coefficients
            of the discrepancy if there is one, shape (n, 3, n_unknown).
        noise: Covariance of (x, y, ln F) by noise alone, shape (n, 3, 3).
        misfit: Derivatives of the part of the charges that no contact explains, by the same unknowns, shape
            (n, n_electrode, n_unknown), in units of the noise.
        log_charge: Derivatives of ln Q at fixed contacts by the same unknowns, shape (n, n_electrode, n_unknown).
    """

    contact: Array
    by_parameter: Array
    noise: Array
    misfit: Array
    log_charge: Array

    @classmethod
    def at(cls, problem: CalibrationProblem, parameters: Array) -> "ContactSensitivity":
        """Return the response of contacts spread over the domain, on one film.

        Args:
            problem: The films.
            parameters: The film, as `FilmCharges.film` takes it.
        """
        domain = problem.domain
        low, high = domain.force_range
        place = domain.radius * sunflower(CONTACTS)
        force = low * (high / low) ** ((0.5 + np.arange(CONTACTS)) * GOLDEN_SHARE % 1.0)
        contact = np.column_stack([place.real, place.imag, force])
        contact_slopes, film_slopes = _whitened_slopes(problem, parameters, contact)
        charge = problem.charges.charges(parameters, contact)
        log_force_std = max(np.log(high / low), 0.1) / np.sqrt(12.0)
        prior_std = np.array([0.5 * domain.radius, 0.5 * domain.radius, log_force_std])
        precision = np.einsum("nki,nkj->nij", contact_slopes, contact_slopes) + np.diag(prior_std**-2)
        noise = np.linalg.inv(precision)
        by_parameter = -np.einsum("nij,nkj,nkp->nip", noise, contact_slopes, film_slopes)
        return cls(
            contact=contact,
            by_parameter=by_parameter,
            noise=noise,
            misfit=derivatives_with_adjusted_contacts(film_slopes, contact_slopes),
            log_charge=film_slopes * (problem.noise.sigma(charge) / charge)[:, :, None],
        )

    def contact_error(self, covariance: Array) -> ContactError:
        """Return the errors for a covariance of the film's unknowns."""
        return ContactError.of(self.contact_covariance(covariance))

    def contact_covariance(self, covariance: Array) -> Array:
        """Return the covariances of (x, y, ln F), shape (n, 3, 3), for a covariance of the film's unknowns."""
        return np.asarray(self.by_parameter @ covariance @ self.by_parameter.swapaxes(1, 2))

    @property
    def noise_error(self) -> ContactError:
        """Errors by noise alone."""
        return ContactError.of(self.noise)

    def cost(self) -> Array:
        """Return the matrix S with mean relative squared error tr(S C), shape (n_parameter, n_parameter).

        Positions and forces count in units of their errors by noise alone.
        """
        unit = self.noise_error
        scaled = self.by_parameter / np.array([[unit.position_mm], [unit.position_mm], [0.01 * unit.force_percent]])
        return np.asarray(np.einsum("nip,niq->pq", scaled, scaled) / len(scaled))


def _whitened_slopes(problem: CalibrationProblem, parameters: Array, contact: Array) -> tuple[Array, Array]:
    """Return the derivatives of the charges over their noise, by the contact and by the unknowns of the film."""
    charges = problem.charges
    by_contact = charges.by_contact(parameters, contact)
    weight = 1.0 / problem.noise.sigma(charges.charges(parameters, contact))[:, :, None]
    return weight * by_contact, weight * charges.by_parameter(parameters, contact, by_contact)


def information_of(
    problem: CalibrationProblem,
    parameters: Array,
    contact: Array,
    position_std_mm: float = POSITION_STD_MM,
    force_std: float = FORCE_STD,
) -> Array:
    """Return the information of each press about the parameters over their prior standard deviations.

    Args:
        problem: The films.
        parameters: Where the map is linearised, as `FilmCharges.film` takes it.
        contact: Presses (x, y, F), shape (n, 3), mm and N.
        position_std_mm: Standard deviation of the place of a press, mm; infinite if the place is unknown.
        force_std: Standard deviation of its force, a share.

    Returns:
        Fisher information, shape (n, n_unknown, n_unknown).
    """
    rows = _rows_of(problem, parameters, contact, position_std_mm, force_std)
    return np.asarray(rows.swapaxes(1, 2) @ rows)


def _rows_of(
    problem: CalibrationProblem, parameters: Array, contact: Array, position_std_mm: float, force_std: float
) -> Array:
    """Return the roots R of the information R' R, shape (n, n_electrode + 3, n_unknown)."""
    contact_slopes, film_slopes = _whitened_slopes(problem, parameters, contact)
    rig_weights = np.array([1.0 / position_std_mm, 1.0 / position_std_mm, 1.0 / force_std])
    rig_contact_slopes = np.broadcast_to(np.diag(rig_weights), (len(contact), 3, 3))
    rig_film_slopes = np.zeros((len(contact), 3, film_slopes.shape[2]))
    return derivatives_with_adjusted_contacts(
        np.concatenate([film_slopes, rig_film_slopes], axis=1),
        np.concatenate([contact_slopes, rig_contact_slopes], axis=1),
    )


@dataclass(frozen=True)
class ProposedPress:
    """A press to make.

    Attributes:
        x_mm: Place along x, mm.
        y_mm: Place along y, mm.
        force_N: Force, N.
        position_mm: Expected root-mean-square position error by the film's uncertainty after the press, mm.
        force_percent: The same error of the force, %.
    """

    x_mm: float
    y_mm: float
    force_N: float
    position_mm: float
    force_percent: float

    @property
    def contact(self) -> Array:
        """(x, y, F), shape (3,), mm and N."""
        return np.array([self.x_mm, self.y_mm, self.force_N])


def next_presses(
    problem: CalibrationProblem,
    count: int,
    film: FilmEstimate | None = None,
    *,
    position_std_mm: float = POSITION_STD_MM,
    force_std: float = FORCE_STD,
    avoid_mm: Array | None = None,
) -> list[ProposedPress]:
    """Return the presses to make next, best first.

    Args:
        problem: The films.
        count: How many.
        film: The present estimate, such as the posterior of a result; `problem.expected` if absent.
        position_std_mm: Standard deviation that the presses' places will have, mm.
        force_std: Standard deviation that their forces will have, a share.
        avoid_mm: Places that cannot be pressed, shape (n, 2), mm; nothing within `AVOIDED_MM` of them is proposed.

    Raises:
        PressError: If every place is to be avoided.
        SceneError: If even the smallest force exceeds the stress limit.
    """
    film = film or problem.expected
    sensitivity = ContactSensitivity.at(problem, film.unknowns)
    avoid_mm = np.empty((0, 2)) if avoid_mm is None else avoid_mm
    candidates = _candidates(problem.domain.radius, problem.proposed_forces, avoid_mm)
    offered = _rows_of(problem, film.unknowns, candidates, position_std_mm, force_std)
    cost = sensitivity.cost()
    covariance = film.unknown_covariance
    proposed = []
    for _ in range(count):
        # A press with the rows R lowers the covariance C by (R C)' (1 + R C R')^-1 (R C).
        projection = offered @ covariance
        innovation = np.eye(offered.shape[1]) + projection @ offered.swapaxes(1, 2)
        benefit = np.einsum("nij,nji->n", np.linalg.inv(innovation), projection @ cost @ projection.swapaxes(1, 2))
        best = int(np.argmax(benefit))
        covariance = covariance - projection[best].T @ np.linalg.solve(innovation[best], projection[best])
        error = sensitivity.contact_error(covariance)
        x, y, force = candidates[best].tolist()
        proposed.append(ProposedPress(x, y, force, error.position_mm, error.force_percent))
    return proposed


def _candidates(radius: float, force_range: tuple[float, float], avoid_mm: Array) -> Array:
    """Return the presses to compare, on a grid that a person can set, shape (n, 3)."""
    low, high = force_range
    place = radius * sunflower(PLACES)
    places = np.unique(np.round(np.column_stack([place.real, place.imag]) / ROUND_MM) * ROUND_MM, axis=0)
    distance = np.hypot(*np.moveaxis(places[:, None] - avoid_mm, 2, 0))
    places = places[(distance > AVOIDED_MM).all(axis=1) & (np.hypot(*places.T) <= radius)]
    if not len(places):
        raise PressError(f"no place within {radius:.3g} mm of the centre is left to press; skip fewer")
    rounded_forces = np.round(low * (high / low) ** np.array(FORCES) / ROUND_N) * ROUND_N
    forces = np.unique(np.clip(np.maximum(rounded_forces, ROUND_N), low, high))
    return np.array([(x, y, force) for x, y in places for force in forces])
