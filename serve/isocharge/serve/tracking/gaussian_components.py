"""Gaussian components that describe the state of a contact, with their prediction and their update for each frame.

The state of a component consists of x, y and the logarithm of the force, the rates of change of these three values, and
the logarithms of the electrode gains.
"""

import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.serve.tracking.motion_filter import (
    ACCELERATION_DENSITY,
    POSITION,
    RATES,
    SPEED_CHANGE_RATE,
    TIME_EXPONENT,
    UNIT_NOISE,
    VALUES,
    VELOCITY,
    MEAN_MODE_TIME_s,
)

MOTION = slice(0, 6)
"""Slice of x, y, ln F and their rates in a state."""

GAINS = slice(6, None)
"""Slice of the logarithms of the electrode gains in a state."""

GAIN_STD = 0.01
"""Standard deviation of an electrode gain about its calibrated value, dimensionless."""

MAX_ITERATION_STEP = np.array([0.5, 0.5, 0.2])
"""Largest change of x and y (mm) and of ln F in one iteration. The linearisation is inaccurate for larger changes."""

INITIAL_RATE_STD = np.array([60.0, 60.0, 10.0])
"""Standard deviations of the rates at the beginning of a movement, mm/s, mm/s and 1/s.

The standard deviation of the rate of ln F is small. Otherwise, a wrong contact with a changing force could explain the
charges. If the force changes faster, the film is searched again.
"""

FORCE_ACCELERATION_DENSITY = 2.0
"""Spectral density of the second derivative of ln F, 1/s^3. The value is small for the reason stated above."""


class Components(NamedTuple):
    """The n Gaussian components of a mixture.

    Attributes:
        mean: Mean of the state of each component, shape (n, 6 + n_electrode).
        covariance: Covariance of the state of each component, shape (n, 6 + n_electrode, 6 + n_electrode).
        log_weight: Logarithm of the weight of each component, shape (n,). Only differences of the logarithms matter.
    """

    mean: Array
    covariance: Array
    log_weight: Array

    def select(self, rows: list[int] | Booleans) -> "Components":
        """Return copies of the components that `rows` selects, by indices or by a truth value for each component."""
        return Components(self.mean[rows], self.covariance[rows], self.log_weight[rows])

    def with_copies_of_first(self, count: int) -> "Components":
        """Return copies of all components, followed by `count` further copies of the first component."""
        return self.select([*range(len(self.mean)), *[0] * count])


class UpdatedComponents(NamedTuple):
    """Components after an update.

    Attributes:
        components: The components, in the order before the update.
        squared_misfit: Squared misfit of the charges of each component relative to the noise, shape (n,).
        squared_distance: Squared misfit plus squared change of the state, shape (n,). The change is measured relative
            to the covariance of the state before the update.
    """

    components: Components
    squared_misfit: Array
    squared_distance: Array


def contacts_of(states: Array) -> Array:
    """Return the contacts (x, y, F), shape (n, 3), of states whose first components are x, y and ln F."""
    return np.column_stack([states[:, POSITION], np.exp(states[:, 2])])


