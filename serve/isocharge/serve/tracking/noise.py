"""The noise of frames: what a model states, as a unit, and how much they scatter, learned from themselves.

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


class Unit(NamedTuple):
    """The covariance R of a frame as a unit.

    Attributes:
        xx, yy, xy: Of its inverse, 1/mm^2 or 1.
        variance: det(R)^(1 / dimensions), mm^2 or the square of ln N.
        dimensions: 2 for a place, 1 for a force.
    """

    xx: float
    yy: float
    xy: float
    variance: float
    dimensions: int

    @classmethod
    def of_place(cls, x_std: float, y_std: float, correlation: float) -> "Unit":
        """From deviations, mm, and their correlation."""
        rest, both = max(1.0 - correlation * correlation, 1e-6), x_std * y_std
        inverse = 1.0 / (x_std * x_std * rest), 1.0 / (y_std * y_std * rest), -correlation / (both * rest)
        return cls(*inverse, both * math.sqrt(rest), 2)

    @classmethod
    def of_force(cls, std: float) -> "Unit":
        """From the deviation of the logarithm."""
        return cls(1.0 / (std * std), 0.0, 0.0, std * std, 1)

    def square(self, value: complex) -> float:
        """A squared distance in units of R."""
        x, y = value.real, value.imag
        return (self.xx * x + 2.0 * self.xy * y) * x + self.yy * y * y


class Scatter(NamedTuple):
    """What is known of the noise.

    Attributes:
        variance: In units of what the model states.
        frames: How many told it.
        measured: The last of these.
        rate: Its change from the one before that, 1/s.
        dt_s: Time between the two, s; 0 if there are not two.
        waited_s: Time since the last, s.
    """

    variance: float
    frames: int
    measured: complex
    rate: complex
    dt_s: float
    waited_s: float

    @classmethod
    def start(cls, measured: complex) -> "Scatter":
        """At a first frame: as the model states it."""
        return cls(1.0, FIRST, measured, 0j, 0.0, 0.0)

    def after(self, measured: complex, dt_s: float, unit: Unit, white: float) -> "Scatter":
        """With a frame more, `dt_s` after the one before, of which the model states `white` times R."""
        variance, frames, before, rate, before_s, waited_s = self
        dt_s += waited_s
        if dt_s < FRESH_S:
            return Scatter(variance, frames, before, rate, before_s, dt_s)
        change = measured - before
        if before_s > 0.0:
            longer = dt_s / before_s
            alike = white * unit.dimensions * (1.0 + longer * longer + (1.0 + longer) ** 2)
            seen = min(unit.square(change - rate * dt_s) / alike, SUDDEN * variance)
            frames = min(frames + 1, LAST)
            variance = min(max(variance + (seen - variance) / frames, LEAST), MOST)
        return Scatter(variance, frames, measured, change / dt_s, dt_s, 0.0)
