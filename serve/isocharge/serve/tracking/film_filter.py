"""Bayesian filter that uses touches to estimate the pretension and other unknown parameters of a film.

The misfit vector of a touch is the part of the charges that no contact explains. The misfit vector depends on two kinds
of unknowns.

- The pretension of the film changes the misfit vector non-linearly. The pretension is therefore estimated on a grid.
- The linear unknowns change the misfit vector approximately linearly. The linear unknowns are the combinations of film
  parameters that remain uncertain after the calibration (`FilmDirections`), the drift of the gain of each electrode,
  and a common offset. The common offset is a charge that is added to all electrodes during a touch, such as the
  pyroelectric charge that a warm finger produces.

At each pretension of the grid, a Kalman filter estimates the linear unknowns (a Rao-Blackwellised filter, Doucet and
others 2000). The estimated pretension therefore hardly changes if a gain, an offset or an error of the calibration
explains a change of the misfit.

The size of the offsets is unknown before the first touch. The filter therefore compares several offset levels. At the
first level, touches have no offset. At the other levels, the offsets have standard deviations from small to large. Each
level has a Kalman filter at each pretension, and the levels are weighted by their probabilities. The level may change
between two touches, for example because a warm hand approaches the film (an interacting multiple model, Blom and
Bar-Shalom 1988).
"""

import math

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.film_directions import FilmDirections
from isocharge.serve.model.pretensions import Pretensions
from isocharge.serve.tracking.film_unknowns import UnknownsLayout
from isocharge.serve.tracking.film_update import TouchResiduals, kalman_update, multiply_stacks
from isocharge.serve.tracking.pretension_grid import (
    GRID_STEP_MPa,
    normal_probabilities,
    pretension_grid,
    smooth_moments,
)
from isocharge.serve.tracking.touch_misfits import TouchMisfits

JUMP_PROBABILITY = 5e-4
"""Probability that the pretension jumps between two touches. After a jump, all pretensions are equally likely."""

OUTLIER_PROBABILITY = 0.05
"""Probability that a touch is an outlier, for example because two fingers touch the film."""

OUTLIER_DENSITY = math.exp(-4.5)
"""Probability density of the misfit of an outlier, relative to the density of a good touch with a misfit of zero."""

GAIN_STD = 0.01
"""Standard deviation of the drift of a gain, and step of the finite differences with respect to a gain."""

GAIN_TIME_CONSTANT_s = 1800.0
"""Time constant of the gains (Ornstein-Uhlenbeck process), s.

With a shorter time constant, the filter would at first explain a change of the film by the gains.
"""

SMALLEST_OFFSET_STEP_pC = 1.0
"""Smallest step of the finite differences with respect to the common offset, pC."""

OFFSET_TIME_CONSTANT_s = 600.0
"""Time constant of the mean offset (Ornstein-Uhlenbeck process), s."""

RELATIVE_LEVELS = (0.0, 0.15, 0.33, 1.0, 3.3)
"""Standard deviation of the mean offset at each level, relative to the largest standard deviation that is tolerated.

The last level represents offsets that are too large to be tolerated.
"""

RELATIVE_SCATTER = (0.0, 0.03, 0.1, 0.3, 1.0)
"""Standard deviation of the offset of a single touch about the mean offset at each level.

The values are relative to the largest standard deviation of the mean offset that is tolerated.
"""

MAX_RELATIVE_OFFSET = 2.0
"""Magnitude of the mean offset, relative to the largest tolerated standard deviation, above which it is too large."""

NO_OFFSET_PROBABILITY = 0.9
"""Probability before the first touch that touches have no offset. The other levels have equal probabilities."""

LEVEL_CHANGE_PROBABILITY = 0.0003
"""Probability that the level of the offsets changes between two touches."""

SECONDS_PER_HOUR = 3600.0

PROBABILITY_COLUMN = 0
"""Index of the probability on the last axis of the weighted moments."""


