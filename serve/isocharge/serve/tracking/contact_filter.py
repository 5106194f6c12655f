"""Filter that smooths the predicted contacts of successive frames.

One `TwoModeFilter` estimates the position, and another `TwoModeFilter` estimates the logarithm of the force.

Some errors of a model, such as its approximation error and the errors of the gains, are the same in every frame of a
held contact. Smoothing does not reduce these constant errors. The filters therefore use only the variance of the errors
that change from frame to frame. The variance of the constant errors is added to the variance of the smoothed values.
"""

import math

from isocharge.serve.flags import BEYOND, MISFIT, SATURATED
from isocharge.serve.model.contact import Contact
from isocharge.serve.record.record import TrackedContact
from isocharge.serve.tracking.two_mode_filter import FORCE_MOTION, POSITION_MOTION, Estimate, Metric, TwoModeFilter

FLAG_VARIANCE_FACTORS = {SATURATED: 100.0, BEYOND: 100.0, MISFIT: 10.0}
"""Factor by which the variance of a frame is multiplied, for each flag of the frame."""

MAX_OUTLIERS = 1
"""Number of successive outliers that are ignored. One more outlier in succession starts a new contact."""

MAX_SPEED_mm_per_s = 300.0
"""Speed, mm/s, that no contact reaches. A position that only a faster contact could have reached is an outlier."""

MAX_GAP_s = 1.0
"""Time without a frame after which the tracked contact is discarded, s."""

MIN_FORCE_N = 1e-6
"""Smallest force whose logarithm is computed, N."""

MIN_UNCORRELATED_SHARE = 1e-6
"""Smallest value of 1 - r^2, where r is the correlation of x and y. It keeps the covariance invertible."""


