"""Search for the force that best explains given charges if the position is known."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.measuring_chain.noise import NoiseModel

STEPS = 4
"""Number of steps of the search. A few steps suffice, because the tabulated exponent is nearly correct."""

MAX_LOG_CHANGE = 30.0
"""Largest change of the logarithm of a charge in one step of the search, dimensionless."""

EXPONENT_NODES = 65
"""Number of forces at which the exponent of the charges is tabulated."""


@dataclass(frozen=True)
class ForceProfile:
    """Function that computes the charges at a position from the force.

    The charges at a position are Q = weights(ln F) @ terms. The weights depend only on the force F, and the terms
    depend only on the position. Each charge is approximately proportional to a power of the force. The exponent of this
    power is nearly the same for all positions and electrodes.

    Attributes:
        weights: Function that computes weights, shape (n, n_term), from values of ln F, shape (n,).
        log_range: Smallest and largest value of ln F.
        log_forces: Values of ln F in ascending order at which the exponent is tabulated, shape (m,).
        exponent: Derivative of the logarithm of the sum of the weights with respect to ln F, shape (m,), dimensionless.
            It approximates d ln Q / d ln F of every charge Q.
    """

    weights: Callable[[Array], Array]
    log_range: tuple[float, float]
    log_forces: Array
    exponent: Array

    @classmethod
    def of(cls, weights: Callable[[Array], Array], force_range: tuple[float, float]) -> "ForceProfile":
        """Create a profile from its weights.

        A profile computes the charges at a position as weights(ln F) @ terms, where F is the force. The terms depend
        only on the position. The charges are approximately proportional to a power of the force. The exponent of this
        power is tabulated as a function of ln F.

        Args:
            weights: Function that computes weights, shape (n, n_term), from values of ln F, shape (n,).
            force_range: Smallest and largest force, N. They may be equal.
        """
        min_log_force, max_log_force = np.log(force_range).tolist()
        if max_log_force > min_log_force:
            log_forces = np.linspace(min_log_force, max_log_force, EXPONENT_NODES)
        else:  # the numerical derivative needs two points, which lie on both sides of the single force
            log_forces = np.array([min_log_force - 1e-3, min_log_force + 1e-3])

        # The sum of the weights depends on the force nearly as the charges do. The derivative of the logarithm of this
        # sum with respect to ln F is therefore the exponent.
        log_sum = np.log(weights(log_forces).sum(axis=1))
        exponent = np.gradient(log_sum, log_forces)
        return cls(weights, (min_log_force, max_log_force), log_forces, exponent)

    def charge(self, log_force: Array, terms: Array) -> Array:
        """Compute the charges of presses at several positions. Each press has its own force.

        Args:
            log_force: Natural logarithm of the force in N at each position, shape (n,).
            terms: Terms of the charges at each position, shape (n, n_term, n_electrode).

        Returns:
            Charges, shape (n, n_electrode), pC.
        """
        term_weights = self.weights(log_force)  # shape (n, n_term)
        return np.asarray(np.einsum("nk,nke->ne", term_weights, terms))  # sum over the terms (index k)

    def slope(self, log_force: Array, charge: Array) -> Array:
        """Use the tabulated exponent to compute the derivatives of charges with respect to ln F.

        Args:
            log_force: Natural logarithm of the force in N, shape (n,).
            charge: Charges at these forces, shape (n, n_electrode), pC.

        Returns:
            Derivatives with respect to ln F, shape (n, n_electrode), pC.
        """
        exponent = np.interp(log_force, self.log_forces, self.exponent)
        return np.asarray(exponent[:, None] * charge)

    def best_log_force(self, terms: Array, charge: Array, noise: NoiseModel) -> Array:
        """For each position, find the force that best explains the measured charges (weighted least squares).

        The search starts in the middle of the range of ln F. Each step computes the factor by which the predicted
        charges must be multiplied in order to fit the measured charges best. The force is then changed such that the
        predicted charges change by about this factor.

        Args:
            terms: Values from which the profile computes the charges at each position, shape (n, n_term, n_electrode).
            charge: Measured charges for each position, shape (n, n_electrode), pC.
            noise: Noise of the readings.

        Returns:
            Natural logarithm of the best force in N at each position, within the range of the profile, shape (n,).
        """
        middle_log_force = 0.5 * sum(self.log_range)
        log_force = np.full(len(charge), middle_log_force)
        for _ in range(STEPS):
            # With the weights w = 1 / variance, the best factor is sum(w P Q) / sum(w P P), where P are the predicted
            # charges, Q are the measured charges, and the sums are over the electrodes (index e).
            predicted = self.charge(log_force, terms)
            weighted_charge = predicted / noise.variance(predicted)
            factor = np.einsum("ne,ne->n", weighted_charge, charge) / np.einsum("ne,ne->n", weighted_charge, predicted)

            # A negative factor has no logarithm. Measured charges with opposite signs lead to the smallest force.
            positive_factor = np.maximum(factor, 1e-300)
            log_factor = np.clip(np.log(positive_factor), -MAX_LOG_CHANGE, MAX_LOG_CHANGE)

            # Near the present force F, the charges are proportional to F^exponent. A change of ln F therefore changes
            # their logarithms by exponent times this change.
            exponent = np.interp(log_force, self.log_forces, self.exponent)
            log_force = np.clip(log_force + log_factor / exponent, *self.log_range)
        return np.asarray(log_force)