def predict_components(components: Components, dt_s: float) -> Components:
    """Predict the components at a later time, and add one component whose rates have changed to unknown values.

    The rates are constant except for a random white acceleration.

    Args:
        components: Components after the previous step. The added component has the contact of the first component,
            which is the most probable.
        dt_s: Time since the previous step, s.
    """
    # The slices select entries of a state: VALUES is (x, y, ln F), RATES are their rates, VELOCITY is the rate of x and
    # y, and MOTION contains VALUES and RATES.

    # Add the component as the last one. Its rates are unknown, and independent of its other values: in its covariance,
    # the rows and the columns of the rates are zero except for the variances of the rates.
    present = components.with_copies_of_first(1)
    present.mean[-1, RATES] = 0.0
    present.covariance[-1, RATES] = 0.0
    present.covariance[-1, :, RATES] = 0.0
    present.covariance[-1, RATES, RATES] = np.diag(INITIAL_RATE_STD**2)
    # The rates change once in the mean mode time, so the ratio is the probability that they have changed meanwhile.
    present.log_weight[-1] += math.log(dt_s / MEAN_MODE_TIME_s)

    # Predict the mean of each component: the values change by their rates times the time.
    transition = np.eye(present.mean.shape[1])
    transition[VALUES, RATES] = dt_s * np.eye(3)
    mean = present.mean @ transition.T

    # Predict the covariance of each component. Random accelerations increase it, more so for a faster contact.
    covariance = transition @ present.covariance @ transition.T
    squared_speed = (present.mean[:, VELOCITY] ** 2).sum(axis=1, keepdims=True)
    density = ACCELERATION_DENSITY + squared_speed * SPEED_CHANGE_RATE  # one for each entry of MOTION
    log_force_and_rate = [2, 5]  # indices of ln F and of its rate in MOTION
    density[:, log_force_and_rate] = FORCE_ACCELERATION_DENSITY
    covariance[:, MOTION, MOTION] += density[:, None] * UNIT_NOISE * dt_s**TIME_EXPONENT
    return present._replace(mean=mean, covariance=covariance)


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

    Returns:
        The updated components, with their squared misfits and their squared distances. A squared distance is the sum of
        the squared misfit and the squared change of the state.
    """
    # The slices VALUES and GAINS select (x, y, ln F) and the logarithms of the gains in a state. The last pass of the
    # loop only evaluates the final states, for the statements after the loop.
    states = prior.mean  # shape (n_component, n_state)
    jacobian = np.zeros((len(states), charge_pC.size, states.shape[1]))  # J
    for iteration in range(iterations + 1):
        # Predict the measured charges and their derivatives with respect to the state. A measured charge is the charge
        # of the film times the gain.
        film_charge_pC, film_jacobian = charges.linearised(contacts_of(states))
        gains = np.exp(states[:, GAINS])
        predicted_pC = film_charge_pC * gains
        jacobian[:, :, VALUES] = film_jacobian * gains[:, :, None]
        jacobian[:, :, GAINS] = predicted_pC[:, :, None] * np.eye(charge_pC.size)

        # Compute the innovation v and its covariance S. The innovation is the difference of the measured charges from
        # the linearised charges at the prior mean, shape (n_component, n_electrode, 1).
        cross_covariance = jacobian @ prior.covariance  # J P
        charge_covariance = cross_covariance @ jacobian.swapaxes(1, 2)  # J P J^T
        innovation_covariance = charge_covariance + np.diag(variance_pC2)
        residual_pC = charge_pC - predicted_pC
        innovation = residual_pC[:, :, None] - jacobian @ (prior.mean - states)[:, :, None]
        weighted_innovation = np.linalg.solve(innovation_covariance, innovation)  # S^-1 v
        if iteration < iterations:  # move the state, unless this is the last evaluation
            kalman_correction = (cross_covariance.swapaxes(1, 2) @ weighted_innovation)[:, :, 0]  # P J^T S^-1 v
            step = prior.mean + kalman_correction - states
            # Shorten a step in which x, y or ln F changes by more than its entry of `MAX_ITERATION_STEP`, to this
            # entry.
            relative_step = (np.abs(step[:, VALUES]) / MAX_ITERATION_STEP).max(axis=1, keepdims=True)
            states = states + step / np.maximum(relative_step, 1.0)

    squared_misfit = (residual_pC**2 / variance_pC2).sum(axis=1)
    # The change of the state, relative to its prior covariance: v^T S^-1 J P J^T S^-1 v
    squared_change = (weighted_innovation * (charge_covariance @ weighted_innovation)).sum(axis=(1, 2))
    squared_distance = squared_misfit + squared_change
    log_weight = prior.log_weight - 0.5 * (squared_distance + np.linalg.slogdet(innovation_covariance).logabsdet)
    gain = np.linalg.solve(innovation_covariance, cross_covariance).swapaxes(1, 2)  # Kalman gain P J^T S^-1
    covariance = prior.covariance - gain @ cross_covariance
    covariance = 0.5 * (covariance + covariance.swapaxes(1, 2))  # removes asymmetric rounding errors
    return UpdatedComponents(Components(states, covariance, log_weight), squared_misfit, squared_distance)


def prune_components(components: Components, max_count: int = 8, merge_distance: float = 0.7) -> Components:
    """Remove components of negligible weight, and merge components with a similar motion.

    If the motions of two components are similar, the less probable component is removed. The weight of the removed
    component is added to the weight of the more probable component.

    Args:
        components: Components after an update.
        max_count: Largest number of remaining components. If there are more, only the most probable ones remain.
        merge_distance: Two components are merged if each entry of `MOTION` differs by less than this number of standard
            deviations.

    Returns:
        The remaining components, the most probable first.
    """
    log_weight = components.log_weight - components.log_weight.max()
    # Motion of each component and its standard deviations, shape (n_component, number of entries of MOTION)
    motion = components.mean[:, MOTION]
    std = np.sqrt(np.diagonal(components.covariance, axis1=1, axis2=2)[:, MOTION])
    kept: list[int] = []
    for row in np.argsort(-log_weight, kind="stable").tolist():  # the most probable component first
        is_negligible = np.exp(log_weight[row]) < np.finfo(float).tiny
        if is_negligible:  # all later components have even smaller weights
            break
        max_difference = merge_distance * std[row]
        is_similar = (np.abs(motion[kept] - motion[row]) < max_difference).all(axis=1)
        if is_similar.any():
            most_probable_row = kept[is_similar.argmax()]  # `kept` is in descending order
            log_weight[most_probable_row] = np.logaddexp(log_weight[most_probable_row], log_weight[row])  # sum
        else:
            kept.append(row)
    return components._replace(log_weight=log_weight).select(kept[:max_count])


def split_first_component(components: Components, axis: Array, distance: float) -> Components:
    """Add two narrow components, one at each end of an axis through the first component, which is kept.

    The density of the first component at an end is divided by the maximum of this density. The weight of an added
    component is this ratio times the weight of the first component. The variance of an added component along the axis
    is a quarter of the variance of the first component.

    Args:
        components: The components.
        axis: Direction and length of the axis: the expected change of the state for one standard deviation along it,
            shape (6 + n_electrode,).
        distance: Distance of the ends from the first component, in standard deviations.
    """
    split = components.with_copies_of_first(2)
    added = slice(-2, None)  # the two copies, which are the last components
    split.mean[added] += distance * np.array([axis, -axis])
    # The outer product is the part of the covariance that belongs to this axis, of which a quarter remains.
    split.covariance[added] -= 0.75 * np.outer(axis, axis)
    split.log_weight[added] -= 0.5 * distance**2  # a normal distribution has the relative density exp(-distance^2 / 2)
    return split
