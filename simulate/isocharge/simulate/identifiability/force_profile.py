"""Force that explains given charges best at given positions, for many positions at once."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.measuring_chain.noise import NoiseModel

STEPS = 4
"""Number of steps to the best force. The error of a step is of second order in the error of the exponent."""

MAX_LOG_CHANGE = 30.0
"""Largest change of ln Q in one step, dimensionless."""

EXPONENT_NODES = 65
"""Number of forces at which the exponent is tabulated."""


@dataclass(frozen=True)
class ForceProfile:
    """Charges at a position as a function of the force, Q = weights(ln F) @ terms.

    Attributes:
        weights: Function from ln F, shape (n,), to weights, shape (n, n_term).
        log_range: Smallest and largest ln F.
        logs: Values of ln F at which the exponent is tabulated, ascending, shape (m,).
        exponent: Exponent d ln Q / d ln F of the sum of the weights, shape (m,). It is used for every charge.
    """

    weights: Callable[[Array], Array]
    log_range: tuple[float, float]
    logs: Array
    exponent: Array

    @classmethod
    def of(cls, weights: Callable[[Array], Array], force_range: tuple[float, float]) -> "ForceProfile":
        """Create a profile, for which the exponent is tabulated.

        Args:
            weights: Function from ln F, shape (n,), to weights, shape (n, n_term).
            force_range: Smallest and largest force, N. They may be equal.
        """
        min_log, max_log = (float(end) for end in np.log(force_range))
        if max_log > min_log:
            logs = np.linspace(min_log, max_log, EXPONENT_NODES)
        else:
            logs = np.array([min_log - 1e-3, min_log + 1e-3])
        log_sum = np.log(weights(logs).sum(axis=1))
        exponent = np.gradient(log_sum, logs)
        return cls(weights, (min_log, max_log), logs, exponent)

    def charge(self, logs: Array, terms: Array) -> Array:
        """Compute the charges for logarithms of the force.

        Args:
            logs: ln F, shape (n,).
            terms: Terms of each position, shape (n, n_term, n_electrode).

        Returns:
            Charges, shape (n, n_electrode), pC.
        """
        term_weights = self.weights(logs)  # shape (n, n_term)
        return np.asarray(np.einsum("nk,nke->ne", term_weights, terms))

    def slope(self, logs: Array, charge: Array) -> Array:
        """Compute dQ / d ln F with the common exponent.

        Args:
            logs: ln F, shape (n,).
            charge: Charges at these forces, shape (n, n_electrode), pC.

        Returns:
            Slopes, shape (n, n_electrode), pC.
        """
        return np.asarray(np.interp(logs, self.logs, self.exponent)[:, None] * charge)

    def best(self, terms: Array, charge: Array, noise: NoiseModel) -> Array:
        """Find the force that explains the charges best, by weighted least squares.

        In each step, the factor by which the predicted charges should be multiplied is converted into a change of ln F
        with the exponent of the profile.

        Args:
            terms: Terms of each position, shape (n, n_term, n_electrode).
            charge: Measured charges, shape (n, n_electrode), pC.
            noise: Noise of the readings.

        Returns:
            ln F within the range of the profile, shape (n,).
        """
        logs = np.full(len(charge), 0.5 * sum(self.log_range))
        for _ in range(STEPS):
            predicted = self.charge(logs, terms)
            weighted = predicted / noise.variance(predicted)
            # The best factor is sum(w Q_predicted Q) / sum(w Q_predicted^2), with sums over the electrodes e.
            factor = np.einsum("ne,ne->n", weighted, charge) / np.einsum("ne,ne->n", weighted, predicted)
            log_change = np.clip(np.log(np.maximum(factor, 1e-300)), -MAX_LOG_CHANGE, MAX_LOG_CHANGE)
            exponent = np.interp(logs, self.logs, self.exponent)
            logs = np.clip(logs + log_change / exponent, *self.log_range)
        return np.asarray(logs)
