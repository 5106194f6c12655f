"""Bayesian filter for the pretension of a film, its other unknowns, its gains, and a charge that warmth adds to all.

Every touch gives one misfit vector, which depends on

- the pretension of the film, non-linearly: the pretension is estimated on a grid;
- the directions in which the calibration left the film uncertain (`FilmDirections`), the drift of the gain of each
  electrode, and a common offset, i.e. a charge that is added to all electrodes while a touch lasts (the pyroelectric
  charge of a warm finger). The misfit vector is linearised in these unknowns.

At each pretension a Kalman filter estimates the linear unknowns (a Rao-Blackwellised filter, Doucet et al. 2000). A
change of the misfit that a gain, an offset or an error of the calibration explains is therefore not taken for a change
of the pretension.

How large offsets are is not known beforehand. The filter therefore compares several offset levels: films that are
touched without any offset, and films whose offsets have a small or a large standard deviation. Each level has a Kalman
filter of its own at each pretension, and the levels are weighted by their evidence. The film may change from one level
to another between two touches, as when a warm hand comes or goes (an interacting multiple model, Blom and Bar-Shalom
1988).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Reals
from isocharge.serve.model.film_directions import FilmDirections
from isocharge.serve.model.pretensions import Pretensions

GRID_STEP_MPa = 0.02
"""Distance of the pretensions that are compared."""

NETWORK_STEP_MPa = 0.1
"""Distance of the pretensions at which the network is evaluated. In between, misfit vectors are interpolated."""

JUMP_PROBABILITY = 5e-4
"""Probability that the film changes between two touches by more than a drift. All pretensions are then equally likely.
"""

OUTLIER_PROBABILITY = 0.05
"""Share of touches that are no single contact on this film."""

OUTLIER_DENSITY = math.exp(-4.5)
"""Density of the misfit of an outlier, relative to the density of a good touch with a misfit of zero."""

GAIN_STD = 0.01
"""Standard deviation of the drift of a gain, and step of the finite differences with respect to a gain."""

GAIN_TIME_CONSTANT_s = 1800.0
"""Time constant of the gains (Ornstein-Uhlenbeck process). With a shorter one a changing film is followed late."""

SMALLEST_OFFSET_STEP_pC = 1.0
"""Smallest step of the finite differences with respect to the common offset."""

OFFSET_TIME_CONSTANT_s = 600.0
"""Time constant of the mean offset (Ornstein-Uhlenbeck process)."""

RELATIVE_LEVELS = (0.0, 0.15, 0.33, 1.0, 3.3)
"""Standard deviation of the mean offset at each level, over the largest that the filter tolerates.

