"""Errors that the uncertainty of a film causes in estimated contacts, and choice of presses that reduce these errors.

Let dp be the difference between the parameters that an estimator assumes and the real parameters of the film. The
difference dp changes the charges that the estimator expects at each contact. The error dc of the estimated contact
compensates this change as well as possible:

    dc = -G dp,   G = (J' W J)^-1 J' W P.

Here J is the derivative of the charges with respect to the contact, P is the derivative of the charges with respect to
the parameters, and W is the inverse of the noise covariance. If the parameters have the covariance C, the errors dc
have the covariance G C G'. Noise alone causes errors with the covariance (J' W J)^-1, which is the Cramer-Rao limit.

In the code, the inverse of a prior covariance of the contact is added to J' W J. According to this prior, the contact
lies in the working area and in the range of forces. The prior keeps the errors finite at folds of the charge map, where
the matrix J' W J is singular.

The information that a press adds about the film depends on the contact of the press, but hardly on its charges.
Therefore, the best next press can be chosen before any charge is measured. Several presses are chosen one after the
other, and each choice takes the previous choices into account. The result is a greedy A-optimal design (Pukelsheim
1993).
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
"""Forces that are compared for the next press, on a logarithmic scale from 0 (smallest force) to 1 (largest force)."""

FORCE_ORDER_SEED = 0
"""Seed of the random order in which `spread_contacts` assigns forces to positions."""

POSITION_GRID_MM = 0.5
"""Grid to which the coordinates of proposed presses are rounded, mm, so that a person can set them."""

FORCE_GRID_N = 0.05
"""Grid to which the forces of proposed presses are rounded, N."""

MIN_LOG_FORCE_RANGE = 0.1
"""Smallest width of the prior distribution of ln F.

The limit keeps the standard deviation above zero if the range of forces is a single force."""

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
    def from_covariance(cls, covariance: Array) -> "ContactError":
        """Compute root-mean-square errors from the covariances of estimated contacts.

        Args:
            covariance: Covariances of the estimated (x, y, ln F), shape (n, 3, 3).
        """
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
    """Linearised effects that noise and errors in the unknowns of the film have on estimated contacts.

    The unknowns of the film are its parameters, followed by its coefficients if there are any. Parameters are in units
    of their prior standard deviations.

    Attributes:
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        contact_jacobian: Derivatives of the estimated (x, y, ln F) with respect to the unknowns, shape (n, 3,
            n_unknown). It is the matrix -G of each contact in the description of the module.
        noise_covariance: Covariance of the estimated (x, y, ln F) that noise alone causes, shape (n, 3, 3).
        misfit_jacobian: Derivatives of the misfit with respect to the unknowns, in units of the noise, shape (n,
            n_electrode, n_unknown). The misfit is the part of the charges that no contact explains.
        log_charge_jacobian: Derivatives of the logarithms of the charges at fixed contacts with respect to the
            unknowns, shape (n, n_electrode, n_unknown).
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
    def for_film(cls, problem: CalibrationProblem, unknowns: Array) -> "ContactSensitivity":
        """Linearise the charges of a film at `N_CONTACTS` contacts that are spread over the domain of the problem.

        Args:
            problem: The calibration problem, with the films and the noise.
            unknowns: Unknowns of the film at which the charges are linearised, as `FilmCharges.film` expects them.
        """
        domain = problem.domain
        contact = spread_contacts(domain, N_CONTACTS)
        # Derivatives of the charges in units of the noise, with respect to (x, y, ln F) and to the unknowns of the film
        contact_slopes, film_slopes = _whitened_slopes(problem, unknowns, contact)

        # Covariance of each estimated contact, shape (n, 3, 3). Its inverse is the information of the charges plus that
        # of the prior. The information of the charges is a sum over the electrodes k, for each contact n and each pair
        # of coordinates i and j.
        charge_information = np.einsum("nki,nkj->nij", contact_slopes, contact_slopes)
        prior_information = np.diag(_prior_contact_std(domain) ** -2)
        noise_covariance = np.linalg.inv(charge_information + prior_information)

        # The gain is the matrix that converts a change of the charges into the change of the estimated contact. The
        # whitened gain converts changes of the charges in units of the noise, shape (n, 3, n_electrode).
        whitened_gain = noise_covariance @ contact_slopes.swapaxes(1, 2)
        charge = problem.charges.charges(unknowns, contact)
        noise_std = problem.noise.sigma(charge)
        return cls(
            contact=contact,
            # The estimator assumes wrong charges, and the estimated contact compensates them: hence the minus sign.
            contact_jacobian=-(whitened_gain @ film_slopes),
            noise_covariance=noise_covariance,
            misfit_jacobian=derivatives_with_adjusted_contacts(film_slopes, contact_slopes),
            log_charge_jacobian=film_slopes * (noise_std / charge)[:, :, None],  # d ln Q = dQ / Q
            charge_gain=whitened_gain / noise_std[:, None, :],  # converts changes in pC
        )

    def contact_error(self, covariance: Array) -> ContactError:
        """Compute the contact errors that are caused by the uncertainty of the film.

        Args:
            covariance: Covariance of the unknowns of the film, shape (n_unknown, n_unknown).
        """
        return ContactError.from_covariance(self.contact_covariance(covariance))

    def contact_covariance(self, covariance: Array) -> Array:
        """Compute the part of the covariance of each estimated contact that is caused by the uncertainty of the film.

        Args:
            covariance: Covariance of the unknowns of the film, shape (n_unknown, n_unknown).

        Returns:
            Covariances of (x, y, ln F), shape (n, 3, 3).
        """
        return np.asarray(self.contact_jacobian @ covariance @ self.contact_jacobian.swapaxes(1, 2))

    @property
    def noise_error(self) -> ContactError:
        """Errors of contacts that noise alone causes."""
        return ContactError.from_covariance(self.noise_covariance)

    def error_weights(self) -> Array:
        """Return a matrix S such that trace(S C) is the mean squared error of the contacts.

        The matrix C is any covariance of the film's unknowns. The mean squared error is an average over all contacts,
        and includes the errors of both position and force. These errors are divided by the position error and the force
        error that noise alone causes. Therefore, the mean squared error is dimensionless.

        Returns:
            Matrix S, shape (n_unknown, n_unknown).
        """
        noise_error = self.noise_error
        log_force_error = 0.01 * noise_error.force_percent  # a relative error is an error of ln F
        noise_std = np.array([noise_error.position_mm, noise_error.position_mm, log_force_error])
        scaled_jacobian = self.contact_jacobian / noise_std[:, None]
        # Sums over the contacts n and the components i of the contact, for each pair of unknowns p and q
        sum_of_products = np.einsum("nip,niq->pq", scaled_jacobian, scaled_jacobian)
        return np.asarray(sum_of_products / len(scaled_jacobian))


