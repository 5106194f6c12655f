"""Filter that smooths the predicted contacts of successive frames.

One `TwoModeFilter` estimates the position, and another `TwoModeFilter` estimates the logarithm of the force.

Some errors of a model, such as its approximation error and the errors of the gains, are the same in every frame of a
held contact. Smoothing does not reduce these constant errors. The filters therefore use only the variance of the errors
that change from frame to frame. The variance of the constant errors is added to the variance of the smoothed values.
"""

import math
from typing import NamedTuple

from isocharge.serve.flags import BEYOND, MISFIT, SATURATED
from isocharge.serve.prediction.contact import Contact
from isocharge.serve.record.record import TrackedContact
from isocharge.serve.tracking.measurement_noise import SCALAR_SHAPE, CovarianceShape
from isocharge.serve.tracking.motion import FORCE_MOTION, POSITION_MOTION, MAX_GAP_s
from isocharge.serve.tracking.two_mode_filter import Estimate, TwoModeFilter

FLAG_VARIANCE_FACTORS = {SATURATED: 100.0, BEYOND: 100.0, MISFIT: 10.0}
"""Factor by which the variance of a frame is multiplied, for each flag of the frame."""

MAX_OUTLIERS = 1
"""Number of successive outliers that are ignored. One more outlier in succession starts a new contact."""

MAX_SPEED_mm_per_s = 300.0
"""Speed, mm/s, that no contact reaches. A position that only a faster contact could have reached is an outlier."""

MIN_FORCE_N = 1e-6
"""Smallest force whose logarithm is computed, N."""


