"""Errors of contacts that are caused by the uncertainty of a film, and a choice of presses that reduce these errors.

An estimator may assume wrong parameters of the film, which differ from the real parameters by dp. The error of the
estimated contact is then the change that compensates the difference of the charges best:

    dc = -G dp,   G = (J' W J)^-1 J' W P.

J and P are the derivatives of the charges with respect to the contact and to the parameters, and W is the inverse of
the noise variance. If the parameters have the covariance C, the errors of the contacts have the covariance G C G'.
Noise alone causes errors with the covariance (J' W J)^-1, which is the Cramer-Rao limit. The matrix J' W J also
contains the prior of a contact. According to this prior, the contact lies in the working area and in the range of
forces. The errors are therefore finite where the charge map folds.

The information that a press adds about the film depends on the contact, but hardly on the measured charges. The best
next press can therefore be chosen before it is made. Presses are chosen one after the other. Each further press is the
best one given the previous presses (a greedy A-optimal design, Pukelsheim 1993).
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.common.measured_presses import FORCE_STD, POSITION_STD_MM
from isocharge.simulate import Domain
from isocharge.simulate.numerics.disk import sunflower
from isocharge.train.calibration.contacts import derivatives_with_adjusted_contacts
from isocharge.train.calibration.problem import CalibrationProblem, FilmEstimate

N_CONTACTS = 200
"""Number of contacts over which the errors are averaged."""

N_CANDIDATE_POSITIONS = 80
"""Number of positions that are compared for the next press."""

CANDIDATE_FORCES = (0.15, 0.45, 0.95)
"""Forces that are compared for the next press: positions in the logarithm of the force range, from 0 to 1."""

FORCE_ORDER_SEED = 0
"""Seed of the random order of the forces of contacts that are spread over a domain."""

POSITION_GRID_MM = 0.5
"""Grid to which the coordinates of proposed presses are rounded, mm, so that a person can set them."""

FORCE_GRID_N = 0.05
"""Grid to which the forces of proposed presses are rounded, N."""

MIN_LOG_FORCE_RANGE = 0.1
"""Smallest width of the prior of ln F, so that its standard deviation is not zero for a single force."""

AVOIDED_DISTANCE_MM = 1.0
"""Distance from an avoided position within which no press is proposed, mm."""


@dataclass(frozen=True)
class ContactError:
    """Root-mean-square errors of contacts.

    Attributes:
        position_mm: Root-mean-square position error over all contacts, mm.
        force_percent: Root-mean-square force error over all contacts, % of the force.
        each_mm: Root-mean-square position error of each contact, shape (n,), mm.
    """

    position_mm: float
    force_percent: float
    each_mm: Array

    @classmethod
    def of(cls, covariance: Array) -> "ContactError":
        """Compute the errors of contacts from the covariances of (x, y, ln F), shape (n, 3, 3)."""
        variances = np.diagonal(covariance, axis1=1, axis2=2)  # of x, y and ln F, shape (n, 3)
        x_variance, y_variance, log_force_variance = variances.T
        position_variance = x_variance + y_variance
        return cls(
            position_mm=float(np.sqrt(position_variance.mean())),
            force_percent=100.0 * float(np.sqrt(log_force_variance.mean())),
            each_mm=np.sqrt(position_variance),
        )


@dataclass(frozen=True)
class ContactSensitivity:
    """Linearised effects of noise and of errors of the film's unknowns on estimated contacts.

    The unknowns of the film are its parameters, in units of their prior standard deviations, and the coefficients of
    the discrepancy if there is one.

    Attributes:
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        contact_jacobian: Derivatives of the estimated (x, y, ln F) with respect to the unknowns, the matrix -G of each
            contact, shape (n, 3, n_unknown).
        noise_covariance: Covariance of the estimated (x, y, ln F) that noise alone causes, shape (n, 3, 3).
        misfit_jacobian: Derivatives of the part of the charges that no contact explains with respect to the unknowns,
            shape (n, n_electrode, n_unknown), in units of the noise.
        log_charge_jacobian: Derivatives of ln Q at fixed contacts with respect to the unknowns, shape
            (n, n_electrode, n_unknown).
        charge_gain: Derivatives of the estimated (x, y, ln F) with respect to the charges, shape (n, 3, n_electrode),
            mm/pC, mm/pC and 1/pC.
    """

    contact: Array
    contact_jacobian: Array
    noise_covariance: Array
    misfit_jacobian: Array
    log_charge_jacobian: Array
    charge_gain: Array

    @classmethod
    def at(cls, problem: CalibrationProblem, parameters: Array) -> "ContactSensitivity":
        """Compute the effects at contacts that are spread over the domain.

        Args:
            problem: The films.
            parameters: The film at which the charges are linearised, as `FilmCharges.film` takes it.
        """
        domain = problem.domain
        contact = spread_contacts(domain, N_CONTACTS)
        contact_slopes, film_slopes = _whitened_slopes(problem, parameters, contact)

        # Covariance of a contact by noise, from the information of the charges and of the prior. The prior of ln F is
        # uniform, so its standard deviation is its width divided by the root of 12.
        min_force, max_force = domain.force_range
        log_force_range = max(np.log(max_force / min_force), MIN_LOG_FORCE_RANGE)
        log_force_std = log_force_range / np.sqrt(12.0)
        prior_std = np.array([0.5 * domain.radius, 0.5 * domain.radius, log_force_std])
        # J' J of each contact n: sums over the electrodes k, for each pair of coordinates i and j
        charge_information = np.einsum("nki,nkj->nij", contact_slopes, contact_slopes)
        noise_covariance = np.linalg.inv(charge_information + np.diag(prior_std**-2))

        # The estimated contact moves by the gain times the change of the charges over their noise.
        charge = problem.charges.charges(parameters, contact)
        sigma = problem.noise.sigma(charge)
        whitened_gain = noise_covariance @ contact_slopes.swapaxes(1, 2)
        return cls(
            contact=contact,
            contact_jacobian=-(whitened_gain @ film_slopes),
            noise_covariance=noise_covariance,
            misfit_jacobian=derivatives_with_adjusted_contacts(film_slopes, contact_slopes),
            log_charge_jacobian=film_slopes * (sigma / charge)[:, :, None],  # from units of the noise to ln Q
            charge_gain=whitened_gain / sigma[:, None, :],
        )

    def contact_error(self, covariance: Array) -> ContactError:
        """Compute the errors of contacts that a covariance of the film's unknowns causes."""
        return ContactError.of(self.contact_covariance(covariance))

    def contact_covariance(self, covariance: Array) -> Array:
        """Compute the covariances of (x, y, ln F), shape (n, 3, 3), that a covariance of the film's unknowns causes."""
        return np.asarray(self.contact_jacobian @ covariance @ self.contact_jacobian.swapaxes(1, 2))

    @property
    def noise_error(self) -> ContactError:
        """Errors that noise alone causes."""
        return ContactError.of(self.noise_covariance)

    def error_weights(self) -> Array:
        """Return the matrix S for which the trace of S C is the mean squared error of the contacts.

        C is the covariance of the film's unknowns. Errors of position and force are in units of the errors that noise
        alone causes, so that the mean is dimensionless.

        Returns:
            Matrix S, shape (n_unknown, n_unknown).
        """
        noise_error = self.noise_error
        noise_std = np.array([noise_error.position_mm, noise_error.position_mm, 0.01 * noise_error.force_percent])
        scaled_jacobian = self.contact_jacobian / noise_std[:, None]
        # Sum over the contacts n and the components i of the error, for each pair of unknowns p and q
        sum_of_products = np.einsum("nip,niq->pq", scaled_jacobian, scaled_jacobian)
        return np.asarray(sum_of_products / len(scaled_jacobian))