def spread_contacts(domain: Domain, count: int) -> Array:
    """Return contacts whose positions and logarithmic forces are evenly spread over a domain.

    The forces are assigned to the positions in a random order. Therefore, the forces do not depend on the positions.

    Args:
        domain: Range of positions and forces in which the contacts lie.
        count: Number of contacts.

    Returns:
        Contacts (x, y, F), shape (count, 3), mm and N.
    """
    position = sunflower(count)  # complex numbers x + i y in the unit disk
    force_rank = np.random.default_rng(FORCE_ORDER_SEED).permutation(count)
    # Centres of `count` equal parts of the interval [-1, 1], to which `domain` scales the logarithms of the forces
    unit_log_force = 2.0 * (force_rank + 0.5) / count - 1.0
    return domain.to_contact(np.column_stack([position.real, position.imag, unit_log_force]))


def _prior_contact_std(domain: Domain) -> Array:
    """Return the prior standard deviations of the coordinates (x, y, ln F) of a contact, shape (3,).

    According to the prior, contacts are distributed uniformly over the positions and the logarithms of the forces of
    the domain.

    Args:
        domain: Range of contacts.
    """
    # In a uniform distribution over a disk, the standard deviation of x, and also of y, is half of the radius.
    position_std = 0.5 * domain.radius
    # The standard deviation of a uniform distribution is its width divided by the root of 12.
    min_force, max_force = domain.force_range
    log_force_range = max(np.log(max_force / min_force), MIN_LOG_FORCE_RANGE)
    log_force_std = log_force_range / np.sqrt(12.0)
    return np.array([position_std, position_std, log_force_std])


def _whitened_slopes(problem: CalibrationProblem, unknowns: Array, contact: Array) -> tuple[Array, Array]:
    """Compute the derivatives of the charges of a film, divided by the standard deviations of the noise.

    Args:
        problem: The calibration problem, with the films and the noise.
        unknowns: Unknowns of the film, as `FilmCharges.film` expects them.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        Derivatives with respect to (x, y, ln F), shape (n, n_electrode, 3), and derivatives with respect to the
        unknowns of the film, shape (n, n_electrode, n_unknown).
    """
    charges = problem.charges
    contact_slopes = charges.contact_slopes(unknowns, contact)
    film_slopes = charges.unknown_slopes(unknowns, contact, contact_slopes)
    noise_std = problem.noise.sigma(charges.charges(unknowns, contact))  # shape (n, n_electrode)
    inverse_std = 1.0 / noise_std[:, :, None]
    return inverse_std * contact_slopes, inverse_std * film_slopes


