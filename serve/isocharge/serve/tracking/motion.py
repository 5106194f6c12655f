"""Parameters of the process noise that the tracking filters assume for the motion of a contact."""

from typing import NamedTuple

SPEED_STD = 30.0
"""Standard deviation of the velocity along x or y at the beginning of a movement, mm/s."""

FORCE_RATE_STD = 10.0
"""Standard deviation of the rate of ln F at the beginning of a change of the force, 1/s."""

MIN_ACCELERATION_SHARE = 0.2
"""Acceleration density of a slow contact, relative to `MotionModel.acceleration_density`, dimensionless."""

MAX_GAP_s = 1.0
"""Time without a frame after which the tracked contact is discarded, s."""


class MotionModel(NamedTuple):
    """Parameters of the process noise of one quantity: a position in mm, or the logarithm of a force.

    Attributes:
        held_drift: Increase of the variance per second while the contact is held, mm^2/s or 1/s.
        velocity_variance: Variance of the velocity at the beginning of a movement, mm^2/s^2 or 1/s^2.
        acceleration_density: Spectral density of the white acceleration of a contact whose squared speed is
            `velocity_variance`, mm^2/s^3 or 1/s^3. At other speeds the density is proportional to the squared speed,
            because fast contacts change their velocity more than slow contacts. The density is at least
            `MIN_ACCELERATION_SHARE` of this value.
    """

    held_drift: float
    velocity_variance: float
    acceleration_density: float


POSITION_MOTION = MotionModel(held_drift=5e-4, velocity_variance=SPEED_STD**2, acceleration_density=800.0)
"""Motion of a finger: a held finger drifts by 0.02 mm in a second, and a moving finger moves at about 30 mm/s."""

FORCE_MOTION = MotionModel(held_drift=5e-4, velocity_variance=FORCE_RATE_STD**2, acceleration_density=1e3)
"""Change of ln F: a held force drifts by 2 % in a second, and a changing force grows by a factor of e in 0.1 s."""
