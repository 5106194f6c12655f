"""Components of the Gaussian mixture that the module `contact_mixture` uses to follow a contact, and their update."""

import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.serve.model.contact import Contact
from isocharge.serve.tracking.motion_filter import POSITION, RATES, VALUES, VELOCITY, process_noise

MOTION = slice(0, 6)
"""Slice of x, y, ln F and their rates in a state."""

GAINS = slice(6, None)
"""Slice of the logarithms of the electrode gains in a state."""

MAX_ITERATION_STEP = np.array([0.5, 0.5, 0.2])
"""Largest change of x and y (mm) and of ln F in one iteration. The linearisation is inaccurate for larger changes."""

FORCE_ACCELERATION_DENSITY = 2.0
"""Spectral density of the second derivative of ln F, 1/s^3.

The density is small, because a wrong contact together with a change of the force may explain the charges.
"""

MAX_COMPONENTS = 8
"""Largest number of components that are kept after an update."""

MIN_LOG_WEIGHT = -14.0
"""Logarithm of the weight, relative to the largest weight, below which a component is removed."""

MERGE_DISTANCE = 0.7
"""Difference of each entry of `MOTION` below which two components are merged, in standard deviations of the entry."""


class ContactHypothesis(NamedTuple):
    """A contact that explains the measured charges, with its probability.

    Attributes:
        mean: Mean of the state, shape (6 + n_electrode,): x and y in mm, ln F, the rates of these three values in mm/s
            and 1/s, and the logarithms of the gains.
        covariance: Covariance of the state, shape (6 + n_electrode, 6 + n_electrode).
        probability: Probability that the film is touched by this contact, and not by another contact.
        misfit: Distance between the measured charges and the charges of the contact, in standard deviations of the
            noise.
    """

    mean: Array
    covariance: Array
    probability: float
    misfit: float

    def contact(self, dt_s: float) -> Contact:
        """Return the contact, extrapolated with constant rates.

        Args:
            dt_s: Time by which the contact is extrapolated, s. The growth of the covariance in this time is negligible.
        """
        x_mm, y_mm, log_force = (self.mean[VALUES] + dt_s * self.mean[RATES]).tolist()
        std = np.sqrt(self.covariance.diagonal()[VALUES])
        correlation = self.covariance[VALUES, VALUES] / np.outer(std, std)
        x_std_mm, y_std_mm, log_force_std = std.tolist()
        force_N = math.exp(log_force)
        return Contact(
            x_mm,
            y_mm,
            force_N,
            x_std_mm,
            y_std_mm,
            log_force_std * force_N,
            self.misfit,
            *correlation[np.triu_indices(3, 1)].tolist(),
        )

    @property
    def moving_probability(self) -> float:
        """Probability that the estimated speed of a contact at rest would be smaller than the speed of this contact.

        The probability is the result of a chi-squared test with two degrees of freedom.
        """
        velocity = self.mean[VELOCITY]
        squared_distance = float(velocity @ np.linalg.solve(self.covariance[VELOCITY, VELOCITY], velocity))
        return -math.expm1(-0.5 * squared_distance)


class Components(NamedTuple):
    """The n Gaussian components of the mixture.

    Attributes:
        mean: Mean of the state of each component, shape (n, 6 + n_electrode).
        covariance: Covariance of the state of each component, shape (n, 6 + n_electrode, 6 + n_electrode).
        log_weight: Logarithm of the weight of each component, shape (n,). Only differences of the logarithms matter.
    """

    mean: Array
    covariance: Array
    log_weight: Array

    def select(self, rows: list[int]) -> "Components":
        """Return only the components with the indices `rows`."""
        return Components(self.mean[rows], self.covariance[rows], self.log_weight[rows])

    def joined(self, other: "Components") -> "Components":
        """Return the components of both mixtures."""
        mean, covariance, log_weight = (np.concatenate(arrays) for arrays in zip(self, other, strict=True))
        return Components(mean, covariance, log_weight)


def film_charges(charges: ChargeSeries, states: Array) -> tuple[Array, Array]:
    """Compute the charges that the film produces for states, and their derivatives with respect to (x, y, ln F).

    Args:
        charges: Charges that the film produces for every contact.
        states: States, shape (n, 6 + n_electrode). Contacts outside the range of forces are allowed.

    Returns:
        The charges, shape (n, n_electrode), pC, and the derivatives, shape (n, n_electrode, 3).
    """
    return charges.linearised(np.column_stack([states[:, POSITION], np.exp(states[:, 2])]))


def predict_components(components: Components, dt_s: float) -> Components:
    """Predict the components at a later time, with constant rates and a random white acceleration.

    Args:
        components: Components after an update.
        dt_s: Time between the update and the prediction, s.
    """
    transition = np.eye(components.mean.shape[1])
    transition[VALUES, RATES] = dt_s * np.eye(3)
    covariance = transition @ components.covariance @ transition.T
    covariance[:, MOTION, MOTION] += process_noise(components.mean[:, VELOCITY], FORCE_ACCELERATION_DENSITY, dt_s)
    return Components(components.mean @ transition.T, covariance, components.log_weight)


