"""Filter that smooths the predicted contacts of successive frames: an interacting multiple model.

The state of a contact consists of x, y and ln F, and the rates of these three values. The position is either held or
moves, and the force is either held or changes. Each of these four modes has a Kalman filter (Blom and Bar-Shalom 1988).
Before each frame, the estimates of the modes are mixed, because the mode may have changed. After each frame, the
innovation of each mode determines its new probability. The velocity of a held position is zero. When a movement begins,
its velocity is unknown. Later, a white random acceleration changes the velocity.

The covariance that a model reports applies to the noise with which the model was trained. The actual noise of a board
may be smaller or larger. The filter estimates the actual noise: noise changes randomly from frame to frame, whereas a
contact moves smoothly.
"""

import math
from collections import deque

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.flags import BEYOND, MISFIT, SATURATED
from isocharge.serve.frames.frame import Frame
from isocharge.serve.model.contact import correlation_matrices
from isocharge.serve.record.record import TrackedContact

VALUES = slice(0, 3)
"""Slice of x (mm), y (mm) and ln F in a state."""

POSITION = slice(0, 2)
"""Slice of x and y in a state."""

RATES = slice(3, 6)
"""Slice of the rates of x and y (mm/s) and of ln F (1/s) in a state."""

VELOCITY = slice(3, 5)
"""Slice of the velocities along x and y in a state."""

MOVING_POSITION = slice(2, 4)
"""Slice of the two modes in which the position moves."""

_IS_MOVING = np.tile([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0]], 2)
"""Whether x, y and ln F change (1) or are held (0) in each mode. The values are repeated for the rates; (4, 6)."""

_CHANGE_COUNT = np.array([[0.0, 1.0, 1.0, 2.0], [1.0, 0.0, 2.0, 1.0], [1.0, 2.0, 0.0, 1.0], [2.0, 1.0, 1.0, 0.0]])
"""Number of quantities (position, force) that start or stop changing between two modes, 0 to 2, shape (4, 4)."""

MEAN_MODE_TIME_s = 0.7
"""Mean time after which a held position or force starts changing, and a changing one stops changing, s."""

INITIAL_RATE_STD = np.array([60.0, 60.0, 100.0])
"""Standard deviations of the rates at the beginning of a movement, mm/s, mm/s and 1/s."""

_PREDICTION_FACTOR = np.maximum(_IS_MOVING, [1.0, 1.0, 1.0, 0.0, 0.0, 0.0])[:, None]
"""Factor of each value and rate in the prediction of the next state: 0 for rates of held values, else 1; (4, 1, 6)."""

_HELD_RATE_COVARIANCE = np.eye(6) * (1.0 - _PREDICTION_FACTOR) * np.tile(INITIAL_RATE_STD, 2) ** 2
"""Variances of the rates of held values, shape (4, 6, 6). A held value may begin to change at any time."""

_IDENTITY = np.eye(6)

_INTEGRATION = np.eye(6, k=3)
"""Matrix that selects the rate of each value of a state."""

HELD_DRIFT_DENSITY = np.diag([5e-4, 5e-4, 5e-4, 0.0, 0.0, 0.0])
"""Increase of the covariance of a state per second due to the drift of held values, mm^2/s or 1/s, shape (6, 6).

A held finger drifts by 0.02 mm in a second.
"""

ACCELERATION_DENSITY = np.array([150.0, 150.0, 1e6] * 2)
"""Spectral densities of the acceleration of a slow contact, mm^2/s^3, and of the second derivative of ln F, 1/s^3.

The same densities apply to the rates, so the shape is (6,).
"""

SPEED_CHANGE_RATE = np.array([0.5, 0.5, 0.0] * 2)
"""Increase of the spectral densities of the acceleration with the squared speed, 1/s, shape (6,).

A fast contact changes its velocity more than a slow contact.
"""

UNIT_NOISE = np.kron([[1.0 / 3.0, 1.0 / 2.0], [1.0 / 2.0, 1.0]], np.eye(3))
"""Covariance that white accelerations of unit spectral density add to a moving state in 1 s, shape (6, 6).

The covariance after the time t is the product of each entry and a power of t (Bar-Shalom et al. 2001, 6.2.2).
"""

TIME_EXPONENT = np.kron([[3.0, 2.0], [2.0, 1.0]], np.ones((3, 3)))
"""Exponents of the time in the covariance that white accelerations add, shape (6, 6)."""

SQUARED_GATE = 30.0
"""Squared Mahalanobis distance above which a frame does not belong to a contact."""

MAX_GAP_s = 1.0
"""Time without a frame after which the tracked contact is discarded, s."""

