"""Where the presses of a calibration really were: each contact adjusted between what the rig and the charges say.

A rig knows place and force of a press to its own uncertainty, or one of them not at all. For a given film the contact
is the one that fits charges and rig best; the residuals of both speak about the film.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.serve.prediction.measured_presses import MeasuredPresses
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import sunflower
from isocharge.simulate.numerics.disk_least_squares import minimise
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values
from isocharge.train.calibration.film_charges import CONTACT_STEPS, FilmCharges

PLACES = 300
"""Places among which the start of a press is chosen whose place is not known."""

LEAST_CHANGE = 1e-5
"""Least change of a press's chi2 that is worth another step of its contact, relative to 1 + chi2."""

VAGUE_FORCE = 1.5
"""Standard deviation of the logarithm of a force that nobody knows, about the middle of the forces."""

NUISANCES = 3
"""What a session has besides a film: change of the pretension with temperature, offset and drift of the charges."""

APART_MPa = 0.5
"""Distance of the pretensions between which charges are interpolated where the film's differs from press to press."""


@dataclass(frozen=True)
class PressData:
    """Measured presses as least squares takes them.

    Attributes:
        charge: Shape (n, n_electrode), pC, 0 where unknown.
        weight: One over the standard deviation of each charge, 1/pC, 0 where unknown.
        contact: (x, y, ln F), shape (n, 3); the middle of the domain where unknown.
        contact_weight: One over the standard deviation of each, shape (n, 3); small where unknown.
        known: Which charges and coordinates were measured, shape (n, n_electrode + 3).
        turn: When each press was made, from -1/2, the first, to 1/2, the last, shape (n,).
        warmer: How much warmer each was than their mean, K, shape (n,).
        tauter: Pretension of each over that of the film, MPa, shape (n,).
    """

    charge: Array
    weight: Array
    contact: Array
    contact_weight: Array
    known: Booleans
    turn: Array
    warmer: Array
    tauter: Array

    @classmethod
    def of(cls, presses: MeasuredPresses, noise: NoiseModel, charges: FilmCharges) -> "PressData":
        """From presses on one of the films."""
        seen, domain = ~np.isnan(presses.charge_pC), charges.domain
        charge = np.where(seen, presses.charge_pC, 0.0)
        logs = np.column_stack([presses.contact[:, :2], np.log(presses.contact[:, 2])])
        rig_std = np.column_stack([presses.position_std_mm, presses.position_std_mm, presses.force_std])
        known, temperature = ~np.isnan(logs), temperatures(presses)
        return cls(
            charge=charge,
            weight=np.where(seen, 1.0 / noise.sigma(charge), 0.0),
            contact=np.where(known, logs, domain.centre),
            contact_weight=1.0 / np.where(known, rig_std, [domain.radius, domain.radius, VAGUE_FORCE]),
            known=np.column_stack([seen, known]),
            turn=np.linspace(-0.5, 0.5, len(presses)) if len(presses) > 1 else np.zeros(1),
            warmer=temperature - temperature.mean(),
            tauter=np.zeros(len(presses)),
        )

    def __getitem__(self, rows: Integers | Booleans) -> "PressData":
        return PressData(**{name: column[rows] for name, column in vars(self).items()})

    def __len__(self) -> int:
        return len(self.contact)

    def without(self, nuisances: Array) -> "PressData":
        """The presses as on a film of one temperature, without offset and drift of the charges.

        Args:
            nuisances: Change of the pretension, MPa/K, common offset, pC, drift over the session, a share.
        """
        per_kelvin, offset, drift = nuisances
        charge = self.charge - offset - drift * self.turn[:, None] * self.charge
        return replace(self, charge=charge, tauter=per_kelvin * self.warmer)

    def scattered(self, share: float) -> "PressData":
        """The presses with forces that are known less well than they are said to, by a share."""
        weight = self.contact_weight.copy()
        weight[:, 2] = 1.0 / np.hypot(1.0 / weight[:, 2], share)
        return replace(self, contact_weight=weight)

    def by_force(self) -> Array:
        """Derivative of the residual by the logarithm of the stated force, shape (n, n_electrode + 3)."""
        rows = np.zeros(self.known.shape)
        rows[:, -1] = -self.contact_weight[:, 2]
        return rows

    def of_films(self, pretension: float, bounds: tuple[float, float]) -> tuple[Array, Array]:
        """Pretensions (k,) between which the charges of presses are interpolated, and the shares of each, (n, k)."""
        own = np.clip(pretension + self.tauter, *bounds)
        low, high = float(own.min(initial=np.inf)), float(own.max(initial=-np.inf))
        if high <= low:
            return np.array([low]), np.ones((len(self), 1))
        nodes = chebyshev_nodes(2 + int(np.ceil((high - low) / APART_MPa)), low, high)
        return nodes, lagrange_values(nodes, barycentric_weights(nodes), own)

    def by_nuisance(self) -> Array:
        """Derivatives of the residual by offset and drift, shape (n, n_electrode + 3, 2)."""
        by_charge = np.stack([np.ones_like(self.charge), self.turn[:, None] * self.charge], axis=2)
        return np.concatenate([self.weight[:, :, None] * by_charge, np.zeros((len(self), 3, 2))], axis=1)

    def residual(self, charge: Array, contact: Array) -> Array:
        """Residuals of a film's charges and of the rig over their deviations at (x, y, ln F): (n, n_electrode + 3)."""
        of_charge = self.weight * (charge - self.charge)
        return np.column_stack([of_charge, self.contact_weight * (contact - self.contact)])

    def slopes(self, by_contact: Array) -> Array:
        """Derivatives of the residual by the contact, from those of the charges, (n, n_electrode, 3)."""
        of_rig = self.contact_weight[:, :, None] * np.eye(3)
        return np.concatenate([self.weight[:, :, None] * by_contact, of_rig], axis=1)


