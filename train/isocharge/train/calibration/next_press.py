"""Where to press next: the presses that would lower the error of contacts most.

A press at a place adds information about the film, however it turns out; the error left by not knowing the film
follows from the information alone (linearised, at the film as known by now). The presses are chosen one after the
other, each the best given those before (A-optimal design, greedily; Pukelsheim 1993).
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import sunflower
from isocharge.train.calibration.contact_error import ContactSensitivity
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.noise import sigma_pC

PLACES = 80
"""Places that are compared."""

FORCES = (0.15, 0.45, 0.95)
"""Forces that are compared, as shares of the range's logarithm from its lower end."""

ROUND_MM, ROUND_N = 0.5, 0.05
"""Proposed presses lie on this grid, so that a person can make them."""

AVOIDED_MM = 1.0
"""Distance from a place to avoid within which nothing is proposed, mm."""


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
        """(x_mm, y_mm, force_N), shape (3,)."""
        return np.array([self.x_mm, self.y_mm, self.force_N])


def information_of(
    charges: FilmCharges, parameters: Array, contact: Array, noise: NoiseModel, position_std_mm: float, force_std: float
) -> Array:
    """What each press says of the parameters over their prior standard deviations.

    Args:
        charges: The films.
        parameters: Where the map is linearised, shape (n_parameter,).
        contact: Presses (x_mm, y_mm, force_N), shape (n, 3).
        noise: Of the charges.
        position_std_mm: How well a press's place is known, mm; infinite if not at all.
        force_std: How well its force is known, share.

    Returns:
        Fisher information, shape (n, n_parameter, n_parameter).
    """
    by_contact = charges.by_contact(charges.forward_map(parameters), contact)
    weight = 1.0 / sigma_pC(noise, charges.charge_pC(parameters, contact))[:, :, None]
    slopes, by_film = weight * by_contact, weight * charges.by_parameter(parameters, contact, by_contact)
    known = np.diag([position_std_mm**-2.0, position_std_mm**-2.0, force_std**-2.0])
    normal = np.einsum("nki,nkj->nij", slopes, slopes) + known
    across = np.einsum("nki,nkp->nip", slopes, by_film)
    at_known_contact: Array = np.einsum("nkp,nkq->npq", by_film, by_film)
    information: Array = at_known_contact - np.einsum("nip,nij,njq->npq", across, np.linalg.inv(normal), across)
    return information


def next_presses(
    charges: FilmCharges,
    domain: ContactDomain,
    noise: NoiseModel,
    count: int,
    parameters: Array | None = None,
    covariance: Array | None = None,
    *,
    position_std_mm: float = 0.1,
    force_std: float = 0.01,
    avoid_mm: Array | None = None,
) -> list[ProposedPress]:
    """The presses to make next, best first.

    Args:
        charges: The films.
        domain: Where presses can be made, and where contacts shall be right.
        noise: Of the charges.
        count: How many.
        parameters: The film as known by now, shape (n_parameter,); the prior's mean before the first press.
        covariance: Of the parameters over their prior standard deviations; the prior's before the first press.
        position_std_mm: How well the presses' places will be known, mm.
        force_std: How well their forces will be known, share.
        avoid_mm: Places that cannot be pressed, shape (n, 2), mm; nothing within `AVOIDED_MM` of them is proposed.

    Raises:
        PressError: If every place is to be avoided.
    """
    parameters = charges.prior.mean if parameters is None else parameters
    covariance = np.eye(parameters.size) if covariance is None else covariance
    sensitivity = ContactSensitivity.at(charges, parameters, domain, noise)
    cost, candidates = sensitivity.cost(), _candidates(domain, np.empty((0, 2)) if avoid_mm is None else avoid_mm)
    offered = information_of(charges, parameters, candidates, noise, position_std_mm, force_std)
    proposed, information = [], np.linalg.inv(covariance)
    for _ in range(count):
        after = np.linalg.inv(information + offered)
        best = int(np.argmin(np.einsum("pq,nqp->n", cost, after)))
        information = information + offered[best]
        left = sensitivity.left(after[best])
        x_mm, y_mm, force_N = candidates[best].tolist()
        proposed.append(ProposedPress(x_mm, y_mm, force_N, left.position_mm, left.force_percent))
    return proposed


def _candidates(domain: ContactDomain, avoid_mm: Array) -> Array:
    """Presses to compare, on a grid that a person can set, shape (n, 3)."""
    at, (low, high) = domain.radius_mm * sunflower(PLACES), domain.force_range_N
    places = np.unique(np.round(np.column_stack([at.real, at.imag]) / ROUND_MM) * ROUND_MM, axis=0)
    places = places[np.hypot(*places.T) <= domain.radius_mm]
    distance_mm = np.hypot(*np.moveaxis(places[:, None] - avoid_mm, 2, 0))
    places = places[(distance_mm > AVOIDED_MM).all(axis=1)]
    if not len(places):
        raise PressError(f"no place within {domain.radius_mm:.3g} mm of the centre is left to press; skip fewer")
    forces = np.maximum(np.round(low * (high / low) ** np.array(FORCES) / ROUND_N) * ROUND_N, ROUND_N)
    return np.array([(x, y, force) for x, y in places for force in np.unique(np.clip(forces, low, high))])