WEAK_FLAGS = frozenset({SATURATED, BEYOND, MISFIT})
"""Flags of frames whose charges are wrong."""

WEAK_VARIANCE_FACTOR = 100.0
"""Factor by which the variance of a frame with a flag in `WEAK_FLAGS` is multiplied."""

LARGEST_STD = np.array([100.0, 100.0, 3.0])
"""Largest standard deviations of measured x and y (mm) and ln F.

The first frames of a slow press may have much larger standard deviations. Without the limit, rounding errors could make
eigenvalues of the covariance of the state negative.
"""

LARGEST_LOG_FORCE = 88.0
"""Largest ln F of a smoothed contact. With this limit, F is finite even if an outlier is extrapolated."""

NOISE_INTERVAL_s = 0.0045
"""Time between two frames above which their noise is independent, s. Boards filter charges over shorter times."""


class NoiseEstimate:
    """Estimate of the noise of measured values, relative to the noise that the model states.

    Attributes:
        relative_variance: Estimated variance of the noise, relative to the variance stated by the model.
    """

    def __init__(self) -> None:
        """Start with the noise that the model states."""
        self.relative_variance = 1.0
        self._frames = 1  # the noise that the model states has the weight of one frame
        self._latest: deque[tuple[float, Array]] = deque(maxlen=3)  # time and measured values of the latest frames

    def update(self, measured: Array, covariance: Array, t_s: float) -> None:
        """Update the estimate with the values of a frame.

        If the contact moves steadily and there is no noise, the values of the latest three frames lie on a straight
        line. The deviation of the middle values from the line between the two others therefore shows the noise. The
        estimate is the mean square of the deviation over all frames. A contact that starts or stops deviates from a
        line, too. A deviation of more than three standard deviations therefore counts as three.

        Args:
            measured: Measured x, y and ln F, shape (3,).
            covariance: Covariance of the measured values as stated by the model, shape (3, 3).
            t_s: Time of the frame, s. Frames within `NOISE_INTERVAL_s` after the previous one are not used.
        """
        if self._latest and t_s - self._latest[-1][0] < NOISE_INTERVAL_s:
            return
        self._latest.append((t_s, measured))
        if len(self._latest) < 3:
            return
        # Compare the middle values with the line between the first and the last values.
        (first_s, first), (middle_s, middle), (last_s, last) = self._latest
        last_share = (middle_s - first_s) / (last_s - first_s)
        first_share = 1.0 - last_share
        deviation = middle - first_share * first - last_share * last

        # Divide the squared deviation by the value that is expected for the noise that the model states.
        squared_distance = float(deviation @ np.linalg.solve(covariance, deviation))
        expected_square = (1.0 + first_share**2 + last_share**2) * deviation.size
        relative_square = squared_distance / expected_square

        # Update the mean over all frames. A deviation counts as at most three standard deviations of the noise.
        self._frames += 1
        limited_square = min(relative_square, 3.0**2 * self.relative_variance)
        self.relative_variance += (limited_square - self.relative_variance) / self._frames


