"""One filter of two modes, held and moving, for a place or for the logarithm of a force.

Interacting multiple models (Blom and Bar-Shalom 1988): each mode has a Kalman filter of its own, their estimates are
mixed as the contact may change from one to the other, and each frame's innovations say which it is. The held mode
knows no velocity; the moving one has a constant velocity with white acceleration, and takes an unknown one when a
movement begins.

A place is a complex number x + iy, a logarithm of a force a real one. Covariances have the shape of a frame's: noise of
the process is given that shape, so that one number stands for a matrix and a step takes microseconds.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from isocharge.serve.tracking.noise import FRESH_S, Scatter, Shape


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

LARGEST_LEAD = 60.0
"""Largest logarithm of what a frame says for one mode over the other: by then the probability is at its limit."""

LEAST, MOST = 1e-6, 1.0 - 1e-6
"""Limits of the probability of a mode."""

Estimate = tuple[complex, float]
"""A place or a logarithm, and its variance."""


@dataclass(slots=True)
class Modes:
    """The filter and its state; variances in mm^2, or squares of ln N.

    Attributes:
        movement: How the contact moves.
        moving: Probability of the moving mode.
        held: Estimate of the held mode.
        held_variance: Its variance.
        place, velocity: Estimates of the moving mode.
        variance, covariance, velocity_variance: Their variances.
        scatter: Of the frames up to now.
        waited_s: Time since the last frame that told it, s.
    """

    movement: Movement
    moving: float
    held: complex
    held_variance: float
    place: complex
    velocity: complex
    variance: float
    covariance: float
    velocity_variance: float
    scatter: Scatter
    waited_s: float = 0.0

    @classmethod
    def start(cls, measured: complex, white: float, movement: Movement) -> "Modes":
        """At a first frame."""
        scatter = Scatter.start(measured)
        return cls(movement, 0.5, measured, white, measured, measured - measured, white, 0.0, movement.speed, scatter)

    def step(self, measured: complex, dt_s: float, shape: Shape, white: float) -> Estimate | None:
        """Take the next frame in.

        Calls of `min`, `max` and `Shape.square` would take a third of its time.

        Args:
            measured: What the frame says.
            dt_s: Since the frame before, s, positive.
            shape: Of its covariance.
            white: Variance of what is independent from frame to frame, as stated; larger for a frame that counts for
                less.

        Returns:
            The estimate and its variance; None, and nothing changes, if the frame is none of this contact.
        """
        xx, yy, xy, dimensions = shape
        creep, speed, density = self.movement
        moving, held, first, place, velocity = self.moving, self.held, self.held_variance, self.place, self.velocity
        a, b, c, scatter = self.variance, self.covariance, self.velocity_variance, self.scatter
        noise = white * scatter.variance
        begins = (1.0 - moving) * (dt_s / HELD_S if dt_s < 0.5 * HELD_S else 0.5)
        ends = moving * (dt_s / MOVING_S if dt_s < 0.5 * MOVING_S else 0.5)
        moving += begins - ends
        share, back = begins / moving, ends / (1.0 - moving)
        gap = place - held
        x, y, vx, vy = gap.real, gap.imag, velocity.real, velocity.imag
        dual_x, dual_y = xx * x + xy * y, xy * x + yy * y
        apart, across = dual_x * x + dual_y * y, dual_x * vx + dual_y * vy
        fast = (xx * vx + 2.0 * xy * vy) * vx + yy * vy * vy
        stay = 1.0 - share
        held += back * gap
        first, a = (
            first + back * (a - first + (1.0 - back) * apart) + creep * dt_s,
            a + share * (first - a + stay * apart),
        )
        b += share * (stay * across - b)
        c += share * (speed - c + stay * fast)
        velocity *= stay
        calm = stay * stay * (vx * vx + vy * vy) / speed
        change = density * (calm if calm > CALMEST else CALMEST) * dt_s
        place += velocity * dt_s - share * gap
        a += dt_s * (2.0 * b + dt_s * (c + change / 3.0))
        b += dt_s * (c + 0.5 * change)
        c += change
        by_held, by_moving = measured - held, measured - place
        in_held, in_moving = 1.0 / (first + noise), 1.0 / (a + noise)
        x, y, dx, dy = by_held.real, by_held.imag, by_moving.real, by_moving.imag
        from_held = dimensions * in_held * ((xx * x + 2.0 * xy * y) * x + yy * y * y)
        from_moving = dimensions * in_moving * ((xx * dx + 2.0 * xy * dy) * dx + yy * dy * dy)
        if from_held > FARTHEST and from_moving > FARTHEST:
            return None
        weight = in_moving / in_held if dimensions == 2 else math.sqrt(in_moving / in_held)
        lead = 0.5 * (from_held - from_moving)
        odds = moving / (1.0 - moving) * weight * math.exp(lead if lead < LARGEST_LEAD else LARGEST_LEAD)
        moving = odds / (1.0 + odds)
        moving = LEAST if moving < LEAST else MOST if moving > MOST else moving
        gain = first * in_held
        held += gain * by_held
        first = gain * noise
        gain, turn = a * in_moving, b * in_moving
        place += gain * by_moving
        velocity += turn * by_moving
        a, b, c = gain * noise, turn * noise, c - turn * b
        gap = place - held
        x, y = gap.real, gap.imag
        apart = (xx * x + 2.0 * xy * y) * x + yy * y * y
        spread = first + moving * (a - first + (1.0 - moving) * apart)
        self.moving, self.held, self.held_variance, self.place, self.velocity = moving, held, first, place, velocity
        self.variance, self.covariance, self.velocity_variance = a, b, c
        self.waited_s += dt_s
        if self.waited_s >= FRESH_S:
            self.scatter, self.waited_s = scatter.after(measured, self.waited_s, shape, white), 0.0
        return held + moving * gap, spread
