"""Where the presses of a calibration really were: each contact adjusted between what the rig and the charges say.

A rig knows place and force of a press to its own uncertainty, or one of them not at all. For a given film the contact
is the one that fits charges and rig best; what is left over of both speaks about the film.
"""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import sunflower
from isocharge.train.calibration.film_charges import FilmCharges, charges_of
from isocharge.train.data.noise import sigma_pC

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
class RigData:
    """Measured presses as least squares takes them.

    Attributes:
        charge_pC: Shape (n, n_electrode), 0 where unknown.
        weight: One over the standard deviation of each charge, 1/pC, 0 where unknown.
        contact: (x_mm, y_mm, ln F), shape (n, 3); the middle of the domain where unknown.
        contact_weight: One over the standard deviation of each, shape (n, 3); small where unknown.
        known: Which charges and coordinates were measured, shape (n, n_electrode + 3).
    """

    charge_pC: Array
    weight: Array
    contact: Array
    contact_weight: Array
    known: np.ndarray

    @classmethod
    def of(
        cls,
        contact: Array,
        charge_pC: Array,
        position_std_mm: Array,
        force_std: Array,
        noise: NoiseModel,
        charges: FilmCharges,
    ) -> "RigData":
        """From presses (x_mm, y_mm, force_N), NaN where unknown, and charges, NaN where unknown."""
        seen = ~np.isnan(charge_pC)
        charge = np.where(seen, charge_pC, 0.0)
        low, high = np.log(charges.force_range_N)
        logs = np.column_stack([contact[:, :2], np.log(contact[:, 2])])
        known = ~np.isnan(logs)
        middle = np.array([0.0, 0.0, 0.5 * (low + high)])
        std = np.where(
            known,
            np.column_stack([position_std_mm, position_std_mm, force_std]),
            [charges.radius_mm, charges.radius_mm, VAGUE_FORCE],
        )
        return cls(
            charge_pC=charge,
            weight=np.where(seen, 1.0 / sigma_pC(noise, charge), 0.0),
            contact=np.where(known, logs, middle),
            contact_weight=1.0 / std,
            known=np.column_stack([seen, known]),
        )

    def __getitem__(self, rows: np.ndarray) -> "RigData":
        return RigData(
            self.charge_pC[rows], self.weight[rows], self.contact[rows], self.contact_weight[rows], self.known[rows]
        )

    def __len__(self) -> int:
        return len(self.contact)


@dataclass(frozen=True)
class AdjustedContacts:
    """Contacts adjusted to one film.

    Attributes:
        contact: (x_mm, y_mm, ln F), shape (n, 3).
        residual: Whitened misses of charges and rig, shape (n, n_electrode + 3).
        slopes: Derivatives of the residual by the contact, shape (n, n_electrode + 3, 3).
    """

    contact: Array
    residual: Array
    slopes: Array

    @property
    def chi2(self) -> Array:
        """Sum of squared misses of each press, shape (n,)."""
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


def adjust_contacts(
    charges: FilmCharges, parameters: Array, data: RigData, start: AdjustedContacts | Array
) -> AdjustedContacts:
    """The contacts that fit charges and rig best on one film.

    Args:
        charges: The films.
        parameters: The film, shape (n_parameter,).
        data: The presses.
        start: Contacts (x_mm, y_mm, ln F), shape (n, 3), or those adjusted to a neighbouring film, whose slopes serve
            for the first steps: charges alone are a seventh of the work.
    """
    forward_map = charges.forward_map(parameters)
    if isinstance(start, AdjustedContacts):
        adjusted = replace(start, residual=_residual(forward_map, data, start.contact))
    else:
        adjusted = linearised(charges, forward_map, data, _inside(charges, start))
    for _ in range(ROUNDS):
        adjusted, settled = _steps_with_these_slopes(charges, forward_map, data, adjusted)
        if settled:
            break
        adjusted = linearised(charges, forward_map, data, adjusted.contact)
    return adjusted


