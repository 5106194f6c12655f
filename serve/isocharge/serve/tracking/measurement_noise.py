"""Noise of the measured contacts, which is described by the shape of its covariance and by its estimated size.

The standard deviations that a model reports apply to the noise with which the model was trained. The noise of a board
may be smaller or larger. Noise changes from frame to frame, but a contact moves smoothly. The size of the noise is
therefore estimated from the residuals of a linear extrapolation through the two previous frames.
"""

import math
from typing import NamedTuple

PRIOR_FRAMES = 5
"""Weight of the variance stated by the model, as a number of frames."""

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
    """Covariance of a measurement divided by the square root of its determinant, so that the determinant is 1.

    Attributes:
        inverse_xx: Element xx of the inverse of this matrix, divided by the number of dimensions.
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
        """Split the covariance of a position into its shape and its size: covariance = size * shape.

        Args:
            x_std_mm: Standard deviation of x, mm.
            y_std_mm: Standard deviation of y, mm.
            correlation: Correlation of x and y, from -1 to 1.

        Returns:
            The shape, and the square root of the determinant of the covariance, mm^2.
        """
        # The determinant is (x_std * y_std)^2 * (1 - correlation^2). The size is its square root, so that the shape has
        # the determinant 1. The inverse of the shape is stored, divided by the number of dimensions.
        uncorrelated_share = 1.0 - correlation * correlation
        root = math.sqrt(max(uncorrelated_share, MIN_UNCORRELATED_SHARE))
        size_mm2 = x_std_mm * y_std_mm * root
        dimensions = 2
        scale = dimensions * root
        inverse_xx = y_std_mm / (x_std_mm * scale)
        inverse_yy = x_std_mm / (y_std_mm * scale)
        inverse_xy = -correlation / scale
        return cls(inverse_xx, inverse_yy, inverse_xy, dimensions), size_mm2

    def mean_square(self, difference: complex) -> float:
        """Compute the squared Mahalanobis distance of a difference x + iy, divided by the number of dimensions."""
        x = difference.real
        y = difference.imag
        return (self.inverse_xx * x + 2.0 * self.inverse_xy * y) * x + self.inverse_yy * y * y


SCALAR_SHAPE = CovarianceShape(inverse_xx=1.0, inverse_yy=0.0, inverse_xy=0.0, dimensions=1)
"""Shape of the variance of a real number, such as the logarithm of a force."""


class NoiseEstimate(NamedTuple):
    """Size of the noise, as estimated from the frames.

    Attributes:
        relative_variance: Variance of the noise, relative to the variance stated by the model.
        frames: Number of frames in the average, at most `MAX_FRAMES`.
        measured: Latest measured value: a position x + iy, mm, or the logarithm of a force.
        rate: Rate of change between the latest two measured values, mm/s or 1/s.
        dt_s: Time between the latest two measured values, s; 0 if there is only one.
    """

    relative_variance: float
    frames: int
    measured: complex
    rate: complex
    dt_s: float

    @classmethod
    def start(cls, measured: complex) -> "NoiseEstimate":
        """Return the estimate after the first measured value. The estimate is the variance stated by the model."""
        return cls(relative_variance=1.0, frames=PRIOR_FRAMES, measured=measured, rate=0j, dt_s=0.0)

    def updated(
        self, measured: complex, dt_s: float, shape: CovarianceShape, stated_variance: float
    ) -> "NoiseEstimate":
        """Return the estimate after another measured value.

        The value is compared with the linear extrapolation of the two previous values. The estimate is the mean of the
        squared errors of these extrapolations over the latest frames, relative to the error that the variance stated by
        the model would cause. The squared error of one frame is limited, because a sudden movement is not noise.

        Args:
            measured: The measured value: a position x + iy, mm, or the logarithm of a force.
            dt_s: Time since the latest measured value, s, at least `MIN_INTERVAL_s`.
            shape: Shape of the covariance of the measured value.
            stated_variance: Variance of the noise as stated by the model, mm^2, or dimensionless for a force.
        """
        change = measured - self.measured
        rate = change / dt_s
        if self.dt_s <= 0.0:  # there is only one previous value, so that no value can be extrapolated
            return self._replace(measured=measured, rate=rate, dt_s=dt_s)

        # The error is x2 - (1 + r) x1 + r x0, where r is the ratio of the two intervals. The noise of the three values
        # is independent, so that the error has the variance (1 + (1 + r)^2 + r^2) times the variance of one value.
        time_ratio = dt_s / self.dt_s
        extrapolation_variance = stated_variance * (1.0 + time_ratio * time_ratio + (1.0 + time_ratio) ** 2)
        extrapolation_error = change - self.rate * dt_s
        relative_square = shape.mean_square(extrapolation_error) / extrapolation_variance
        limited_square = min(relative_square, MAX_RELATIVE_SQUARE * self.relative_variance)

        # Running mean, in which the number of frames is limited so that the estimate follows changes of the noise.
        frames = min(self.frames + 1, MAX_FRAMES)
        mean_square = self.relative_variance + (limited_square - self.relative_variance) / frames
        relative_variance = min(max(mean_square, MIN_RELATIVE_VARIANCE), MAX_RELATIVE_VARIANCE)
        return NoiseEstimate(relative_variance, frames, measured, rate, dt_s)