def temperatures(presses: MeasuredPresses) -> Array:
    """Of every press, shape (n,), degrees Celsius: between readings in the order of the presses; 0 without any."""
    if presses.temperature_C is None or not presses.knows_temperature:
        return np.zeros(len(presses))
    number, seen = np.arange(len(presses)), np.isfinite(presses.temperature_C)
    return np.interp(number, number[seen], presses.temperature_C[seen])


class AdjustedContacts(NamedTuple):
    """Contacts adjusted to one film.

    Attributes:
        contact: (x, y, ln F), shape (n, 3).
        residual: As `PressData.residual`, shape (n, n_electrode + 3).
    """

    contact: Array
    residual: Array

    @property
    def chi2(self) -> Array:
        """Sum of squared residuals of each press, shape (n,)."""
        return np.asarray((self.residual**2).sum(axis=1))


def projected(by_parameter: Array, slopes: Array) -> Array:
    """Derivatives of the residual by the parameters once the contacts follow them (Golub and Pereyra 1973).

    Args:
        by_parameter: Derivatives at fixed contacts, shape (n, n_electrode + 3, n_parameter).
        slopes: Derivatives by the contacts, shape (n, n_electrode + 3, 3).
    """
    normal = np.einsum("nki,nkj->nij", slopes, slopes)
    moved = np.linalg.solve(normal, np.einsum("nki,nkp->nip", slopes, by_parameter))
    return np.asarray(by_parameter - np.einsum("nki,nip->nkp", slopes, moved))


def with_force(contact: Array) -> Array:
    """(x, y, ln F), shape (n, 3), to (x, y, F)."""
    return np.column_stack([contact[:, :2], np.exp(contact[:, 2])])


