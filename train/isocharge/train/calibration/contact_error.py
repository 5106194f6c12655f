"""The error of contacts that is left by not knowing the film, and the presses that would lower it most.

An estimator that takes a film for another by dp errs by the contact that explains the difference of the charges best,

    dc = -G dp,   G = (J' W J)^-1 J' W P,

J and P the derivatives of the charges by contact and parameters, W one over the noise variance. With C the covariance
of the parameters the error left is G C G'; noise alone leaves (J' W J)^-1, the Cramer-Rao limit. To J' W J belongs what
is known of a contact beforehand, that it lies in the working area and the range of forces: no estimator errs by more,
also where the map folds.

A press adds information about the film, however it turns out, so the best next press is known before it is made.
Presses are chosen one after the other, each the best given those before (A-optimal design, greedily; Pukelsheim 1993).
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.serve.prediction.measured_presses import FORCE_STD, POSITION_STD_MM
from isocharge.simulate.numerics.disk import sunflower
from isocharge.train.calibration.contacts import projected
from isocharge.train.calibration.problem import CalibrationProblem, FilmEstimate

CONTACTS = 200
"""Contacts over which the error is taken."""

PLACES = 80
"""Places of presses that are compared."""

FORCES = (0.15, 0.45, 0.95)
"""Forces of presses that are compared, as shares of the range's logarithm from its lower end."""

ROUND_MM, ROUND_N = 0.5, 0.05
"""Proposed presses lie on this grid, so that a person can make them."""

AVOIDED_MM = 1.0
"""Distance from a place to avoid within which nothing is proposed, mm."""


@dataclass(frozen=True)
class ContactError:
    """Errors of contacts.

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
        """From covariances of (x, y, ln F), shape (n, 3, 3)."""
        squares = covariance[:, 0, 0] + covariance[:, 1, 1]
        return cls(float(np.sqrt(squares.mean())), 100.0 * float(np.sqrt(covariance[:, 2, 2].mean())), np.sqrt(squares))


@dataclass(frozen=True)
class ContactSensitivity:
    """How contacts answer to noise and to a wrong film, linearised at one film.

    Attributes:
        contact: (x, y, F), shape (n, 3), mm and N.
        by_parameter: -G: (x, y, ln F) by the parameters over their prior standard deviations, and by the coefficients
            of the discrepancy if there is one, shape (n, 3, n_unknown).
        noise: Covariance of (x, y, ln F) by noise alone, shape (n, 3, 3).
        misfit: Derivatives of what no contact explains of the charges by the same, shape (n, n_electrode, n_unknown),
            in units of the noise.
    """

    contact: Array
    by_parameter: Array
    noise: Array
    misfit: Array

    @classmethod
    def at(cls, problem: CalibrationProblem, parameters: Array) -> "ContactSensitivity":
        """At contacts spread over the domain, on one film."""
        domain = problem.domain
        at, (low, high) = domain.radius * sunflower(CONTACTS), domain.force_range
        force = low * (high / low) ** ((0.5 + np.arange(CONTACTS)) * 0.6180339887 % 1.0)
        contact = np.column_stack([at.real, at.imag, force])
        slopes, by_film = _whitened_slopes(problem, parameters, contact)
        spread = np.array([0.5 * domain.radius, 0.5 * domain.radius, max(np.log(high / low), 0.1) / np.sqrt(12.0)])
        covariance = np.linalg.inv(np.einsum("nki,nkj->nij", slopes, slopes) + np.diag(spread**-2))
        by_parameter = -np.einsum("nij,nkj,nkp->nip", covariance, slopes, by_film)
        return cls(contact, by_parameter, covariance, projected(by_film, slopes))

    def contact_error(self, covariance: Array) -> ContactError:
        """The error left with a covariance of what is unknown of the film."""
        return ContactError.of(self.contact_covariance(covariance))

    def contact_covariance(self, covariance: Array) -> Array:
        """The same as covariances of (x, y, ln F), shape (n, 3, 3)."""
        return np.asarray(self.by_parameter @ covariance @ self.by_parameter.swapaxes(1, 2))

    @property
    def noise_error(self) -> ContactError:
        """The error that noise alone leaves."""
        return ContactError.of(self.noise)

    def cost(self) -> Array:
        """Matrix S with mean relative squared error tr(S C), shape (n_parameter, n_parameter).

        Position and force count in units of the error that noise alone leaves.
        """
        unit = self.noise_error
        scaled = self.by_parameter / np.array([[unit.position_mm], [unit.position_mm], [0.01 * unit.force_percent]])
        return np.asarray(np.einsum("nip,niq->pq", scaled, scaled) / len(scaled))


def _whitened_slopes(problem: CalibrationProblem, parameters: Array, contact: Array) -> tuple[Array, Array]:
    """Derivatives of the charges over their noise: by the contact, and by the parameters over their prior's."""
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
    """What each press says of the parameters over their prior standard deviations.

    Args:
        problem: The films.
        parameters: Where the map is linearised, as `FilmCharges.film` takes it.
        contact: Presses (x, y, F), shape (n, 3), mm and N.
        position_std_mm: How well a press's place is known, mm; infinite if not at all.
        force_std: How well its force is known, share.

    Returns:
        Fisher information, shape (n, n_unknown, n_unknown).
    """
    rows = _rows_of(problem, parameters, contact, position_std_mm, force_std)
    return np.asarray(rows.swapaxes(1, 2) @ rows)


