"""Filter with two modes, held and moving, for the position of a contact or for the logarithm of its force.

The filter is an interacting multiple model (Blom and Bar-Shalom 1988). Each mode has a Kalman filter. Before each
frame, the estimates of the two modes are mixed, because the contact may have changed from one mode to the other. After
each frame, the innovation of each mode determines the new probability of the mode. In the held mode, the velocity is
zero. In the moving mode, the velocity is unknown when a movement begins. A white acceleration changes the velocity
later.

A position is represented by a complex number x + iy, and the logarithm of a force by a real number. All covariance
matrices are assumed to be multiples of the covariance matrix of the measurement. A single number therefore represents
each matrix, and a step takes only microseconds.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from isocharge.serve.tracking.measurement_noise import CovarianceShape, MIN_INTERVAL_s, NoiseEstimate
from isocharge.serve.tracking.motion import MIN_ACCELERATION_SHARE, MotionModel

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


class Estimate(NamedTuple):
    """Estimate of a position, or of the logarithm of a force, with its variance.

    Attributes:
        value: Position x + iy, mm, or logarithm of the force.
        variance: Variance of the value, mm^2, or dimensionless for a force.
    """

    value: complex
    variance: float


@dataclass(slots=True)
class TwoModeFilter:
    """Filter with a held mode and a moving mode, for a position or for the logarithm of a force.

    The unit of a value is mm for a position. The logarithm of a force is dimensionless. Times are in s.

    Attributes:
        motion: Parameters of the process noise.
        moving_probability: Probability of the moving mode.
        held_value: Value that the held mode estimates.
        held_variance: Variance of `held_value`.
        moving_value: Value that the moving mode estimates.
        velocity: Rate of change of the value in the moving mode.
        moving_variance: Variance of `moving_value`.
        moving_covariance: Covariance of `moving_value` and `velocity`.
        velocity_variance: Variance of `velocity`.
        noise: Estimate of the size of the measurement noise.
        noise_age_s: Time since `noise` was last updated, s.
    """

    motion: MotionModel
    moving_probability: float
    held_value: complex
    held_variance: float
    moving_value: complex
    velocity: complex
    moving_variance: float
    moving_covariance: float
    velocity_variance: float
    noise: NoiseEstimate
    noise_age_s: float = 0.0

    @classmethod
    def start(cls, measured: complex, variance: float, motion: MotionModel) -> "TwoModeFilter":
        """Return the filter after the first frame.

        Args:
            measured: Measured value of the first frame.
            variance: Variance of the noise of this value.
            motion: Parameters of the process noise.
        """
        return cls(
            motion,
            moving_probability=0.5,
            held_value=measured,
            held_variance=variance,
            moving_value=measured,
            velocity=measured - measured,  # zero of the same type as the value, real or complex
            moving_variance=variance,
            moving_covariance=0.0,
            velocity_variance=motion.velocity_variance,
            noise=NoiseEstimate.start(measured),
        )

    def step(self, measured: complex, dt_s: float, shape: CovarianceShape, stated_variance: float) -> Estimate | None:
        """Process the next frame: predict both modes, and update both modes with the measured value.

        The method computes minima, maxima and squared distances without calls of `min`, `max` and
        `CovarianceShape.mean_square`, because the calls would take a third of its time.

        Args:
            measured: The measured value of the frame.
            dt_s: Time since the previous frame, s, not negative.
            shape: Shape of the covariance of the measured value.
            stated_variance: Variance of the noise that is independent from frame to frame, as stated by the model. A
                larger variance gives the frame a smaller weight.

        Returns:
            The estimate of the value; None if the frame does not belong to the same contact as the previous frames. In
            this case, the state of the filter is not changed.
        """
        inverse_xx, inverse_yy, inverse_xy, dimensions = shape
        held_drift, initial_velocity_variance, acceleration_density = self.motion
        noise_variance = stated_variance * self.noise.relative_variance

        # Probability of each mode at this frame. `started_share` is the probability that a contact that moves now was
        # held at the previous frame. `stopped_share` is the probability that a contact that is held now was moving.
        start_probability = dt_s / MEAN_HELD_TIME_s
        if start_probability > MAX_CHANGE_PROBABILITY:
            start_probability = MAX_CHANGE_PROBABILITY
        stop_probability = dt_s / MEAN_MOVING_TIME_s
        if stop_probability > MAX_CHANGE_PROBABILITY:
            stop_probability = MAX_CHANGE_PROBABILITY
        started = (1.0 - self.moving_probability) * start_probability
        stopped = self.moving_probability * stop_probability
        moving_probability = self.moving_probability + (started - stopped)
        started_share = started / moving_probability
        stopped_share = stopped / (1.0 - moving_probability)
        continued_share = 1.0 - started_share

        # Mixing of the two modes. A movement that has just started has the velocity zero on average.
        difference = self.moving_value - self.held_value
        x = difference.real
        y = difference.imag
        velocity_x = self.velocity.real
        velocity_y = self.velocity.imag
        weighted_x = inverse_xx * x + inverse_xy * y
        weighted_y = inverse_xy * x + inverse_yy * y
        squared_difference = weighted_x * x + weighted_y * y
        difference_times_velocity = weighted_x * velocity_x + weighted_y * velocity_y
        squared_speed = (
            inverse_xx * velocity_x + 2.0 * inverse_xy * velocity_y
        ) * velocity_x + inverse_yy * velocity_y * velocity_y
        held_value = self.held_value + stopped_share * difference
        held_variance = self.held_variance + stopped_share * (
            self.moving_variance - self.held_variance + (1.0 - stopped_share) * squared_difference
        )
        moving_variance = self.moving_variance + started_share * (
            self.held_variance - self.moving_variance + continued_share * squared_difference
        )
        covariance = self.moving_covariance
        covariance += started_share * (continued_share * difference_times_velocity - covariance)
        velocity_variance = self.velocity_variance
        velocity_variance += started_share * (
            initial_velocity_variance - velocity_variance + continued_share * squared_speed
        )
        velocity = self.velocity * continued_share

        # Prediction of both modes. The acceleration density is proportional to the squared speed.
        relative_density = (
            continued_share
            * continued_share
            * (velocity_x * velocity_x + velocity_y * velocity_y)
            / initial_velocity_variance
        )
        if relative_density < MIN_ACCELERATION_SHARE:
            relative_density = MIN_ACCELERATION_SHARE
        velocity_noise = acceleration_density * relative_density * dt_s
        held_variance += held_drift * dt_s
        moving_value = self.moving_value + (velocity * dt_s - started_share * difference)
        moving_variance += dt_s * (2.0 * covariance + dt_s * (velocity_variance + velocity_noise / 3.0))
        covariance += dt_s * (velocity_variance + 0.5 * velocity_noise)
        velocity_variance += velocity_noise

        # Squared Mahalanobis distance of the innovation of each mode.
        held_innovation = measured - held_value
        moving_innovation = measured - moving_value
        held_precision = 1.0 / (held_variance + noise_variance)
        moving_precision = 1.0 / (moving_variance + noise_variance)
        x = held_innovation.real
        y = held_innovation.imag
        held_square = dimensions * held_precision * ((inverse_xx * x + 2.0 * inverse_xy * y) * x + inverse_yy * y * y)
        x = moving_innovation.real
        y = moving_innovation.imag
        moving_square = (
            dimensions * moving_precision * ((inverse_xx * x + 2.0 * inverse_xy * y) * x + inverse_yy * y * y)
        )
        if held_square > SQUARED_GATE and moving_square > SQUARED_GATE:
            return None

        # Probability of the moving mode by Bayes' theorem.
        density_ratio = moving_precision / held_precision
        if dimensions == 1:
            density_ratio = math.sqrt(density_ratio)
        log_likelihood_ratio = 0.5 * (held_square - moving_square)
        if log_likelihood_ratio > MAX_LOG_LIKELIHOOD_RATIO:
            log_likelihood_ratio = MAX_LOG_LIKELIHOOD_RATIO
        odds = moving_probability / (1.0 - moving_probability) * density_ratio * math.exp(log_likelihood_ratio)
        moving_probability = odds / (1.0 + odds)
        if moving_probability < MIN_PROBABILITY:
            moving_probability = MIN_PROBABILITY
        elif moving_probability > 1.0 - MIN_PROBABILITY:
            moving_probability = 1.0 - MIN_PROBABILITY

        # Kalman update of each mode.
        held_gain = held_variance * held_precision
        held_value += held_gain * held_innovation
        held_variance = held_gain * noise_variance
        moving_gain = moving_variance * moving_precision
        velocity_gain = covariance * moving_precision
        moving_value += moving_gain * moving_innovation
        velocity += velocity_gain * moving_innovation
        velocity_variance -= velocity_gain * covariance
        moving_variance = moving_gain * noise_variance
        covariance = velocity_gain * noise_variance

        self.moving_probability = moving_probability
        self.held_value = held_value
        self.held_variance = held_variance
        self.moving_value = moving_value
        self.velocity = velocity
        self.moving_variance = moving_variance
        self.moving_covariance = covariance
        self.velocity_variance = velocity_variance
        self.noise_age_s += dt_s
        if self.noise_age_s >= MIN_INTERVAL_s:
            self.noise = self.noise.updated(measured, self.noise_age_s, shape, stated_variance)
            self.noise_age_s = 0.0

        # Mean and variance of the mixture of the two modes.
        difference = moving_value - held_value
        x = difference.real
        y = difference.imag
        squared_difference = (inverse_xx * x + 2.0 * inverse_xy * y) * x + inverse_yy * y * y
        variance = held_variance + moving_probability * (
            moving_variance - held_variance + (1.0 - moving_probability) * squared_difference
        )
        return Estimate(held_value + moving_probability * difference, variance)