def _steps_with_these_slopes(
    charges: FilmCharges, forward_map: ForwardMap, data: RigData, adjusted: AdjustedContacts
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
        residual = _residual(forward_map, data, trial)
        change = (residual**2).sum(axis=1) - adjusted.chi2
        better = change <= 1e-9 * (1.0 + adjusted.chi2)
        moved = np.where(better, np.abs((trial - adjusted.contact) * unit).max(axis=1), 0.0)
        adjusted = replace(
            adjusted,
            contact=np.where(better[:, None], trial, adjusted.contact),
            residual=np.where(better[:, None], residual, adjusted.residual),
        )
        if not better.all():
            worse = ~better & (np.abs(step * unit).max(axis=1) > SETTLED)
            if worse.any() and share.min() < 0.1:
                return adjusted, False
            share = np.where(worse, 0.3 * share, share)
            if worse.any():
                continue
        if moved.max() < SETTLED:
            return adjusted, True
    return adjusted, False


def _inside(charges: FilmCharges, contact: Array) -> Array:
    """(x_mm, y_mm, ln F) moved into the domain of all films."""
    inside = charges.into_domain(_with_force(np.clip(contact, -1e3, 1e2)))
    return np.column_stack([inside[:, :2], np.log(inside[:, 2])])


def linearised(charges: FilmCharges, forward_map: ForwardMap, data: RigData, contact: Array) -> AdjustedContacts:
    """Misses and slopes at contacts (x_mm, y_mm, ln F), shape (n, 3), on one film."""
    at = AdjustedContacts(contact, _residual(forward_map, data, contact), np.empty(0))
    return with_slopes(at, data, charges.by_contact(forward_map, _with_force(contact)))


def with_slopes(adjusted: AdjustedContacts, data: RigData, by_contact: Array) -> AdjustedContacts:
    """The same contacts with slopes from the derivatives of the charges by the contact, (n, n_electrode, 3)."""
    of_rig = data.contact_weight[:, :, None] * np.broadcast_to(np.eye(3), (len(data), 3, 3))
    slopes = np.concatenate([data.weight[:, :, None] * by_contact, of_rig], axis=1)
    return replace(adjusted, slopes=slopes)


def _residual(forward_map: ForwardMap, data: RigData, contact: Array) -> Array:
    by_charge = data.weight * (charges_of(forward_map, _with_force(contact)) - data.charge_pC)
    return np.column_stack([by_charge, data.contact_weight * (contact - data.contact)])


def _with_force(contact: Array) -> Array:
    """(x_mm, y_mm, ln F) to (x_mm, y_mm, force_N)."""
    return np.column_stack([contact[:, :2], np.exp(contact[:, 2])])


def search_places(charges: FilmCharges, parameters: Array, data: RigData) -> Array:
    """Where to start: (x_mm, y_mm, ln F), shape (n, 3); the place whose ratios of charges are nearest where unknown.

    Ratios hardly depend on the film's stiffness and coefficients, which are not known yet.
    """
    start, unknown = data.contact.copy(), ~data.known[:, -3:-1].all(axis=1)
    if not unknown.any():
        return start
    lattice = charges.radius_mm * sunflower(PLACES)
    force = np.exp(np.median(data.contact[unknown, 2]))
    at = np.column_stack([lattice.real, lattice.imag, np.full(PLACES, force)])
    candidates = np.log(charges.charge_pC(parameters, at))
    for row in np.flatnonzero(unknown):
        seen = data.known[row, : data.charge_pC.shape[1]]
        measured = np.log(np.maximum(data.charge_pC[row, seen], 1.0))
        ratios = (measured - measured.mean()) - (candidates[:, seen] - candidates[:, seen].mean(axis=1)[:, None])
        best = int(np.argmin((ratios**2).sum(axis=1)))
        start[row, :2] = at[best, :2]
    return start