Offsets of the last level are too large.
"""

LARGEST_RATIO = 2.0
"""Mean offset, over the largest standard deviation that the filter tolerates, above which offsets are too large."""

RELATIVE_SCATTER = (0.0, 0.03, 0.1, 0.3, 1.0)
"""Standard deviation of the offset of a touch about the mean offset at each level, over the same."""

NO_OFFSET_PROBABILITY = 0.9
"""Probability, before the first touch, that touches have no offset. The other levels are equally likely."""

LEVEL_CHANGE_PROBABILITY = 0.0003
"""Probability that the level of the offsets changes between two touches."""


@dataclass(frozen=True)
class UnknownsLayout:
    """Positions of the linear unknowns in a vector.

    Attributes:
        electrodes: Number of electrodes.
        direction_count: Number of directions in which the film is uncertain.
    """

    electrodes: int
    direction_count: int

    @property
    def gains(self) -> slice:
        """Deviations of the gains from one, in units of GAIN_STD, one for each electrode."""
        return slice(0, self.electrodes)

    @property
    def offset(self) -> int:
        """Mean of the common offset, pC."""
        return self.electrodes

    @property
    def directions(self) -> slice:
        """Coordinates along the directions in which the film is uncertain, in standard deviations."""
        return slice(self.electrodes + 1, self.size)

    @property
    def size(self) -> int:
        """Number of linear unknowns."""
        return self.electrodes + 1 + self.direction_count


class TouchResiduals(NamedTuple):
    """Squared misfits of a touch that the most likely offset level leaves, in units of a good touch's mean square.

    Attributes:
        filtered: With the estimated gains and offset, at each pretension, shape (n_pretension,).
        without_gains: With the estimated offset and directions only, at each pretension, shape (n_pretension,).
        offset_variance: Variance that the unknown offset of this touch adds to its misfit, over that of a good touch
            with a known offset.
    """

    filtered: Array
    without_gains: Array
    offset_variance: float


class FilmFilter:
    """Estimates the pretension of one film by touches of unknown place and force.

    Attributes:
        grid_MPa: Pretensions that are compared, shape (n_pretension,), MPa.
    """

    def __init__(
        self,
        pretensions: Pretensions,
        directions: FilmDirections,
        drift_MPa_per_root_hour: float,
        largest_offset_pC: float,
        offset_ratio: Array,
    ) -> None:
        """Begin with the film as it was calibrated.

        Args:
            pretensions: The network of the film at any pretension.
            directions: Directions in which the film is uncertain at a given pretension.
            drift_MPa_per_root_hour: Standard deviation of the pretension's change in an hour.
            largest_offset_pC: Standard deviation of the largest offsets that the filter tolerates; 0 for none.
            offset_ratio: Charge of each electrode over the common offset, shape (n_electrode,).
        """
        low, high = pretensions.range_MPa
        self.grid_MPa = _evenly_spaced(low, high, GRID_STEP_MPa)
        self._pretensions = pretensions
        self._network = pretensions.at(_evenly_spaced(low, high, NETWORK_STEP_MPa))
        self._drift = drift_MPa_per_root_hour
        self._largest_offset = largest_offset_pC
        self._offset_ratio = offset_ratio
        self._directions = directions
        self._layout = UnknownsLayout(pretensions.typical_pC.size, directions.count)

        relative_levels = RELATIVE_LEVELS if largest_offset_pC > 0.0 else RELATIVE_LEVELS[:1]
        self._level_std = largest_offset_pC * np.array(relative_levels)
        self._scatter_std = largest_offset_pC * np.array(RELATIVE_SCATTER[: len(relative_levels)])
        self.reset()

    def reset(self) -> None:
        """Return to the distribution before the first touch."""
        level_count = self._level_std.size
        level_probability = np.full(level_count, (1.0 - NO_OFFSET_PROBABILITY) / max(level_count - 1, 1))
        level_probability[0] = 1.0 - level_probability[1:].sum()
        calibrated = _normal(self.grid_MPa - self._pretensions.calibrated_MPa, self._pretensions.std_MPa)
        self._probability = np.outer(level_probability, calibrated)

        shape = self._probability.shape
        size = self._layout.size
        self._mean = np.zeros((*shape, size))
        change_MPa = self.grid_MPa - self._pretensions.calibrated_MPa
        self._mean[..., self._layout.directions] = np.outer(change_MPa, self._directions.by_pretension)
        self._covariance = np.zeros((*shape, size, size))
        self._covariance[:] = self._stationary_covariance()[:, None]
        self._last_touch_s: float | None = None
        self._pending_variance = 0.0

    @property
    def probability(self) -> Array:
        """Probability of each pretension, shape (n_pretension,)."""
        return np.asarray(self._probability.sum(axis=0))

    @property
    def level_probability(self) -> Array:
        """Probability of each offset level, shape (n_level,)."""
        return np.asarray(self._probability.sum(axis=1))

    @property
    def mean_MPa(self) -> float:
        """Mean of the pretension."""
        return float(self.probability @ self.grid_MPa)

    @property
    def offset_correction_MPa(self) -> float:
        """Difference between the mean of the pretension and the mean if touches had no offset."""
        without_offset = self._probability[0] / self._probability[0].sum()
        return self.mean_MPa - float(without_offset @ self.grid_MPa)

    @property
    def nearest(self) -> int:
        """Index of the grid's pretension that is nearest to the mean."""
        return int(np.abs(self.grid_MPa - self.mean_MPa).argmin())

    @property
    def is_offset_too_large(self) -> bool:
        """Whether the offsets are probably larger than the filter tolerates."""
        if self._level_std.size == 1:
            return False
        last_level = self._level_std.size - 1
        return self._likeliest_level == last_level or abs(self._mean_offset_pC) > LARGEST_RATIO * self._largest_offset

    @property
    def offset_pC(self) -> Array:
        """Estimated offset of each electrode at the most likely level of offsets, shape (n_electrode,), pC."""
        return np.asarray(self._mean_offset_pC * self._offset_ratio)

    @property
    def _mean_offset_pC(self) -> float:
        return float(self._mean[self._likeliest_level, self.nearest, self._layout.offset])

    @property
    def _likeliest_level(self) -> int:
        return int(self.level_probability.argmax())

    def direction_means(self, pretension_MPa: float) -> Array:
        """Return the means of the directions at one pretension, shape (n_direction,), in standard deviations."""
        share = self._probability / self._probability.sum(axis=0)
        means = (share[..., None] * self._mean[..., self._layout.directions]).sum(axis=0)
        return np.array([np.interp(pretension_MPa, self.grid_MPa, column) for column in means.T])

    def _stationary_covariance(self) -> Array:
        """Return the covariance of the linear unknowns before any touch, shape (n_level, n_unknown, n_unknown)."""
        layout = self._layout
        covariance = np.tile(np.eye(layout.size), (self._level_std.size, 1, 1))
        covariance[:, layout.offset, layout.offset] = self._level_std**2
        return covariance

    def predict(self, clock_s: float) -> None:
        """Advance the distribution to the time of a touch.

        Args:
            clock_s: Time on a clock that does not jump, s.
        """
        elapsed_s = 0.0 if self._last_touch_s is None else max(clock_s - self._last_touch_s, 0.0)
        self._last_touch_s = clock_s
        self._relax_unknowns(elapsed_s)
        self._change_level()
        self._change_pretension(elapsed_s)

    def _relax_unknowns(self, elapsed_s: float) -> None:
        """Move the distributions of the linear unknowns towards their stationary distributions, as the time passes."""
        layout = self._layout
        decay = np.empty(layout.size)
        decay[layout.gains] = math.exp(-elapsed_s / GAIN_TIME_CONSTANT_s)
        decay[layout.offset] = math.exp(-elapsed_s / OFFSET_TIME_CONSTANT_s)
        decay[layout.directions] = 1.0
        decay_of_products = np.outer(decay, decay)
        stationary = self._stationary_covariance()[:, None]
        self._mean = decay * self._mean
        self._covariance = decay_of_products * self._covariance + (1.0 - decay_of_products) * stationary

    def _change_level(self) -> None:
        """Let the level of the offsets change with a small probability.

        This is the mixing step of an interacting multiple model (Blom and Bar-Shalom 1988). The mean offset of a new
        level does not depend on the mean offset of the old level.
        """
        level_count = self._level_std.size
        if level_count == 1:
            return
        offset = self._layout.offset
        pretension_probability = self._probability.sum(axis=0)  # over all levels, shape (n_pretension,)
        staying_probability = (1.0 - LEVEL_CHANGE_PROBABILITY) * self._probability
        arriving_probability = LEVEL_CHANGE_PROBABILITY / level_count * pretension_probability

        # A film arrives at a new level with the gains that are averaged over all levels, and with a new offset.
        level_share = self._probability / pretension_probability
        arriving_mean = (level_share[..., None] * self._mean).sum(axis=0)
        arriving_mean[:, offset] = 0.0
        average_covariance = (level_share[..., None, None] * self._covariance).sum(axis=0)
        arriving_covariance = np.repeat(average_covariance[None], level_count, 0)
        arriving_covariance[:, :, offset, :] = 0.0
        arriving_covariance[:, :, :, offset] = 0.0
        arriving_covariance[:, :, offset, offset] = self._level_std[:, None] ** 2

        self._probability = staying_probability + arriving_probability
        arrived = arriving_probability / self._probability  # share of the films that have just arrived
        stayed = 1.0 - arrived
        self._mean = stayed[..., None] * self._mean + arrived[..., None] * arriving_mean
        self._covariance = stayed[..., None, None] * self._covariance + arrived[..., None, None] * arriving_covariance

    def _change_pretension(self, elapsed_s: float) -> None:
        """Let the pretension drift, and jump to any other pretension with a small probability.

        Means and covariances of the linear unknowns at a pretension are averaged over the pretensions that the film may
        have had before, weighted by their probabilities.

        Args:
            elapsed_s: Time since the latest touch, s.
        """
        self._pending_variance += self._drift**2 * elapsed_s / 3600.0
        level_count, grid_size = self._probability.shape
        size = self._layout.size
        # Columns: probability, mean and covariance, each multiplied by the probability, so that they can be added.
        moments = np.concatenate(
            [
                np.ones((level_count, grid_size, 1)),
                self._mean,
                self._covariance.reshape(level_count, grid_size, size * size),
            ],
            axis=2,
        )
        moments *= self._probability[..., None]
        drift_std = math.sqrt(self._pending_variance)
        if drift_std >= GRID_STEP_MPa:  # a smaller drift is added to the next one, because the grid cannot represent it
            moments = _convolve(moments, drift_std)
            self._pending_variance = 0.0
        moments /= moments[..., 0].sum()
        moments = (1.0 - JUMP_PROBABILITY) * moments + JUMP_PROBABILITY * moments.mean(axis=1, keepdims=True)
        self._probability = moments[..., 0]
        moments = moments / self._probability[..., None]
        self._mean = moments[..., 1 : 1 + size]
        self._covariance = moments[..., 1 + size :].reshape(level_count, grid_size, size, size)

    def update(self, charge_pC: Array, log_changes: Array) -> TouchResiduals:
        """Update the distribution by a touch.

        Args:
            charge_pC: Touch charges, shape (n_electrode,), pC.
            log_changes: Changes of the logarithms of the charges by one unit of each direction at the contact, shape
                (n_direction, n_electrode).
        """
        misfit, jacobian = self._linearise(charge_pC, log_changes)
        by_offset = jacobian[..., self._layout.offset]
        scatter = self._scatter_std[:, None, None, None] ** 2 * (by_offset[..., :, None] * by_offset[..., None, :])
        noise = np.eye(charge_pC.size) + scatter

        cross_covariance = jacobian @ self._covariance
        innovation_covariance = noise + cross_covariance @ jacobian.swapaxes(-1, -2)
        innovation = misfit - (jacobian @ self._mean[..., None])[..., 0]
        right_sides = np.concatenate([innovation[..., None], cross_covariance], axis=-1)
        solved = np.linalg.solve(innovation_covariance, right_sides)
        square = (innovation * solved[..., 0]).sum(axis=-1)
        density = np.exp(-0.5 * square) / np.sqrt(np.linalg.det(innovation_covariance))

        good = (1.0 - OUTLIER_PROBABILITY) * density
        outlier = OUTLIER_PROBABILITY * OUTLIER_DENSITY
        weight = good / (good + outlier)
        gain = cross_covariance.swapaxes(-1, -2)
        self._mean = self._mean + weight[..., None] * (gain @ solved[..., :1])[..., 0]
        self._covariance = self._covariance - weight[..., None, None] * (gain @ solved[..., 1:])
        posterior = self._probability * (good + outlier)
        self._probability = posterior / posterior.sum()
        return self._residuals(misfit, jacobian, noise)

    def _linearise(self, charge_pC: Array, log_changes: Array) -> tuple[Array, Array]:
        """Return the misfit vector of a touch at each pretension, and its Jacobian for the linear unknowns.

        The derivative with respect to the offset is the difference quotient between the charges and the charges
        without the estimated mean offset of the level. The misfit without that offset is therefore exact.

        Returns:
            Misfit vectors, shape (n_pretension, n_electrode), and their Jacobian, shape (n_level, n_pretension,
            n_electrode, n_unknown), both in units of a good touch's root mean square.
        """
        layout = self._layout
        offset_step_pC = self._offset_steps()
        changes = [
            charge_pC[None],
            charge_pC + GAIN_STD * np.diag(charge_pC),
            charge_pC - np.outer(offset_step_pC, self._offset_ratio),
            charge_pC * np.exp(log_changes),
        ]
        vectors = self._network.vectors(np.concatenate(changes), self.grid_MPa) / self._pretensions.misfit_rms
        split = np.cumsum([len(rows) for rows in changes])[:-1]
        (misfit,), with_gain, without_offset, with_direction = np.split(vectors, split)

        jacobian = np.empty((*self._probability.shape, layout.electrodes, layout.size))
        jacobian[..., layout.gains] = np.moveaxis(with_gain - misfit, 0, 2)
        jacobian[..., layout.offset] = (misfit - without_offset) / offset_step_pC[:, None, None]
        jacobian[..., layout.directions] = np.moveaxis(with_direction - misfit, 0, 2)
        return misfit, jacobian

    def _offset_steps(self) -> Array:
        """Return the steps of the finite differences with respect to the offset, shape (n_level,), pC."""
        weight = self._probability / self._probability.sum(axis=1, keepdims=True)
        mean_offset_pC = (weight * self._mean[..., self._layout.offset]).sum(axis=1)
        is_small = np.abs(mean_offset_pC) < SMALLEST_OFFSET_STEP_pC
        return np.where(is_small, SMALLEST_OFFSET_STEP_pC, mean_offset_pC)

    def _residuals(self, misfit: Array, jacobian: Array, noise: Array) -> TouchResiduals:
        """Return the squared misfits that remain after the corrections of the most likely offset level."""
        level = self._likeliest_level
        mean = self._mean[level]
        by_offset = jacobian[level, :, :, self._layout.offset]
        filtered = misfit - (jacobian[level] @ mean[:, :, None])[:, :, 0]
        mean_without_gains = mean.copy()
        mean_without_gains[:, self._layout.gains] = 0.0
        without_gains = misfit - (jacobian[level] @ mean_without_gains[:, :, None])[:, :, 0]
        precision = np.linalg.inv(noise[level])
        offset_variance = self._scatter_std[level] ** 2 * (by_offset[self.nearest] ** 2).sum()
        return TouchResiduals(
            np.einsum("ge,gef,gf->g", filtered, precision, filtered),
            np.einsum("ge,gef,gf->g", without_gains, precision, without_gains),
            float(offset_variance),
        )


