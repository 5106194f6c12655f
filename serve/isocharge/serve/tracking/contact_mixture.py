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
- If the most probable component extends across a fold, one component is added on each side of the fold.

The charges are averaged over intervals of `NOISE_INTERVAL_s` before an update. Shorter intervals would hardly improve
the accuracy.
"""

import math

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.tracking.mixture_components import (
    MOTION,
    Components,
    ContactHypothesis,
    film_charges,
    predict_components,
    prune_components,
    update_components,
)
from isocharge.serve.tracking.motion_filter import (
    INITIAL_RATE_STD,
    POSITION,
    RATES,
    MAX_GAP_s,
    MEAN_MODE_TIME_s,
    NOISE_INTERVAL_s,
    mixture_moments,
)

GAIN_STD = 0.01
"""Standard deviation of an electrode gain about its calibrated value, dimensionless."""

SLOW_NOISE_STD = 0.003
"""Standard deviation of slow noise, relative to the charge. Slow noise lasts for several frames."""

INITIAL_LOG_FORCE_STD = 2.0
"""Standard deviation of ln F when a touch begins, dimensionless."""

SEARCH_INTERVAL_s = 0.05
"""Shortest time between two searches over the whole film, s. Each search takes milliseconds."""

MAX_SQUARED_DISTANCE = 60.0
"""Largest squared distance of a component that explains the charges, dimensionless."""

MAX_RELATIVE_RADIUS = 1.1
"""Distance from the centre, relative to the radius of the film, beyond which components are removed."""

FOLD_DISTANCE = 4.0
"""Distance of a fold from the most probable component, in standard deviations, below which two components are added.