def spread_contacts(domain: Domain, count: int) -> Array:
    """Return contacts whose positions and logarithms of the force are evenly spread over a domain.

    The order of the forces is random, so that the force does not depend on the position.

    Args:
        domain: The domain.
        count: Number of contacts.

    Returns:
        Contacts (x, y, F), shape (count, 3), mm and N.
    """
    position = sunflower(count)
    force_rank = np.random.default_rng(FORCE_ORDER_SEED).permutation(count)
    unit_log_force = 2.0 * (force_rank + 0.5) / count - 1.0
    return domain.to_contact(np.column_stack([position.real, position.imag, unit_log_force]))


def _whitened_slopes(problem: CalibrationProblem, parameters: Array, contact: Array) -> tuple[Array, Array]:
    """Return the derivatives of the charges in units of the noise of each charge.

    Args:
        problem: The films.
        parameters: The film, as `FilmCharges.film` takes it.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        Derivatives with respect to (x, y, ln F), shape (n, n_electrode, 3). Derivatives with respect to the unknowns of
        the film, shape (n, n_electrode, n_unknown).
    """
    charges = problem.charges
    contact_slopes = charges.by_contact(parameters, contact)
    film_slopes = charges.by_parameter(parameters, contact, contact_slopes)
    noise_std = problem.noise.sigma(charges.charges(parameters, contact))  # shape (n, n_electrode)
    weight = 1.0 / noise_std[:, :, None]
    return weight * contact_slopes, weight * film_slopes