def _evenly_spaced(low: float, high: float, step: float) -> Array:
    """Return numbers from low to high at distances of about a step."""
    intervals = max(round((high - low) / step), 1)
    return np.linspace(low, high, intervals + 1)


def _normal(deviation: Reals, std: float) -> Array:
    """Return the probabilities of a normal distribution at evenly spaced deviations from its mean."""
    density = np.exp(-0.5 * (deviation / std) ** 2)
    return np.asarray(density / density.sum())


def _convolve(moments: Array, std: float) -> Array:
    """Smooth moments over the pretensions by a normal distribution.

    Args:
        moments: Moments at each pretension of the grid, shape (n_level, n_pretension, n_moment). Beyond the ends of the
            grid they are taken as constant.
        std: Standard deviation of the normal distribution, MPa.

    Returns:
        The smoothed moments, of the same shape.
    """
    grid_size = moments.shape[1]
    reach = min(round(4.0 * std / GRID_STEP_MPa), grid_size)
    kernel = _normal(GRID_STEP_MPa * np.arange(-reach, reach + 1.0), std)
    padded = np.pad(moments, ((0, 0), (reach, reach), (0, 0)), mode="edge")
    smoothed = np.zeros_like(moments)
    for start, share in enumerate(kernel):
        smoothed += share * padded[:, start : start + grid_size]
    return smoothed