def adjust_contacts(charges: FilmCharges, parameters: Array, data: PressData, start: Array) -> AdjustedContacts:
    """The contacts that fit charges and rig best on one film.

    Args:
        charges: The films.
        parameters: The film, as `FilmCharges.film` takes it.
        data: The presses.
        start: Contacts (x, y, ln F), shape (n, 3).
    """
    count, domain, begin = len(charges.prior.names), charges.domain, with_force(start)
    films, shares = films_of(charges, parameters, data)
    maps = [charges.forward_map(film[:count]) for film in films]
    factor, steeper = np.ones_like(data.charge), np.zeros((*data.charge.shape, 3))
    if parameters[count:].any():  # what a film has besides its parameters is smooth: linear about the start
        factor, steeper = _between([_linearised(partial(charges.factor, film), begin) for film in films], shares)

    def residuals(rows: Integers, unit: Array) -> tuple[Array, Array]:
        contact, presses = unit * domain.scale + domain.centre, data[rows]
        at, change = with_force(contact), (contact - start[rows])[:, None]
        share = factor[rows] + (steeper[rows] * change).sum(axis=2)
        charge, by_contact = _between([_linearised(forward_map.charges, at) for forward_map in maps], shares[rows])
        slopes = presses.slopes(share[:, :, None] * by_contact + charge[:, :, None] * steeper[rows])
        return presses.residual(share * charge, contact), (slopes * domain.scale).swapaxes(1, 2)

    unit, residual = minimise(residuals, (start - domain.centre) / domain.scale, least=LEAST_CHANGE)
    return AdjustedContacts(unit * domain.scale + domain.centre, residual)


def films_of(charges: FilmCharges, parameters: Array, data: PressData) -> tuple[list[Array], Array]:
    """The films of other pretensions between which every press is, and the shares of each, shape (n, k)."""
    low, high = charges.prior.bounds
    nodes, shares = data.of_films(float(parameters[0]), (float(low[0]), float(high[0])))
    return [np.append(node, parameters[1:]) for node in nodes], shares


def _between(of_films: list[tuple[Array, Array]], shares: Array) -> tuple[Array, Array]:
    """Values (n, n_electrode) and derivatives of presses on their own films from those on the films beside them."""
    values, slopes = (sum_over(parts, shares) for parts in zip(*of_films, strict=True))
    return values, slopes


def sum_over(of_films: Sequence[Array], shares: Array) -> Array:
    """Weighted sum of arrays (n, ...) with shares (n, k)."""
    weighted = (
        part * share.reshape(-1, *(1,) * (part.ndim - 1)) for part, share in zip(of_films, shares.T, strict=True)
    )
    return np.asarray(sum(weighted))


def _linearised(function: Callable[[Array], Array], contact: Array) -> tuple[Array, Array]:
    """Values at contacts (x, y, F) and derivatives by (x, y, ln F): one-sided differences are enough for a search."""
    moved = contact + np.zeros((4, 1, 1))
    moved[1, :, 0] += CONTACT_STEPS[0]
    moved[2, :, 1] += CONTACT_STEPS[1]
    moved[3, :, 2] *= np.exp(CONTACT_STEPS[2])
    values = function(moved.reshape(-1, 3)).reshape(4, len(contact), -1)
    return values[0], np.stack([(values[i + 1] - values[0]) / CONTACT_STEPS[i] for i in range(3)], axis=2)


def search_places(charges: FilmCharges, parameters: Array, data: PressData) -> Array:
    """Where to start: (x, y, ln F), shape (n, 3); the place whose ratios of charges are nearest where unknown.

    Ratios hardly depend on the film's stiffness and coefficients, which are not known yet.
    """
    start, unknown = data.contact.copy(), ~data.known[:, -3:-1].all(axis=1)
    if unknown.any():
        lattice = charges.domain.radius * sunflower(PLACES)
        force = np.exp(np.median(data.contact[unknown, 2]))
        at = np.column_stack([lattice.real, lattice.imag, np.full(PLACES, force)])
        measured = np.where(data.known[unknown, :-3], np.log(np.maximum(data.charge[unknown], 1.0)), np.nan)
        logs = measured[:, None] - np.log(charges.charges(parameters, at))
        start[unknown, :2] = at[np.nanvar(logs, axis=2).argmin(axis=1), :2]
    return start
