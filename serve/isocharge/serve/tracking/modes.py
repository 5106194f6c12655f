"""One filter of two modes, held and moving, for a place or for the logarithm of a force.

Interacting multiple models (Blom and Bar-Shalom 1988): each mode has a Kalman filter of its own, their estimates are
mixed as the contact may change from one to the other, and each frame's innovations say which it is. The held mode
knows no velocity; the moving one has a constant velocity with white acceleration, and takes an unknown one when a
movement begins.

A place is a complex number x + iy, a logarithm of a force a complex number without imaginary part. Variances are
multiples of the covariance R of a frame: noise of the process is given its shape, so that one number stands for a
matrix and a step takes microseconds.
"""

import math
from typing import NamedTuple

from isocharge.serve.tracking.noise import Scatter, Unit


class Movement(NamedTuple):
    """How places or forces move; squares of mm or of ln N.

    Attributes:
        creep: Growth of the variance while held, 1/s.
        speed: Variance of the velocity with which a movement begins, 1/s^2.
        change: Spectral density of the acceleration of what moves so fast, 1/s^3. It grows with the square of the
            speed, as turns take a way: slow contacts are followed more calmly than fast ones.
    """

    creep: float
    speed: float
    change: float


HELD_S, MOVING_S = 1.0, 0.5
"""Mean times that a contact is held, and that it moves, s."""

CALMEST = 0.2
"""Least share of `change`, of a contact that hardly moves."""

FARTHEST = 30.0
"""Squared innovation, in deviations, beyond which a frame is none of this contact."""


class Modes(NamedTuple):
    """The state of the filter; variances in units of R.

    Attributes:
        moving: Probability of the moving mode.
        held: Estimate of the held mode.
        held_variance: Its variance.
        place, velocity: Estimates of the moving mode.
        variance, covariance, velocity_variance: Their variances.
        unit: R's `variance` at the frame before.
        scatter: Of the frames up to now.
    """

    moving: float
    held: complex
    held_variance: float
    place: complex
    velocity: complex
    variance: float
    covariance: float
    velocity_variance: float
    unit: float
    scatter: Scatter

    @classmethod
    def start(cls, measured: complex, unit: Unit, white: float, movement: Movement) -> "Modes":
        """At a first frame."""
        fast = movement.speed / unit.variance
        return cls(0.5, measured, white, measured, 0j, white, 0.0, fast, unit.variance, Scatter.start(measured))


Step = tuple[Modes, complex, float]
"""The state after a frame, the estimate, and its variance in units of R."""


def step(modes: Modes, measured: complex, dt_s: float, unit: Unit, white: float, movement: Movement) -> Step | None:
    """Take the next frame in.

    Args:
        modes: After the frame before.
        measured: What the frame says.
        dt_s: Since the frame before, s, positive.
        unit: R of the frame.
        white: Part of R that is independent from frame to frame, as stated; larger than 1 for a frame that counts for
            less.
        movement: How the contact moves.

    Returns:
        The state, the estimate and its variance; None if the frame is none of this contact.
    """
    xx, yy, xy, scale, dimensions = unit
    square = unit.square
    moving, held, held_variance, place, velocity, a, b, c, before, scatter = modes
    white, stated = white * scatter.variance, white
    rescale = before / scale
    begins, ends = (1.0 - moving) * min(dt_s / HELD_S, 0.5), moving * min(dt_s / MOVING_S, 0.5)
    moving += begins - ends
    share, back = begins / moving, ends / (1.0 - moving)
    gap = place - held
    apart = square(gap) / dimensions
    x, y, vx, vy = gap.real, gap.imag, velocity.real, velocity.imag
    across = ((xx * x + xy * y) * vx + (yy * y + xy * x) * vy) / dimensions
    fast = square(velocity) / dimensions
    stay = share * (1.0 - share)
    held_variance, a, b, c = held_variance * rescale, a * rescale, b * rescale, c * rescale
    first = held_variance + back * (a - held_variance) + back * (1.0 - back) * apart + movement.creep * dt_s / scale
    held += back * gap
    a += share * (held_variance - a) + stay * apart
    b += stay * across - share * b
    c += share * (movement.speed / scale - c) + stay * fast
    place -= share * gap
    velocity *= 1.0 - share
    speed_square = velocity.real * velocity.real + velocity.imag * velocity.imag
    change = movement.change * max(speed_square / movement.speed, CALMEST) * dt_s / scale
    place += velocity * dt_s
    a += dt_s * (2.0 * b + dt_s * (c + change / 3.0))
    b += dt_s * (c + 0.5 * change)
    c += change
    by_held, by_moving = measured - held, measured - place
    in_held, in_moving = 1.0 / (first + white), 1.0 / (a + white)
    from_held, from_moving = square(by_held) * in_held, square(by_moving) * in_moving
    if from_held > FARTHEST and from_moving > FARTHEST:
        return None
    weight = in_moving / in_held if dimensions == 2 else math.sqrt(in_moving / in_held)
    odds = moving / (1.0 - moving) * weight * math.exp(min(max(0.5 * (from_held - from_moving), -60.0), 60.0))
    moving = min(max(odds / (1.0 + odds), 1e-6), 1.0 - 1e-6)
    gain = first * in_held
    held += gain * by_held
    first = gain * white
    gain, turn = a * in_moving, b * in_moving
    place += gain * by_moving
    velocity += turn * by_moving
    a, b, c = gain * white, turn * white, c - turn * b
    gap = place - held
    apart = square(gap) / dimensions
    spread = first + moving * (a - first) + moving * (1.0 - moving) * apart
    scatter = scatter.after(measured, dt_s, unit, stated)
    return Modes(moving, held, first, place, velocity, a, b, c, scale, scatter), held + moving * gap, spread
