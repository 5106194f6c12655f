"""Gaussian mixture that follows a contact if the map from contacts to charges has a fold.

Near a fold of the map from contacts to charges, two different contacts produce the same charges. A single frame cannot
distinguish these two contacts. A sequence of frames can distinguish the two contacts, because one contact crosses the
fold while the other contact turns back at the fold.

The state of a component consists of x, y and the logarithm of the force, the rates of change of these three values, and
the logarithms of the electrode gains. The probability distribution of the state is a weighted sum of Gaussian
distributions (Alspach and Sorenson 1972).

Components are added in three cases.

- When a touch begins, components are placed all over the film. Components that do not explain the charges are removed.
- Before each update, a component with an unknown velocity is added, because the contact may have started or stopped.
- If the most probable component extends across a fold, two components are added at its ends.

The charges are averaged over intervals of `NOISE_INTERVAL_s` before an update. Shorter intervals would hardly improve
the accuracy.
"""

import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.flags import SATURATED
from isocharge.serve.frames.frame import Frame
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.serve.model.contact import Contact, Validity
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.record.record import OtherContact, TrackedContact
from isocharge.serve.tracking.motion_filter import (
    ACCELERATION_DENSITY,
    POSITION,
    RATES,
    SPEED_CHANGE_RATE,
    SQUARED_GATE,
    TIME_EXPONENT,
    UNIT_NOISE,
    VALUES,
    VELOCITY,
    MAX_GAP_s,
    MEAN_MODE_TIME_s,
    NOISE_INTERVAL_s,
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

The rate of ln F is small, because a wrong contact together with a change of the force may explain the charges. If the
force changes faster, the film is searched again.
"""

FORCE_ACCELERATION_DENSITY = 2.0
"""Spectral density of the second derivative of ln F, 1/s^3. It is small for the same reason."""


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
        """Return copies of the components with the indices `rows`, or of those for which `rows` is true."""
        return Components(self.mean[rows], self.covariance[rows], self.log_weight[rows])

    def with_copies_of_first(self, count: int) -> "Components":
        """Return copies of all components, followed by `count` further copies of the first component."""
        return self.select([*range(len(self.mean)), *[0] * count])


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
    present = components.with_copies_of_first(1)
    present.mean[-1, RATES] = 0.0
    present.covariance[-1, RATES] = 0.0
    present.covariance[-1, :, RATES] = 0.0
    present.covariance[-1, RATES, RATES] = np.diag(INITIAL_RATE_STD**2)
    present.log_weight[-1] += math.log(dt_s / MEAN_MODE_TIME_s)

    transition = np.eye(present.mean.shape[1])
    transition[VALUES, RATES] = dt_s * np.eye(3)
    covariance = transition @ present.covariance @ transition.T
    squared_speed = (present.mean[:, VELOCITY] ** 2).sum(axis=1, keepdims=True)
    density = ACCELERATION_DENSITY + squared_speed * SPEED_CHANGE_RATE
    density[:, [2, 5]] = FORCE_ACCELERATION_DENSITY  # of ln F and its rate
    covariance[:, MOTION, MOTION] += density[:, None] * UNIT_NOISE * dt_s**TIME_EXPONENT
    return present._replace(mean=present.mean @ transition.T, covariance=covariance)


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
    jacobian = np.zeros((len(states), charge_pC.size, states.shape[1]))  # J
    for iteration in range(iterations + 1):
        # Predict the measured charges and their derivatives with respect to the state. A measured charge is the charge
        # of the film times the gain.
        film_charge_pC, film_jacobian = charges.linearised(contacts_of(states))
        gains = np.exp(states[:, GAINS])
        predicted_pC = film_charge_pC * gains
        jacobian[:, :, VALUES] = film_jacobian * gains[:, :, None]
        jacobian[:, :, GAINS] = predicted_pC[:, :, None] * np.eye(charge_pC.size)

        # Compute the innovation v and its covariance S, relative to the charges of the prior mean.
        cross_covariance = jacobian @ prior.covariance  # J P
        charge_covariance = cross_covariance @ jacobian.swapaxes(1, 2)  # J P J^T
        innovation_covariance = charge_covariance + np.diag(variance_pC2)
        residual_pC = charge_pC - predicted_pC
        innovation = residual_pC[:, :, None] - jacobian @ (prior.mean - states)[:, :, None]
        weighted_innovation = np.linalg.solve(innovation_covariance, innovation)  # S^-1 v
        if iteration < iterations:  # move the state, unless this is the last evaluation
            # From the present state to the Kalman update of the prior mean, shape (n_component, n_state)
            step = prior.mean + (cross_covariance.swapaxes(1, 2) @ weighted_innovation)[:, :, 0] - states
            relative_length = np.abs(step[:, VALUES]) / MAX_ITERATION_STEP
            states = states + step / np.maximum(relative_length.max(axis=1, keepdims=True), 1.0)

    squared_misfit = (residual_pC**2 / variance_pC2).sum(axis=1)
    squared_change = (weighted_innovation * (charge_covariance @ weighted_innovation)).sum(axis=(1, 2))
    squared_distance = squared_misfit + squared_change
    log_weight = prior.log_weight - 0.5 * (squared_distance + np.linalg.slogdet(innovation_covariance).logabsdet)
    gain = np.linalg.solve(innovation_covariance, cross_covariance).swapaxes(1, 2)  # Kalman gain P J^T S^-1
    covariance = prior.covariance - gain @ cross_covariance
    covariance = 0.5 * (covariance + covariance.swapaxes(1, 2))  # removes asymmetric rounding errors
    return UpdatedComponents(Components(states, covariance, log_weight), squared_misfit, squared_distance)


def prune_components(components: Components, max_count: int = 8, merge_distance: float = 0.7) -> Components:
    """Remove components whose weight is too small for a number, and merge components with a similar motion.

    If the motions of two components are similar, the less probable component is removed. The weight of the removed
    component is added to the weight of the more probable component.

    Args:
        components: Components after an update.
        max_count: Largest number of components that remain, which are the most probable ones.
        merge_distance: Difference of each entry of `MOTION` below which two components are merged, in standard
            deviations of the entry.

    Returns:
        The remaining components, the most probable first.
    """
    log_weight = components.log_weight - components.log_weight.max()
    # Motion of each component and its standard deviations, shape (n_component, number of entries of MOTION)
    motion = components.mean[:, MOTION]
    std = np.sqrt(np.diagonal(components.covariance, axis1=1, axis2=2)[:, MOTION])
    kept: list[int] = []
    for row in np.argsort(-log_weight, kind="stable").tolist():  # the most probable component first
        if np.exp(log_weight[row]) < np.finfo(float).tiny:
            break
        is_similar = (np.abs(motion[kept] - motion[row]) < merge_distance * std[row]).all(axis=1)
        if is_similar.any():
            first = kept[is_similar.argmax()]
            log_weight[first] = np.logaddexp(log_weight[first], log_weight[row])  # add the weights
        else:
            kept.append(row)
    return components._replace(log_weight=log_weight).select(kept[:max_count])


def split_first_component(components: Components, axis: Array, distance: float) -> Components:
    """Add two narrow components, one at each end of an axis through the first component.

    The weight of an added component is the density of the first component at this end. Its variance along the axis is a
    quarter of that of the first component.

    Args:
        components: The components.
        axis: Expected change of the state for one standard deviation along the axis, shape (6 + n_electrode,).
        distance: Distance of the ends from the first component, in standard deviations.
    """
    split = components.with_copies_of_first(2)
    split.mean[-2:] += distance * np.array([axis, -axis])
    split.covariance[-2:] -= 0.75 * np.outer(axis, axis)
    split.log_weight[-2:] -= 0.5 * distance**2
    return split


SLOW_NOISE_STD = 0.003
"""Standard deviation of slow noise, relative to the charge. Slow noise lasts for several frames."""

SEARCH_INTERVAL_s = 0.05
"""Pause of the searches over the whole film after an unsuccessful search, s. Each search takes milliseconds."""

MAX_RELATIVE_RADIUS = 1.1
"""Distance from the centre, relative to the radius of the film, beyond which components are removed."""

CLEAR_DISTANCE = 4.0
"""Distance, in standard deviations, above which two positions are clearly different.

Components that are further apart are different contacts. If a fold is nearer to the most probable component, two
components are added. The distance is large, because an error of a gain displaces the fold. The contact then seems to
stop before the fold.
"""

SPLIT_DISTANCE = 2.5
"""Distance of an added component from the component that extends across a fold, in standard deviations."""

CERTAIN_PROBABILITY = 0.97
"""Probability of a contact above which no other contact is reported."""


class ContactHypothesis(NamedTuple):
    """A contact that explains the measured charges, with its probability.

    Attributes:
        mean: Mean of the state, shape (6 + n_electrode,): x and y in mm, ln F, the rates of these three values in mm/s
            and 1/s, and the logarithms of the gains.
        covariance: Covariance of the state, shape (6 + n_electrode, 6 + n_electrode).
        probability: Probability that the film is touched by this contact, and not by another contact.
    """

    mean: Array
    covariance: Array
    probability: float

    def values_after(self, dt_s: float) -> tuple[float, float, float]:
        """Return x, mm, y, mm, and the force, N, after a time, s, in which the rates are constant."""
        x_mm, y_mm, log_force = (self.mean[VALUES] + dt_s * self.mean[RATES]).tolist()
        return x_mm, y_mm, math.exp(log_force)

    def contact_after(self, dt_s: float, misfit: float) -> Contact:
        """Return the contact, with a given misfit, after a time, s, in which the growth of the covariance is small."""
        x_mm, y_mm, force_N = self.values_after(dt_s)
        std = np.sqrt(self.covariance.diagonal()[VALUES])  # of x, y and ln F
        correlations = (self.covariance[VALUES, VALUES] / np.outer(std, std))[np.triu_indices(3, 1)]
        x_std_mm, y_std_mm, force_std_N = (std * [1.0, 1.0, force_N]).tolist()
        return Contact(x_mm, y_mm, force_N, x_std_mm, y_std_mm, force_std_N, misfit, *correlations.tolist())

    @property
    def moving_probability(self) -> float:
        """Probability that the estimated speed of a contact at rest would be smaller than the speed of this contact.

        The probability is the result of a chi-squared test with two degrees of freedom.
        """
        velocity = self.mean[VELOCITY]
        squared_distance = velocity @ np.linalg.solve(self.covariance[VELOCITY, VELOCITY], velocity)
        return -math.expm1(-0.5 * squared_distance)


class ContactMixture:
    """Gaussian mixture that estimates the position and the force of one contact from the charges of each frame.

    The methods must be called from one thread. Equal sequences of frames always give bitwise equal results.

    Attributes:
        time_s: Time of the latest update, which is the mean time of its frames, s.
        other: Second possible contact in the latest frame, or None.
    """

    def __init__(self, charges: ChargeSeries, noise: ModelNoise, validity: Validity) -> None:
        """Start without a contact.

        Args:
            charges: Charges of every contact on the film.
            noise: Noise of the charges of a frame.
            validity: Domain in which the contacts of the mixture are valid.
        """
        self._charges = charges
        self._noise = noise
        self._validity = validity
        self.time_s = -math.inf
        self._misfit = math.nan  # misfit of the most probable component
        self.other: OtherContact | None = None
        self._components: Components | None = None
        self._hypotheses: list[ContactHypothesis] = []
        self._frames: list[tuple[Array, float]] = []  # charges and time of each frame of the present step
        self._step_begin_s = -math.inf
        self._next_search_s = -math.inf  # earliest time of the next search over the whole film

    def step(self, frame: Frame, t_s: float) -> TrackedContact | None:
        """Process the next frame, and replace its contact by the most probable contact.

        Args:
            frame: Frame with a contact. A frame with saturated charges is ignored.
            t_s: Time of the frame on a clock that is never set back, s.

        Returns:
            The most probable contact, or None if the frame is ignored or no contact explains the charges.
        """
        if SATURATED in frame.flags or frame.charge_pC is None:  # saturated charges are wrong
            return None
        hypotheses = self.update(frame.charge_pC, t_s)
        if not hypotheses:
            return None
        best, *others = hypotheses
        delay_s = t_s - self.time_s
        contact = best.contact_after(delay_s, self._misfit)
        frame.set_contact(contact, self._validity)
        self.other = None
        if best.probability < CERTAIN_PROBABILITY:
            self.other = OtherContact(*others[0].values_after(delay_s), others[0].probability)
        vx_mm_s, vy_mm_s = best.mean[VELOCITY].tolist()
        return TrackedContact(*contact[:6], vx_mm_s, vy_mm_s, best.moving_probability)

    def update(self, charge_pC: Array, t_s: float) -> list[ContactHypothesis]:
        """Process the charges of a frame, and return the contacts that explain the charges of the latest update.

        The frames within `NOISE_INTERVAL_s` are one step. The mixture is updated once in each step, with the mean
        charges of the frames of the step.

        Args:
            charge_pC: Touch charges, shape (n_electrode,), pC.
            t_s: Time of the frame, s.

        Returns:
            The contacts at the time `time_s` of the latest update, in descending order of their probability. The list
            is empty if no contact explains the charges.
        """
        # After a gap in the stream, the frames of a step that was not complete may belong to another contact.
        self._frames = [(charge, time) for charge, time in self._frames if t_s - time < 2.0 * NOISE_INTERVAL_s]
        self._frames.append((charge_pC, t_s))
        if t_s - self._step_begin_s < NOISE_INTERVAL_s:
            return self._hypotheses

        # The frame noise of the n frames is independent, so its variance is divided by n. The slow noise is the same in
        # all frames of a step.
        charges, times_s = zip(*self._frames, strict=True)
        mean_pC = np.mean(charges, axis=0)
        time_s = float(np.mean(times_s))
        variance_pC2 = self._noise.variance(mean_pC) / len(self._frames) + (SLOW_NOISE_STD * mean_pC) ** 2
        dt_s = time_s - self.time_s
        self._frames = []
        self._step_begin_s = t_s
        self.time_s = time_s

        # Follow the contact of the previous step. If there was no contact, or the charges no longer fit it, search the
        # whole film, which needs more iterations. The search takes milliseconds, so it is not repeated in every step if
        # it finds no contact.
        previous = self._components
        self._components = None
        self._hypotheses = []
        if previous is not None and dt_s < MAX_GAP_s:
            self._update(predict_components(previous, dt_s), mean_pC, variance_pC2, iterations=3)
        if self._components is None and t_s >= self._next_search_s:
            self._update(self._initial_components(), mean_pC, variance_pC2, iterations=20)
            if self._components is None:
                self._next_search_s = t_s + SEARCH_INTERVAL_s
        return self._hypotheses

    def _initial_components(self, grid_points: int = 13) -> Components:
        """Return components with a medium force and large variances at the points of a grid all over the film.

        Args:
            grid_points: Number of components along each axis of the film.
        """
        domain = self._charges.domain
        # Choose the points of a square grid that lie on the film, shape (n, 2).
        coordinates = np.linspace(-domain.radius, domain.radius, grid_points)
        grid = np.stack(np.meshgrid(coordinates, coordinates), axis=-1).reshape(-1, 2)
        grid = grid[np.hypot(*grid.T) <= domain.radius]

        std = np.full(MOTION.stop + len(self._charges.electrodes), GAIN_STD)  # of each entry of a state
        std[POSITION] = coordinates[1] - coordinates[0]
        std[2] = domain.scale[2]  # of ln F
        std[RATES] = INITIAL_RATE_STD

        # The rates and the logarithms of the gains have the mean 0.
        mean = np.zeros((len(grid), std.size))
        mean[:, POSITION] = grid
        mean[:, 2] = domain.centre[2]  # ln F
        return Components(mean, np.tile(np.diag(std**2), (len(grid), 1, 1)), np.zeros(len(grid)))

    def _update(self, prior: Components, charge_pC: Array, variance_pC2: Array, iterations: int) -> None:
        """Update components with charges, and store them with their contacts if the charges are explained.

        Args:
            prior: Predicted components. Those that are updated to states beyond `MAX_RELATIVE_RADIUS` are removed.
            charge_pC: Mean charges of this step, shape (n_electrode,), pC.
            variance_pC2: Variances of the charges, shape (n_electrode,), pC^2.
            iterations: Number of iterations of the Kalman filter.
        """
        updated = update_components(self._charges, prior, charge_pC, variance_pC2, iterations)
        components = updated.components
        distance_mm = np.hypot(*components.mean[:, POSITION].T)
        is_outside = distance_mm > MAX_RELATIVE_RADIUS * self._charges.domain.radius
        components.log_weight[is_outside] = -np.inf
        best = components.log_weight.argmax()
        if is_outside[best] or updated.squared_distance[best] > SQUARED_GATE:
            return
        self._misfit = math.sqrt(updated.squared_misfit[best])
        components = prune_components(components)

        # Search for folds between the components, and between the most probable component and two states that lie at
        # the distance `CLEAR_DISTANCE` on its longest axis.
        axis = _longest_axis(components.covariance[0])
        distant_states = components.mean[0] + CLEAR_DISTANCE * np.array([axis, -axis])
        is_across_fold = self._is_across_fold(np.vstack([distant_states, components.mean]))
        self._hypotheses = _hypotheses_of(components, is_across_fold[2:, 2:])
        if is_across_fold[2, :2].any():  # a Gaussian component describes only the contacts on one side of a fold
            components = split_first_component(components, axis, SPLIT_DISTANCE)
        self._components = components

    def _is_across_fold(self, states: Array) -> Booleans:
        """Return for each pair of n states whether an odd number of folds lies between them, shape (n, n).

        At a fold, the orientation of the map from contacts to charges changes. For three electrodes, the determinants
        of the Jacobians J and K of two states then differ in sign, and det(J^T K) = det(J) det(K) is negative. With
        more electrodes, J and K are not square, but the product J^T K is square.

        Args:
            states: The states, shape (n, 6 + n_electrode).
        """
        _, jacobians = self._charges.linearised(contacts_of(states))
        transposed = jacobians.swapaxes(1, 2)[:, np.newaxis]
        return np.asarray(np.linalg.det(transposed @ jacobians) < 0.0)


def _longest_axis(covariance: Array) -> Array:
    """Return the expected change of a state if its position changes by one standard deviation along the longest axis.

    Args:
        covariance: Covariance of the state, shape (6 + n_electrode, 6 + n_electrode).
    """
    variances, axes = np.linalg.eigh(covariance[POSITION, POSITION])  # ascending; each column is the axis of a variance
    return np.asarray(covariance[:, POSITION] @ axes[:, 1] / math.sqrt(variances[1]))


def _hypotheses_of(components: Components, is_across_fold: Booleans) -> list[ContactHypothesis]:
    """Combine the components that describe the same contact, and return one hypothesis for each contact.

    Two components describe the same contact if x and y differ by less than `CLEAR_DISTANCE` standard deviations of
    the difference, and no fold lies between them.

    Args:
        components: The n components after the update, the most probable first.
        is_across_fold: Whether a fold lies between two components, shape (n, n).

    Returns:
        The hypotheses in descending order of their probability.
    """
    weight = np.exp(components.log_weight)
    position = components.mean[:, POSITION]
    variance = np.diagonal(components.covariance, axis1=1, axis2=2)[:, POSITION]
    is_remaining = np.ones(len(weight), dtype=bool)
    hypotheses = []
    while is_remaining.any():
        first = is_remaining.argmax()  # the most probable of the remaining components
        distance_mm = np.abs(position - position[first])
        is_near = (distance_mm < CLEAR_DISTANCE * np.sqrt(variance + variance[first])).all(axis=1)
        is_same = is_remaining & is_near & ~is_across_fold[first]
        is_same[first] = True  # even if rounding errors make it appear to be across a fold
        is_remaining &= ~is_same

        # Compute the mean and the covariance of the mixture of these components.
        group = components.select(is_same)
        share = weight[is_same] / weight[is_same].sum()
        mean = share @ group.mean
        deviation = group.mean - mean
        covariance = np.tensordot(share, group.covariance, 1) + (share * deviation.T) @ deviation
        probability = weight[is_same].sum() / weight.sum()
        hypotheses.append(ContactHypothesis(mean, covariance, float(probability)))
    return sorted(hypotheses, key=lambda hypothesis: -hypothesis.probability)
