"""Filter that smooths the predicted contacts of successive frames: an interacting multiple model.

The state of a contact consists of x, y and ln F, and the rates of these three values. The position is either held or
moves, and the force is either held or changes. Each of these four modes has a Kalman filter (Blom and Bar-Shalom 1988).
Before each frame, the estimates of the modes are mixed, because the mode may have changed. After each frame, the
innovation of each mode determines its new probability. The velocity of a held position is zero. When a movement begins,
its velocity is unknown. A white acceleration changes the velocity later.

The covariance that a model reports applies to the noise with which the model was trained. The actual noise of a board
may be smaller or larger. The filter estimates the actual noise: noise changes randomly from frame to frame, whereas a
contact moves smoothly.
"""

import math

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.flags import BEYOND, MISFIT, SATURATED
from isocharge.serve.model.contact import Contact, correlation_matrices
from isocharge.serve.record.record import TrackedContact

VALUES = slice(0, 3)
"""Slice of x (mm), y (mm) and ln F in a state."""

POSITION = slice(0, 2)
"""Slice of x and y in a state."""

RATES = slice(3, 6)
"""Slice of the rates of x and y (mm/s) and of ln F (1/s) in a state."""

VELOCITY = slice(3, 5)
"""Slice of the velocities along x and y in a state."""

IS_MOVING = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
"""Whether x, y and ln F change (1) or are held (0) in each of the four modes."""

MEAN_MODE_TIME_s = 0.7
"""Mean time after which a position or a force that is held starts to change, or the reverse, s."""

INITIAL_RATE_STD = np.array([60.0, 60.0, 100.0])
"""Standard deviations of the rates at the beginning of a movement, mm/s, mm/s and 1/s."""

_HELD_RATE_COVARIANCE = np.eye(6) * np.pad((1.0 - IS_MOVING) * INITIAL_RATE_STD**2, ((0, 0), (3, 0)))[:, None]
"""Variances of the rates of held values, shape (4, 6, 6). A held value may begin to change at any time."""

_HAS_EFFECT = np.concatenate([np.ones((4, 3)), IS_MOVING], axis=1)[:, None]
"""Factor of each value and rate in the prediction of the next state: 0 for rates of held values, else 1; (4, 1, 6)."""

_KEPT = np.eye(6) * _HAS_EFFECT
"""Matrices that keep the values, and the rates of values that change, shape (4, 6, 6)."""

_INTEGRATION = np.eye(6, k=3) * _HAS_EFFECT
"""Matrices that add the rates of values that change to the values, shape (4, 6, 6)."""

HELD_DRIFT = 5e-4
"""Increase of the variance of a held value per second, mm^2/s or 1/s. A held finger drifts by 0.02 mm in a second."""

_HELD_DRIFT_DENSITY = np.diag([HELD_DRIFT] * 3 + [0.0] * 3)
"""Increase of the covariance of a state per second because of this drift, shape (6, 6)."""

_IDENTITY = np.eye(3)

ACCELERATION_DENSITY = 150.0
"""Spectral density of the acceleration of a slow contact, mm^2/s^3."""

SPEED_CHANGE_RATE = 0.5
"""Increase of the spectral density of the acceleration with the squared speed, 1/s."""

FORCE_ACCELERATION_DENSITY = 1e6
"""Spectral density of the second derivative of a changing ln F, 1/s^3."""

SQUARED_GATE = 30.0
"""Squared Mahalanobis distance of a frame above which it does not belong to a contact."""

MAX_GAP_s = 1.0
"""Time without a frame after which the tracked contact is discarded, s."""

WEAK_FLAGS = frozenset({SATURATED, BEYOND, MISFIT})
"""Flags of frames whose charges are wrong."""

WEAK_VARIANCE_FACTOR = 100.0
"""Factor by which the variance of a frame with such a flag is multiplied."""

LARGEST_STD = np.array([100.0, 100.0, 3.0])
"""Largest standard deviations of measured x and y (mm) and ln F.

The first frames of a slow press may have much larger standard deviations. Without the limit, rounding errors could make
eigenvalues of the covariance of the state negative.
"""