def _rows_of(
    problem: CalibrationProblem, parameters: Array, contact: Array, position_std_mm: float, force_std: float
) -> Array:
    """Roots of the information: R with R' R, shape (n, n_electrode + 3, n_unknown)."""
    slopes, by_film = _whitened_slopes(problem, parameters, contact)
    rig = np.broadcast_to(
        np.diag([1.0 / position_std_mm, 1.0 / position_std_mm, 1.0 / force_std]), (len(contact), 3, 3)
    )
    still = np.zeros((len(contact), 3, by_film.shape[2]))
    return projected(np.concatenate([by_film, still], axis=1), np.concatenate([slopes, rig], axis=1))


@dataclass(frozen=True)
class ProposedPress:
    """A press to make.

    Attributes:
        x_mm: Where.
        y_mm: Where.
        force_N: How hard.
        position_mm: Root-mean-square position error that is expected to be left by the film after it, mm.
        force_percent: The same of the force, %.
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
    """The presses to make next, best first.

    Args:
        problem: The films.
        count: How many.
        film: What is known by now: the posterior of a result; `problem.expected` if absent.
        position_std_mm: How well the presses' places will be known, mm.
        force_std: How well their forces will be known, share.
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
    cost, proposed, covariance = sensitivity.cost(), [], film.unknown_covariance
    for _ in range(count):
        reached = offered @ covariance  # a press lowers the covariance by reached' (1 + R C R')^-1 reached
        inner = np.eye(offered.shape[1]) + reached @ offered.swapaxes(1, 2)
        gain = np.einsum("nij,nji->n", np.linalg.inv(inner), reached @ cost @ reached.swapaxes(1, 2))
        best = int(np.argmax(gain))
        covariance = covariance - reached[best].T @ np.linalg.solve(inner[best], reached[best])
        left = sensitivity.contact_error(covariance)
        x, y, force = candidates[best].tolist()
        proposed.append(ProposedPress(x, y, force, left.position_mm, left.force_percent))
    return proposed


def _candidates(radius: float, force_range: tuple[float, float], avoid_mm: Array) -> Array:
    """Presses to compare, on a grid that a person can set, shape (n, 3)."""
    at, (low, high) = radius * sunflower(PLACES), force_range
    places = np.unique(np.round(np.column_stack([at.real, at.imag]) / ROUND_MM) * ROUND_MM, axis=0)
    distance = np.hypot(*np.moveaxis(places[:, None] - avoid_mm, 2, 0))
    places = places[(distance > AVOIDED_MM).all(axis=1) & (np.hypot(*places.T) <= radius)]
    if not len(places):
        raise PressError(f"no place within {radius:.3g} mm of the centre is left to press; skip fewer")
    forces = np.maximum(np.round(low * (high / low) ** np.array(FORCES) / ROUND_N) * ROUND_N, ROUND_N)
    return np.array([(x, y, force) for x, y in places for force in np.unique(np.clip(forces, low, high))])