def information_of(
    problem: CalibrationProblem,
    parameters: Array,
    contact: Array,
    position_std_mm: float = POSITION_STD_MM,
    force_std: float = FORCE_STD,
) -> Array:
    """Compute the information that each press adds about the unknowns of the film.

    Args:
        problem: The films.
        parameters: The film at which the charges are linearised, as `FilmCharges.film` takes it.
        contact: Presses (x, y, F), shape (n, 3), mm and N.
        position_std_mm: Standard deviation of the position of a press, mm; infinite if the position is unknown.
        force_std: Standard deviation of the force of a press, relative to the force.

    Returns:
        Fisher information about the parameters in units of their prior standard deviations and about the coefficients
        of the discrepancy, shape (n, n_unknown, n_unknown).
    """
    roots = _information_roots(problem, parameters, contact, position_std_mm, force_std)
    return np.asarray(roots.swapaxes(1, 2) @ roots)


def _information_roots(
    problem: CalibrationProblem, parameters: Array, contact: Array, position_std_mm: float, force_std: float
) -> Array:
    """Compute a matrix R for each press whose product R' R is the information of the press.

    The rows of R are the derivatives of the residuals of the charges and of the measured contact (x, y, ln F) with
    respect to the unknowns of the film. The contact of the press is adjusted to each change of the unknowns. The
    arguments are those of `information_of`.

    Returns:
        Matrices R, shape (n, n_electrode + 3, n_unknown).
    """
    contact_slopes, film_slopes = _whitened_slopes(problem, parameters, contact)

    # The contact that the rig measures depends only on the contact itself. Each coordinate has its own error, so its
    # derivatives form a diagonal matrix. The derivatives with respect to the film are zero.
    rig_weights = np.array([1.0 / position_std_mm, 1.0 / position_std_mm, 1.0 / force_std])
    rig_contact_slopes = np.broadcast_to(np.diag(rig_weights), (len(contact), 3, 3))
    rig_film_slopes = np.zeros((len(contact), 3, film_slopes.shape[2]))
    return derivatives_with_adjusted_contacts(
        np.concatenate([film_slopes, rig_film_slopes], axis=1),
        np.concatenate([contact_slopes, rig_contact_slopes], axis=1),
    )


