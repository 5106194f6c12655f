"""Errors that the uncertainty of a film causes in estimated contacts, and the presses that reduce them most.

Let du be the error of the unknowns of the film. This error changes the charges that the model expects at each contact.
The error dc of the estimated contact compensates the change as well as possible:

    dc = -G du,   G = (J' W J + P)^-1 J' W A.

Here J and A are the derivatives of the charges with respect to the contact and to the unknowns, and W is the inverse
covariance of the noise. P is the inverse covariance of a contact that may lie anywhere in the domain. The matrix P
keeps the errors finite where the map from contacts to charges folds. Noise alone causes errors with the covariance
matrix (J' W J + P)^-1, which is the Cramer-Rao limit.

The information that a press adds about the film hardly depends on its charges. The best next press can therefore be
chosen before any charge is measured. Several presses are chosen one after the other (greedy A-optimal design,
Pukelsheim 1993).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import with_log_force
from isocharge.serve.presses.measured_presses import FORCE_STD, POSITION_STD_MM
from isocharge.simulate import Domain, Sweep
from isocharge.simulate.identifiability.cramer_rao import CramerRao
from isocharge.simulate.numerics.disk import log_spaced_forces, sunflower
from isocharge.simulate.solver.stress_limit import force_within_stress
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.film_estimate import FilmEstimate
from isocharge.train.calibration.press_data import UNKNOWN_STD, Linearised, PressData, model_values
from isocharge.train.calibration.problem import CalibrationProblem
from isocharge.train.data.contact_errors import rms

N_CONTACTS = 200
"""Number of contacts over which errors are averaged, and number of positions compared for the next press."""

CANDIDATE_FORCES = (0.15, 0.45, 0.95)
"""Forces that are compared, on a logarithmic scale from 0 (smallest force) to 1 (largest force)."""

GRID_MM = 0.5
"""Spacing of the grid to which proposed positions are rounded, mm, so that a person can set the positions."""

GRID_N = 0.05
"""Largest step to which proposed forces are rounded, N. The step is at most the smallest force of the domain."""


@dataclass(frozen=True)
class ContactError:
    """Root-mean-square errors of contacts.

    Attributes:
        position_mm: Root-mean-square position error over all contacts, mm.
        force_percent: Root-mean-square force error over all contacts, % of the force.
    """

    position_mm: float
    force_percent: float

    @classmethod
    def of(cls, errors: CramerRao) -> "ContactError":
        """Compute the errors from the covariances of several contacts (x, y, ln F)."""
        return cls(rms(errors.position), 100.0 * rms(errors.force))


@dataclass(frozen=True)
class ContactSensitivity:
    """Effects of noise and of errors of a film on estimated contacts.

    Attributes:
        film_gain: Derivatives of the errors of the contacts (x, y, ln F) with respect to errors of the unknowns, shape
            (n, 3, n_unknown).
        noise_covariance: Covariance of the errors that noise alone causes, shape (n, 3, 3).
    """

    film_gain: Array
    noise_covariance: Array

    @classmethod
    def of(cls, film: FilmEstimate, charges: FilmCharges, domain: Domain) -> "ContactSensitivity":
        """Compute the sensitivity of the contacts that `spread_contacts` returns.

        Args:
            film: The film and the noise of the charges.
            charges: Charges of a film and of similar films.
            domain: The working area.
        """
        # The derivatives J of the charges with respect to the contact, and A with respect to the unknowns of the film,
        # are divided by the standard deviations of the noise. Noise alone then causes errors of the contact with the
        # covariance (J' J + P)^-1, where P is the inverse covariance of a contact anywhere in the domain. An error of
        # the unknowns, multiplied by G = (J' J + P)^-1 J' A, gives the error of the contact, apart from the sign.
        linearised = _linearise_at(film, charges, spread_contacts(domain))
        contact_jacobian = linearised.contact_jacobian  # J for each contact, shape (n, n_electrode + 3, 3)
        transposed_jacobian = contact_jacobian.swapaxes(1, 2)  # J'
        # A contact that may lie anywhere in the domain has unit coordinates that are uniformly distributed from -1 to
        # 1, with the variance 1/3.
        domain_precision = np.diag(3.0 / domain.scale**2)  # P
        contact_covariance = np.linalg.inv(transposed_jacobian @ contact_jacobian + domain_precision)
        film_gain = contact_covariance @ transposed_jacobian @ linearised.jacobian  # G; the last matrix is A
        # The charges of a later contact do not depend on the offset of the forces that the load cell stated.
        film_gain[:, :, film.layout.index("force_offset")] = 0.0
        return cls(film_gain, np.asarray(contact_covariance))

    @property
    def noise_error(self) -> ContactError:
        """Errors that noise alone causes."""
        return ContactError.of(CramerRao(self.noise_covariance))

    def film_error(self, covariance: Array) -> ContactError:
        """Return the rms errors of the contacts for a covariance of the unknowns, shape (n_unknown, n_unknown)."""
        return ContactError.of(self.film_limits(covariance))

    def film_limits(self, covariance: Array) -> CramerRao:
        """Return the errors of each contact for a given covariance of the unknowns.

        Args:
            covariance: Covariance of the unknowns, shape (n_unknown, n_unknown).
        """
        return CramerRao(self.film_gain @ covariance @ self.film_gain.swapaxes(1, 2))


@dataclass(frozen=True)
class ProposedPress:
    """A proposed press, and the contact errors that the uncertainty of the film still causes after this press.

    Attributes:
        x_mm: Coordinate x of the position, mm.
        y_mm: Coordinate y of the position, mm.
        force_N: Force, N.
        position_mm: Root-mean-square position error after the press, mm.
        force_percent: Root-mean-square force error after the press, %.
    """

    x_mm: float
    y_mm: float
    force_N: float
    position_mm: float
    force_percent: float

    @property
    def contact(self) -> Array:
        """The contact (x, y, F), shape (3,), mm and N."""
        return np.array([self.x_mm, self.y_mm, self.force_N])


def next_presses(
    problem: CalibrationProblem,
    charges: FilmCharges,
    count: int,
    film: FilmEstimate | None = None,
    *,
    position_std_mm: float = POSITION_STD_MM,
    force_std: float = FORCE_STD,
) -> list[ProposedPress]:
    """Propose the presses that reduce the errors of later contacts most.

    The errors are those that the uncertainty of the film causes. The presses are chosen one after the other from a list
    of candidates. Each chosen press is the candidate that most reduces the sum of the squared errors that remain after
    the previous presses.

    Args:
        problem: The calibration problem.
        charges: Charges of a film and of similar films.
        count: Number of presses.
        film: Estimate of the film and of the noise; None before the first press.
        position_std_mm: Standard deviation of the positions, mm.
        force_std: Relative standard deviation of the forces.

    Returns:
        The presses in the order in which they are chosen, each with the errors that remain after it.
    """
    estimate = film or problem.film_before
    covariance = estimate.covariance  # C of all unknowns, such as the properties of the film
    candidates = _candidates(problem)  # contacts (x, y, F), shape (n, 3), mm and N
    contact_std = (position_std_mm, position_std_mm, force_std)
    # Derivatives H of the residuals of each candidate with respect to the unknowns, shape (n, n_electrode, n_unknown).
    # The contact of each press is eliminated, and the remaining residuals have the variance 1.
    _, jacobian = _linearise_at(estimate, charges, candidates, contact_std).eliminated()
    sensitivity = ContactSensitivity.of(estimate, charges, problem.domain)

    # The gain G contains the derivatives of x, y and ln F of later contacts with respect to errors of the unknowns.
    # Divide it by the errors that the noise causes, so that the squares of the three coordinates can be added. If the
    # unknowns have the covariance C, the sum of the squared errors of all contacts is the trace of G C G', which equals
    # the trace of C G' G. The product G' G is a sum over the contacts (n) and their coordinates (i), and has two axes
    # of unknowns (j and k).
    noise_std = np.sqrt(np.diagonal(sensitivity.noise_covariance, axis1=1, axis2=2).mean(axis=0))  # shape (3,)
    gain = sensitivity.film_gain / noise_std[:, None]
    squared_gain = np.einsum("nij,nik->jk", gain, gain)  # G' G, shape (n_unknown, n_unknown)
    proposed = []
    for _ in range(count):
        # A press reduces the covariance C by C H' (1 + H C H')^-1 H C (Kalman). It therefore reduces the sum of the
        # squared errors by the trace of (1 + H C H')^-1 H C G' G C H'. Compute this reduction for all candidates.
        cross_covariance = np.tensordot(jacobian, covariance, 1)  # H C, shape (n, n_electrode, n_unknown)
        residual_covariance = np.eye(jacobian.shape[1]) + cross_covariance @ jacobian.swapaxes(1, 2)  # 1 + H C H'
        numerator = np.tensordot(cross_covariance, squared_gain, 1) @ cross_covariance.swapaxes(1, 2)  # H C G' G C H'
        reduction = np.trace(np.linalg.solve(residual_covariance, numerator), axis1=1, axis2=2)  # shape (n,)

        # Choose the best candidate, and continue with the covariance after it.
        best = int(reduction.argmax())
        best_cross_covariance = cross_covariance[best]  # H C of this candidate
        covariance = covariance - best_cross_covariance.T @ np.linalg.solve(
            residual_covariance[best], best_cross_covariance
        )
        error = sensitivity.film_error(covariance)
        x, y, force = candidates[best].tolist()
        proposed.append(ProposedPress(x, y, force, error.position_mm, error.force_percent))
    return proposed


def spread_contacts(domain: Domain) -> Array:
    """Return `N_CONTACTS` contacts (x, y, F) that cover a domain evenly, shape (N_CONTACTS, 3), mm and N."""
    return Sweep(domain.radius, domain.force_range, N_CONTACTS).contacts()


def _candidates(problem: CalibrationProblem) -> Array:
    """Return the contacts (x, y, F) from which the next press of a calibration is chosen.

    The positions cover the working area evenly. Each position occurs with each of a few forces. Positions and forces
    are rounded to grids, so that a person can set them. No force causes a larger stress than the problem allows.

    Args:
        problem: The calibration problem, with the film, the probe, the working area and the largest allowed stress.

    Returns:
        Contacts, shape (n, 3), mm and N.
    """
    domain = problem.domain
    # The points of a sunflower cover a disk evenly. `N_CONTACTS` is the number of points.
    even_position = domain.radius * sunflower(N_CONTACTS)  # shape (N_CONTACTS, 2), mm
    # The addition replaces -0.0 by 0.0, which is easier to read.
    rounded_position = np.unique(GRID_MM * np.round(even_position / GRID_MM) + 0.0, axis=0)  # without duplicates
    distance = np.linalg.norm(rounded_position, axis=1)  # from the centre
    position = rounded_position[distance <= domain.radius]

    low, high = domain.force_range
    film_limit = force_within_stress(problem.sensor.film, problem.probe, problem.stress_limit, domain.force_range)
    high_within_stress = min(high, film_limit)
    # `CANDIDATE_FORCES` contains fractions of the range of forces on a logarithmic scale.
    force = log_spaced_forces(np.array(CANDIDATE_FORCES), (low, high_within_stress))
    force_step_N = min(GRID_N, low)  # a step above the smallest force would be too coarse for small forces
    rounded_force = np.clip(force_step_N * np.round(force / force_step_N), low, high_within_stress)
    return np.array([(x, y, force_N) for x, y in position for force_N in rounded_force])


def _linearise_at(
    film: FilmEstimate, charges: FilmCharges, contact: Array, contact_std: Sequence[float] = (UNKNOWN_STD,) * 3
) -> Linearised:
    """Compute the derivatives of the residuals of planned presses on a film.

    The presses are assumed to be made at equal intervals of time, because their real times are not yet known. Only the
    effect of a drift during the session depends on the times.

    The charges that will be measured are assumed to be those of the film, so that all residuals are zero.

    Args:
        film: The film and the noise of the charges.
        charges: Charges of a film and of similar films.
        contact: Contacts (x, y, F) of the presses, shape (n, 3), mm and N.
        contact_std: Standard deviations of x and y, mm, and of ln F. By default, the contacts are not measured.
    """
    log_contact = with_log_force(contact)
    time = np.linspace(-0.5, 0.5, len(contact))
    model = model_values(charges, film.layout, time, film.values, log_contact)
    data = PressData(
        charge=model.charge_pC,
        charge_std=film.noise.sigma(model.charge_pC),
        noise=film.noise,
        contact=log_contact,
        contact_std=np.broadcast_to(contact_std, contact.shape),
        time=time,
    )
    return Linearised.of(model, data, log_contact)