NOISE_INTERVAL_s = 0.0045
"""Time after which the noise of two frames is independent, s. Boards filter their charges over shorter times."""


def process_noise(velocity_mm_per_s: Array, force_density: float, dt_s: float, is_moving: Array | float = 1.0) -> Array:
    """Return the covariance that a white acceleration adds to moving states (Bar-Shalom et al. 2001, 6.2.2).

    The spectral density of the acceleration of the position increases with the squared speed, because a fast contact
    changes its velocity more than a slow contact.

    Args:
        velocity_mm_per_s: Velocities along x and y, shape (n, 2), mm/s.
        force_density: Spectral density of the second derivative of ln F, 1/s^3.
        dt_s: Time over which the acceleration acts, s.
        is_moving: Whether x, y and ln F change (1) or are held (0) in each state, shape (n, 3). By default, all change.

    Returns:
        Covariances of x, y, ln F and their rates, shape (n, 6, 6).
    """
    density = np.full((len(velocity_mm_per_s), 3), force_density)
    squared_speed = (velocity_mm_per_s**2).sum(axis=1)
    density[:, POSITION] = (ACCELERATION_DENSITY + SPEED_CHANGE_RATE * squared_speed)[:, None]
    # Covariance of a value and its rate for a unit density. Values that are held get no covariance. In the sum, a and b
    # select the value or its rate, k and l select x, y or ln F, and n selects the state.
    unit_covariance = np.array([[dt_s**3 / 3.0, dt_s**2 / 2.0], [dt_s**2 / 2.0, dt_s]])
    blocks: Array = np.einsum("ab,nk,kl->nakbl", unit_covariance, is_moving * density, _IDENTITY)
    return blocks.reshape(-1, 6, 6)