def fisher_information(
    problem: CalibrationProblem,
    unknowns: Array,
    contact: Array,
    position_std_mm: float = POSITION_STD_MM,
    force_std: float = FORCE_STD,
) -> Array:
    """Compute the Fisher information of each press about the unknowns of a film.

    Args:
        problem: The calibration problem, with the films and the noise.
        unknowns: Unknowns of the film at which the charges are linearised, as `FilmCharges.film` expects them.
        contact: Contacts (x, y, F) of the presses, shape (n, 3), mm and N.
        position_std_mm: Standard deviation of the position of a press, mm; infinite if the position is unknown.
        force_std: Standard deviation of the force of a press, relative to the force.

    Returns:
        Fisher information of each press, shape (n, n_unknown, n_unknown). The unknowns are the parameters, in units of
        their prior standard deviations, and the coefficients of the film.
    """
    roots = _information_roots(problem, unknowns, contact, position_std_mm, force_std)
    return np.asarray(roots.swapaxes(1, 2) @ roots)


def _information_roots(
    problem: CalibrationProblem, unknowns: Array, contact: Array, position_std_mm: float, force_std: float
) -> Array:
    """For each press, compute a matrix R for which R' R is the Fisher information of the press about a film.

    Each row of R contains the derivatives of one residual with respect to the unknowns of the film. The first residuals
    of a press are those of its charges. The last three residuals are those of its contact (x, y, ln F), as the rig
    measures it. If the unknowns change, the contact that agrees best with all measurements moves. The derivatives
    include the effect of this movement.

    Args:
        problem: The calibration problem, with the films and the noise.
        unknowns: Unknowns of the film, as `FilmCharges.film` expects them.
        contact: Contacts (x, y, F) of the presses, shape (n, 3), mm and N.
        position_std_mm: Standard deviation of the measured positions, mm; infinite if the positions are unknown.
        force_std: Standard deviation of the measured forces, relative to the force.

    Returns:
        Matrices R, shape (n, n_electrode + 3, n_unknown).
    """
    # Derivatives of the residuals of the charges
    charge_contact_slopes, charge_film_slopes = _whitened_slopes(problem, unknowns, contact)

    # Derivatives of the residuals of the measured contact. Each residual depends only on its own coordinate of the
    # contact, and not on the unknowns of the film. The weight of an unknown position is zero.
    rig_weights = np.array([1.0 / position_std_mm, 1.0 / position_std_mm, 1.0 / force_std])
    rig_contact_slopes = np.broadcast_to(np.diag(rig_weights), (len(contact), 3, 3))
    rig_film_slopes = np.zeros((len(contact), 3, charge_film_slopes.shape[2]))
    return derivatives_with_adjusted_contacts(
        np.concatenate([charge_film_slopes, rig_film_slopes], axis=1),
        np.concatenate([charge_contact_slopes, rig_contact_slopes], axis=1),
    )


