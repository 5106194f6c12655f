"""Components of the Gaussian mixture that the module `contact_mixture` uses to follow a contact.

The functions predict, prune and combine components.
"""

import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Integers
from isocharge.serve.model.contact import Contact
from isocharge.serve.tracking.two_mode_filter import MIN_ACCELERATION_SHARE, POSITION_MOTION

X = 0
"""Index of the position x in a state, mm."""

Y = 1
"""Index of the position y in a state, mm."""

LOG_FORCE = 2
"""Index of ln F in a state, where F is the force in N."""

X_RATE = 3
"""Index of the velocity along x in a state, mm/s."""

Y_RATE = 4
"""Index of the velocity along y in a state, mm/s."""

LOG_FORCE_RATE = 5
"""Index of the rate of ln F in a state, 1/s."""

POSITION = slice(X, LOG_FORCE)
"""Slice of x and y in a state."""

CONTACT = slice(X, X_RATE)
"""Slice of x, y and ln F in a state."""

VELOCITY = slice(X_RATE, LOG_FORCE_RATE)
"""Slice of the velocities along x and y in a state."""

RATES = slice(X_RATE, LOG_FORCE_RATE + 1)
"""Slice of the rates of x, y and ln F in a state."""

MOTION = slice(X, LOG_FORCE_RATE + 1)
"""Slice of x, y, ln F and their rates in a state."""

N_MOTION = LOG_FORCE_RATE + 1
"""Number of entries of `MOTION`."""

GAINS = slice(N_MOTION, None)
"""Slice of the logarithms of the electrode gains in a state."""

FORCE_ACCELERATION_DENSITY = 2.0
"""Spectral density of the second derivative of ln F, 1/s^3."""

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

    def extrapolated(self, dt_s: float) -> "ContactHypothesis":
        """Return the hypothesis at a later time, extrapolated with constant rates.

        The covariance is not changed, because its growth during the short time is negligible.

        Args:
            dt_s: Time by which the hypothesis is extrapolated, s.
        """
        mean = self.mean.copy()
        mean[CONTACT] += dt_s * mean[RATES]
        return self._replace(mean=mean)

    @property
    def contact(self) -> Contact:
        """The hypothesis as a `Contact`, which is the type that models use for their predictions.

        The state contains the logarithm of the force. The standard deviation of the force is therefore the force
        multiplied by the standard deviation of the logarithm.
        """
        x_mm, y_mm, log_force = self.mean[CONTACT].tolist()
        covariance = self.covariance[CONTACT, CONTACT]  # of x, y and ln F, shape (3, 3)
        std = np.sqrt(covariance.diagonal())
        correlation = covariance / np.outer(std, std)
        x_std_mm, y_std_mm, log_force_std = std.tolist()
        force_N = math.exp(log_force)
        return Contact(
            x_mm=x_mm,
            y_mm=y_mm,
            force_N=force_N,
            x_std_mm=x_std_mm,
            y_std_mm=y_std_mm,
            force_std_N=log_force_std * force_N,
            misfit=self.misfit,
            xy_correlation=float(correlation[X, Y]),
            xF_correlation=float(correlation[X, LOG_FORCE]),
            yF_correlation=float(correlation[Y, LOG_FORCE]),
        )

    @property
    def velocity_mm_per_s(self) -> tuple[float, float]:
        """Velocity along x and y, mm/s."""
        vx_mm_per_s, vy_mm_per_s = self.mean[VELOCITY].tolist()
        return vx_mm_per_s, vy_mm_per_s

    @property
    def moving_probability(self) -> float:
        """Probability that the estimated speed of a contact at rest would be smaller than the speed of this contact.

        The probability is the result of a chi-squared test with two degrees of freedom.
        """
        velocity = self.mean[VELOCITY]
        covariance = self.covariance[VELOCITY, VELOCITY]
        squared_distance = float(velocity @ np.linalg.solve(covariance, velocity))
        return -math.expm1(-0.5 * squared_distance)


class Components(NamedTuple):
    """The n Gaussian components of the mixture.

    Attributes:
        mean: Mean of the state of each component, shape (n, 6 + n_electrode).
        covariance: Covariance of the state of each component, shape (n, 6 + n_electrode, 6 + n_electrode).
        log_weight: Logarithm of the weight of each component, shape (n,). Only differences of the logarithms matter.
        misfit: Distance between the latest charges and the charges of the most probable component, in standard
            deviations of the noise; NaN before the first update.
    """

    mean: Array
    covariance: Array
    log_weight: Array
    misfit: float = math.nan

    @property
    def best(self) -> int:
        """Index of the most probable component."""
        return int(self.log_weight.argmax())

    def select(self, rows: "list[int] | Integers") -> "Components":
        """Return only the components with the indices `rows`."""
        return self._replace(mean=self.mean[rows], covariance=self.covariance[rows], log_weight=self.log_weight[rows])

    def with_component(self, mean: Array, covariance: Array, log_weight: float) -> "Components":
        """Return all components and one additional component.

        Args:
            mean: Mean of the state of the additional component, shape (6 + n_electrode,).
            covariance: Covariance of the state, shape (6 + n_electrode, 6 + n_electrode).
            log_weight: Logarithm of the weight of the additional component.
        """
        return self._replace(
            mean=np.vstack([self.mean, mean]),
            covariance=np.concatenate([self.covariance, covariance[None]]),
            log_weight=np.append(self.log_weight, log_weight),
        )