class FilmFilter:
    """Filter that estimates the pretension of one film from touches whose position and force are unknown.

    Attributes:
        grid_MPa: Evenly spaced pretensions for which the filter computes probabilities, shape (n_pretension,), MPa.
    """

    def __init__(
        self,
        pretensions: Pretensions,
        directions: FilmDirections,
        misfits: TouchMisfits,
        drift_MPa_per_root_hour: float,
        largest_offset_pC: float,
        offset_ratio: Array,
    ) -> None:
        """Start with the probability distribution of the unknowns after the calibration.

        An offset is a charge that is added to all electrodes during a touch, for example by a warm finger.

        Args:
            pretensions: Weights of the network at any pretension.
            directions: Combinations of film parameters that are uncertain at a given pretension.
            misfits: Method that computes the misfit vectors of touches at the pretensions of `pretension_grid`.
            drift_MPa_per_root_hour: Standard deviation of the change of the pretension in an hour, MPa. The standard
                deviation is proportional to the square root of the time.
            largest_offset_pC: Largest standard deviation of the offsets that the filter tolerates, pC; 0 if touches
                have no offsets.
            offset_ratio: Charge that an offset adds to each electrode, relative to the common offset, shape
                (n_electrode,).
        """
        self.grid_MPa = pretension_grid(pretensions)
        self._pretensions = pretensions
        self._misfits = misfits
        self._drift_MPa_per_root_hour = drift_MPa_per_root_hour
        self._largest_offset_pC = largest_offset_pC
        self._offset_ratio = offset_ratio
        self._directions = directions
        self._layout = UnknownsLayout(pretensions.typical_pC.size, directions.count)

        # The size of the offsets is unknown, so the filter compares several offset levels. Each level has a standard
        # deviation of the mean offset, and a standard deviation (scatter) of the offset of a single touch about the
        # mean offset. Both are 0 at level 0, which is the only level if touches have no offsets.
        level_count = len(RELATIVE_LEVELS) if largest_offset_pC > 0.0 else 1
        self._level_std_pC = largest_offset_pC * np.array(RELATIVE_LEVELS[:level_count])
        self._scatter_std_pC = largest_offset_pC * np.array(RELATIVE_SCATTER[:level_count])
        self.reset()

    def reset(self) -> None:
        """Discard all touches, and restore the probability distribution that is assumed before the first touch.

        An offset is a charge that is added to all electrodes during a touch. An offset level is a hypothesis about the
        size of the offsets. The linear unknowns are the gains of the electrodes, the offset, and the coordinates of the
        film along the directions. A direction is a combination of film parameters that remained uncertain after the
        calibration.
        """
        # Probability of each offset level, shape (n_level,). Level 0 is the level without offsets. The other levels
        # share the remaining probability equally. There may be no other level.
        level_count = self._level_std_pC.size
        offset_level_count = level_count - 1
        offset_level_probability = (1.0 - NO_OFFSET_PROBABILITY) / max(offset_level_count, 1)  # no division by zero
        level_probability = np.full(level_count, offset_level_probability)
        level_probability[0] = 1.0 - level_probability[1:].sum()

        # Joint probability of the offset level and the pretension, shape (n_level, n_pretension). The change of the
        # pretension since the calibration is normally distributed.
        change_MPa = self.grid_MPa - self._pretensions.calibrated_MPa
        pretension_probability = normal_probabilities(change_MPa, self._pretensions.std_MPa)
        self._joint_probability = np.outer(level_probability, pretension_probability)

        # Mean and covariance of the linear unknowns at each level and pretension. Only the means of the directions
        # depend on the pretension. `by_pretension` is the change of each mean per MPa.
        shape = self._joint_probability.shape
        size = self._layout.size
        self._mean = np.zeros((*shape, size))
        self._mean[..., self._layout.directions] = np.outer(change_MPa, self._directions.by_pretension)
        self._covariance = np.zeros((*shape, size, size))
        self._covariance[:] = self._stationary_covariance()[:, None]  # the same at every pretension
        self._last_touch_s: float | None = None
        self._pending_variance_MPa2 = 0.0  # variance of the drift that `_change_pretension` has not applied yet

    @property
    def pretension_probability(self) -> Array:
        """Probability of each pretension, shape (n_pretension,)."""
        return np.asarray(self._joint_probability.sum(axis=0))

    @property
    def level_probability(self) -> Array:
        """Probability of each offset level, shape (n_level,)."""
        return np.asarray(self._joint_probability.sum(axis=1))

    @property
    def mean_MPa(self) -> float:
        """Mean of the pretension, MPa."""
        return float(self.pretension_probability @ self.grid_MPa)

    @property
    def offset_correction_MPa(self) -> float:
        """Change of the estimated mean pretension that the consideration of offsets causes, MPa.

        The mean over all offset levels is compared with the mean at the level at which touches have no offsets.
        """
        probability_without_offset = self._joint_probability[0] / self._joint_probability[0].sum()
        return self.mean_MPa - float(probability_without_offset @ self.grid_MPa)

    @property
    def nearest_index(self) -> int:
        """Index of the grid pretension that is nearest to the mean pretension."""
        return int(np.abs(self.grid_MPa - self.mean_MPa).argmin())

    @property
    def is_offset_too_large(self) -> bool:
        """Whether the offsets are probably larger than the largest offsets that the filter tolerates.

        An offset is a charge that is added to all electrodes during a touch. The offset levels are hypotheses about the
        size of the offsets. The offsets are too large if the last level is the most likely level, or if the magnitude
        of the mean offset exceeds `MAX_RELATIVE_OFFSET` times the largest tolerated standard deviation.
        """
        level_count = self._level_std_pC.size
        if level_count == 1:  # touches are assumed to have no offsets
            return False
        is_last_level_likeliest = self._likeliest_level == level_count - 1
        is_mean_too_large = abs(self._mean_offset_pC) > MAX_RELATIVE_OFFSET * self._largest_offset_pC
        return is_last_level_likeliest or is_mean_too_large

    @property
    def offset_pC(self) -> Array:
        """Estimated offset of each electrode at the most likely offset level, shape (n_electrode,), pC."""
        return np.asarray(self._mean_offset_pC * self._offset_ratio)

    @property
    def _mean_offset_pC(self) -> float:
        """Mean common offset at the most likely level and at the grid pretension nearest to the mean, pC."""
        return float(self._mean[self._likeliest_level, self.nearest_index, self._layout.offset])

    @property
    def _likeliest_level(self) -> int:
        """Index of the offset level with the largest probability."""
        return int(self.level_probability.argmax())

    def direction_means(self, pretension_MPa: float) -> Array:
        """Return the mean coordinate along each direction at one pretension, averaged over the offset levels.

        Args:
            pretension_MPa: The pretension, MPa. The means are interpolated between the pretensions of the grid.

        Returns:
            Means, shape (n_direction,), in standard deviations of the directions.
        """
        level_weight = self._joint_probability / self.pretension_probability
        level_means = self._mean[..., self._layout.directions]  # shape (n_level, n_pretension, n_direction)
        grid_means = (level_weight[..., None] * level_means).sum(axis=0)  # shape (n_pretension, n_direction)
        return np.array([np.interp(pretension_MPa, self.grid_MPa, direction_mean) for direction_mean in grid_means.T])

    def _stationary_covariance(self) -> Array:
        """Return the covariance of the linear unknowns before any touch, shape (n_level, n_unknown, n_unknown).

        The unknowns are independent. The variances of the gains and directions are 1, because these unknowns are in
        units of their standard deviations.
        """
        layout = self._layout
        covariance = np.tile(np.eye(layout.size), (self._level_std_pC.size, 1, 1))
        covariance[:, layout.offset, layout.offset] = self._level_std_pC**2
        return covariance

    def predict(self, clock_s: float) -> None:
        """Predict the probability distribution of the unknowns at the time of the next touch.

        If the clock was set back since the previous touch, the elapsed time is assumed to be zero.

        Args:
            clock_s: Time of the touch, s.
        """
        elapsed_s = 0.0 if self._last_touch_s is None else max(clock_s - self._last_touch_s, 0.0)
        self._last_touch_s = clock_s
        self._relax_unknowns(elapsed_s)
        self._change_level()
        self._change_pretension(elapsed_s)

    def _relax_unknowns(self, elapsed_s: float) -> None:
        """Move the distributions of the gains and of the offset towards their stationary distributions.

        The mean of each unknown decays exponentially with the time constant of the unknown. The directions do not
        change with time.

        Args:
            elapsed_s: Time since the previous touch, s.
        """
        layout = self._layout
        decay = np.empty(layout.size)
        decay[layout.gains] = math.exp(-elapsed_s / GAIN_TIME_CONSTANT_s)
        decay[layout.offset] = math.exp(-elapsed_s / OFFSET_TIME_CONSTANT_s)
        decay[layout.directions] = 1.0
        decay_of_products = np.outer(decay, decay)
        stationary_covariance = self._stationary_covariance()[:, None]  # the same at every pretension
        self._mean = decay * self._mean
        self._covariance = decay_of_products * self._covariance + (1.0 - decay_of_products) * stationary_covariance

    def _change_level(self) -> None:
        """Account for the small probability that the offset level has changed since the previous touch.

        An offset is a charge that is added to all electrodes during a touch. An offset level is a hypothesis about the
        size of the offsets.

        The method is the mixing step of an interacting multiple model (Blom and Bar-Shalom 1988). After a change of the
        offset level, the mean offset does not depend on the previous mean offset. A change of the level does not affect
        the other linear unknowns.
        """
        level_count = self._level_std_pC.size
        if level_count == 1:  # there is no other level
            return
        changed_mean, changed_covariance = self._moments_after_level_change()

        # After a change of the level, all levels are equally likely. The second term has the shape (n_pretension,), and
        # is added at each level.
        unchanged_probability = (1.0 - LEVEL_CHANGE_PROBABILITY) * self._joint_probability
        changed_probability = LEVEL_CHANGE_PROBABILITY / level_count * self.pretension_probability
        self._joint_probability = unchanged_probability + changed_probability

        # Average the moments with and without a change. The weight is broadcast over the axis of the unknowns for the
        # means, and over the two axes of the unknowns for the covariances.
        changed_weight = changed_probability / self._joint_probability  # shape (n_level, n_pretension)
        mean_weight = changed_weight[..., None]
        self._mean = (1.0 - mean_weight) * self._mean + mean_weight * changed_mean
        covariance_weight = changed_weight[..., None, None]
        self._covariance = (1.0 - covariance_weight) * self._covariance + covariance_weight * changed_covariance

    def _moments_after_level_change(self) -> tuple[Array, Array]:
        """Compute the mean and the covariance of the linear unknowns directly after a change of the offset level.

        After the change, the offset has the same probability distribution as before the first touch. The moments of the
        other unknowns are averaged over the previous levels.

        Returns:
            Mean, shape (n_pretension, n_unknown). The mean does not depend on the new level. Covariance at each new
            level, shape (n_level, n_pretension, n_unknown, n_unknown).
        """
        offset = self._layout.offset
        level_weight = self._joint_probability / self.pretension_probability  # shape (n_level, n_pretension)
        mean = (level_weight[..., None] * self._mean).sum(axis=0)
        mean[:, offset] = 0.0

        average_covariance = (level_weight[..., None, None] * self._covariance).sum(axis=0)
        covariance = np.repeat(average_covariance[None], self._level_std_pC.size, axis=0)
        covariance[:, :, offset, :] = 0.0
        covariance[:, :, :, offset] = 0.0
        covariance[:, :, offset, offset] = self._level_std_pC[:, None] ** 2
        return mean, covariance

    def _change_pretension(self, elapsed_s: float) -> None:
        """Account for a drift of the pretension, and for the small probability of a jump to any pretension.

        The means and the covariances of the linear unknowns at a new pretension are averaged over all previous
        pretensions. The weight of a previous pretension is the probability that the pretension has changed from the
        previous value to the new value.

        Args:
            elapsed_s: Time since the previous touch, s.
        """
        self._pending_variance_MPa2 += self._drift_MPa_per_root_hour**2 * elapsed_s / SECONDS_PER_HOUR

        # The moments are the probability of each level and pretension, and the mean and the covariance multiplied by
        # the probability. Moments are therefore averaged over pretensions by adding them up. The shape is (n_level,
        # n_pretension, n_moment).
        moments = self._weighted_moments()

        # The grid cannot represent a drift that is smaller than the step of the grid. The variance of such a drift
        # remains pending and is added to the variance of the next drift.
        drift_std_MPa = math.sqrt(self._pending_variance_MPa2)
        if drift_std_MPa >= GRID_STEP_MPa:
            moments = smooth_moments(moments, drift_std_MPa)
            self._pending_variance_MPa2 = 0.0
        moments /= moments[..., PROBABILITY_COLUMN].sum()  # all probabilities add up to 1 again

        # After a jump, all pretensions are equally likely. At each level, all pretensions then have the same moments,
        # namely the mean of the moments over the previous pretensions.
        moments_after_jump = moments.mean(axis=1, keepdims=True)
        moments = (1.0 - JUMP_PROBABILITY) * moments + JUMP_PROBABILITY * moments_after_jump
        self._set_weighted_moments(moments)

    def _weighted_moments(self) -> Array:
        """Return the probability, the mean and the covariance at each level and pretension in one array.

        The mean and the covariance are multiplied by the probability. The sum of the moments of several pretensions is
        therefore weighted by the probabilities.

        Returns:
            Moments, shape (n_level, n_pretension, 1 + n_unknown + n_unknown^2). The last axis contains the probability,
            the weighted mean and the weighted covariance, in this order.
        """
        level_count, grid_size = self._joint_probability.shape
        size = self._layout.size
        flat_covariance = self._covariance.reshape(level_count, grid_size, size * size)
        moments = np.concatenate([np.ones((level_count, grid_size, 1)), self._mean, flat_covariance], axis=2)
        moments *= self._joint_probability[..., None]
        return moments

    def _set_weighted_moments(self, moments: Array) -> None:
        """Set the probabilities, the means and the covariances from an array of weighted moments.

        Args:
            moments: Weighted moments, as `_weighted_moments` returns them.
        """
        level_count, grid_size = self._joint_probability.shape
        size = self._layout.size
        self._joint_probability = moments[..., PROBABILITY_COLUMN]
        normalised_moments = moments / self._joint_probability[..., None]
        mean_columns = slice(1, 1 + size)
        covariance_columns = slice(1 + size, None)
        self._mean = normalised_moments[..., mean_columns]
        self._covariance = normalised_moments[..., covariance_columns].reshape(level_count, grid_size, size, size)

    def update(self, charge_pC: Array, contact: Array, log_changes: Array, misfit_std: float) -> TouchResiduals:
        """Update the probability distribution of the unknowns with a touch.

        With a small probability, the touch is an outlier. The changes that the Kalman update computes are therefore
        multiplied by the probability that the touch is not an outlier.

        A direction is a combination of film parameters that remained uncertain after the calibration.

        Args:
            charge_pC: Touch charges, shape (n_electrode,), pC.
            contact: Contact (x, y, F) that the network computed from the charges, shape (3,), mm and N.
            log_changes: Changes of the logarithms of the charges by one unit of each direction at the contact, shape
                (n_direction, n_electrode).
            misfit_std: Root mean square misfit of good touches with as little noise as this touch, relative to the root
                mean square misfit of single frames of good touches.

        Returns:
            The squared misfits that remain after the update.
        """
        frame_misfit, frame_jacobian = self._linearise(charge_pC, contact, log_changes)
        misfit = frame_misfit / misfit_std
        jacobian = frame_jacobian / misfit_std
        noise_covariance = self._noise_covariance(jacobian)
        kalman = kalman_update(misfit, jacobian, noise_covariance, self._mean, self._covariance)

        # Probability density of the touch, and probability that the touch is not an outlier (good). All arrays have the
        # shape (n_level, n_pretension).
        good_density = (1.0 - OUTLIER_PROBABILITY) * kalman.density
        total_density = good_density + OUTLIER_PROBABILITY * OUTLIER_DENSITY
        good_probability = good_density / total_density
        self._mean = self._mean + good_probability[..., None] * kalman.mean_change
        self._covariance = self._covariance - good_probability[..., None, None] * kalman.covariance_reduction

        # Update the probabilities of the levels and pretensions by Bayes' theorem.
        unnormalised_probability = self._joint_probability * total_density
        self._joint_probability = unnormalised_probability / unnormalised_probability.sum()
        return self._residuals(misfit, jacobian, noise_covariance)

    def _noise_covariance(self, jacobian: Array) -> Array:
        """Compute the covariance that the misfit vector of a touch would have if the linear unknowns were known.

        The covariance is the sum of two matrices. The identity matrix describes the noise of a good touch. The other
        matrix describes the random deviation of the offset of a single touch from the mean offset.

        Args:
            jacobian: Jacobian of the misfit vector, as `_linearise` returns it.

        Returns:
            Covariance, shape (n_level, n_pretension, n_electrode, n_electrode), in units of the mean squared misfit of
            good touches.
        """
        offset_jacobian = jacobian[..., self._layout.offset]  # shape (n_level, n_pretension, n_electrode)
        outer_product = offset_jacobian[..., :, None] * offset_jacobian[..., None, :]
        scatter_variance = self._scatter_std_pC[:, None, None, None] ** 2
        scatter_covariance = scatter_variance * outer_product
        return np.asarray(np.eye(self._layout.electrodes) + scatter_covariance)

    def _linearise(self, charge_pC: Array, contact: Array, log_changes: Array) -> tuple[Array, Array]:
        """Compute the misfit vectors of a touch, and their Jacobian with respect to the linear unknowns.

        The misfit vector is the part of the charges that no contact explains. There is one misfit vector for each
        pretension. The linear unknowns are the gains of the electrodes, the coordinates of the film along the
        directions (uncertain combinations of film parameters), and the offset (a charge that is added to all
        electrodes).

        The derivative with respect to the offset is a finite difference. The step of this difference is the mean offset
        that was estimated at the offset level. The linearised misfit vector is therefore exact for charges from which
        the mean offset is subtracted.

        Args:
            charge_pC: Touch charges, shape (n_electrode,), pC.
            contact: Contact (x, y, F) that the network computed from the charges, shape (3,), mm and N.
            log_changes: Changes of the logarithms of the charges by one unit of each direction at the contact, shape
                (n_direction, n_electrode).

        Returns:
            Misfit vectors, shape (n_pretension, n_electrode). Jacobian of the misfit vectors, shape (n_level,
            n_pretension, n_electrode, n_unknown). Both are relative to the root mean square misfit of single frames of
            good touches.
        """
        layout = self._layout
        gain_changes = GAIN_STD * np.eye(layout.electrodes)  # changes of the logarithms; one row for each gain
        offset_step_pC = self._offset_steps()  # shape (n_level,)

        # The first row contains the charges of the touch. All other rows are the charges without the offset of a level.
        charges_without_offset = charge_pC - np.outer(offset_step_pC, self._offset_ratio)
        linearised = self._misfits.linearise(
            np.vstack([charge_pC, charges_without_offset]), contact, np.vstack([gain_changes, log_changes])
        )
        misfit = linearised.vectors[0]  # shape (n_pretension, n_electrode)
        misfit_without_offset = linearised.vectors[1:]  # shape (n_level, n_pretension, n_electrode)

        # The derivatives with respect to gains and directions are the same at every level. Each change of the charges
        # is caused by one unit of a gain or of a direction, so the changes of the misfit vectors are the derivatives.
        jacobian = np.empty((*self._joint_probability.shape, layout.electrodes, layout.size))
        jacobian[..., layout.offset] = (misfit - misfit_without_offset) / offset_step_pC[:, None, None]
        jacobian[..., layout.gains] = linearised.changes[..., : layout.electrodes]
        jacobian[..., layout.directions] = linearised.changes[..., layout.electrodes :]
        return misfit, jacobian

    def _offset_steps(self) -> Array:
        """Return the step of the finite difference with respect to the offset at each level, shape (n_level,), pC.

        The step is the mean offset of the level, or `SMALLEST_OFFSET_STEP_pC` if the magnitude of the mean offset is
        smaller than `SMALLEST_OFFSET_STEP_pC`.
        """
        pretension_weight = self._joint_probability / self._joint_probability.sum(axis=1, keepdims=True)
        mean_offset_pC = (pretension_weight * self._mean[..., self._layout.offset]).sum(axis=1)
        is_small = np.abs(mean_offset_pC) < SMALLEST_OFFSET_STEP_pC
        return np.where(is_small, SMALLEST_OFFSET_STEP_pC, mean_offset_pC)

    def _residuals(self, misfit: Array, jacobian: Array, noise_covariance: Array) -> TouchResiduals:
        """Compute the squared misfits of a touch after a correction with the estimates at the most likely offset level.

        The misfit vectors are corrected for the means of the linear unknowns, which are the gains, the offset and the
        directions. A second result is corrected only for the offset and the directions.

        Args:
            misfit: Misfit vectors, as `_linearise` returns them.
            jacobian: Jacobian of the misfit vectors, as `_linearise` returns it.
            noise_covariance: Covariance of the misfit vectors, as `_noise_covariance` returns it.
        """
        level = self._likeliest_level
        level_jacobian = jacobian[level]  # shape (n_pretension, n_electrode, n_unknown)
        precision = np.linalg.inv(noise_covariance[level])  # shape (n_pretension, n_electrode, n_electrode)

        # Subtract the part of each misfit vector that the means of the unknowns explain.
        mean = self._mean[level]  # shape (n_pretension, n_unknown)
        mean_without_gains = mean.copy()
        mean_without_gains[:, self._layout.gains] = 0.0
        residual = misfit - multiply_stacks(level_jacobian, mean)
        residual_without_gains = misfit - multiply_stacks(level_jacobian, mean_without_gains)

        # Variance that the scatter of the offset of a single touch adds to the misfit at the estimated pretension.
        offset_jacobian = level_jacobian[self.nearest_index, :, self._layout.offset]
        offset_variance = self._scatter_std_pC[level] ** 2 * (offset_jacobian**2).sum()

        # The squared misfit at a pretension is r^T P r, where r is the residual and P is the precision. In the indices
        # of `einsum`, g is the pretension, and e and f are electrodes.
        quadratic_form = "ge,gef,gf->g"
        return TouchResiduals(
            with_gains=np.einsum(quadratic_form, residual, precision, residual),
            without_gains=np.einsum(quadratic_form, residual_without_gains, precision, residual_without_gains),
            offset_variance=float(offset_variance),
        )