@dataclass(frozen=True)
class ProposedPress:
    """A proposed press, with the errors that are expected after this press.

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
        """Contact (x, y, F) of the press, shape (3,), mm and N."""
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
    """Choose the next presses, in the order in which they should be made.

    The presses are chosen one after the other from many candidates. Each round chooses the candidate that reduces the
    expected mean squared error of contacts most. The expected error assumes that all previously chosen presses are
    made. A candidate may be chosen more than once.

    Args:
        problem: The calibration problem, with the films and the noise.
        count: Number of presses to choose.
        film: The present estimate of the film, such as the posterior of a calibration; by default `problem.expected`.
        position_std_mm: Standard deviation that the positions of the presses will have, mm.
        force_std: Standard deviation that the forces of the presses will have, relative to the force.
        avoid_mm: Positions that cannot be pressed, shape (n, 2), mm. No press is proposed within
            `AVOIDED_DISTANCE_MM` of them.

    Raises:
        PressError: If all candidate positions are avoided.
        SceneError: If even the smallest force of the domain exceeds the stress limit of the problem.
    """
    if film is None:
        film = problem.expected
    if avoid_mm is None:
        avoid_mm = np.empty((0, 2))
    sensitivity = ContactSensitivity.for_film(problem, film.unknowns)
    candidates = _candidate_contacts(problem.domain.radius, problem.proposed_forces, avoid_mm)
    # For each candidate, a matrix R such that R' R is the Fisher information of the press about the film, shape
    # (n_candidate, n_residual, n_unknown)
    information_roots = _information_roots(problem, film.unknowns, candidates, position_std_mm, force_std)
    error_weights = sensitivity.error_weights()

    # In each round, the covariance is replaced by the covariance that is expected after the chosen presses.
    covariance = film.unknown_covariance
    proposed = []
    for _ in range(count):
        best_index, covariance = _choose_candidate(information_roots, covariance, error_weights)
        error = sensitivity.contact_error(covariance)
        x, y, force = candidates[best_index].tolist()
        proposed.append(ProposedPress(x, y, force, error.position_mm, error.force_percent))
    return proposed


def _choose_candidate(information_roots: Array, covariance: Array, error_weights: Array) -> tuple[int, Array]:
    """Choose the candidate that reduces the mean squared error of contacts most, and return the new covariance.

    A press with the Fisher information R' R reduces the covariance C of the unknowns by the matrix
    D = (R C)' (1 + R C R')^-1 (R C). The mean squared error of contacts decreases by trace(S D), where S is the matrix
    of error weights.

    Args:
        information_roots: Matrix R of each candidate, shape (n, n_residual, n_unknown).
        covariance: Covariance C of the film's unknowns before the press, shape (n_unknown, n_unknown).
        error_weights: Matrix S for which trace(S C) is the mean squared error, shape (n_unknown, n_unknown).

    Returns:
        Index of the chosen candidate, and the covariance of the unknowns after its press.
    """
    n_residual = information_roots.shape[1]  # per press
    projection = information_roots @ covariance  # R C
    innovation_covariance = np.eye(n_residual) + projection @ information_roots.swapaxes(1, 2)  # 1 + R C R'
    weighted_projection = projection @ error_weights @ projection.swapaxes(1, 2)  # R C S C R'
    # trace(S D) of each candidate n, which equals the trace of (1 + R C R')^-1 (R C S C R')
    error_reduction = np.einsum("nij,nji->n", np.linalg.inv(innovation_covariance), weighted_projection)
    best_index = int(np.argmax(error_reduction))

    # The matrix D of the best candidate
    best_projection = projection[best_index]
    covariance_reduction = best_projection.T @ np.linalg.solve(innovation_covariance[best_index], best_projection)
    return best_index, covariance - covariance_reduction


def _candidate_contacts(radius: float, force_range: tuple[float, float], avoid_mm: Array) -> Array:
    """Return the candidates for the next press, which combine each allowed position with each candidate force.

    The positions are distributed evenly over the working area. The positions and forces are rounded to values that a
    person can easily set. Positions near the positions in `avoid_mm` are left out.

    Args:
        radius: Radius of the working area, which is the largest distance of a press from the centre, mm.
        force_range: Smallest and largest force of a press, N.
        avoid_mm: Positions that cannot be pressed, shape (n_avoided, 2), mm.

    Returns:
        Contacts (x, y, F) of the candidates, shape (n, 3), mm and N.

    Raises:
        PressError: If no position is allowed.
    """
    complex_positions = radius * sunflower(N_CANDIDATE_POSITIONS)  # complex numbers x + i y
    exact_positions = np.column_stack([complex_positions.real, complex_positions.imag])
    positions = np.unique(np.round(exact_positions / POSITION_GRID_MM) * POSITION_GRID_MM, axis=0)

    # A rounded position may lie outside the working area.
    is_inside = np.hypot(positions[:, 0], positions[:, 1]) <= radius
    displacement = positions[:, None] - avoid_mm  # shape (n_position, n_avoided, 2)
    avoided_distance = np.hypot(displacement[..., 0], displacement[..., 1])
    is_allowed = (avoided_distance > AVOIDED_DISTANCE_MM).all(axis=1)
    positions = positions[is_inside & is_allowed]
    if not len(positions):
        raise PressError(f"no place within {radius:.3g} mm of the centre is left to press; skip fewer")

    # The exact forces divide the logarithmic range of forces at the fractions `CANDIDATE_FORCES`. A force that would be
    # rounded to zero is replaced by the smallest force of the grid. Rounding may also move a force out of the range, so
    # the forces are clipped, and equal forces are removed.
    min_force, max_force = force_range
    exact_forces = min_force * (max_force / min_force) ** np.array(CANDIDATE_FORCES)
    rounded_forces = np.round(exact_forces / FORCE_GRID_N) * FORCE_GRID_N
    positive_forces = np.maximum(rounded_forces, FORCE_GRID_N)
    forces = np.unique(np.clip(positive_forces, min_force, max_force))
    return np.array([(x, y, force) for x, y in positions for force in forces])