@dataclass(frozen=True)
class ProposedPress:
    """A proposed press, and the errors that are expected after this press.

    Attributes:
        x_mm: Position along x, mm.
        y_mm: Position along y, mm.
        force_N: Force, N.
        position_mm: Root-mean-square position error that the uncertainty of the film still causes after the press, mm.
        force_percent: Root-mean-square force error that the uncertainty of the film still causes after the press, %.
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
    """Choose the presses to make next, the best one first.

    The presses are chosen one after the other from many candidates. Each chosen press is the candidate that reduces the
    expected error of contacts most, given the presses chosen before.

    Args:
        problem: The films.
        count: Number of presses.
        film: The present estimate of the film, such as the posterior of a calibration; by default `problem.expected`.
        position_std_mm: Standard deviation that the positions of the presses will have, mm.
        force_std: Standard deviation that the forces of the presses will have, relative to the force.
        avoid_mm: Positions that cannot be pressed, shape (n, 2), mm. No press is proposed within
            `AVOIDED_DISTANCE_MM` of them.

    Raises:
        PressError: If all candidate positions are avoided.
        SceneError: If even the smallest force exceeds the stress limit.
    """
    if film is None:
        film = problem.expected
    if avoid_mm is None:
        avoid_mm = np.empty((0, 2))
    sensitivity = ContactSensitivity.at(problem, film.unknowns)
    candidates = _candidates(problem.domain.radius, problem.proposed_forces, avoid_mm)
    # For each candidate, the matrix R whose product R' R is the information that the press adds about the film, shape
    # (n_candidate, n_residual, n_unknown)
    information_roots = _information_roots(problem, film.unknowns, candidates, position_std_mm, force_std)
    error_weights = sensitivity.error_weights()

    covariance = film.unknown_covariance  # after each round, the covariance that is expected after the chosen presses
    proposed = []
    for _ in range(count):
        best_index, covariance = _best_candidate(information_roots, covariance, error_weights)
        error = sensitivity.contact_error(covariance)
        x, y, force = candidates[best_index].tolist()
        proposed.append(ProposedPress(x, y, force, error.position_mm, error.force_percent))
    return proposed


def _best_candidate(information_roots: Array, covariance: Array, error_weights: Array) -> tuple[int, Array]:
    """Return the candidate that reduces the mean squared error most, and the covariance after this press.

    A press with the information R' R reduces the covariance C by (R C)' (1 + R C R')^-1 (R C). The reduction of the
    mean squared error is the trace of the error weights times this matrix.

    Args:
        information_roots: Matrix R of each candidate, shape (n, n_residual, n_unknown).
        covariance: Covariance C of the film's unknowns before the press, shape (n_unknown, n_unknown).
        error_weights: Matrix S for which the trace of S C is the mean squared error, shape (n_unknown, n_unknown).

    Returns:
        Index of the candidate, and the covariance after the press.
    """
    n_residual = information_roots.shape[1]
    projection = information_roots @ covariance  # R C
    innovation = np.eye(n_residual) + projection @ information_roots.swapaxes(1, 2)  # 1 + R C R'
    weighted_projection = projection @ error_weights @ projection.swapaxes(1, 2)  # R C S C R'
    error_reduction = np.einsum("nij,nji->n", np.linalg.inv(innovation), weighted_projection)  # traces of products
    best_index = int(np.argmax(error_reduction))

    # (R C)' (1 + R C R')^-1 (R C) of the best candidate
    best_projection = projection[best_index]
    covariance_reduction = best_projection.T @ np.linalg.solve(innovation[best_index], best_projection)
    return best_index, covariance - covariance_reduction


def _candidates(radius: float, force_range: tuple[float, float], avoid_mm: Array) -> Array:
    """Return the candidates for the next press: every allowed position with every force.

    The positions are distributed evenly over the working area. Positions and forces are rounded so that a person can
    set them.

    Args:
        radius: Largest distance of a press from the centre, mm.
        force_range: Smallest and largest force, N.
        avoid_mm: Positions to avoid, shape (n_avoided, 2), mm.

    Returns:
        Presses (x, y, F), shape (n, 3), mm and N.

    Raises:
        PressError: If all positions are avoided.
    """
    spiral = radius * sunflower(N_CANDIDATE_POSITIONS)
    coordinates = np.column_stack([spiral.real, spiral.imag])
    positions = np.unique(np.round(coordinates / POSITION_GRID_MM) * POSITION_GRID_MM, axis=0)

    is_inside = np.hypot(positions[:, 0], positions[:, 1]) <= radius
    offset = positions[:, None] - avoid_mm  # shape (n_position, n_avoided, 2)
    avoided_distance = np.hypot(offset[..., 0], offset[..., 1])
    is_allowed = (avoided_distance > AVOIDED_DISTANCE_MM).all(axis=1)
    positions = positions[is_inside & is_allowed]
    if not len(positions):
        raise PressError(f"no place within {radius:.3g} mm of the centre is left to press; skip fewer")

    # The candidate forces are fractions of the logarithmic range of forces.
    min_force, max_force = force_range
    exact_forces = min_force * (max_force / min_force) ** np.array(CANDIDATE_FORCES)
    rounded_forces = np.round(exact_forces / FORCE_GRID_N) * FORCE_GRID_N
    positive_forces = np.maximum(rounded_forces, FORCE_GRID_N)
    forces = np.unique(np.clip(positive_forces, min_force, max_force))
    return np.array([(x, y, force) for x, y in positions for force in forces])
