"""Noise of measured contacts, described by the shape of its covariance and by an estimate of its size.

The standard deviations that a model reports apply to the noise with which the model was trained. The actual noise of a
board may be smaller or larger. Noise changes randomly from frame to frame, whereas a contact moves smoothly. Each frame
is therefore compared with a linear extrapolation of the two previous frames. The differences between the frames and the
extrapolations determine the estimated size of the noise.
"""

import math
from typing import NamedTuple

PRIOR_FRAMES = 5
"""Weight of the variance stated by the model in the average, as a number of frames."""

MAX_FRAMES = 100
"""Number of frames over which the estimate is averaged."""

MIN_INTERVAL_s = 0.0045
"""Time after which the noise of two frames is independent, s. Boards filter their charges over shorter times."""

MAX_RELATIVE_SQUARE = 6.0
"""Largest squared residual of a frame, relative to the present estimate. Sudden movements are not noise."""

MIN_RELATIVE_VARIANCE = 0.01
"""Smallest variance of the noise, relative to the variance stated by the model."""

MAX_RELATIVE_VARIANCE = 100.0
"""Largest variance of the noise, relative to the variance stated by the model."""

MIN_UNCORRELATED_SHARE = 1e-6
"""Smallest value of 1 - r^2, where r is the correlation of x and y. It keeps the covariance invertible."""


class CovarianceShape(NamedTuple):
    """Covariance matrix of a measurement, scaled to the determinant 1.

    The inverse of the scaled matrix is stored, divided by the number of dimensions. `mean_square` uses this form.

    Attributes:
        inverse_xx: Element xx of the inverse, divided by the number of dimensions.
        inverse_yy: Element yy of the inverse, divided by the number of dimensions.
        inverse_xy: Element xy of the inverse, divided by the number of dimensions.
        dimensions: Number of dimensions: 2 for a position, 1 for the logarithm of a force.
    """

    inverse_xx: float
    inverse_yy: float
    inverse_xy: float
    dimensions: int

    @classmethod
    def of_position(cls, x_std_mm: float, y_std_mm: float, correlation: float) -> tuple["CovarianceShape", float]:
        """Split the covariance of a position into two factors: its shape, and its size.

        The shape is a matrix with the determinant 1, and the size is a number.

        Args:
            x_std_mm: Standard deviation of x, mm.
            y_std_mm: Standard deviation of y, mm.
            correlation: Correlation of x and y, from -1 to 1.

        Returns:
            The shape, and the size in mm^2. The size is the square root of the determinant of the covariance.
        """
        # The determinant of the covariance is (x_std * y_std)^2 * (1 - correlation^2). The lower limit keeps the
        # determinant positive if x and y are fully correlated.
        uncorrelated_share = 1.0 - correlation * correlation
        root_of_uncorrelated_share = math.sqrt(max(uncorrelated_share, MIN_UNCORRELATED_SHARE))
        size_mm2 = x_std_mm * y_std_mm * root_of_uncorrelated_share

        # Elements of the inverse of the shape. They are divided by the number of dimensions, because `mean_square`
        # computes the mean over the dimensions from them.
        dimensions = 2
        inverse_divisor = dimensions * root_of_uncorrelated_share
        inverse_xx = y_std_mm / (x_std_mm * inverse_divisor)
        inverse_yy = x_std_mm / (y_std_mm * inverse_divisor)
        inverse_xy = -correlation / inverse_divisor
        return cls(inverse_xx, inverse_yy, inverse_xy, dimensions), size_mm2

    def mean_square(self, difference: complex) -> float:
        """Compute the squared Mahalanobis distance of a difference x + iy, divided by the number of dimensions."""
        x = difference.real
        y = difference.imag
        return (self.inverse_xx * x + 2.0 * self.inverse_xy * y) * x + self.inverse_yy * y * y


SCALAR_SHAPE = CovarianceShape(inverse_xx=1.0, inverse_yy=0.0, inverse_xy=0.0, dimensions=1)
"""Shape of the variance of a real number, such as the logarithm of a force."""


class NoiseEstimate(NamedTuple):
    """Estimate of the size of the noise, and the latest measured value.

    Attributes:
        relative_variance: Estimated variance of the noise, relative to the variance stated by the model.
        frames: Number of frames over which the variance was averaged, at most `MAX_FRAMES`.
        measured: Latest measured value: a position x + iy, mm, or the logarithm of a force.
        rate: Rate of change between the latest two measured values, mm/s or 1/s.
        dt_s: Time between the latest two measured values, s; 0 if there is only one value.
    """

    relative_variance: float
    frames: int
    measured: complex
    rate: complex
    dt_s: float

    @classmethod
    def start(cls, measured: complex) -> "NoiseEstimate":
        """Return the estimate after the first measured value.

        The estimated variance of the noise is then the variance that the model states.

        Args:
            measured: The measured value: a position x + iy, mm, or the logarithm of a force.
        """
        return cls(relative_variance=1.0, frames=PRIOR_FRAMES, measured=measured, rate=0j, dt_s=0.0)

    def updated(
        self, measured: complex, dt_s: float, shape: CovarianceShape, stated_variance: float
    ) -> "NoiseEstimate":
        """Return the estimate after the next measured value.

        The measured value is compared with the linear extrapolation of the two previous values. The relative square of
        a frame is the squared error of the extrapolation, divided by the mean of this square for noise with the stated
        variance. The estimated relative variance is the mean of the relative squares of the latest frames. The relative
        square of a single frame is limited, because a sudden movement is not noise.

        Args:
            measured: The measured value: a position x + iy, mm, or the logarithm of a force.
            dt_s: Time since the latest measured value, s, at least `MIN_INTERVAL_s`.
            shape: Shape of the covariance of the measured value.
            stated_variance: Variance of the noise as stated by the model, mm^2, or dimensionless for a force.
        """
        change = measured - self.measured
        rate = change / dt_s
        if self.dt_s <= 0.0:  # there is only one previous value, so there is no extrapolation yet
            return self._replace(measured=measured, rate=rate, dt_s=dt_s)

        # The error is x2 - (1 + r) x1 + r x0, where x0, x1 and x2 are the latest three values, and r is the ratio of
        # the two intervals. The noise of the three values is independent. The variance of the error is therefore the
        # variance of one value times 1 + (1 + r)^2 + r^2.
        time_ratio = dt_s / self.dt_s
        extrapolation_variance = stated_variance * (1.0 + time_ratio * time_ratio + (1.0 + time_ratio) ** 2)
        extrapolation_error = change - self.rate * dt_s
        relative_square = shape.mean_square(extrapolation_error) / extrapolation_variance
        limited_square = min(relative_square, MAX_RELATIVE_SQUARE * self.relative_variance)

        # Update the running mean. The number of frames is limited, so that the estimate follows changes of the noise.
        frames = min(self.frames + 1, MAX_FRAMES)
        mean_square = self.relative_variance + (limited_square - self.relative_variance) / frames
        relative_variance = min(max(mean_square, MIN_RELATIVE_VARIANCE), MAX_RELATIVE_VARIANCE)
        return NoiseEstimate(relative_variance, frames, measured, rate, dt_s)