def predict_components(components: Components, dt_s: float) -> Components:
    """Predict the components at the next step.

    The rates of x, y and the logarithm of the force are assumed to be constant, except for a random white acceleration
    that increases the covariance.

    Args:
        components: Components after the update of the previous step.
        dt_s: Time since the previous step, s.
    """
    # A state contains x, y and ln F, the rates of these three values, and the gains. The gains are constant.
    mean = components.mean.copy()
    mean[:, CONTACT] += dt_s * mean[:, RATES]

    transition = np.eye(mean.shape[1])
    transition[CONTACT, RATES] = dt_s * np.eye(3)
    covariance = transition @ components.covariance @ transition.T

    # The spectral density of the white acceleration of the position is proportional to the squared speed, because a
    # fast contact changes its velocity more than a slow contact. The density has a lower limit.
    squared_speed = (mean[:, VELOCITY] ** 2).sum(axis=1)
    relative_density = np.maximum(squared_speed / POSITION_MOTION.velocity_variance, MIN_ACCELERATION_SHARE)
    position_density = POSITION_MOTION.acceleration_density * relative_density
    _add_process_noise(covariance, X, X_RATE, position_density, dt_s)
    _add_process_noise(covariance, Y, Y_RATE, position_density, dt_s)
    _add_process_noise(covariance, LOG_FORCE, LOG_FORCE_RATE, FORCE_ACCELERATION_DENSITY, dt_s)
    return components._replace(mean=mean, covariance=covariance)


def _add_process_noise(
    covariance: Array, value_index: int, rate_index: int, density: Array | float, dt_s: float
) -> None:
    """Add the process noise of a white acceleration to covariances (Bar-Shalom, Li and Kirubarajan 2001, 6.2.2).

    Args:
        covariance: Covariances of the state, shape (n, 6 + n_electrode, 6 + n_electrode). They are changed in place.
        value_index: Index of x, y or ln F in the state.
        rate_index: Index of the rate of the same quantity in the state.
        density: Spectral density of the acceleration, shape (n,) or a number, in squared units of the value per s^3.
        dt_s: Time over which the acceleration acts, s.
    """
    covariance[:, value_index, value_index] += density * dt_s**3 / 3.0
    covariance[:, value_index, rate_index] += density * dt_s**2 / 2.0
    covariance[:, rate_index, value_index] += density * dt_s**2 / 2.0
    covariance[:, rate_index, rate_index] += density * dt_s


def prune_components(components: Components) -> Components:
    """Remove improbable components, and merge components with a similar motion.

    If the motions of two components are similar, the less probable component is removed. The weight of the removed
    component is added to the weight of the more probable component. Only the `MAX_COMPONENTS` most probable components
    remain.

    Args:
        components: Components after an update. The largest logarithm of the weights is 0.
    """
    log_weight = components.log_weight.copy()
    descending_rows = np.argsort(-log_weight, kind="stable")  # rows of the components, the most probable first
    probable_rows = descending_rows[log_weight[descending_rows] > MIN_LOG_WEIGHT]
    remaining_rows: list[int] = []
    for row in probable_rows.tolist():
        similar_row = _similar_component(components, row, remaining_rows)
        if similar_row is None:
            remaining_rows.append(row)
        else:
            log_weight[similar_row] = np.logaddexp(log_weight[similar_row], log_weight[row])  # add the weights
    return components._replace(log_weight=log_weight).select(remaining_rows[:MAX_COMPONENTS])


def _similar_component(components: Components, row: int, candidate_rows: list[int]) -> int | None:
    """Return the first candidate whose motion is similar to the motion of a given component.

    A motion consists of x, y, ln F and the rates of these three values. Two motions are similar if each value differs
    by less than `MERGE_DISTANCE` standard deviations of the given component.

    Args:
        components: All components.
        row: Row of the given component.
        candidate_rows: Rows of the candidates.

    Returns:
        Row of the candidate; None if no candidate has a similar motion.
    """
    motion = components.mean[:, MOTION]
    std = np.sqrt(components.covariance[row].diagonal()[MOTION])
    for candidate_row in candidate_rows:
        difference = np.abs(motion[row] - motion[candidate_row])
        if (difference < MERGE_DISTANCE * std).all():
            return candidate_row
    return None


def combine_components(components: Components, probability: Array) -> ContactHypothesis:
    """Combine components that describe the same contact into one hypothesis.

    The hypothesis has the mean and the covariance of the mixture of the components.

    Args:
        components: The n components to combine.
        probability: Probability of each component, shape (n,).

    Returns:
        The hypothesis. Its probability is the sum of the probabilities of the components.
    """
    total_probability = probability.sum()
    weight = probability / total_probability  # the weights add up to 1
    mean = weight @ components.mean
    deviation = components.mean - mean  # shape (n, n_state)

    # The covariance of a mixture is the mean of the covariances plus the covariance of the means.
    covariance_within = np.tensordot(weight, components.covariance, 1)
    covariance_between = (weight[:, None] * deviation).T @ deviation
    covariance = covariance_within + covariance_between
    return ContactHypothesis(mean, covariance, float(total_probability), components.misfit)