class UpdatedComponents(NamedTuple):
    """Components after an update.

    Attributes:
        components: The components, in the order before the update.
        squared_misfit: Squared misfit of the charges of each component relative to the noise, shape (n,).
        squared_distance: Sum of the squared misfit and the squared change of the state relative to its covariance
            before the update, shape (n,).
    """

    components: Components
    squared_misfit: Array
    squared_distance: Array


def update_components(
    charges: ChargeSeries, prior: Components, charge_pC: Array, variance_pC2: Array, iterations: int
) -> UpdatedComponents:
    """Update components with measured charges by an iterated extended Kalman filter (Bell and Cathey 1993).

    Each iteration linearises the charges about the present state, computes the Kalman update of the prior mean with the
    linearised charges, and moves the state towards the updated mean. The measured charge of an electrode is the charge
    that the film produces, multiplied by the gain of the electrode.

    Let J be the Jacobian of the charges, P the prior covariance, and R the covariance of the noise. The covariance of
    the innovation v is S = J P J^T + R. The likelihood p of a component is given by -2 ln p = squared misfit + squared
    change of the state + ln det S.

    Args:
        charges: Charges that the film produces for every contact.
        prior: Predicted components.
        charge_pC: Measured charges, shape (n_electrode,), pC.
        variance_pC2: Variances of the noise of the charges, shape (n_electrode,), pC^2.
        iterations: Number of iterations.
    """
    states = prior.mean
    n_component, n_state = states.shape
    for iteration in range(iterations + 1):
        film_charge_pC, film_jacobian = film_charges(charges, states)
        gains = np.exp(states[:, GAINS])
        predicted_pC = film_charge_pC * gains
        jacobian = np.zeros((n_component, charge_pC.size, n_state))
        jacobian[:, :, VALUES] = film_jacobian * gains[:, :, None]
        jacobian[:, :, GAINS] = predicted_pC[:, :, None] * np.eye(charge_pC.size)

        cross_covariance = jacobian @ prior.covariance
        charge_covariance = cross_covariance @ jacobian.swapaxes(1, 2)
        innovation_covariance = charge_covariance + np.diag(variance_pC2)
        residual_pC = charge_pC - predicted_pC
        innovation = residual_pC[:, :, None] - jacobian @ (prior.mean - states)[:, :, None]
        weighted = np.linalg.solve(innovation_covariance, innovation)  # S^-1 v
        if iteration < iterations:
            step = prior.mean + (cross_covariance.swapaxes(1, 2) @ weighted)[:, :, 0] - states
            relative_length = np.abs(step[:, VALUES]) / MAX_ITERATION_STEP
            states = states + step / np.maximum(relative_length.max(axis=1, keepdims=True), 1.0)

    squared_misfit = (residual_pC**2 / variance_pC2).sum(axis=1)
    squared_distance = squared_misfit + (weighted * (charge_covariance @ weighted)).sum(axis=(1, 2))
    log_weight = prior.log_weight - 0.5 * (squared_distance + np.linalg.slogdet(innovation_covariance).logabsdet)
    gain = np.linalg.solve(innovation_covariance, cross_covariance).swapaxes(1, 2)
    covariance = prior.covariance - gain @ cross_covariance
    covariance = 0.5 * (covariance + covariance.swapaxes(1, 2))  # removes asymmetric rounding errors
    return UpdatedComponents(Components(states, covariance, log_weight), squared_misfit, squared_distance)


def prune_components(components: Components) -> Components:
    """Remove improbable components, and merge components with a similar motion.

    If the motions of two components are similar, the less probable component is removed. The weight of the removed
    component is added to the weight of the more probable component. Only the `MAX_COMPONENTS` most probable components
    remain.

    Args:
        components: Components after an update.
    """
    log_weight = components.log_weight - components.log_weight.max()
    motion = components.mean[:, MOTION]
    std = np.sqrt(np.diagonal(components.covariance, axis1=1, axis2=2)[:, MOTION])
    kept: list[int] = []
    for row in np.argsort(-log_weight, kind="stable").tolist():
        if log_weight[row] < MIN_LOG_WEIGHT:
            break
        is_similar = (np.abs(motion[kept] - motion[row]) < MERGE_DISTANCE * std[row]).all(axis=1)
        if is_similar.any():
            first = kept[int(is_similar.argmax())]
            log_weight[first] = np.logaddexp(log_weight[first], log_weight[row])  # add the weights
        else:
            kept.append(row)
    return components._replace(log_weight=log_weight).select(kept[:MAX_COMPONENTS])
