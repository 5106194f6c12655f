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
- If the most probable component extends across a fold, one component is added at each of its two ends.

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
from isocharge.serve.tracking.gaussian_components import (
    GAIN_STD,
    INITIAL_RATE_STD,
    Components,
    contacts_of,
    predict_components,
    prune_components,
    split_first_component,
    update_components,
)
from isocharge.serve.tracking.motion_filter import (
    POSITION,
    RATES,
    SQUARED_GATE,
    VALUES,
    VELOCITY,
    MAX_GAP_s,
    NOISE_INTERVAL_s,
)

SLOW_NOISE_STD = 0.003
"""Standard deviation of slow noise, relative to the charge. Slow noise lasts for several frames."""

SEARCH_INTERVAL_s = 0.05
"""Time between an unsuccessful search of the whole film and the next search, s. Each search takes milliseconds."""

MAX_RELATIVE_RADIUS = 1.1
"""Distance from the centre, relative to the radius of the film, beyond which components are removed."""

CLEAR_DISTANCE = 4.0
"""Distance, in standard deviations, above which two positions are clearly different.

Components that are further apart describe different contacts. If a fold is nearer than this distance to the most
probable component, two components are added. The distance is large, because an error of an electrode gain displaces the
fold. A contact that crosses the fold then seems to stop before the fold.
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
        """Return x (mm), y (mm) and the force (N) after the time `dt_s`, assuming that the rates stay constant."""
        x_mm, y_mm, log_force = (self.mean[VALUES] + dt_s * self.mean[RATES]).tolist()
        return x_mm, y_mm, math.exp(log_force)

    def contact_after(self, dt_s: float, misfit: float) -> Contact:
        """Return the contact after the time `dt_s`. The covariance is taken as constant, because the time is short.

        The state contains ln F, and the contact contains F. The standard deviation of F is F times that of ln F, and
        the correlations are the same.

        Args:
            dt_s: The time, s.
            misfit: Distance of the measured charges from the charges of the contact, in standard deviations of the
                noise.
        """
        x_mm, y_mm, force_N = self.values_after(dt_s)
        covariance = self.covariance[VALUES, VALUES]  # of x, y and ln F
        std = np.sqrt(covariance.diagonal())
        x_std_mm, y_std_mm, log_force_std = std.tolist()
        correlation_matrix = covariance / np.outer(std, std)
        correlations = correlation_matrix[np.triu_indices(3, 1)].tolist()  # of x and y, x and F, y and F
        return Contact(x_mm, y_mm, force_N, x_std_mm, y_std_mm, force_N * log_force_std, misfit, *correlations)

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

        The frames of a few milliseconds form one step. Each step updates Gaussian components, which together are the
        probability distribution of the contact. Components that describe the same contact form one hypothesis.

        Args:
            charges: Charges of every contact on the film.
            noise: Noise of the charges of a frame.
            validity: Domain in which the contacts of the model are valid.
        """
        self._charges = charges
        self._noise = noise
        self._validity = validity
        self.time_s = -math.inf  # mean time of the frames of the latest step
        self._misfit = math.nan  # misfit of the most probable component in this step
        self.other: OtherContact | None = None  # second contact that may explain the charges of the latest frame
        self._components: Components | None = None  # None if no contact explains the charges
        self._hypotheses: list[ContactHypothesis] = []  # contacts after the latest update, the most probable one first
        self._frames: list[tuple[Array, float]] = []  # charges and time of each frame since the latest update
        self._previous_step_end_s = -math.inf  # time of the frame after which the latest update was made
        self._next_search_s = -math.inf  # earliest time of the next search over the whole film

    def step(self, frame: Frame, t_s: float) -> TrackedContact | None:
        """Process the next frame, and replace its contact by the most probable contact.

        If this contact is uncertain, the second most probable contact is stored in the attribute `other`.

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
        # The hypotheses belong to the mean time of the frames of the latest step, which is earlier than this frame.
        delay_s = t_s - self.time_s
        contact = best.contact_after(delay_s, self._misfit)
        frame.set_contact(contact, self._validity)
        self.other = None
        if best.probability < CERTAIN_PROBABILITY:
            second_best = others[0]  # exists, because the sum of all probabilities is 1
            self.other = OtherContact(*second_best.values_after(delay_s), second_best.probability)
        vx_mm_s, vy_mm_s = best.mean[VELOCITY].tolist()
        # The first six fields are x, y and F, and their standard deviations.
        return TrackedContact(*contact[:6], vx_mm_s, vy_mm_s, best.moving_probability)

    def update(self, charge_pC: Array, t_s: float) -> list[ContactHypothesis]:
        """Process the charges of a frame, and return the contacts that explain the charges of the latest update.

        Frames within `NOISE_INTERVAL_s` form one step, because a part of their noise is the same. The mixture is
        updated at the end of each step, with the mean charges of the frames in the step. The components of the mixture
        (`_components`) are Gaussian distributions of the contact. If no contact explains the charges, `_components` is
        None.

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
        if t_s - self._previous_step_end_s < NOISE_INTERVAL_s:
            return self._hypotheses

        # The frame noise of the n frames is independent, so its variance is divided by n. The slow noise is the same in
        # all frames of a step.
        charges, times_s = zip(*self._frames, strict=True)
        mean_pC = np.mean(charges, axis=0)
        mean_time_s = float(np.mean(times_s))
        variance_pC2 = self._noise.variance(mean_pC) / len(self._frames) + (SLOW_NOISE_STD * mean_pC) ** 2
        dt_s = mean_time_s - self.time_s  # since the previous step
        self._frames = []
        self._previous_step_end_s = t_s
        self.time_s = mean_time_s

        # Follow the contact of the previous step. If there was no contact, or the charges no longer fit it, search the
        # whole film, which needs more iterations. The search takes milliseconds, so it is not repeated in every step if
        # it finds no contact. `_fit_components` sets `_components` and `_hypotheses` only if it finds a contact.
        previous = self._components
        self._components = None
        self._hypotheses = []
        if previous is not None and dt_s < MAX_GAP_s:
            self._fit_components(predict_components(previous, dt_s), mean_pC, variance_pC2, iterations=3)
        if self._components is None and t_s >= self._next_search_s:
            self._fit_components(self._initial_components(), mean_pC, variance_pC2, iterations=20)
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

        # Standard deviations of x and y, of ln F, of the rates, and of the logarithms of the gains. `domain.scale` and
        # `domain.centre` are the half width and the centre of the domain in x, y and ln F.
        spacing_mm = coordinates[1] - coordinates[0]
        _, _, log_force_scale = domain.scale
        gain_std = np.full(len(self._charges.electrodes), GAIN_STD)
        std = np.hstack([spacing_mm, spacing_mm, log_force_scale, INITIAL_RATE_STD, gain_std])
        covariance = np.tile(np.diag(std**2), (len(grid), 1, 1))

        # The rates and the logarithms of the gains have the mean 0.
        _, _, medium_log_force = domain.centre
        mean = np.zeros((len(grid), std.size))
        mean[:, VALUES] = np.column_stack([grid, np.full(len(grid), medium_log_force)])
        equal_log_weights = np.zeros(len(grid))
        return Components(mean, covariance, equal_log_weights)

    def _fit_components(self, prior: Components, charge_pC: Array, variance_pC2: Array, iterations: int) -> None:
        """Update components with charges, and store the result if a component explains the charges.

        The result consists of the components (`_components`), the contacts that they represent (`_hypotheses`), and the
        misfit of the most probable component (`_misfit`). If no component explains the charges, these attributes remain
        unchanged.

        Args:
            prior: Predicted components. A component is removed if its updated state lies beyond `MAX_RELATIVE_RADIUS`.
            charge_pC: Mean charges of this step, shape (n_electrode,), pC.
            variance_pC2: Variances of the charges, shape (n_electrode,), pC^2.
            iterations: Number of iterations of the Kalman filter.
        """
        # Update the components, and remove those that are no longer on the film.
        updated = update_components(self._charges, prior, charge_pC, variance_pC2, iterations)
        components = updated.components
        distance_mm = np.hypot(*components.mean[:, POSITION].T)  # from the centre
        is_outside = distance_mm > MAX_RELATIVE_RADIUS * self._charges.domain.radius
        components.log_weight[is_outside] = -np.inf
        best = components.log_weight.argmax()
        # `SQUARED_GATE` is the squared distance above which a component does not explain the charges.
        if is_outside[best] or updated.squared_distance[best] > SQUARED_GATE:  # no component explains the charges
            return
        self._misfit = math.sqrt(updated.squared_misfit[best])
        components = prune_components(components)  # the most probable component is now the first one

        # Search for folds between the components. Also search for folds between the most probable component and two
        # distant states, the ends of its longest axis. They lie at the distance `CLEAR_DISTANCE` on either side. If the
        # component extends across a fold, it must be split, because it describes only the contacts on one side.
        axis = _longest_axis(components.covariance[0])
        axis_ends = components.mean[0] + CLEAR_DISTANCE * np.array([axis, -axis])
        is_across_fold = self._is_across_fold(np.vstack([axis_ends, components.mean]))
        best_row = 2  # the two ends have the rows 0 and 1, and all components follow, the most probable first
        has_fold_between_components = is_across_fold[best_row:, best_row:]
        has_fold_beside_best = is_across_fold[best_row, :best_row]
        self._hypotheses = _hypotheses_of(components, has_fold_between_components)
        if has_fold_beside_best.any():
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

        # Compute the mean and the covariance of the mixture of these components. The covariance is the mean of their
        # covariances plus the covariance of their means.
        group = components.select(is_same)
        group_weight = weight[is_same].sum()
        share = weight[is_same] / group_weight
        mean = share @ group.mean
        deviation = group.mean - mean
        spread = (share * deviation.T) @ deviation  # covariance of the means, weighted by the shares
        covariance = np.tensordot(share, group.covariance, 1) + spread
        probability = group_weight / weight.sum()
        hypotheses.append(ContactHypothesis(mean, covariance, float(probability)))
    return sorted(hypotheses, key=lambda hypothesis: -hypothesis.probability)
