"""Filter with two modes, held and moving, for the position of a contact or for the logarithm of its force.

The filter is an interacting multiple model (Blom and Bar-Shalom 1988). Each mode has a Kalman filter. Before each
frame, the estimates of the two modes are mixed, because the contact may have changed from one mode to the other. After
each frame, the innovation of each mode determines the new probability of the mode. In the held mode, the velocity is
zero. In the moving mode, the velocity is unknown when a movement begins. A white acceleration changes the velocity
later.

A position is represented by a complex number x + iy, and the logarithm of a force by a real number. All covariance
matrices are assumed to be multiples of the covariance matrix of the measurement. A single number therefore represents
each matrix, and a step takes only microseconds.

The variance that a model reports applies to the noise with which the model was trained. The actual noise of a board may
be smaller or larger. The filter estimates the actual noise: noise changes randomly from frame to frame, whereas a
contact moves smoothly.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

MEAN_HELD_TIME_s = 1.0
"""Mean time for which a contact is held, s."""

MEAN_MOVING_TIME_s = 0.5
"""Mean time for which a contact moves, s."""

MAX_CHANGE_PROBABILITY = 0.5
"""Largest probability that the mode changes between two frames."""

SQUARED_GATE = 30.0
"""Squared Mahalanobis distance of the innovation above which a frame does not belong to this contact."""

MAX_LOG_LIKELIHOOD_RATIO = 60.0
"""Largest logarithm of the likelihood ratio of the two modes. The limit prevents an overflow of `math.exp`."""

MIN_PROBABILITY = 1e-6
"""Smallest probability of a mode."""

MIN_ACCELERATION_SHARE = 0.2
"""Acceleration density of a slow contact, relative to `MotionModel.acceleration_density`, dimensionless."""


class MotionModel(NamedTuple):
    """Parameters of the process noise of one quantity: a position in mm, or the logarithm of a force.

    Attributes:
        held_drift: Increase of the variance per second while the contact is held, mm^2/s or 1/s.
        velocity_variance: Variance of the velocity at the beginning of a movement, mm^2/s^2 or 1/s^2.
        acceleration_density: Spectral density of the white acceleration of a contact whose squared speed is
            `velocity_variance`, mm^2/s^3 or 1/s^3. At other speeds the density is proportional to the squared speed,
            because fast contacts change their velocity more than slow contacts. The density is at least
            `MIN_ACCELERATION_SHARE` of this value.
        dimensions: Number of dimensions: 2 for a position, 1 for the logarithm of a force.
    """

    held_drift: float
    velocity_variance: float
    acceleration_density: float
    dimensions: int


SPEED_STD = 30.0
"""Standard deviation of the velocity along x or y at the beginning of a movement, mm/s."""

FORCE_RATE_STD = 10.0
"""Standard deviation of the rate of ln F at the beginning of a change of the force, 1/s."""

POSITION_MOTION = MotionModel(5e-4, SPEED_STD**2, acceleration_density=800.0, dimensions=2)
"""Motion of a finger: a held finger drifts by 0.02 mm in a second, and a moving finger moves at about 30 mm/s."""

FORCE_MOTION = MotionModel(5e-4, FORCE_RATE_STD**2, acceleration_density=1e3, dimensions=1)
"""Change of ln F: a held force drifts by 2 % in a second, and a changing force grows by a factor of e in 0.1 s."""


class Metric(NamedTuple):
    """Squared length of a difference z = x + iy in units of a covariance with the determinant 1.

    The squared length is `mean * abs(z)**2 + (skew * z**2).real`.

    Attributes:
        mean: Half of the trace of the inverse covariance C; 1 for equal and independent errors.
        skew: (C_xx - C_yy) / 2 - i C_xy; 0 for equal and independent errors.
    """

    mean: float = 1.0
    skew: complex = 0.0


EQUAL_ERRORS = Metric()
"""Metric for equal and independent errors of x and y, and for real numbers."""


class Estimate(NamedTuple):
    """Estimate of a position, or of the logarithm of a force, with its variance.

    Attributes:
        value: Position x + iy, mm, or logarithm of the force.
        variance: Root of the determinant of the covariance of a position, mm^2, or variance of the logarithm of a
            force.
    """

    value: complex
    variance: float


class NoiseEstimate:
    """Estimate of the noise of measured values, relative to the noise that the model states.

    Attributes:
        relative_variance: Estimated variance of the noise, relative to the variance stated by the model.
    """

    PRIOR_FRAMES = 5
    """Weight of the variance stated by the model in the average, as a number of frames."""

    MAX_FRAMES = 100
    """Number of frames over which the estimate is averaged."""

    MIN_INTERVAL_s = 0.0045
    """Time after which the noise of two frames is independent, s. Boards filter their charges over shorter times."""

    MAX_RELATIVE_SQUARE = 6.0
    """Largest squared residual of a frame, relative to the present estimate. Sudden movements are not noise."""

    RELATIVE_VARIANCES = (0.01, 100.0)
    """Smallest and largest variance of the noise, relative to the variance stated by the model."""

    def __init__(self, measured: complex) -> None:
        """Begin with the noise that the model states.

        Args:
            measured: First measured value: a position x + iy, mm, or the logarithm of a force.
        """
        self.relative_variance = 1.0
        self._frames = self.PRIOR_FRAMES
        self._measured = measured
        self._rate = 0j  # rate of change between the latest two measured values
        self._dt_s = 0.0  # time between these values; 0 if there is only one value

    def update(self, measured: complex, dt_s: float, stated_variance: float, metric: Metric, dimensions: int) -> None:
        """Compare the next measured value with the linear extrapolation of the two previous values.

        The relative square of a frame is the squared error of the extrapolation, divided by the mean of this square for
        noise with the stated variance. The estimated relative variance is the mean of the relative squares of the
        latest frames. The relative square of a single frame is limited, because a sudden movement is not noise.

        Args:
            measured: The measured value.
            dt_s: Time since the latest measured value, s, at least `MIN_INTERVAL_s`.
            stated_variance: Variance of the noise as stated by the model.
            metric: Shape of the covariance of the noise.
            dimensions: Number of dimensions of the value.
        """
        change = measured - self._measured
        if self._dt_s > 0.0:  # otherwise there is only one previous value
            # The error is x2 - (1 + r) x1 + r x0, where x0, x1 and x2 are the latest three values, and r is the ratio
            # of the two intervals. The noise of the three values is independent. The variance of the error is therefore
            # the variance of one value times 1 + (1 + r)^2 + r^2.
            ratio = dt_s / self._dt_s
            error_variance = dimensions * stated_variance * (1.0 + ratio * ratio + (1.0 + ratio) ** 2)
            error = change - self._rate * dt_s
            relative_square = (metric.mean * abs(error) ** 2 + (metric.skew * error * error).real) / error_variance
            limited_square = min(relative_square, self.MAX_RELATIVE_SQUARE * self.relative_variance)

            # The number of frames is limited, so that the mean follows changes of the noise.
            self._frames = min(self._frames + 1, self.MAX_FRAMES)
            mean_square = self.relative_variance + (limited_square - self.relative_variance) / self._frames
            smallest, largest = self.RELATIVE_VARIANCES
            self.relative_variance = min(max(mean_square, smallest), largest)
        self._measured = measured
        self._rate = change / dt_s
        self._dt_s = dt_s


@dataclass(slots=True)
class TwoModeFilter:
    """Filter with a held mode and a moving mode, for a position or for the logarithm of a force.

    The unit of a value is mm for a position. The logarithm of a force is dimensionless. Times are in s.

    Attributes:
        motion: Parameters of the process noise.
        held_value: Value that the held mode estimates.
        held_variance: Variance of `held_value`.
        moving_value: Value that the moving mode estimates.
        moving_variance: Variance of `moving_value`.
        velocity: Rate of change of the value in the moving mode.
        velocity_variance: Variance of `velocity`.
        noise: Estimate of the size of the measurement noise.
        moving_covariance: Covariance of `moving_value` and `velocity`.
        moving_probability: Probability of the moving mode.
        noise_age_s: Time since `noise` was last updated, s.
        metric: Shape of the covariance of the noise in the predicted frame.
    """

    motion: MotionModel
    held_value: complex
    held_variance: float
    moving_value: complex
    moving_variance: float
    velocity: complex
    velocity_variance: float
    noise: NoiseEstimate
    moving_covariance: float = 0.0
    moving_probability: float = 0.5
    noise_age_s: float = 0.0
    metric: Metric = EQUAL_ERRORS

    @classmethod
    def start(cls, measured: complex, variance: float, motion: MotionModel) -> "TwoModeFilter":
        """Return the filter after the first frame.

        Args:
            measured: Measured value of the first frame.
            variance: Variance of the noise of this value.
            motion: Parameters of the process noise.
        """
        zero = measured - measured  # of the same type as the value, real or complex
        noise = NoiseEstimate(measured)
        return cls(motion, measured, variance, measured, variance, zero, motion.velocity_variance, noise)

    def predict(self, dt_s: float, metric: Metric = EQUAL_ERRORS) -> None:
        """Mix the two modes, and predict the values of both modes at the next frame.

        Args:
            dt_s: Time until the next frame, s, not negative.
            metric: Shape of the covariance of the noise in the next frame.
        """
        self.metric = metric
        self.noise_age_s += dt_s
        drift, initial_velocity_variance, acceleration_density, dimensions = self.motion
        mean, skew = metric

        # Probability of each mode at the next frame. `started` is the probability that a contact that moves then is
        # held now. `stopped` is the probability that a contact that is held then moves now.
        moving = self.moving_probability
        starting = (1.0 - moving) * min(dt_s / MEAN_HELD_TIME_s, MAX_CHANGE_PROBABILITY)
        stopping = moving * min(dt_s / MEAN_MOVING_TIME_s, MAX_CHANGE_PROBABILITY)
        moving += starting - stopping
        self.moving_probability = moving
        started = starting / moving
        stopped = stopping / (1.0 - moving)
        continued = 1.0 - started

        # Mixing of the two modes. A movement that has just started has the velocity zero on average.
        velocity = self.velocity
        difference = self.moving_value - self.held_value
        squared_speed = abs(velocity) ** 2
        squared_difference = (mean * abs(difference) ** 2 + (skew * difference * difference).real) / dimensions
        projection = (velocity * (mean * difference.conjugate() + skew * difference)).real / dimensions
        velocity_spread = (mean * squared_speed + (skew * velocity * velocity).real) / dimensions
        excess_variance = self.moving_variance - self.held_variance
        held_variance = self.held_variance + stopped * (excess_variance + (1.0 - stopped) * squared_difference)
        moving_variance = self.moving_variance - started * (excess_variance - continued * squared_difference)
        covariance = continued * (self.moving_covariance + started * projection)
        velocity_variance = continued * (self.velocity_variance + started * velocity_spread)
        velocity_variance += started * initial_velocity_variance
        velocity *= continued

        # Prediction of both modes. The acceleration density is proportional to the squared speed.
        relative_density = max(
            continued * continued * squared_speed / initial_velocity_variance, MIN_ACCELERATION_SHARE
        )
        velocity_noise = acceleration_density * relative_density * dt_s
        self.held_value += stopped * difference
        self.held_variance = held_variance + drift * dt_s
        self.moving_value += velocity * dt_s - started * difference
        self.moving_variance = moving_variance + dt_s * (
            2.0 * covariance + dt_s * (velocity_variance + velocity_noise / 3.0)
        )
        self.moving_covariance = covariance + dt_s * (velocity_variance + 0.5 * velocity_noise)
        self.velocity = velocity
        self.velocity_variance = velocity_variance + velocity_noise

    def update(self, measured: complex, stated_variance: float) -> Estimate | None:
        """Update the predicted modes and their probabilities with the measured value of the frame.

        Args:
            measured: The measured value.
            stated_variance: Variance of the noise that is independent from frame to frame, as stated by the model. A
                larger variance gives the frame a smaller weight.

        Returns:
            The estimate of the value; None if the frame does not belong to the same contact as the previous frames.
            Nothing is updated in this case.
        """
        # Squared Mahalanobis distance of the innovation of each mode
        noise_variance = stated_variance * self.noise.relative_variance
        held_innovation = measured - self.held_value
        moving_innovation = measured - self.moving_value
        held_precision = 1.0 / (self.held_variance + noise_variance)
        moving_precision = 1.0 / (self.moving_variance + noise_variance)
        mean, skew = self.metric
        held_square = mean * abs(held_innovation) ** 2 + (skew * held_innovation * held_innovation).real
        held_square *= held_precision
        moving_square = mean * abs(moving_innovation) ** 2 + (skew * moving_innovation * moving_innovation).real
        moving_square *= moving_precision
        if held_square > SQUARED_GATE and moving_square > SQUARED_GATE:
            return None

        # Probability of the moving mode by Bayes' theorem
        dimensions = self.motion.dimensions
        log_likelihood_ratio = min(0.5 * (held_square - moving_square), MAX_LOG_LIKELIHOOD_RATIO)
        odds = self.moving_probability / (1.0 - self.moving_probability)
        odds *= (moving_precision / held_precision) ** (0.5 * dimensions) * math.exp(log_likelihood_ratio)
        moving = min(max(odds / (1.0 + odds), MIN_PROBABILITY), 1.0 - MIN_PROBABILITY)
        self.moving_probability = moving

        # Kalman update of each mode
        held_gain = self.held_variance * held_precision
        self.held_value += held_gain * held_innovation
        self.held_variance = held_gain * noise_variance
        moving_gain = self.moving_variance * moving_precision
        velocity_gain = self.moving_covariance * moving_precision
        self.moving_value += moving_gain * moving_innovation
        self.moving_variance = moving_gain * noise_variance
        self.velocity += velocity_gain * moving_innovation
        self.velocity_variance -= velocity_gain * self.moving_covariance
        self.moving_covariance = velocity_gain * noise_variance
        if self.noise_age_s >= NoiseEstimate.MIN_INTERVAL_s:
            self.noise.update(measured, self.noise_age_s, stated_variance, self.metric, dimensions)
            self.noise_age_s = 0.0

        # Mean and variance of the mixture of the two modes
        difference = self.moving_value - self.held_value
        squared_difference = (mean * abs(difference) ** 2 + (skew * difference * difference).real) / dimensions
        excess_variance = self.moving_variance - self.held_variance + (1.0 - moving) * squared_difference
        variance = self.held_variance + moving * excess_variance
        return Estimate(self.held_value + moving * difference, variance)
