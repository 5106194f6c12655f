"""Search for the force that explains given charges best at a given position, for many positions at once."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.measuring_chain.noise import NoiseModel

STEPS = 4
"""Number of steps of the search. The error decreases quickly, because the tabulated exponent is nearly correct."""

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
        log_forces: Values of ln F at which the exponent is tabulated, ascending, shape (m,).
        exponent: Exponent d ln(sum of the weights) / d ln F, shape (m,). It approximates d ln Q / d ln F of every
            charge.
    """

    weights: Callable[[Array], Array]
    log_range: tuple[float, float]
    log_forces: Array
    exponent: Array

    @classmethod
    def of(cls, weights: Callable[[Array], Array], force_range: tuple[float, float]) -> "ForceProfile":
        """Create a profile, and tabulate the exponent with which the charges increase with the force.

        The exponent is d ln(sum of the weights) / d ln F.

        Args:
            weights: Function from ln F, shape (n,), to weights, shape (n, n_term).
            force_range: Smallest and largest force, N. They may be equal.
        """
        min_log_force, max_log_force = np.log(force_range).tolist()
        if max_log_force > min_log_force:
            log_forces = np.linspace(min_log_force, max_log_force, EXPONENT_NODES)
        else:  # two points for a difference quotient about the single force
            log_forces = np.array([min_log_force - 1e-3, min_log_force + 1e-3])
        log_sum = np.log(weights(log_forces).sum(axis=1))
        exponent = np.gradient(log_sum, log_forces)
        return cls(weights, (min_log_force, max_log_force), log_forces, exponent)

    def charge(self, log_force: Array, terms: Array) -> Array:
        """Compute the charges for logarithms of the force.

        Args:
            log_force: ln F, shape (n,).
            terms: Terms of each position, shape (n, n_term, n_electrode).

        Returns:
            Charges, shape (n, n_electrode), pC.
        """
        term_weights = self.weights(log_force)  # shape (n, n_term)
        return np.asarray(np.einsum("nk,nke->ne", term_weights, terms))  # sum over the terms k

    def slope(self, log_force: Array, charge: Array) -> Array:
        """Compute dQ / d ln F with the common exponent.

        Args:
            log_force: ln F, shape (n,).
            charge: Charges at these forces, shape (n, n_electrode), pC.

        Returns:
            Slopes, shape (n, n_electrode), pC.
        """
        exponent = np.interp(log_force, self.log_forces, self.exponent)
        return np.asarray(exponent[:, None] * charge)

    def best(self, terms: Array, charge: Array, noise: NoiseModel) -> Array:
        """Find the force that explains the charges best, by weighted least squares.

        In each step, the predicted charges are multiplied by the factor with which they fit the measured charges best.
        The exponent of the profile converts this factor into a change of ln F.

        Args:
            terms: Terms of each position, shape (n, n_term, n_electrode).
            charge: Measured charges, shape (n, n_electrode), pC.
            noise: Noise of the readings.

        Returns:
            ln F within the range of the profile, shape (n,).
        """
        middle_log_force = 0.5 * sum(self.log_range)
        log_force = np.full(len(charge), middle_log_force)
        for _ in range(STEPS):
            predicted = self.charge(log_force, terms)
            weighted = predicted / noise.variance(predicted)
            # The best factor is sum(w Q_predicted Q) / sum(w Q_predicted^2), with sums over the electrodes e.
            factor = np.einsum("ne,ne->n", weighted, charge) / np.einsum("ne,ne->n", weighted, predicted)
            positive_factor = np.maximum(factor, 1e-300)  # charges with opposite signs lead to the smallest force
            log_factor = np.clip(np.log(positive_factor), -MAX_LOG_CHANGE, MAX_LOG_CHANGE)

            # Near a force F, the charges are proportional to F^exponent.
            exponent = np.interp(log_force, self.log_forces, self.exponent)
            log_force = np.clip(log_force + log_factor / exponent, *self.log_range)
        return np.asarray(log_force)