def mixture_moments(weight: Array, mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Return the means, shape (m, k), and the covariances, shape (m, k, k), of m mixtures of n Gaussian components.

    Args:
        weight: Weights of the components in each mixture, shape (m, n). Each row adds up to 1.
        mean: Means of the components, shape (n, k).
        covariance: Covariances of the components, shape (n, k, k).
    """
    mixed_mean = weight @ mean
    deviation = mean - mixed_mean[:, None]  # shape (m, n, k)
    spread = (weight[:, :, None] * deviation).swapaxes(1, 2) @ deviation  # covariance of the means of the components
    mean_covariance = (weight @ covariance.reshape(len(mean), -1)).reshape(spread.shape)
    return mixed_mean, mean_covariance + spread


class NoiseEstimate:
    """Estimate of the noise of measured values, relative to the noise that the model states.

    Attributes:
        relative_variance: Estimated variance of the noise, relative to the variance stated by the model.
    """

    def __init__(self) -> None:
        """Start with the noise that the model states."""
        self.relative_variance = 1.0
        self._frames = 1  # the noise that the model states has the weight of one frame
        self._latest: list[Array] = []  # the latest values and their times, at most three arrays of shape (4,)
        self._latest_s = -math.inf

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
        if t_s - self._latest_s < NOISE_INTERVAL_s:
            return
        self._latest_s = t_s
        self._latest = [*self._latest[-2:], np.append(measured, t_s)]
        if len(self._latest) < 3:
            return
        # Compare the middle values with the line between the first and the last values. The last entry is the time.
        first, middle, last = self._latest
        time_share = (middle[-1] - first[-1]) / (last[-1] - first[-1])
        deviation = (middle - (1.0 - time_share) * first - time_share * last)[:-1]
        variance_factor = (1.0 + (1.0 - time_share) ** 2 + time_share**2) * deviation.size
        relative_square = deviation @ np.linalg.solve(covariance, deviation) / variance_factor

        # Update the mean over all frames.
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

        Args:
            measured: Measured x, y and ln F, shape (3,), mm, mm and dimensionless.
            covariance: Covariance of the measured values, shape (3, 3).
        """
        # All modes start with the measured values and with unknown rates.
        self.mean = np.zeros((4, 6))
        self.mean[:, VALUES] = measured
        self.covariance = np.zeros((4, 6, 6))
        self.covariance[:, VALUES, VALUES] = covariance
        self.covariance[:, RATES, RATES] = np.diag(INITIAL_RATE_STD**2)
        self.probability = np.full(4, 0.25)

    @property
    def moving_probability(self) -> float:
        """Probability that the position moves."""
        return float(self.probability @ IS_MOVING[:, 0])

    def predict(self, dt_s: float) -> None:
        """Mix the modes, and predict the state of each mode at the next frame.

        Args:
            dt_s: Time until the next frame, s, not negative.
        """
        # Probability that a value is held or moves (row) after it was held or moved (column), shape (2, 2). Position
        # and force change independently, so the probabilities of the modes are products, shape (4, 4).
        change = min(dt_s / MEAN_MODE_TIME_s, 0.5)
        value_transition = np.array([[1.0 - change, change], [change, 1.0 - change]])
        mode_transition = (value_transition[:, None, :, None] * value_transition[:, None]).reshape(4, 4)

        # Mix the states of the previous modes (columns) for each new mode (row).
        joint_probability = mode_transition * self.probability
        self.probability = joint_probability.sum(axis=1)
        mixing_weights = joint_probability / self.probability[:, None]
        mean, covariance = mixture_moments(mixing_weights, self.mean, self.covariance)

        # The rate of a held value is that of a movement that would begin now: zero on average.
        noise = process_noise(mean[:, VELOCITY], FORCE_ACCELERATION_DENSITY, dt_s, IS_MOVING)
        noise += _HELD_RATE_COVARIANCE + dt_s * _HELD_DRIFT_DENSITY
        transition = _KEPT + dt_s * _INTEGRATION
        self.mean = (transition @ mean[:, :, None])[:, :, 0]
        self.covariance = transition @ covariance @ transition.swapaxes(1, 2) + noise

    def update(self, measured: Array, covariance: Array) -> bool:
        """Update the predicted modes and their probabilities with the measured values of the frame.

        Args:
            measured: Measured x, y and ln F, shape (3,).
            covariance: Covariance of the noise, shape (3, 3).

        Returns:
            Whether the frame belongs to the contact. Otherwise nothing is updated. The result is also False if rounding
            errors have made a covariance useless.
        """
        # Mahalanobis distance of the measured values from the prediction of each mode
        innovation = (measured - self.mean[:, VALUES])[:, :, None]  # shape (4, 3, 1)
        precision = np.linalg.inv(self.covariance[:, VALUES, VALUES] + covariance)  # shape (4, 3, 3)
        squared_distance = (innovation * (precision @ innovation)).sum(axis=(1, 2))
        smallest = squared_distance.min()
        determinant = np.linalg.det(precision)
        if not (0.0 <= smallest <= SQUARED_GATE and determinant.min() > 0.0):
            return False

        # Apply Bayes' rule to the modes. A common factor of the likelihoods has no effect; it makes the exponents <= 0.
        likelihood = np.exp(0.5 * (smallest - squared_distance)) * np.sqrt(determinant)
        posterior = self.probability * likelihood
        self.probability = np.maximum(posterior / posterior.sum(), np.finfo(float).tiny)

        # Kalman update of each mode
        gain = self.covariance[:, :, VALUES] @ precision
        self.mean = self.mean + (gain @ innovation)[:, :, 0]
        self.covariance = self.covariance - gain @ self.covariance[:, VALUES]
        return True


class ContactFilter:
    """Filter that smooths the position and the force of one contact over successive frames.

    The errors of a model have two parts. The first part of the errors changes from frame to frame, such as the noise of
    the charges. The second part is the same in every frame of a held contact, such as the approximation error of the
    model and the errors of the gains. Smoothing reduces only the first part. The filter therefore weights the frames by
    the variance of the first part alone, and adds the variance of the second part to that of the smoothed values.

    The noise is estimated from all frames of a touch, even if the touch consists of several successive contacts.
    """

    def __init__(self, constant_variance_share: float) -> None:
        """Start without a tracked contact.

        Args:
            constant_variance_share: Variance of the errors that are the same in every frame of a held contact, divided
                by the variance that the model states, 0 to 1.
        """
        self._constant_share = constant_variance_share
        self.reset()

    def reset(self) -> None:
        """Discard the tracked contact."""
        self._filter: MotionFilter | None = None
        self._noise = NoiseEstimate()
        self._is_outlier = False  # whether the latest frame was ignored
        self._latest_time_s = 0.0

    def step(self, contact: Contact, t_s: float, flags: tuple[str, ...]) -> TrackedContact:
        """Process the next frame, and return the smoothed contact.

        The standard deviations of the smoothed contact include the constant errors.

        A single frame that does not belong to the contact is ignored. A second such frame in succession begins a new
        contact. A new contact also begins if the time since the latest frame is longer than `MAX_GAP_s`. Frames may
        have the same time, for example because they were received together.

        Args:
            contact: Contact predicted by the model.
            t_s: Time of the frame on a clock that is never set back, s.
            flags: Flags of the frame. Frames with flags in `WEAK_FLAGS` have a small weight.
        """
        # Compute the measured values, and the part of their covariance that changes from frame to frame.
        dt_s = t_s - self._latest_time_s
        if dt_s > MAX_GAP_s:
            self.reset()
        self._latest_time_s = t_s
        measured, stated_covariance = _measured_values(contact)
        model_covariance = (1.0 - self._constant_share) * stated_covariance
        covariance = self._noise.relative_variance * model_covariance
        if WEAK_FLAGS.intersection(flags):
            covariance *= WEAK_VARIANCE_FACTOR

        # Update the filter, or begin a new contact at the second frame that does not belong to the contact.
        belongs = False
        if self._filter is not None:
            self._filter.predict(dt_s)
            belongs = self._filter.update(measured, covariance)
            self._is_outlier = not (belongs or self._is_outlier)
        if self._filter is None or not (belongs or self._is_outlier):
            self._filter = MotionFilter(measured, covariance)
        if not self._is_outlier:
            self._noise.update(measured, model_covariance, t_s)

        # Combine the modes, and add the constant errors.
        modes = self._filter
        (mean,), (smoothed_covariance,) = mixture_moments(modes.probability[None], modes.mean, modes.covariance)
        variance = smoothed_covariance[VALUES, VALUES] + self._constant_share * stated_covariance
        x_std_mm, y_std_mm, log_force_std = np.sqrt(variance.diagonal()).tolist()
        x_mm, y_mm, log_force, vx_mm_s, vy_mm_s, _ = mean.tolist()
        force_N = math.exp(log_force)
        return TrackedContact(
            x_mm, y_mm, force_N, x_std_mm, y_std_mm, force_N * log_force_std, vx_mm_s, vy_mm_s, modes.moving_probability
        )


def _measured_values(contact: Contact) -> tuple[Array, Array]:
    """Return x, y and ln F of a contact, shape (3,), and their covariance, shape (3, 3).

    The standard deviations are limited, and the correlations are made slightly smaller, so that the covariance has only
    positive eigenvalues in spite of rounding errors. For charges that differ much from those of its training, a model
    may state 1e-6 mm or 1e14 mm.
    """
    smallest_force_N = float(np.finfo(np.float32).tiny)  # ln F would be infinite if the force were zero
    force_N = max(smallest_force_N, contact.force_N)
    stated_std = [contact.x_std_mm, contact.y_std_mm, contact.force_std_N / force_N]
    std = np.clip(stated_std, 1e-5 * LARGEST_STD, LARGEST_STD)
    covariance = correlation_matrices(contact) * np.outer(std, std)
    return np.array([contact.x_mm, contact.y_mm, math.log(force_N)]), covariance
