"""One filter of two modes, held and moving, for a place or for the logarithm of a force.

Interacting multiple models (Blom and Bar-Shalom 1988): each mode has a Kalman filter of its own, their estimates are
mixed as the contact may change from one to the other, and each frame's innovations say which it is. The held mode
knows no velocity; the moving one has a constant velocity with white acceleration, and takes an unknown one when a
movement begins.

A place is a complex number x + iy, a logarithm of a force a complex number without imaginary part. Variances are
multiples of the covariance R of a frame: noise of the process is given its shape, so that one number stands for a
matrix and a step takes microseconds. With R's inverse as the form alpha |z|^2 + Re(beta z^2), a whitened square costs
one product.
"""

import math
from typing import NamedTuple


class Unit(NamedTuple):
    """The covariance R of a frame as a unit.

    Attributes:
        alpha, beta: Of the form of its inverse, as above, real and complex.
        variance: det(R)^(1 / dimensions), mm^2 or the square of ln N.
        dimensions: 2 for a place, 1 for a force.
    """

    alpha: float
    beta: complex
    variance: float
    dimensions: int

    @classmethod
    def of_place(cls, x_std: float, y_std: float, correlation: float) -> "Unit":
        """From deviations, mm, and their correlation."""
        rest = max(1.0 - correlation * correlation, 1e-6)
        xx, yy, xy = 1.0 / (x_std * x_std * rest), 1.0 / (y_std * y_std * rest), -correlation / (x_std * y_std * rest)
        return cls(0.5 * (xx + yy), complex(0.5 * (xx - yy), -xy), x_std * y_std * math.sqrt(rest), 2)

    @classmethod
    def of_force(cls, std: float) -> "Unit":
        """From the deviation of the logarithm."""
        return cls(1.0 / (std * std), 0j, std * std, 1)


class Movement(NamedTuple):
    """How places or forces move; squares of mm or of ln N.

    Attributes:
        creep: Growth of the variance while held, 1/s.
        speed: Variance of the velocity with which a movement begins, 1/s^2.
        change: Spectral density of the acceleration, 1/s^3.
    """

    creep: float
    speed: float
    change: float


HELD_S, MOVING_S = 1.0, 0.5
"""Mean times that a contact is held, and that it moves, s."""

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

    @classmethod
    def start(cls, measured: complex, unit: Unit, white: float, movement: Movement) -> "Modes":
        """At a first frame."""
        return cls(0.5, measured, white, measured, 0j, white, 0.0, movement.speed / unit.variance, unit.variance)


Step = tuple[Modes, complex, float]
"""The state after a frame, the estimate, and its variance in units of R."""


def step(modes: Modes, measured: complex, dt_s: float, unit: Unit, white: float, movement: Movement) -> Step | None:
    """Take the next frame in.

    Args:
        modes: After the frame before.
        measured: What the frame says.
        dt_s: Since the frame before, s, positive.
        unit: R of the frame.
        white: Part of R that is independent from frame to frame; larger than 1 for a frame that counts for less.
        movement: How the contact moves.

    Returns:
        The state, the estimate and its variance; None if the frame is none of this contact.
    """
    alpha, beta, scale, dimensions = unit
    moving, held, held_variance, place, velocity, a, b, c, before = modes
    rescale = before / scale
    begins, ends = (1.0 - moving) * min(dt_s / HELD_S, 0.5), moving * min(dt_s / MOVING_S, 0.5)
    moving += begins - ends
    share, back = begins / moving, ends / (1.0 - moving)
    gap = place - held
    apart = _square(gap, alpha, beta) / dimensions
    across = (alpha * (gap * velocity.conjugate()).real + (beta * gap * velocity).real) / dimensions
    fast = _square(velocity, alpha, beta) / dimensions
    stay = share * (1.0 - share)
    held_variance, a, b, c = held_variance * rescale, a * rescale, b * rescale, c * rescale
    first = held_variance + back * (a - held_variance) + back * (1.0 - back) * apart + movement.creep * dt_s / scale
    held += back * gap
    a += share * (held_variance - a) + stay * apart
    b += stay * across - share * b
    c += share * (movement.speed / scale - c) + stay * fast
    place -= share * gap
    velocity *= 1.0 - share
    change = movement.change * dt_s / scale
    place += velocity * dt_s
    a += dt_s * (2.0 * b + dt_s * (c + change / 3.0))
    b += dt_s * (c + 0.5 * change)
    c += change
    by_held, by_moving = measured - held, measured - place
    in_held, in_moving = 1.0 / (first + white), 1.0 / (a + white)
    from_held, from_moving = _square(by_held, alpha, beta) * in_held, _square(by_moving, alpha, beta) * in_moving
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
    apart = _square(gap, alpha, beta) / dimensions
    spread = first + moving * (a - first) + moving * (1.0 - moving) * apart
    return Modes(moving, held, first, place, velocity, a, b, c, scale), held + moving * gap, spread


def _square(value: complex, alpha: float, beta: complex) -> float:
    """A squared distance in units of R."""
    real, imaginary = value.real, value.imag
    along, cross = beta.real * (real * real - imaginary * imaginary), 2.0 * beta.imag * real * imaginary
    return alpha * (real * real + imaginary * imaginary) + along - cross
