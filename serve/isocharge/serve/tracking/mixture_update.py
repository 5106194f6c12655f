"""Linearised Kalman update of the components of a Gaussian mixture with measured charges."""

from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.serve.tracking.mixture_components import CONTACT, GAINS, LOG_FORCE, Components, X, Y

MAX_ITERATION_STEP_mm = 0.5
"""Largest change of the position in one iteration, mm. The linearisation is not accurate beyond it."""

MAX_ITERATION_LOG_STEP = 0.2
"""Largest change of ln F in one iteration. The linearisation is not accurate beyond it."""


class Measurement(NamedTuple):
    """Measured charges and their variances, averaged over the frames of a step.

    Attributes:
        charge_pC: Touch charges, shape (n_electrode,), pC.
        variance: Variances of the charges, shape (n_electrode,), pC^2.
    """

    charge_pC: Array
    variance: Array


class LinearisedUpdate(NamedTuple):
    """Quantities of a Kalman update of n components. The charges are linearised about one state of each component.

    Attributes:
        charge_pC: Charges of the state, shape (n, n_electrode), pC.
        cross_covariance: Covariance of the charges and the state, shape (n, n_electrode, 6 + n_electrode).
        charge_covariance: Covariance of the charges due to the uncertainty of the state, shape
            (n, n_electrode, n_electrode), pC^2.
        innovation_covariance: Sum of `charge_covariance` and the noise of the measurement, the same shape, pC^2.
        weighted_innovation: Innovation multiplied by the inverse of its covariance, shape (n, n_electrode, 1), 1/pC.
    """

    charge_pC: Array
    cross_covariance: Array
    charge_covariance: Array
    innovation_covariance: Array
    weighted_innovation: Array


def charges_and_jacobian(charges: ChargeSeries, mean: Array) -> tuple[Array, Array]:
    """Compute the charges of states, and their derivatives with respect to the state.

    The charge of an electrode is the charge of the film times the gain of the electrode.

    Args:
        charges: Charges of the film.
        mean: States, shape (n, 6 + n_electrode): contact (x, y, ln F), rates of these three values, and logarithms of
            the gains.

    Returns:
        The charges, shape (n, n_electrode), pC, and their derivatives, shape (n, n_electrode, 6 + n_electrode).
    """
    film_charge_pC, film_jacobian = charges.linearised(mean[:, CONTACT])
    gains = np.exp(mean[:, GAINS])  # the state has the logarithms of the gains
    charge_pC = film_charge_pC * gains

    # Derivatives with respect to the contact, its rates and the logarithms of the gains. The charges do not depend on
    # the rates. The derivative of a charge with respect to the logarithm of its own gain is the charge itself.
    contact_jacobian = film_jacobian * gains[:, :, None]
    rate_jacobian = np.zeros((*charge_pC.shape, 3))
    n_electrode = charge_pC.shape[1]
    gain_jacobian = charge_pC[:, :, None] * np.eye(n_electrode)
    jacobian = np.concatenate([contact_jacobian, rate_jacobian, gain_jacobian], axis=2)
    return charge_pC, jacobian


def linearise_update(
    charges: ChargeSeries, state: Array, prior: Components, measurement: Measurement
) -> LinearisedUpdate:
    """Linearise the charges about a state of each component, and compute the quantities of a Kalman update.

    With the Jacobian J of the charges, the prior covariance P and the covariance R of the measurement, the covariance
    of the charges and the state is J P, and the covariance of the innovation is S = J P J^T + R. The innovation v is
    the measured charges minus the linearised charges of the prior mean, and the weighted innovation is S^-1 v.

    Args:
        charges: Charges of the film.
        state: State of each component about which the charges are linearised, shape (n, 6 + n_electrode).
        prior: Predicted components.
        measurement: Charges of this step.
    """
    charge_pC, jacobian = charges_and_jacobian(charges, state)
    transposed = jacobian.swapaxes(1, 2)
    cross_covariance = jacobian @ prior.covariance
    charge_covariance = cross_covariance @ transposed
    innovation_covariance = charge_covariance + np.diag(measurement.variance)

    # The linearised charges of the prior mean are the charges of the state plus J times (prior mean minus state).
    prior_difference = (prior.mean - state)[:, None]  # shape (n, 1, 6 + n_electrode)
    prior_change_pC = (prior_difference @ transposed)[:, 0]
    innovation = measurement.charge_pC - charge_pC - prior_change_pC
    weighted_innovation = np.linalg.solve(innovation_covariance, innovation[:, :, None])
    return LinearisedUpdate(
        charge_pC, cross_covariance, charge_covariance, innovation_covariance, np.asarray(weighted_innovation)
    )


def updated_covariance(prior: Components, linearised: LinearisedUpdate) -> Array:
    """Return the covariances of the components after a Kalman update, shape (n, 6 + n_electrode, 6 + n_electrode).

    The updated covariance is P - C^T S^-1 C, where P is the covariance of the prior, C is the covariance of the charges
    and the state, and S is the covariance of the innovation. S^-1 C is the transposed Kalman gain.

    Args:
        prior: Predicted components.
        linearised: The update, linearised about the new states.
    """
    cross_covariance = linearised.cross_covariance  # shape (n, n_electrode, 6 + n_electrode)
    transposed_gain = np.linalg.solve(linearised.innovation_covariance, cross_covariance)
    covariance = prior.covariance - cross_covariance.swapaxes(1, 2) @ transposed_gain
    symmetric = 0.5 * (covariance + covariance.swapaxes(1, 2))  # rounding errors would make it asymmetric
    return np.asarray(symmetric)


def limit_iteration_step(step: Array) -> Array:
    """Shorten long steps of the state, so that the linearisation is accurate over each step.

    A step is too long if the position changes by more than `MAX_ITERATION_STEP_mm`, or the logarithm of the force by
    more than `MAX_ITERATION_LOG_STEP`. The whole step is then divided by the ratio to the limit.

    Args:
        step: Step of the state of each component, shape (n, 6 + n_electrode).

    Returns:
        Steps in the same directions, shape (n, 6 + n_electrode).
    """
    relative_distance = np.hypot(step[:, X], step[:, Y]) / MAX_ITERATION_STEP_mm
    relative_force_change = np.abs(step[:, LOG_FORCE]) / MAX_ITERATION_LOG_STEP
    relative_length = np.maximum(relative_distance, relative_force_change)
    divisor = np.maximum(relative_length, 1.0)  # steps that are short enough are not changed
    return np.asarray(step / divisor[:, None])
