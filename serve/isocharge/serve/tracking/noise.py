"""The noise of frames: what a model states, its shape, and how much they scatter, learned from themselves.

A model states the deviations of the noise that it was trained with; a board may be quieter or louder. Noise is new in
each frame, while a contact moves smoothly: the scatter is what a straight line through the two frames before misses.
"""

import math
from typing import NamedTuple

FIRST, LAST = 5, 100
"""How many frames the stated variance counts for, and how many are remembered."""

FRESH_S = 0.0045
"""Time after which noise is new, whatever filter a board has: frames in between tell nothing, s."""

SUDDEN = 6.0
"""Largest square that a frame counts with, in variances learned so far: a jerk is no noise."""

LEAST, MOST = 0.01, 100.0
"""Limits of what is learned."""


class Shape(NamedTuple):
    """The shape of a frame's covariance R, which is a variance times a matrix of determinant 1.

    Attributes:
        xx, yy, xy: Of the inverse of that matrix, over the number of dimensions.
        dimensions: 2 for a place, 1 for a force.
    """

    xx: float
    yy: float
    xy: float
    dimensions: int

    @classmethod
    def of_place(cls, x_std: float, y_std: float, correlation: float) -> tuple["Shape", float]:
        """The shape, and det(R)^(1/2), mm^2, from deviations, mm, and their correlation."""
        rest = 1.0 - correlation * correlation
        root = math.sqrt(rest if rest > 1e-6 else 1e-6)
        twice = 2.0 * root
        return cls(y_std / (x_std * twice), x_std / (y_std * twice), -correlation / twice, 2), x_std * y_std * root

    def square(self, value: complex) -> float:
        """The mean square of a distance over the dimensions."""
        x, y = value.real, value.imag
        return (self.xx * x + 2.0 * self.xy * y) * x + self.yy * y * y


LINE = Shape(1.0, 0.0, 0.0, 1)
"""The shape of a force."""


class Scatter(NamedTuple):
    """What is known of the noise.

    Attributes:
        variance: In units of what the model states.
        frames: How many told it.
        measured: The last of these.
        rate: Its change from the one before that, over the time between, mm/s or, of ln N, 1/s.
        dt_s: Time between the two, s; 0 if there are not two.
    """

    variance: float
    frames: int
    measured: complex
    rate: complex
    dt_s: float

    @classmethod
    def start(cls, measured: complex) -> "Scatter":
        """At a first frame: as the model states it."""
        return cls(1.0, FIRST, measured, 0j, 0.0)

    def after(self, measured: complex, dt_s: float, shape: Shape, stated: float) -> "Scatter":
        """With a frame whose noise is new, `dt_s` after the last, of the variance `stated` by the model."""
        variance, frames, before, rate, before_s = self
        change = measured - before
        if before_s > 0.0:
            longer = dt_s / before_s
            alike = stated * (1.0 + longer * longer + (1.0 + longer) ** 2)
            seen = min(shape.square(change - rate * dt_s) / alike, SUDDEN * variance)
            frames += frames < LAST
            variance = min(max(variance + (seen - variance) / frames, LEAST), MOST)
        return Scatter(variance, frames, measured, change / dt_s, dt_s)
