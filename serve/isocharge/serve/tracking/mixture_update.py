"""Linearised Kalman update of the components of a Gaussian mixture with measured charges."""

from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.serve.tracking.mixture_components import CONTACT, GAINS, LOG_FORCE, Components, X, Y

MAX_ITERATION_STEP_mm = 0.5
"""Largest change of the position in one iteration, mm. For larger changes, the linearisation is inaccurate."""

MAX_ITERATION_LOG_STEP = 0.2
"""Largest change of ln F in one iteration. For larger changes, the linearisation is inaccurate."""


class Measurement(NamedTuple):
    """Charges averaged over the frames of a step, and the variances of these averages.

    Attributes:
        charge_pC: Mean touch charge of each electrode, shape (n_electrode,), pC.
        variance: Variance of each mean charge, shape (n_electrode,), pC^2.
    """

    charge_pC: Array
    variance: Array


class LinearisedUpdate(NamedTuple):
    """Quantities of a linearised Kalman update of n components.

    For each component, the charges are linearised about one state.

    Attributes:
        charge_pC: Charges at this state, shape (n, n_electrode), pC.
        cross_covariance: Covariance between the charges and the state, shape (n, n_electrode, 6 + n_electrode).
        charge_covariance: Covariance of the charges that the uncertainty of the state causes, shape
            (n, n_electrode, n_electrode), pC^2.
        innovation_covariance: Sum of `charge_covariance` and the covariance of the measurement, of the same shape,
            pC^2.
        weighted_innovation: Inverse of `innovation_covariance` times the innovation, shape (n, n_electrode, 1), 1/pC.
    """

    charge_pC: Array
    cross_covariance: Array
    charge_covariance: Array
    innovation_covariance: Array
    weighted_innovation: Array


def film_charges(charges: ChargeSeries, states: Array) -> tuple[Array, Array]:
    """Compute the charges that the film produces for states, and their derivatives with respect to (x, y, ln F).

    Args:
        charges: Charges that the film produces for every contact.
        states: States, as `charges_and_jacobian` expects them. Contacts outside the range of forces are allowed.

    Returns:
        The charges, shape (n, n_electrode), pC, and the derivatives, shape (n, n_electrode, 3).
    """
    contacts = states[:, CONTACT].copy()
    contacts[:, 2] = np.exp(contacts[:, 2])  # a state contains the logarithm of the force
    return charges.linearised(contacts)


def charges_and_jacobian(charges: ChargeSeries, states: Array) -> tuple[Array, Array]:
    """Compute the expected measured charges for states, and their derivatives with respect to the states.

    The measured charge of an electrode is the charge that the film produces, multiplied by the gain of the electrode.

    Args:
        charges: Charges that the film produces for every contact.
        states: States, shape (n, 6 + n_electrode): contact (x, y, ln F), rates of these three values, and logarithms of
            the gains.

    Returns:
        The charges, shape (n, n_electrode), pC, and the derivatives, shape (n, n_electrode, 6 + n_electrode).
    """
    film_charge_pC, film_jacobian = film_charges(charges, states)
    gains = np.exp(states[:, GAINS])  # a state contains the logarithms of the gains
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
    charges: ChargeSeries, states: Array, prior: Components, measurement: Measurement
) -> LinearisedUpdate:
    """Linearise the charges about one state of each component, and compute the quantities of a Kalman update.

    Let J be the Jacobian of the charges, P the prior covariance, and R the covariance of the measurement. The
    covariance between the charges and the state is J P. The covariance of the innovation is S = J P J^T + R. The
    innovation v is the measured charges minus the linearised charges of the prior mean. The product S^-1 v is called
    the weighted innovation.

    Args:
        charges: Charges that the film produces for every contact.
        states: State of each component about which the charges are linearised, shape (n, 6 + n_electrode).
        prior: Components as they were predicted for this step, before the update.
        measurement: Charges of this step.
    """
    charge_pC, jacobian = charges_and_jacobian(charges, states)
    transposed_jacobian = jacobian.swapaxes(1, 2)
    cross_covariance = jacobian @ prior.covariance
    charge_covariance = cross_covariance @ transposed_jacobian
    innovation_covariance = charge_covariance + np.diag(measurement.variance)

    # The linearised charges of the prior mean are the charges of the state plus J times (prior mean minus state).
    difference_row = (prior.mean - states)[:, None]  # shape (n, 1, 6 + n_electrode)
    prior_change_pC = (difference_row @ transposed_jacobian)[:, 0]  # shape (n, n_electrode)
    innovation = measurement.charge_pC - charge_pC - prior_change_pC
    weighted_innovation = np.linalg.solve(innovation_covariance, innovation[:, :, None])
    return LinearisedUpdate(
        charge_pC, cross_covariance, charge_covariance, innovation_covariance, np.asarray(weighted_innovation)
    )


def updated_covariance(prior: Components, linearised: LinearisedUpdate) -> Array:
    """Compute the covariances of the states after a Kalman update, shape (n, 6 + n_electrode, 6 + n_electrode).

    The updated covariance is P - C^T S^-1 C. Here P is the prior covariance, C is the covariance between the charges
    and the state, and S is the covariance of the innovation. The matrix S^-1 C is the transposed Kalman gain.

    Args:
        prior: Components as they were predicted for this step, before the update.
        linearised: Quantities of the update, linearised about the updated states.
    """
    cross_covariance = linearised.cross_covariance  # shape (n, n_electrode, 6 + n_electrode)
    transposed_gain = np.linalg.solve(linearised.innovation_covariance, cross_covariance)
    covariance = prior.covariance - cross_covariance.swapaxes(1, 2) @ transposed_gain
    symmetric_covariance = 0.5 * (covariance + covariance.swapaxes(1, 2))  # removes asymmetric rounding errors
    return np.asarray(symmetric_covariance)


def limit_iteration_steps(steps: Array) -> Array:
    """Shorten steps of states if the steps are too long for an accurate linearisation.

    A step is too long if it changes the position by more than `MAX_ITERATION_STEP_mm`, or the logarithm of the force by
    more than `MAX_ITERATION_LOG_STEP`. If a step is too long, all its entries are divided by the same number, so that
    the step is exactly as long as the limit.

    Args:
        steps: Step of the state of each component, shape (n, 6 + n_electrode).

    Returns:
        Shortened steps in the same directions, shape (n, 6 + n_electrode).
    """
    relative_distance = np.hypot(steps[:, X], steps[:, Y]) / MAX_ITERATION_STEP_mm
    relative_force_change = np.abs(steps[:, LOG_FORCE]) / MAX_ITERATION_LOG_STEP
    relative_length = np.maximum(relative_distance, relative_force_change)
    divisor = np.maximum(relative_length, 1.0)  # steps that are short enough are not changed
    return np.asarray(steps / divisor[:, None])