class MeasuredContact(NamedTuple):
    """A predicted contact, converted to the quantities that the position filter and the force filter process.

    Attributes:
        position: Position x + iy, mm.
        shape: Covariance of the position, scaled to the determinant 1.
        position_variance: Square root of the determinant of the covariance of the position, mm^2.
        log_force: Logarithm of the force in N.
        log_force_std: Standard deviation of the logarithm of the force.
        white_noise_ratio: Variance of the noise that is independent from frame to frame, divided by the variance that
            the model states. The ratio exceeds 1 if a flag of the frame increases the noise.
    """

    position: complex
    shape: CovarianceShape
    position_variance: float
    log_force: float
    log_force_std: float
    white_noise_ratio: float


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
        self._latest_time_s = 0.0  # time of the latest frame that was no outlier

    def step(self, contact: Contact, t_s: float, flags: tuple[str, ...]) -> TrackedContact:
        """Process the next frame, and smooth its position and the logarithm of its force with two filters.

        A filter rejects a measured value that is far from its prediction. If the force filter rejects the measured
        force, only the force filter is restarted. If the position filter rejects the position, the position may be an
        outlier, which means that no contact moves fast enough to reach the position. Up to `MAX_OUTLIERS` outliers in
        succession are ignored. After any other rejected position, both filters are restarted. They are also restarted
        if the time since the latest frame is longer than `MAX_GAP_s`, or if the clock was set back. Frames may have the
        same time, for example because they were received together.

        The filters use only the variance of the noise that changes from frame to frame. Smoothing does not reduce
        errors that are the same in all frames.

        Args:
            contact: Contact predicted by the model.
            t_s: Time of the frame on any clock, s.
            flags: Flags of the frame.

        Returns:
            The smoothed contact. If the frame is ignored, it is the smoothed contact of the previous frame.
        """
        measured = self._measured_contact(contact, flags)
        position_variance = measured.white_noise_ratio * measured.position_variance
        force_variance = measured.white_noise_ratio * measured.log_force_std * measured.log_force_std
        smoothed_position = None
        smoothed_log_force = None

        # Continue the filters. A filter returns None if it rejects its measured value.
        dt_s = t_s - self._latest_time_s  # since the latest frame that was not ignored
        previous = self._tracked
        if previous is not None and 0.0 <= dt_s <= MAX_GAP_s:
            smoothed_position = self._position_filter.step(measured.position, dt_s, measured.shape, position_variance)
            if smoothed_position is not None:
                smoothed_log_force = self._force_filter.step(measured.log_force, dt_s, SCALAR_SHAPE, force_variance)
            elif self._outlier_count < MAX_OUTLIERS and _is_too_far(measured.position, previous, dt_s):
                self._outlier_count += 1
                return previous
        self._outlier_count = 0

        # Start each filter that was not continued. Its first smoothed value is the measured value. If the position was
        # rejected, the force filter was not continued either.
        if smoothed_position is None:
            self._position_filter = TwoModeFilter.start(measured.position, position_variance, POSITION_MOTION)
            smoothed_position = Estimate(measured.position, position_variance)
        if smoothed_log_force is None:
            self._force_filter = TwoModeFilter.start(measured.log_force, force_variance, FORCE_MOTION)
            smoothed_log_force = Estimate(measured.log_force, force_variance)
        self._latest_time_s = t_s
        self._tracked = self._tracked_contact(contact, measured, smoothed_position, smoothed_log_force)
        return self._tracked

    def _measured_contact(self, contact: Contact, flags: tuple[str, ...]) -> MeasuredContact:
        """Convert a predicted contact to the quantities that the position filter and the force filter process.

        Args:
            contact: Contact predicted by the model.
            flags: Flags of the frame. Some flags increase the variance of the noise, which gives the frame a smaller
                weight.
        """
        correlation = contact.xy_correlation
        if math.isnan(correlation):  # the model provides no correlations
            correlation = 0.0
        shape, position_variance = CovarianceShape.of_position(contact.x_std_mm, contact.y_std_mm, correlation)
        force_N = max(MIN_FORCE_N, contact.force_N)

        # Variance of the noise that is independent from frame to frame, relative to the stated variance. Flags without
        # an entry in the table do not change it.
        white_noise_ratio = 1.0 - self._constant_share
        for flag in flags:
            white_noise_ratio *= FLAG_VARIANCE_FACTORS.get(flag, 1.0)
        return MeasuredContact(
            position=complex(contact.x_mm, contact.y_mm),
            shape=shape,
            position_variance=position_variance,
            log_force=math.log(force_N),
            log_force_std=contact.force_std_N / force_N,
            white_noise_ratio=white_noise_ratio,
        )

    def _tracked_contact(
        self, contact: Contact, measured: MeasuredContact, smoothed_position: Estimate, smoothed_log_force: Estimate
    ) -> TrackedContact:
        """Return the smoothed contact with standard deviations that include the constant errors of the model.

        The filters smooth only the errors that change from frame to frame. The variance of the constant errors is a
        fixed fraction of the variance that the model states, and is added to the variance of the smoothed values.

        Args:
            contact: Contact predicted by the model.
            measured: The same contact in the form in which the filters process it.
            smoothed_position: Smoothed position x + iy, mm.
            smoothed_log_force: Smoothed logarithm of the force.
        """
        constant_share = self._constant_share
        # Standard deviation of the smoothed position, relative to the standard deviation that the model states.
        std_ratio = math.sqrt(smoothed_position.variance / measured.position_variance + constant_share)
        constant_log_force_variance = measured.log_force_std * measured.log_force_std * constant_share
        log_force_std = math.sqrt(smoothed_log_force.variance + constant_log_force_variance)
        force_N = math.exp(smoothed_log_force.value.real)

        # The velocity of a held contact is zero. The mean velocity over both modes is therefore the velocity of the
        # moving mode multiplied by the probability of the moving mode.
        moving_probability = self._position_filter.moving_probability
        velocity = moving_probability * self._position_filter.velocity
        return TrackedContact(
            x_mm=smoothed_position.value.real,
            y_mm=smoothed_position.value.imag,
            force_N=force_N,
            x_std_mm=contact.x_std_mm * std_ratio,
            y_std_mm=contact.y_std_mm * std_ratio,
            force_std_N=force_N * log_force_std,
            vx_mm_s=velocity.real,
            vy_mm_s=velocity.imag,
            moving=moving_probability,
        )


def _is_too_far(position: complex, previous: TrackedContact, dt_s: float) -> bool:
    """Return whether a contact would have to move at `MAX_SPEED_mm_per_s` or faster to reach a measured position.

    Args:
        position: Measured position x + iy, mm.
        previous: Smoothed contact of the latest frame that was no outlier.
        dt_s: Time since that frame, s.
    """
    distance_mm = abs(position - complex(previous.x_mm, previous.y_mm))
    return distance_mm >= MAX_SPEED_mm_per_s * dt_s
