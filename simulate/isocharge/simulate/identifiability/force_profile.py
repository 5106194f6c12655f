"""The force that explains charges best at given places, for many places at once."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.measuring_chain.noise import NoiseModel

STEPS = 4
"""Number of steps to the best force: the error of each is of second order in the error of the exponent."""

FAR = 30.0
"""Largest change of ln Q in one step, dimensionless."""


@dataclass(frozen=True)
class ForceProfile:
    """Charges at a position as a function of the force: weights(ln F) @ terms.

    Attributes:
        weights: Function from ln F, shape (n,), to weights, shape (n, n_term).
        ends: Smallest and largest ln F.
        logs: ln F at which the exponent is tabulated, ascending.
        exponent: d ln Q / d ln F of the sum of the weights, taken for every charge.
    """

    weights: Callable[[Array], Array]
    ends: tuple[float, float]
    logs: Array
    exponent: Array

    @classmethod
    def of(cls, weights: Callable[[Array], Array], force_range: tuple[float, float]) -> "ForceProfile":
        """Tabulate the exponent."""
        low, high = (float(end) for end in np.log(force_range))
        logs = np.linspace(low, high, 65) if high > low else np.array([low - 1e-3, low + 1e-3])
        return cls(weights, (low, high), logs, np.gradient(np.log(weights(logs).sum(axis=1)), logs))

    def charge(self, logs: Array, terms: Array) -> Array:
        """Charges at logarithms of forces, shape (n,), and terms (n, n_term, n_electrode): (n, n_electrode)."""
        return np.asarray(np.einsum("nk,nke->ne", self.weights(logs), terms))

    def slope(self, logs: Array, charge: Array) -> Array:
        """d(Q)/d(ln F), by the common exponent, of charges (n, n_electrode)."""
        return np.asarray(np.interp(logs, self.logs, self.exponent)[:, None] * charge)

    def best(self, terms: Array, charge: Array, noise: NoiseModel) -> Array:
        """Logarithm of the force within the ends that explains charges (n, n_electrode) best, shape (n,)."""
        logs = np.full(len(charge), 0.5 * sum(self.ends))
        for _ in range(STEPS):
            known = self.charge(logs, terms)
            weighted = known / noise.variance(known)
            ratio = np.einsum("ne,ne->n", weighted, charge) / np.einsum("ne,ne->n", weighted, known)
            change = np.clip(np.log(np.maximum(ratio, 1e-300)), -FAR, FAR)
            logs = np.clip(logs + change / np.interp(logs, self.logs, self.exponent), *self.ends)
        return np.asarray(logs)
