"""Where the presses of a calibration really were: each contact adjusted between what the rig and the charges say.

A rig knows place and force of a press to its own uncertainty, or one of them not at all. For a given film the contact
is the one that fits charges and rig best; the residuals of both speak about the film.
"""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.serve.prediction.measured_presses import MeasuredPresses
from isocharge.simulate.forward.charge_map import ChargeMap, differences
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import sunflower
from isocharge.train.calibration.film_charges import CONTACT_STEPS, FilmCharges

ROUNDS, STEPS = 8, 8
"""How often the slopes are computed at most, and how many Gauss-Newton steps they serve for at most."""

SETTLED = 1e-4
"""Largest change of a contact, in its own standard deviations, at which the steps end."""

LONGEST_MM, LONGEST_LOG = 1.0, 0.5
"""Largest step of a position, mm, and of the logarithm of a force."""

PLACES = 300
"""Places among which the start of a press is chosen whose place is not known."""

VAGUE_FORCE = 1.5
"""Standard deviation of the logarithm of a force that nobody knows, about the middle of the forces."""


@dataclass(frozen=True)
class PressData:
    """Measured presses as least squares takes them.

    Attributes:
        charge: Shape (n, n_electrode), pC, 0 where unknown.
        weight: One over the standard deviation of each charge, 1/pC, 0 where unknown.
        contact: (x, y, ln F), shape (n, 3); the middle of the domain where unknown.
        contact_weight: One over the standard deviation of each, shape (n, 3); small where unknown.
        known: Which charges and coordinates were measured, shape (n, n_electrode + 3).
    """

    charge: Array
    weight: Array
    contact: Array
    contact_weight: Array
    known: Booleans

    @classmethod
    def of(cls, presses: MeasuredPresses, noise: NoiseModel, charges: FilmCharges) -> "PressData":
        """From presses on one of the films."""
        seen, domain = ~np.isnan(presses.charge_pC), charges.domain
        charge = np.where(seen, presses.charge_pC, 0.0)
        logs = np.column_stack([presses.contact[:, :2], np.log(presses.contact[:, 2])])
        rig_std = np.column_stack([presses.position_std_mm, presses.position_std_mm, presses.force_std])
        known = ~np.isnan(logs)
        return cls(
            charge=charge,
            weight=np.where(seen, 1.0 / noise.sigma(charge), 0.0),
            contact=np.where(known, logs, domain.centre),
            contact_weight=1.0 / np.where(known, rig_std, [domain.radius, domain.radius, VAGUE_FORCE]),
            known=np.column_stack([seen, known]),
        )

    def __getitem__(self, rows: Integers | Booleans) -> "PressData":
        return PressData(**{name: column[rows] for name, column in vars(self).items()})

    def __len__(self) -> int:
        return len(self.contact)

    def residual(self, film: ChargeMap, contact: Array) -> Array:
        """Residuals of charges and rig over their standard deviations at (x, y, ln F): (n, n_electrode + 3)."""
        of_charge = self.weight * (film.charges(with_force(contact)) - self.charge)
        return np.column_stack([of_charge, self.contact_weight * (contact - self.contact)])

    def slopes(self, by_contact: Array) -> Array:
        """Derivatives of the residual by the contact, from those of the charges, (n, n_electrode, 3)."""
        of_rig = self.contact_weight[:, :, None] * np.eye(3)
        return np.concatenate([self.weight[:, :, None] * by_contact, of_rig], axis=1)


@dataclass(frozen=True)
class AdjustedContacts:
    """Contacts adjusted to one film.

    Attributes:
        contact: (x, y, ln F), shape (n, 3).
        residual: As `PressData.residual`, shape (n, n_electrode + 3).
        slopes: Derivatives of the residual by the contact, shape (n, n_electrode + 3, 3).
    """

    contact: Array
    residual: Array
    slopes: Array

    @property
    def chi2(self) -> Array:
        """Sum of squared residuals of each press, shape (n,)."""
        chi2: Array = (self.residual**2).sum(axis=1)
        return chi2

    def projected(self, by_parameter: Array) -> Array:
        """Derivatives of the residual by the parameters once the contacts follow them (Golub and Pereyra 1973).

        Args:
            by_parameter: Derivatives at fixed contacts, shape (n, n_electrode + 3, n_parameter).
        """
        normal = np.einsum("nki,nkj->nij", self.slopes, self.slopes)
        moved = np.linalg.solve(normal, np.einsum("nki,nkp->nip", self.slopes, by_parameter))
        projected: Array = by_parameter - np.einsum("nki,nip->nkp", self.slopes, moved)
        return projected