The distance is large, because an error of a gain displaces the fold. The contact then seems to stop before the fold.
"""

SPLIT_DISTANCE = 2.5
"""Distance of an added component from the component that extends across a fold, in standard deviations."""

SPLIT_VARIANCE_RATIO = 0.25
"""Variance of a component added at a fold along the axis of the split, relative to the original component."""

SEPARATE_DISTANCE = 3.0
"""Distance, in standard deviations, above which components on the same side of a fold are different contacts."""

GRID_POINTS = 13
"""Number of components along each axis of the film when a touch begins."""

UPDATE_ITERATIONS = 3
"""Number of iterations of the Kalman filter in each update."""

INITIAL_ITERATIONS = 20
"""Number of iterations of the Kalman filter when a touch begins."""


class ContactMixture:
    """Gaussian mixture that estimates the position and the force of one contact from the charges of each frame.

    The methods must be called from one thread. The same sequence of frames always gives bitwise equal results.

    Attributes:
        charges: Charges of every contact on the film.
        time_s: Time of the latest update, which is the mean time of its frames, s.
    """

    def __init__(self, charges: ChargeSeries, noise: ModelNoise) -> None:
        """Start without a contact.

        Args:
            charges: Charges of every contact on the film.
            noise: Noise of the charges of a frame, with which the model was trained.
        """
        self.charges = charges
        self._noise = noise
        self.reset()

    def reset(self) -> None:
        """Discard the contact and all received frames."""
        self.time_s = -math.inf
        self._components: Components | None = None
        self._hypotheses: list[ContactHypothesis] = []
        self._frames: list[tuple[Array, float]] = []  # charges and time of each frame of the present step
        self._step_begin_s = -math.inf
        self._next_search_s = -math.inf  # earliest time of the next search over the whole film

    def update(self, charge_pC: Array, t_s: float) -> list[ContactHypothesis]:
        """Process the next frame, and return the contacts that explain the charges.

        The mixture is updated only once in each step, with the mean charges of the frames of the step. If the clock was
        set back, the contact and all earlier frames are discarded. The whole film is then searched at once.

        Args:
            charge_pC: Touch charges, shape (n_electrode,), pC.
            t_s: Time of the frame on any clock, s.

        Returns:
            The contacts that explain the charges at `time_s`, in descending order of their probability. The list is
            empty if no contact explains the charges.
        """
        latest_frame_s = self._frames[-1][1] if self._frames else self._step_begin_s
        if t_s < latest_frame_s:
            self.reset()
        self._frames.append((charge_pC, t_s))
        if t_s - self._step_begin_s < NOISE_INTERVAL_s:
            return self._hypotheses

        # The frame noise of the n frames is independent, so its variance is divided by n. The slow noise is the same.
        mean_pC = np.mean([charge for charge, _ in self._frames], axis=0)
        time_s = float(np.mean([time for _, time in self._frames]))
        variance_pC2 = self._noise.variance(mean_pC) / len(self._frames) + (SLOW_NOISE_STD * mean_pC) ** 2
        dt_s = time_s - self.time_s
        self._frames = []
        self._step_begin_s = t_s
        self.time_s = time_s

        # Follow the contact of the previous step. If there was no contact, or the charges no longer fit it, search the
        # whole film. The search takes milliseconds, so it is not repeated in every step.
        previous = self._components
        self._components = None
        self._hypotheses = []
        if previous is not None and dt_s < MAX_GAP_s:
            self._update(_predicted(previous, dt_s), mean_pC, variance_pC2, UPDATE_ITERATIONS)
        if self._components is None and t_s >= self._next_search_s:
            self._next_search_s = t_s + SEARCH_INTERVAL_s
            self._update(self._initial_components(), mean_pC, variance_pC2, INITIAL_ITERATIONS)
        return self._hypotheses

    def _initial_components(self) -> Components:
        """Return components with a medium force and large variances at the points of a grid all over the film."""
        domain = self.charges.domain
        coordinates = np.linspace(-domain.radius, domain.radius, GRID_POINTS)
        grid = np.stack(np.meshgrid(coordinates, coordinates), axis=-1).reshape(-1, 2)
        grid = grid[np.hypot(grid[:, 0], grid[:, 1]) <= domain.radius]
        mean = np.zeros((len(grid), MOTION.stop + len(self.charges.electrodes)))
        mean[:, POSITION] = grid
        mean[:, 2] = np.log(domain.force_range).mean()

        std = np.full(mean.shape[1], GAIN_STD)
        std[POSITION] = coordinates[1] - coordinates[0]
        std[2] = INITIAL_LOG_FORCE_STD
        std[RATES] = INITIAL_RATE_STD
        return Components(mean, np.tile(np.diag(std**2), (len(mean), 1, 1)), np.zeros(len(mean)))

    def _update(self, prior: Components, charge_pC: Array, variance_pC2: Array, iterations: int) -> None:
        """Update components with charges, and store them with their contacts if the charges are explained.

        Args:
            prior: Predicted components. Those that are updated to states beyond `MAX_RELATIVE_RADIUS` are removed.
            charge_pC: Mean charges of this step, shape (n_electrode,), pC.
            variance_pC2: Variances of the charges, shape (n_electrode,), pC^2.
            iterations: Number of iterations of the Kalman filter.
        """
        updated = update_components(self.charges, prior, charge_pC, variance_pC2, iterations)
        components = updated.components
        distance_mm = np.hypot(components.mean[:, 0], components.mean[:, 1])
        is_outside = distance_mm > MAX_RELATIVE_RADIUS * self.charges.domain.radius
        log_weight = np.where(is_outside, -np.inf, components.log_weight)
        best = int(log_weight.argmax())
        if is_outside[best] or updated.squared_distance[best] > MAX_SQUARED_DISTANCE:
            return
        components = prune_components(components._replace(log_weight=log_weight))  # the most probable is now the first
        count = len(components.mean)
        half_axis = _half_axis(components)
        states = np.vstack([components.mean, components.mean[0] + FOLD_DISTANCE * half_axis])
        is_across_fold = self._is_across_fold(states)
        misfit = math.sqrt(updated.squared_misfit[best])
        self._hypotheses = _hypotheses_of(components, is_across_fold[:count, :count], misfit)
        if is_across_fold[0, count:].any():
            components = _split_at_fold(components, half_axis)
        self._components = components

    def _is_across_fold(self, states: Array) -> Booleans:
        """Return for each pair of n states whether an odd number of folds lies between them, shape (n, n).

        At a fold, the orientation of the map from contacts to charges changes. For three electrodes, the determinants
        of the Jacobians J and K of two states then differ in sign, and det(J^T K) = det(J) det(K) is negative. With
        more electrodes, J and K are not square, but the product J^T K is square.

        Args:
            states: The states, shape (n, 6 + n_electrode).
        """
        _, jacobians = film_charges(self.charges, states)
        transposed = jacobians.swapaxes(1, 2)[:, np.newaxis]
        return np.asarray(np.linalg.det(transposed @ jacobians) < 0.0)


def _half_axis(components: Components) -> Array:
    """Return the expected changes of the state to both ends of the longest axis of the most probable component.

    Args:
        components: Components, the most probable first.

    Returns:
        Changes of the whole state if the position changes by one standard deviation along the axis, or by minus one,
        shape (2, 6 + n_electrode).
    """
    covariance = components.covariance[0]
    variances, axes = np.linalg.eigh(covariance[POSITION, POSITION])  # in ascending order
    change = covariance[:, POSITION] @ axes[:, 1] / math.sqrt(variances[1])
    return np.array([change, -change])


def _split_at_fold(components: Components, half_axis: Array) -> Components:
    """Add one component on each side of the most probable component, which extends across a fold.

    A single Gaussian component describes only the contacts on one side of the fold accurately.

    Args:
        components: Components, the most probable first.
        half_axis: Changes of the state, as `_half_axis` returns them.
    """
    log_weight = components.log_weight[0] - 0.5 * SPLIT_DISTANCE**2  # density of the most probable component there
    change, _ = half_axis
    narrow_covariance = components.covariance[0] - (1.0 - SPLIT_VARIANCE_RATIO) * np.outer(change, change)
    added = Components(
        components.mean[0] + SPLIT_DISTANCE * half_axis, np.array([narrow_covariance] * 2), np.full(2, log_weight)
    )
    return components.joined(added)


def _hypotheses_of(components: Components, is_across_fold: Booleans, misfit: float) -> list[ContactHypothesis]:
    """Combine the components that describe the same contact, and return one hypothesis for each contact.

    Two components describe the same contact if x and y differ by less than `SEPARATE_DISTANCE` standard deviations of
    the difference, and no fold lies between them.

    Args:
        components: The n components after the update, the most probable first.
        is_across_fold: Whether a fold lies between two components, shape (n, n).
        misfit: Misfit of the most probable component.

    Returns:
        The hypotheses in descending order of their probability.
    """
    probability = np.exp(components.log_weight)
    probability /= probability.sum()
    variance = np.diagonal(components.covariance, axis1=1, axis2=2)[:, POSITION]
    remaining = np.ones(len(probability), dtype=bool)
    hypotheses = []
    while remaining.any():
        first = int(remaining.argmax())
        difference_mm = np.abs(components.mean - components.mean[first])[:, POSITION]
        is_near = (difference_mm < SEPARATE_DISTANCE * np.sqrt(variance + variance[first])).all(axis=1)
        is_same = remaining & is_near & ~is_across_fold[first]
        is_same[first] = True  # even if rounding errors make it appear to be across a fold
        remaining &= ~is_same
        total = float(probability[is_same].sum())
        (mean,), (covariance,) = mixture_moments(
            probability[None, is_same] / total, components.mean[is_same], components.covariance[is_same]
        )
        hypotheses.append(ContactHypothesis(mean, covariance, total, misfit))
    return sorted(hypotheses, key=lambda hypothesis: -hypothesis.probability)


def _predicted(components: Components, dt_s: float) -> Components:
    """Predict the components, and add one component whose rates have changed to unknown values.

    Args:
        components: Components after the previous step. The added component has the contact of the first component,
            which is the most probable.
        dt_s: Time since the previous step, s.
    """
    changed = components.select([0])
    changed.mean[:, RATES] = 0.0
    changed.covariance[:, RATES] = 0.0
    changed.covariance[:, :, RATES] = 0.0
    changed.covariance[:, RATES, RATES] = np.diag(INITIAL_RATE_STD**2)
    log_weight = changed.log_weight + math.log(dt_s / MEAN_MODE_TIME_s)
    return predict_components(components.joined(changed._replace(log_weight=log_weight)), dt_s)