class MotionFilter:
    """Interacting multiple model of one contact.

    Attributes:
        mean: Mean of the state in each mode, shape (4, 6).
        covariance: Covariance of the state in each mode, shape (4, 6, 6).
        probability: Probability of each mode, shape (4,).
    """

    def __init__(self, measured: Array, covariance: Array) -> None:
        """Start with the first frame of a contact.

        The state of a contact consists of x, y and ln F (`VALUES`) and of their rates (`RATES`). In each of four modes,
        the position is either held or moves, and the force is either held or changes.

        Args:
            measured: Measured x, y and ln F, shape (3,), mm, mm and dimensionless.
            covariance: Covariance of the measured values, shape (3, 3).
        """
        # All modes start with the measured values and with unknown rates.
        self.mean = np.zeros((4, 6))  # one state for each mode
        self.mean[:, VALUES] = measured
        self.covariance = np.zeros((4, 6, 6))
        self.covariance[:, VALUES, VALUES] = covariance
        self.covariance[:, RATES, RATES] = np.diag(INITIAL_RATE_STD**2)
        self.probability = np.full(4, 0.25)  # of each mode

    def step(self, dt_s: float, measured: Array, covariance: Array) -> bool:
        """Predict the modes at the next frame, and update the modes and their probabilities with the frame.

        Args:
            dt_s: Time since the previous frame, s, not negative.
            measured: Measured x, y and ln F, shape (3,).
            covariance: Covariance of the noise, shape (3, 3).

        Returns:
            Whether the frame belongs to the contact. Otherwise, the modes are only predicted. The result is also False
            if rounding errors have made a covariance useless.
        """
        self._predict(dt_s)
        return self._update(measured, covariance)

    def _predict(self, dt_s: float) -> None:
        """Replace each mode by its prediction after the time `dt_s`, s. The contact may change its mode in this time.

        In each of four modes, the position is either held or moves, and the force is either held or changes. A state
        consists of x, y, ln F and their rates. First, the states of the previous modes are mixed into one state for
        each new mode. Then the mixed state is extrapolated by the motion of the new mode.
        """
        # Compute the probability of each new mode (row) for each previous mode (column). The position and the force
        # start or stop to change independently of each other, so the probabilities of the two quantities are
        # multiplied. `_CHANGE_COUNT` is how many of the two start or stop between two modes, shape (4, 4). After a long
        # time, a quantity has changed its mode with the probability 0.5.
        switch_probability = min(dt_s / MEAN_MODE_TIME_s, 0.5)  # that one quantity starts or stops to change
        mode_transition = switch_probability**_CHANGE_COUNT * (1.0 - switch_probability) ** (2.0 - _CHANGE_COUNT)

        # Mix the states of the previous modes for each new mode.
        joint_probability = mode_transition * self.probability
        self.probability = joint_probability.sum(axis=1)
        weights = joint_probability / self.probability[:, None]
        mean = weights @ self.mean  # shape (4, 6)

        # The covariance of a mixture is the mean of the covariances plus the spread of the means.
        deviation = self.mean - mean[:, None]  # of each previous mode (axis 1) from the mean of each new mode (axis 0)
        spread = (weights[:, :, None] * deviation).swapaxes(1, 2) @ deviation
        mixed_covariance = np.einsum("nm,mij->nij", weights, self.covariance) + spread

        # Compute the covariance that is added until the next frame: by the accelerations of moving values, by the
        # unknown rates of held values, and by the drift of held values. `_IS_MOVING` is 1 for values and rates that
        # change in a mode. `UNIT_NOISE` and `TIME_EXPONENT` describe how accelerations add up over time.
        squared_speed = (mean[:, VELOCITY] ** 2).sum(axis=1, keepdims=True)
        density = _IS_MOVING * (ACCELERATION_DENSITY + squared_speed * SPEED_CHANGE_RATE)
        noise = density[:, None] * UNIT_NOISE * dt_s**TIME_EXPONENT
        noise += _HELD_RATE_COVARIANCE + dt_s * HELD_DRIFT_DENSITY

        # Predict the states. A value changes by its rate times the time. The rate of a held value has no effect, and is
        # replaced by the rate of a movement that begins now: zero on average. `_INTEGRATION` adds the rates to the
        # values, and `_PREDICTION_FACTOR` is 0 for the rates of held values.
        transition = (_IDENTITY + dt_s * _INTEGRATION) * _PREDICTION_FACTOR  # shape (4, 6, 6)
        self.mean = (transition @ mean[:, :, None])[:, :, 0]
        self.covariance = transition @ mixed_covariance @ transition.swapaxes(1, 2) + noise

    def _update(self, measured: Array, covariance: Array) -> bool:
        """Update the predicted modes and their probabilities with measured values.

        Each of the four modes has a mean state and its covariance. `VALUES` is the slice of x, y and ln F in a state.

        Args:
            measured: Measured x, y and ln F, shape (3,).
            covariance: Covariance of the noise, shape (3, 3).

        Returns:
            Whether the modes were updated: False if the measured values are too far from the prediction of each mode,
            or if rounding errors have made a covariance useless.
        """
        # Compute the Mahalanobis distance of the measured values from the prediction of each mode.
        innovation = (measured - self.mean[:, VALUES])[:, :, None]  # shape (4, 3, 1)
        # The precision is the inverse of the covariance of the innovation, shape (4, 3, 3).
        precision = np.linalg.inv(self.covariance[:, VALUES, VALUES] + covariance)
        squared_distance = (innovation * (precision @ innovation)).sum(axis=(1, 2))
        nearest_squared_distance = squared_distance.min()
        determinant = np.linalg.det(precision)
        if not (0.0 <= nearest_squared_distance <= SQUARED_GATE and determinant.min() > 0.0):
            return False

        # Apply Bayes' rule to the modes. A common factor of the likelihoods has no effect; it makes the exponents <= 0.
        likelihood = np.exp(0.5 * (nearest_squared_distance - squared_distance)) * np.sqrt(determinant)
        posterior = self.probability * likelihood
        self.probability = np.maximum(posterior / posterior.sum(), np.finfo(float).tiny)

        # Apply the Kalman update to each mode. Without rounding errors, the last statement would add zero, because
        # gain @ covariance would equal the covariance of the state with the values after the line before. Both
        # statements together are the form of Joseph, whose variances do not become negative by rounding.
        gain = self.covariance[:, :, VALUES] @ precision
        self.mean += (gain @ innovation)[:, :, 0]
        self.covariance -= gain @ self.covariance[:, VALUES]
        self.covariance += (gain @ covariance - self.covariance[:, :, VALUES]) @ gain.swapaxes(1, 2)
        return True


