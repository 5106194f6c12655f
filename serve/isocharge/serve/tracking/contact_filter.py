"""Filter that smooths the contacts predicted by a model from frame to frame.

One `TwoModeFilter` estimates the position, and another `TwoModeFilter` estimates the logarithm of the force.

Some errors of a model are the same in every frame of a held contact, such as its approximation error and the errors of
the gains. Smoothing does not reduce these constant errors. The filters therefore use only the variance of the other
errors, and the variance of the constant errors is added to the results.
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
"""Number of successive outliers that are ignored. The next frame that is far away starts a new contact."""

MAX_SPEED_mm_per_s = 300.0
"""Largest speed of a contact, mm/s. A frame that is farther away from the previous frame is an outlier."""

MIN_FORCE_N = 1e-6
"""Smallest force whose logarithm is computed, N."""


class MeasuredContact(NamedTuple):
    """A contact that a model has predicted, converted to the quantities that the filters process.

    Attributes:
        position: Position x + iy, mm.
        shape: Shape of the covariance of the position.
        position_variance: Square root of the determinant of the covariance of the position, mm^2.
        log_force: Logarithm of the force in N.
        log_force_std: Standard deviation of the logarithm of the force.
        white_share: Variance of the noise that is independent from frame to frame, relative to the stated variances.
    """

    position: complex
    shape: CovarianceShape
    position_variance: float
    log_force: float
    log_force_std: float
    white_share: float


class ContactFilter:
    """Smooths the position and the force of one contact."""

    def __init__(self, constant_variance_share: float) -> None:
        """Begin without a contact.

        Args:
            constant_variance_share: Share of the variance stated by the model that belongs to errors that are the same
                in every frame of a held contact, 0 to 1.
        """
        self._constant_share = constant_variance_share
        self.reset()

    def reset(self) -> None:
        """Discard the contact."""
        # The filters start again with the first contact, so that their values here are never used. A position is a
        # complex number x + iy.
        self._position_filter = TwoModeFilter.start(0j, 1.0, POSITION_MOTION)
        self._force_filter = TwoModeFilter.start(0.0, 1.0, FORCE_MOTION)
        self._tracked: TrackedContact | None = None
        self._outliers = 0  # number of outliers in succession
        self._t_s = 0.0  # time of the latest frame that was no outlier

    def step(self, contact: Contact, t_s: float, flags: tuple[str, ...]) -> TrackedContact:
        """Smooth the position and the logarithm of the force of the next frame, each with its own filter.

        Both filters start again after a gap in time, or if the filter of the position rejects the position. If only the
        force is rejected, only the filter of the force starts again. A rejected position is an outlier if the contact
        would have to move faster than `MAX_SPEED_mm_per_s`. Up to `MAX_OUTLIERS` outliers in succession are ignored.

        The filters use only the share of the variances that is independent from frame to frame, because smoothing does
        not reduce errors that are the same in all frames.

        Args:
            contact: Contact predicted by the model.
            t_s: Time of the frame on any clock, s.
            flags: Flags of the frame.

        Returns:
            The smoothed contact. If the frame is ignored, it is the smoothed contact of the previous frame.
        """
        measured = self._measured(contact, flags)
        position_variance = measured.white_share * measured.position_variance
        force_variance = measured.white_share * measured.log_force_std * measured.log_force_std
        position = None
        log_force = None

        # Continue the filters. A filter rejects a measured value far from its prediction, and then returns None.
        dt_s = t_s - self._t_s  # since the latest frame that was not ignored
        previous = self._tracked
        if previous is not None and 0.0 < dt_s <= MAX_GAP_s:
            position = self._position_filter.step(measured.position, dt_s, measured.shape, position_variance)
            if position is not None:
                log_force = self._force_filter.step(measured.log_force, dt_s, SCALAR_SHAPE, force_variance)
            elif self._outliers < MAX_OUTLIERS and _is_too_far(measured.position, previous, dt_s):
                self._outliers += 1
                return previous
        self._outliers = 0

        # Start each filter that was not continued.
        if position is None:
            self._position_filter = TwoModeFilter.start(measured.position, position_variance, POSITION_MOTION)
            position = Estimate(measured.position, position_variance)
        if log_force is None:
            self._force_filter = TwoModeFilter.start(measured.log_force, force_variance, FORCE_MOTION)
            log_force = Estimate(measured.log_force, force_variance)
        self._t_s = t_s
        self._tracked = self._tracked_contact(contact, measured, position, log_force)
        return self._tracked

    def _measured(self, contact: Contact, flags: tuple[str, ...]) -> MeasuredContact:
        """Return the contact, converted to the quantities that the filters process.

        Args:
            contact: Contact predicted by the model.
            flags: Flags of the frame. Some flags increase the variance of the noise, so that the frame has a smaller
                weight.
        """
        correlation = contact.xy_correlation
        if math.isnan(correlation):  # the model provides no correlations
            correlation = 0.0
        shape, position_variance = CovarianceShape.of_position(contact.x_std_mm, contact.y_std_mm, correlation)
        force_N = max(MIN_FORCE_N, contact.force_N)

        # Share of the variances that belongs to noise that is independent from frame to frame.
        white_share = 1.0 - self._constant_share
        for flag in flags:
            white_share *= FLAG_VARIANCE_FACTORS.get(flag, 1.0)
        return MeasuredContact(
            position=complex(contact.x_mm, contact.y_mm),
            shape=shape,
            position_variance=position_variance,
            log_force=math.log(force_N),
            log_force_std=contact.force_std_N / force_N,
            white_share=white_share,
        )

    def _tracked_contact(
        self, contact: Contact, measured: MeasuredContact, position: Estimate, log_force: Estimate
    ) -> TrackedContact:
        """Return the smoothed contact, whose standard deviations include the constant errors of the model.

        The filters smooth only errors that change from frame to frame. The variance of the constant errors is a fixed
        share of the variance that the model states. It is added to the variance of the smoothed values.

        Args:
            contact: Contact predicted by the model.
            measured: The same contact in the form in which the filters process it.
            position: Smoothed position x + iy, mm.
            log_force: Smoothed logarithm of the force.
        """
        constant_share = self._constant_share
        # Standard deviation of the result, relative to the standard deviation that the model states.
        std_ratio = math.sqrt(position.variance / measured.position_variance + constant_share)
        constant_log_force_variance = measured.log_force_std * measured.log_force_std * constant_share
        log_force_std = math.sqrt(log_force.variance + constant_log_force_variance)
        force_N = math.exp(log_force.value.real)

        # A held contact has no velocity. The mean velocity is that of the moving mode times its probability.
        moving_probability = self._position_filter.moving_probability
        velocity = moving_probability * self._position_filter.velocity
        return TrackedContact(
            x_mm=position.value.real,
            y_mm=position.value.imag,
            force_N=force_N,
            x_std_mm=contact.x_std_mm * std_ratio,
            y_std_mm=contact.y_std_mm * std_ratio,
            force_std_N=force_N * log_force_std,
            vx_mm_s=velocity.real,
            vy_mm_s=velocity.imag,
            moving=moving_probability,
        )


def _is_too_far(position: complex, previous: TrackedContact, dt_s: float) -> bool:
    """Return whether a contact would have to move faster than `MAX_SPEED_mm_per_s` to reach a position.

    Args:
        position: Measured position x + iy, mm.
        previous: Smoothed contact of the previous frame.
        dt_s: Time since the previous frame, s.
    """
    distance_mm = abs(position - complex(previous.x_mm, previous.y_mm))
    return distance_mm >= MAX_SPEED_mm_per_s * dt_s
