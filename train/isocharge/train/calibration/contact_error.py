"""The error of contacts that is left by not knowing the film: linearised, over the working area and the forces.

An estimator that takes a film for another by dp errs by the contact that explains the difference of the charges best,

    dc = -G dp,   G = (J' W J)^-1 J' W P,

J and P the derivatives of the charges by contact and parameters, W one over the noise variance. With C the covariance
of the parameters the error left is G C G'; noise alone leaves (J' W J)^-1, the Cramer-Rao limit. To J' W J belongs what
is known of a contact beforehand, that it lies in the working area and the range of forces: no estimator errs by more,
also where the map folds.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import sunflower
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.noise import sigma_pC

CONTACTS = 200
"""Contacts over which the error is taken."""


def spread_contacts(domain: ContactDomain, count: int = CONTACTS) -> Array:
    """Contacts (x_mm, y_mm, force_N) spread over a domain, shape (count, 3): forces even in the logarithm."""
    at, (low, high) = domain.radius_mm * sunflower(count), domain.force_range_N
    force = low * (high / low) ** ((0.5 + np.arange(count)) * 0.6180339887 % 1.0)
    return np.column_stack([at.real, at.imag, force])


def _spread(domain: ContactDomain) -> Array:
    """Standard deviations of (x_mm, y_mm, ln F) over a domain, shape (3,)."""
    low, high = np.log(domain.force_range_N)
    return np.array([0.5 * domain.radius_mm, 0.5 * domain.radius_mm, max(high - low, 0.1) / np.sqrt(12.0)])


@dataclass(frozen=True)
class ContactSensitivity:
    """How contacts answer to noise and to a wrong film, linearised at one film.

    Attributes:
        contact: (x_mm, y_mm, force_N), shape (n, 3).
        by_parameter: -G: (x_mm, y_mm, ln F) by the parameters over their prior standard deviations, shape
            (n, 3, n_parameter).
        noise: Covariance of (x_mm, y_mm, ln F) by noise alone, shape (n, 3, 3).
    """

    contact: Array
    by_parameter: Array
    noise: Array

    @classmethod
    def at(
        cls, charges: FilmCharges, parameters: Array, domain: ContactDomain, noise: NoiseModel
    ) -> "ContactSensitivity":
        """At contacts spread over a domain, on one film."""
        contact = spread_contacts(domain)
        forward_map = charges.forward_map(parameters)
        by_contact = charges.by_contact(forward_map, contact)
        weight = 1.0 / sigma_pC(noise, charges.charge_pC(parameters, contact))[:, :, None]
        slopes = weight * by_contact
        information = np.einsum("nki,nkj->nij", slopes, slopes) + np.diag(_spread(domain) ** -2)
        covariance = np.linalg.inv(information)
        by_film = weight * charges.by_parameter(parameters, contact, by_contact)
        answer = -np.einsum("nij,nkj,nkp->nip", covariance, slopes, by_film)
        return cls(contact, answer, covariance)

    def left(self, covariance: Array) -> "ContactError":
        """The error left with a covariance of the parameters over their prior standard deviations."""
        return ContactError.of(np.einsum("nip,pq,njq->nij", self.by_parameter, covariance, self.by_parameter))

    def of_noise(self) -> "ContactError":
        """The error that noise alone leaves."""
        return ContactError.of(self.noise)

    def cost(self) -> Array:
        """Matrix S with mean relative squared error tr(S C), shape (n_parameter, n_parameter).

        Position and force count in units of the error that noise alone leaves.
        """
        unit = self.of_noise()
        scale = np.array([1.0 / unit.position_mm, 1.0 / unit.position_mm, 100.0 / unit.force_percent])
        scaled = self.by_parameter * scale[:, None]
        cost: Array = np.einsum("nip,niq->pq", scaled, scaled) / len(scaled)
        return cost


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
        """From covariances of (x_mm, y_mm, ln F), shape (n, 3, 3)."""
        squares = covariance[:, 0, 0] + covariance[:, 1, 1]
        return cls(float(np.sqrt(squares.mean())), 100.0 * float(np.sqrt(covariance[:, 2, 2].mean())), np.sqrt(squares))
