"""Measured presses as least squares takes them."""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.serve.prediction.measured_presses import MeasuredPresses
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values
from isocharge.train.calibration.film_charges import FilmCharges

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