class ContactFilter:
    """Filter that smooths the position and the force of one contact over successive frames."""

    def __init__(self, constant_variance_share: float) -> None:
        """Start without a tracked contact.

        Args:
            constant_variance_share: Variance of the errors that are the same in every frame of a held contact, divided
                by the variance that the model states, 0 to 1.
        """
        self._constant_share = constant_variance_share
        self.reset()

    def reset(self) -> None:
        """Discard the tracked contact."""
        # Placeholders, because `step` replaces both filters at the next contact. A position is a complex number x + iy.
        self._position_filter = TwoModeFilter.start(0j, 1.0, POSITION_MOTION)
        self._force_filter = TwoModeFilter.start(0.0, 1.0, FORCE_MOTION)
        self._tracked: TrackedContact | None = None
        self._outlier_count = 0  # number of outliers in succession
        self._latest_time_s = 0.0  # time of the latest frame

    def step(self, contact: Contact, t_s: float, flags: tuple[str, ...]) -> TrackedContact:
        """Process the next frame, and smooth its position and the logarithm of its force with two filters.

        A filter rejects a measured value that is far from its prediction. If the force filter rejects the measured
        force, only the force filter is restarted. If the position filter rejects the position, the position may be an
        outlier, which means that no contact moves fast enough to reach the position. Up to `MAX_OUTLIERS` outliers in
        succession are ignored. After any other rejected position, both filters are restarted. They are also restarted
        if the time since the latest frame is longer than `MAX_GAP_s`, or if the clock was set back. Frames may have the
        same time, for example because they were received together.

        Args:
            contact: Contact predicted by the model.
            t_s: Time of the frame on any clock, s.
            flags: Flags of the frame. Some flags increase the variance of the noise, which gives the frame a smaller
                weight.

        Returns:
            The smoothed contact. If the frame is ignored, it is the smoothed contact of the previous frame. The
            standard deviations include the constant errors.
        """
        # Convert the contact to the quantities of the filters, with their variances as stated by the model.
        position = complex(contact.x_mm, contact.y_mm)
        position_variance, metric = _position_noise(contact)
        force_N = max(MIN_FORCE_N, contact.force_N)
        log_force = math.log(force_N)
        log_force_variance = (contact.force_std_N / force_N) ** 2

        # Variance of the noise that is independent from frame to frame, relative to the stated variance
        noise_ratio = 1.0 - self._constant_share
        for flag in flags:
            noise_ratio *= FLAG_VARIANCE_FACTORS.get(flag, 1.0)

        # Continue the filters. A filter returns None if it rejects its measured value.
        smoothed_position = None
        smoothed_log_force = None
        previous = self._tracked
        dt_s = t_s - self._latest_time_s
        self._latest_time_s = t_s
        if previous is not None and 0.0 <= dt_s <= MAX_GAP_s:
            self._position_filter.predict(dt_s, metric)
            self._force_filter.predict(dt_s)
            smoothed_position = self._position_filter.update(position, noise_ratio * position_variance)
            if smoothed_position is not None:
                smoothed_log_force = self._force_filter.update(log_force, noise_ratio * log_force_variance)
            elif self._outlier_count < MAX_OUTLIERS and _is_too_far(position, previous, dt_s):
                self._outlier_count += 1
                return previous
        self._outlier_count = 0

        # Start each filter that was not continued. Its first smoothed value is the measured value. If the position was
        # rejected, the force filter was not continued either.
        if smoothed_position is None:
            smoothed_position = Estimate(position, noise_ratio * position_variance)
            self._position_filter = TwoModeFilter.start(*smoothed_position, POSITION_MOTION)
        if smoothed_log_force is None:
            smoothed_log_force = Estimate(log_force, noise_ratio * log_force_variance)
            self._force_filter = TwoModeFilter.start(*smoothed_log_force, FORCE_MOTION)

        # Standard deviation of the smoothed position, relative to the standard deviation that the model states
        std_ratio = math.sqrt(smoothed_position.variance / position_variance + self._constant_share)
        log_force_std = math.sqrt(smoothed_log_force.variance + self._constant_share * log_force_variance)
        smoothed_force_N = math.exp(smoothed_log_force.value.real)

        # The velocity of a held contact is zero. The mean velocity over both modes is therefore the velocity of the
        # moving mode multiplied by the probability of the moving mode.
        moving_probability = self._position_filter.moving_probability
        velocity = moving_probability * self._position_filter.velocity
        self._tracked = TrackedContact(
            x_mm=smoothed_position.value.real,
            y_mm=smoothed_position.value.imag,
            force_N=smoothed_force_N,
            x_std_mm=contact.x_std_mm * std_ratio,
            y_std_mm=contact.y_std_mm * std_ratio,
            force_std_N=smoothed_force_N * log_force_std,
            vx_mm_s=velocity.real,
            vy_mm_s=velocity.imag,
            moving=moving_probability,
        )
        return self._tracked


def _position_noise(contact: Contact) -> tuple[float, Metric]:
    """Return the root of the determinant of the covariance of a position, mm^2, and the shape of the covariance.

    Args:
        contact: Contact predicted by the model. A correlation of NaN counts as 0.
    """
    correlation = 0.0 if math.isnan(contact.xy_correlation) else contact.xy_correlation
    root_share = math.sqrt(max(1.0 - correlation * correlation, MIN_UNCORRELATED_SHARE))
    inverse_xx = contact.y_std_mm / (contact.x_std_mm * root_share)
    inverse_yy = contact.x_std_mm / (contact.y_std_mm * root_share)
    skew = complex(0.5 * (inverse_xx - inverse_yy), correlation / root_share)
    return contact.x_std_mm * contact.y_std_mm * root_share, Metric(0.5 * (inverse_xx + inverse_yy), skew)


def _is_too_far(position: complex, previous: TrackedContact, dt_s: float) -> bool:
    """Return whether a contact would have to move at `MAX_SPEED_mm_per_s` or faster to reach a measured position.

    Args:
        position: Measured position x + iy, mm.
        previous: Smoothed contact of the previous frame.
        dt_s: Time since the previous frame, s.
    """
    distance_mm = abs(position - complex(previous.x_mm, previous.y_mm))
    return distance_mm >= MAX_SPEED_mm_per_s * dt_s