class ContactFilter:
    """Filter that smooths the position and the force of one contact over the frames of a touch.

    The errors of a model have two parts. The first part of the errors changes from frame to frame, such as the noise of
    the charges. The second part is the same in every frame of a held contact, such as the approximation error of the
    model and the errors of the gains. Smoothing reduces only the first part. The filter therefore weights the frames by
    the variance of the first part alone. The variance of the second part is added to the variance of the smoothed
    values.

    The noise is estimated from all frames of a touch, even if the touch consists of several successive contacts.

    Attributes:
        time_s: Time of the latest frame, s.
        other: Always None, because the charges of a film without folds determine the contact.
    """

    other = None

    def __init__(self, constant_variance_share: float) -> None:
        """Start without a frame.

        Args:
            constant_variance_share: Variance of the errors that are the same in every frame while the contact does not
                change, divided by the variance that the model states, 0 to 1.
        """
        self.time_s = -math.inf  # time of the latest frame
        self._constant_share = constant_variance_share
        self._motion: MotionFilter | None = None  # None before the first contact
        self._noise = NoiseEstimate()
        self._is_outlier = False  # whether the latest frame was ignored

    def step(self, frame: Frame, t_s: float) -> TrackedContact:
        """Process the next frame, and return the smoothed contact.

        The standard deviations of the smoothed contact include the constant errors.

        A single frame that does not belong to the contact is ignored. A second such frame in succession begins a new
        contact. Frames may have the same time, for example because they were received together.

        Args:
            frame: Frame with a contact that the model predicted. Frames with a flag in `WEAK_FLAGS` have a small
                weight.
            t_s: Time of the frame on a clock that is never set back, s.
        """
        # Compute the measured values. The standard deviations are limited, because a model may state 1e-6 mm or 1e14 mm
        # for charges that differ much from those of its training.
        contact = frame.contact
        assert contact is not None
        smallest_force_N = float(np.finfo(np.float32).tiny)  # ln F would be infinite if the force were zero
        force_N = max(smallest_force_N, contact.force_N)
        measured = np.array([contact.x_mm, contact.y_mm, math.log(force_N)])
        stated_std = [contact.x_std_mm, contact.y_std_mm, contact.force_std_N / force_N]
        std = np.clip(stated_std, 1e-5 * LARGEST_STD, LARGEST_STD)
        stated_covariance = correlation_matrices(contact) * np.outer(std, std)

        # Compute the part of the covariance that changes from frame to frame.
        model_covariance = (1.0 - self._constant_share) * stated_covariance
        covariance = self._noise.relative_variance * model_covariance
        if not WEAK_FLAGS.isdisjoint([*frame.flags, *frame.contact_flags]):
            covariance *= WEAK_VARIANCE_FACTOR

        # Update the filter, or begin a new contact at the second frame that does not belong to the contact.
        motion = self._motion
        belongs = motion is not None and motion.step(t_s - self.time_s, measured, covariance)
        is_second_outlier = self._is_outlier and not belongs
        if motion is None or is_second_outlier:
            motion = MotionFilter(measured, covariance)
            self._motion = motion
            belongs = True
        self._is_outlier = not belongs
        if belongs:
            self._noise.update(measured, model_covariance, t_s)
        self.time_s = t_s

        # Average the states of the modes, shape (6,). The variance of the average also contains the spread of the
        # modes. Add the variances of the errors that are the same in every frame.
        mean = motion.probability @ motion.mean
        spread = (motion.mean - mean) ** 2
        variances = motion.probability @ (np.diagonal(motion.covariance, axis1=1, axis2=2) + spread)
        constant_variances = self._constant_share * stated_covariance.diagonal()
        smoothed_std = np.sqrt(variances[VALUES] + constant_variances)
        x_std_mm, y_std_mm, log_force_std = smoothed_std.tolist()
        x_mm, y_mm, log_force, vx_mm_s, vy_mm_s, _ = mean.tolist()
        smoothed_N = math.exp(min(log_force, LARGEST_LOG_FORCE))
        moving = float(motion.probability[MOVING_POSITION].sum())
        return TrackedContact(
            x_mm, y_mm, smoothed_N, x_std_mm, y_std_mm, smoothed_N * log_force_std, vx_mm_s, vy_mm_s, moving
        )