def with_force(contact: Array) -> Array:
    """(x, y, ln F), shape (n, 3), to (x, y, F)."""
    return np.column_stack([contact[:, :2], np.exp(contact[:, 2])])


def adjust_contacts(
    charges: FilmCharges, parameters: Array, data: PressData, start: AdjustedContacts | Array
) -> AdjustedContacts:
    """The contacts that fit charges and rig best on one film.

    Args:
        charges: The films.
        parameters: The film, shape (n_parameter,).
        data: The presses.
        start: Contacts (x, y, ln F), shape (n, 3), or those adjusted to a neighbouring film, whose slopes serve for the
            first steps: charges alone are a seventh of the work.
    """
    film = charges.forward_map(parameters)

    def linearised(contact: Array) -> AdjustedContacts:
        by_contact = differences(film.charges, with_force(contact), CONTACT_STEPS)
        return AdjustedContacts(contact, data.residual(film, contact), data.slopes(by_contact))

    if isinstance(start, AdjustedContacts):
        adjusted = replace(start, residual=data.residual(film, start.contact))
    else:
        adjusted = linearised(_inside(charges, start))
    for _ in range(ROUNDS):
        adjusted, settled = _steps_with_these_slopes(charges, film, data, adjusted)
        if settled:
            break
        adjusted = linearised(adjusted.contact)
    return adjusted


def _steps_with_these_slopes(
    charges: FilmCharges, film: ChargeMap, data: PressData, adjusted: AdjustedContacts
) -> tuple[AdjustedContacts, bool]:
    """Gauss-Newton steps that keep the slopes, as long as they help; whether the contacts have settled."""
    normal = np.einsum("nki,nkj->nij", adjusted.slopes, adjusted.slopes)
    unit = np.sqrt(np.einsum("nii->ni", normal))
    share = np.ones(len(data))
    for _ in range(STEPS):
        gradient = np.einsum("nki,nk->ni", adjusted.slopes, adjusted.residual)
        step = -np.linalg.solve(normal, gradient[..., None])[..., 0]
        size = np.maximum(np.hypot(step[:, 0], step[:, 1]) / LONGEST_MM, np.abs(step[:, 2]) / LONGEST_LOG)
        step *= (share / np.maximum(size, 1.0))[:, None]
        trial = _inside(charges, adjusted.contact + step)
        residual = data.residual(film, trial)
        change = (residual**2).sum(axis=1) - adjusted.chi2
        better = change <= 1e-9 * (1.0 + adjusted.chi2)
        moved = np.where(better, np.abs((trial - adjusted.contact) * unit).max(axis=1), 0.0)
        adjusted = replace(
            adjusted,
            contact=np.where(better[:, None], trial, adjusted.contact),
            residual=np.where(better[:, None], residual, adjusted.residual),
        )
        worse = ~better & (np.abs(step * unit).max(axis=1) > SETTLED)
        if worse.any():
            if share.min() < 0.1:
                break
            share = np.where(worse, 0.3 * share, share)
        elif moved.max() < SETTLED:
            return adjusted, True
    return adjusted, False


def _inside(charges: FilmCharges, contact: Array) -> Array:
    """(x, y, ln F) moved into the domain of all films."""
    inside = charges.into_domain(with_force(np.clip(contact, -1e3, 1e2)))
    return np.column_stack([inside[:, :2], np.log(inside[:, 2])])


def search_places(charges: FilmCharges, parameters: Array, data: PressData) -> Array:
    """Where to start: (x, y, ln F), shape (n, 3); the place whose ratios of charges are nearest where unknown.

    Ratios hardly depend on the film's stiffness and coefficients, which are not known yet.
    """
    start, unknown = data.contact.copy(), ~data.known[:, -3:-1].all(axis=1)
    if not unknown.any():
        return start
    lattice = charges.domain.radius * sunflower(PLACES)
    force = np.exp(np.median(data.contact[unknown, 2]))
    at = np.column_stack([lattice.real, lattice.imag, np.full(PLACES, force)])
    candidates = np.log(charges.charges(parameters, at))
    for row in np.flatnonzero(unknown):
        seen = data.known[row, :-3]
        measured = np.log(np.maximum(data.charge[row, seen], 1.0))
        ratios = (measured - measured.mean()) - (candidates[:, seen] - candidates[:, seen].mean(axis=1)[:, None])
        start[row, :2] = at[int(np.argmin((ratios**2).sum(axis=1))), :2]
    return start
