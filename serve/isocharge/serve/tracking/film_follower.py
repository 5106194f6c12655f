"""Correction of contacts for changes of the film. The changes are estimated from ordinary touches.

The state of the film is a vector of these unknowns:

- the change t of the mean pretension, MPa, and the changes z along the uncertain directions of the film
  (`isocharge.serve.model.charge_series`),
- the logarithm of the change of the gain of each electrode,
- a common offset, pC, which is the charge that is added to all electrodes during a touch, for example by a warm finger.

The charges of four electrodes have one degree of freedom more than a contact (x, y, force). If the pretension of a film
changes, for example because the room becomes warmer by 1 K, no contact explains the charges of touches exactly. Each
touch therefore updates the estimate of the state. An iterated extended Kalman filter finds the most probable state
together with the contact of the touch. The prior distribution of the state is Gaussian: the estimate from the earlier
touches. The contact has no prior distribution, because nothing is known about it before the touch.

The pretension, the gains and the offset may change between touches. Before each touch, the variances of these unknowns
therefore increase a little, at most to their values before the first touch. If a touch disagrees with the estimate, the
pretension may have changed suddenly. The variance of the pretension then returns to its value before the first touch.
The uncertain directions consist of properties that a film keeps. The variances of the changes along these directions
therefore only decrease.

The network was trained for the calibrated film. The charges of a frame are therefore converted into charges that the
same contact would cause on the calibrated film. The network computes the contact from the converted charges. The
conversion depends on the contact. The charges are therefore converted twice, the second time for the contact that the
network computes after the first conversion.

The estimate is considered wrong if no state explains the latest touches, or if the estimated pretension or the
estimated offset is at an end of its range. In this case, the film is called lost. Until a new estimate explains the
latest touches, contacts are corrected with the last estimate that explained the touches at its time.

Each touch contributes one set of charges. To reduce the noise of a single reading, this set is the average over the
frames whose contact is close to the contact with the largest force. A touch is not used if its frames have flags that
make the charges unreliable.
"""

import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ModelError
from isocharge.serve.flags import BEYOND, FILM, GAP, MISFIT, OUTSIDE, REPEAT, STRESS
from isocharge.serve.frames.frame import Frame
from isocharge.serve.model.charge_file import FILE, read_charge_map
from isocharge.serve.model.contact import Contact, is_close
from isocharge.serve.model.robust_estimate import ModelValues, RobustProblem
from isocharge.serve.record.record import FollowedFilm
from isocharge.serve.signal_chain.stage import Rule, Setting, Setup, Stage
from isocharge.serve.signal_chain.thermal import warming_ratios
from isocharge.serve.tracking.gaussian_components import GAIN_STD, contacts_of

UNUSED_FRAME_FLAGS = frozenset({OUTSIDE, BEYOND, STRESS, GAP, REPEAT})
"""Flags of frames that are not used, although the other frames of the same touch may be used.

The first and the last frames of every touch have the flag OUTSIDE. GAP and REPEAT only mean that frames were lost.
"""

HARMLESS_FLAGS = UNUSED_FRAME_FLAGS | {MISFIT}
"""Flags that do not make the touch of a frame unusable.

If the film has changed, frames have the flag MISFIT. The estimate of the state of the film gives little weight to
touches that no contact explains.
"""


class TouchPeak:
    """Average charges of the frames of a touch in which the force is close to its largest value.

    The first frame is the reference. A frame with a clearly larger force becomes the new reference, and the average
    starts again. A frame whose contact is close to the contact of the reference is added to the average. All other
    frames are ignored.
    """

    def __init__(self) -> None:
        """Start without a frame."""
        self._reference_contact: Contact | None = None
        self._averaged_count = 0
        self._charge_sum_pC: Array = np.zeros(())
        self._is_reliable = True  # whether all flags so far are harmless

    def add_frame(self, contact: Contact, charge_pC: Array, flags: tuple[str, ...] = ()) -> None:
        """Process the next frame of the touch.

        The first frame is the reference. A frame whose contact is close to that of the reference is averaged with it.
        Another frame with a larger force becomes the new reference, and the average begins again. Frames with a flag in
        `UNUSED_FRAME_FLAGS` are not averaged. A flag that is not harmless makes the whole touch unusable.

        Args:
            contact: Contact that the model computed for the frame.
            charge_pC: Touch charges of the frame, shape (n_electrode,), pC.
            flags: Flags of the frame.
        """
        if set(flags) - HARMLESS_FLAGS:
            self._is_reliable = False
        if UNUSED_FRAME_FLAGS.intersection(flags):
            return
        reference = self._reference_contact
        if is_close(contact, reference):  # false without a reference
            self._averaged_count += 1
            self._charge_sum_pC = self._charge_sum_pC + charge_pC
        elif reference is None or contact.force_N > reference.force_N:
            self._reference_contact = contact
            self._averaged_count = 1
            self._charge_sum_pC = charge_pC

    @property
    def mean_charge_pC(self) -> Array | None:
        """Average of the touch charges, shape (n_electrode,), pC.

        The average is None if no frame was averaged, or if a flag of the touch is not harmless.
        """
        is_usable = self._is_reliable and self._averaged_count > 0
        return self._charge_sum_pC / self._averaged_count if is_usable else None


RELATIVE_OFFSET_STD = 0.1
"""Standard deviation of the common offset, relative to the largest offset.

The offset of a single touch deviates from the common offset with the same standard deviation.
"""

SMALLEST_STD = 1e-4
"""Lower limit for the standard deviation of an unknown, in its unit. The covariance can then be inverted."""

MAX_DEVIATION = 20.0
"""Largest magnitude of an unknown, in standard deviations before the first touch."""

MAX_MEAN_SQUARE = 3.0
"""Largest mean squared distance of the latest touches from the predicted touches, for a film that is not lost.

A squared distance is divided by the number of independent residuals of a touch.
"""

SUDDEN_MEAN_SQUARE = 6.0
"""Mean squared distance of a touch from the predicted touch, above which the pretension may have changed suddenly.

A squared distance is divided by the number of independent residuals of a touch. The distance is measured in standard
deviations of the scaled errors. With a larger value, sudden changes are noticed later. With a smaller value, forces on
an unchanged film are less accurate.
"""

CLEAR_CHANGE = 3.0
"""Number of standard deviations above which the change of an unknown is clear.

An unknown at an end of its range is implausible only if its change is clear. This condition is needed, because the
pretension of a nearly slack film is always close to the lower end of its range.
"""

FADING_TOUCHES = 512
"""Number of touches that decides how fast the variances of the pretension, the gains and the offset increase.

After this number of touches without information about an unknown, 63 % of the information from earlier touches is lost.
"""

UNCHANGED_ODDS = 0.5
"""Odds, before the first touch, that the pretension has not changed since the calibration.

Larger odds make forces on a changed film less accurate, and smaller odds make forces on an unchanged film less
accurate.
"""

MEMORY_TOUCHES = 16
"""Number of touches after which the weight of a touch in the mean squared distance has decreased to 1/e."""

SMALLEST_ERROR_SCALE = 0.1
"""Lower limit for the scale of the error covariance, dimensionless: a few touches may agree by chance."""


class FollowRule(Rule, frozen=True, kw_only=True):
    """Settings of the correction for changes of the film, from the section `[follow]` of a device file.

    Attributes:
        drift_MPa_per_root_hour: Standard deviation of the change of the pretension in an hour, MPa. The standard
            deviation is proportional to the square root of the time. On a ring of aluminium, a change of the
            temperature by 1 K changes the pretension by 0.3 to 0.44 MPa.
        largest_offset_pC: Largest charge that warmth may add to all electrodes during a touch, pC. The film is not
            followed while the mean added charge exceeds twice this value. 0 means that warmth adds no charge.
    """

    drift_MPa_per_root_hour: Setting = 0.35
    largest_offset_pC: Setting = 30.0


class _Conversion(NamedTuple):
    """Shift that converts charges of the changed film into charges of the calibrated film.

    Attributes:
        uncorrected_contact: Contact that the model computes from charges before the conversion. The conversion is used
            for this contact and for contacts near it.
        shift_pC: Charges that the conversion adds, shape (n_electrode,), pC.
        covariance: Covariance of x (mm), y (mm) and the force (N) that the errors of the state cause, shape (3, 3).
    """

    uncorrected_contact: Contact
    shift_pC: Array
    covariance: Array


class FilmFollower(Stage):
    """Estimates the changes of one film, and corrects contacts for the estimated changes.

    Attributes:
        is_lost: Whether the film is lost.
    """

    section = "follow"
    rule_class = FollowRule
    needs_contact = True

    def __init__(self, setup: Setup) -> None:
        """Start with the assumption that the film has not changed since the calibration.

        Raises:
            ModelError: If the model has fewer than four electrodes, or has no charge map with several pretensions, or
                the file of the charge map belongs to another model.
        """
        predictor = setup.model
        electrodes = predictor.metadata.electrodes
        if len(electrodes) < 4:
            raise ModelError(
                f"{predictor.folder}: expected at least four electrodes, got {', '.join(electrodes)}: three charges "
                "fit some contact exactly on any film, so touches do not show its changes; update such a film with "
                "`isocharge train calibrate --from`"
            )
        series = read_charge_map(predictor.folder, electrodes)
        if series is None or series.node_MPa.size < 2:
            raise ModelError(
                f"{predictor.folder}: expected the file {FILE} with the charges of the film at several pretensions; a "
                "film is followed from a model that `isocharge train calibrate` made of presses on it: calibrate it "
                "with this version"
            )
        self._setup = setup  # contains the model of the calibrated film, for the noise of the present touch
        self._rule = setup.device.rule(FollowRule) or FollowRule()
        self._series = series
        # Charge that warmth adds to each electrode, relative to the common offset, shape (n_electrode,)
        self._offset_ratio = warming_ratios(setup)
        self._offset_std_pC = RELATIVE_OFFSET_STD * self._rule.largest_offset_pC

        # The state consists of the state of the charge map, the logarithms of the gains and the common offset.
        film_size = 1 + series.direction_count
        self._film = slice(0, film_size)
        self._directions = slice(1, film_size)
        self._gains = slice(film_size, film_size + len(electrodes))
        self._offset = self._gains.stop
        direction_std = np.ones(series.direction_count)
        gain_std = np.full(len(electrodes), GAIN_STD)
        std = np.hstack([series.tension_std_MPa, direction_std, gain_std, self._offset_std_pC])
        self._initial_std = np.maximum(std, SMALLEST_STD)
        highest = MAX_DEVIATION * self._initial_std
        lowest = -highest
        lowest[0], highest[0] = series.node_MPa[[0, -1]]
        self._state_bounds = (lowest, highest)

        # Smallest and largest x, y and ln F
        domain = series.domain
        self._contact_bounds = (domain.centre - domain.scale, domain.centre + domain.scale)
        self.is_lost = False
        # Mean squared distance of the latest touches from the predicted touches, relative to the unscaled errors
        self._mean_square = 1.0
        self._touch_count = 0
        self._latest_touch_s = math.inf
        self._start_estimate()
        self._applied_state: Array | None = None  # state that contacts are corrected for; None before the first one
        self._applied_covariance = self._covariance
        self._conversion: _Conversion | None = None  # latest conversion of charges
        self.reset()

    def _start_estimate(self) -> None:
        """Set the state to the state of the calibrated film, with the standard deviations before the first touch."""
        self._state = np.zeros(self._initial_std.size)
        self._covariance = np.diag(self._initial_std**2)

    def reset(self) -> None:
        """Discard the frames of the present touch, for example after an outage or a new tare. The estimate remains."""
        self._peak = TouchPeak()

    @property
    def film(self) -> FollowedFilm:
        """Present estimate of the film, in the format of a prediction record."""
        change_MPa = 0.0 if self._applied_state is None else float(self._applied_state[0])
        std_MPa = math.sqrt(self._applied_covariance[0, 0])
        return FollowedFilm(float(self._series.pretension_MPa) + change_MPa, std_MPa, self._touch_count)

    def step(self, frame: Frame) -> None:
        """Correct the contact with the estimate from the earlier touches, and update the estimate when a touch ends.

        An invalid frame does not show whether the touch has ended, and therefore does not change the estimate. The film
        is lost if no state of the film explains the latest touches, or if the estimated state is implausible. Then
        every frame with a contact gets the flag `film`.
        """
        frame.film = self.film
        if frame.contact is not None and frame.charge_pC is not None:
            corrected_contact = self.follow_contact(frame.contact, frame.charge_pC)
            # The corrected contact is a contact on the calibrated film, so the limits of this film apply.
            frame.set_contact(corrected_contact, self._setup.model.validity)
            all_flags = (*frame.flags, *frame.contact_flags)  # some flags exclude the frame, others the whole touch
            self._peak.add_frame(corrected_contact, frame.charge_pC, all_flags)  # averages the strongest frames
            if self.is_lost:
                frame.flags.append(FILM)
        elif frame.is_valid:  # no contact, so a touch that had begun has ended
            mean_charge_pC = self._peak.mean_charge_pC
            self.reset()  # the next touch has a new peak
            if mean_charge_pC is not None:  # None if no touch had begun, or if it cannot be used
                self._observe_touch(mean_charge_pC, frame.host_s)

    def _observe_touch(self, charge_pC: Array, host_s: float) -> None:
        """Update the estimate of the film with a touch, and decide whether the film is lost.

        The charges of a touch have three errors: their noise, the part of the charges that the charge map does not
        describe, and the deviation of the offset of the touch from the common offset. The average charges are assumed
        to have the noise of a single frame, because a board may filter its signals over the whole touch. If the latest
        touches show that these errors are smaller, the covariance of the errors is scaled (`_error_scale`).

        Args:
            charge_pC: Average touch charges near the largest force, shape (n_electrode,), pC.
            host_s: Time of the touch, unix seconds. The clock of the board would not count while the board is off.
        """
        # Increase the variances, because the film may have changed since the previous touch.
        elapsed_hours = max(host_s - self._latest_touch_s, 0.0) / 3600.0
        self._latest_touch_s = host_s
        drift_variance = self._rule.drift_MPa_per_root_hour**2 * elapsed_hours
        self._covariance[0, 0] = min(self._covariance[0, 0] + drift_variance, self._initial_std[0] ** 2)
        # Each touch also restores a small part of the variance that earlier touches have removed.
        lost_variance = np.maximum(self._initial_std**2 - self._covariance.diagonal(), 0.0)
        lost_variance[self._directions] = 0.0  # a film keeps these properties
        self._covariance += np.diag(lost_variance / FADING_TOUCHES)

        # Compute the covariance of the three errors of the charges.
        touch_offset_pC = self._offset_std_pC * self._offset_ratio
        model_error_pC = self._series.charge_std * charge_pC
        variance_pC2 = self._setup.model.noise.variance(charge_pC) + model_error_pC**2
        scale = self._error_scale
        covariance_pC2 = scale * (np.diag(variance_pC2) + np.outer(touch_offset_pC, touch_offset_pC))

        # Estimate the state together with the contact of the touch. The former state is the prior.
        start = self._log_contact(self.follow_contact(self._setup.model.predict(charge_pC), charge_pC))
        problem = RobustProblem(
            self._values, charge_pC[np.newaxis], covariance_pC2[np.newaxis], self._state, self._covariance
        )
        estimate = problem.estimate(
            self._state, start, contact_bounds=self._contact_bounds, state_bounds=self._state_bounds
        )
        self._state = estimate.state
        self._covariance = problem.state_covariance(estimate)
        self._touch_count += 1

        # Twice the cost is the sum of the squared residuals, in which large residuals have little weight. The residuals
        # are divided by the scaled errors. A touch has three independent residuals fewer than charges, because its
        # contact is unknown. Multiplied by the scale, the mean refers to the unscaled errors.
        mean_square = 2.0 * estimate.cost / (charge_pC.size - 3)
        self._mean_square += (scale * mean_square - self._mean_square) / MEMORY_TOUCHES

        # Decide whether the film is lost.
        is_changed = np.abs(estimate.state) > CLEAR_CHANGE * np.sqrt(self._covariance.diagonal())
        is_at_bound = is_changed & np.any(estimate.state == self._state_bounds, axis=0)
        has_implausible_state = bool(is_at_bound[[0, self._offset]].any())  # the pretension or the offset
        was_lost = self.is_lost
        self.is_lost = self._mean_square > MAX_MEAN_SQUARE or has_implausible_state
        if self.is_lost and not was_lost:
            self._start_estimate()  # the film may have changed suddenly, so earlier touches do not help
        elif not self.is_lost:
            self._update_applied_state()
            self._conversion = None  # the stored conversion belongs to the earlier state

        # After a sudden change, the next touches determine the pretension, and not those before the change.
        if mean_square > SUDDEN_MEAN_SQUARE:
            self._covariance[0, 0] = max(self._covariance[0, 0], self._initial_std[0] ** 2)

    @property
    def _error_scale(self) -> float:
        """Scale of the error covariance of touches, dimensionless: the mean squared distance of the latest touches.

        The scale does not exceed 1, so that an unexplained change of the film is not mistaken for larger errors.
        """
        return min(max(self._mean_square, SMALLEST_ERROR_SCALE), 1.0)

    def _update_applied_state(self) -> None:
        """Compute the state of the film for which contacts are corrected, and its covariance.

        There are two cases: since the calibration, the pretension has changed by an unknown amount t, or it has not
        changed (t = 0). The state is the mean over both cases, weighted by their probabilities.

        Before the first touch, the odds of no change are `UNCHANGED_ODDS`. The touches multiply these odds by the
        Savage-Dickey ratio (Dickey 1971). This ratio is the probability density of t = 0 after the touches, divided by
        the probability density of t = 0 before the first touch, when the mean of t is 0.

        The covariance is that of the first case and not a mean over both cases, because hardly any film keeps its
        pretension exactly. Two parts are added. The first part is the outer product of the difference between the
        states of both cases, times the probability of no change. The second part is the variance of the offset of a
        single touch about the common offset.
        """
        change_MPa = self._state[0]  # t in the first case
        variance = self._covariance[0, 0]
        # The density of a normal distribution at t = 0 is exp(-0.5 mean^2 / variance) / std, up to a constant factor.
        std_ratio = self._initial_std[0] / math.sqrt(variance)
        density_ratio = std_ratio * math.exp(-0.5 * change_MPa**2 / variance)
        unchanged_odds = UNCHANGED_ODDS * density_ratio
        unchanged_probability = unchanged_odds / (1.0 + unchanged_odds)

        # Without a change, the other unknowns have their conditional distribution for t = 0.
        difference = change_MPa * self._covariance[0] / variance  # of the state with a change from the other state
        self._applied_state = self._state - unchanged_probability * difference
        self._applied_covariance = self._covariance + unchanged_probability * np.outer(difference, difference)
        self._applied_covariance[self._offset, self._offset] += self._error_scale * self._offset_std_pC**2

    def _values(self, contacts: Array, state: Array) -> ModelValues:
        """Compute the charges that the board would measure under touches, and their derivatives.

        The measured charge of an electrode is g q + r p. In this formula, q is the charge of the film, g is the gain of
        the electrode, p is the common offset, and r is the given ratio of the electrode's offset to p.

        Args:
            contacts: Contacts (x, y, ln F) of n touches, shape (n, 3), mm and the logarithm of N.
            state: State, shape (n_state,). It consists of the state of the film, ln g of each electrode, and p.

        Returns:
            The charges, and their derivatives with respect to each contact and with respect to the state.
        """
        # Charges q that the film causes in this state, and their derivatives
        film = self._series.in_state(contacts_of(contacts), state[self._film])
        gains = np.exp(state[self._gains])
        amplified_pC = gains * film.charge_pC  # g q, shape (n, n_electrode)
        offset_pC = state[self._offset] * self._offset_ratio  # r p, shape (n_electrode,)

        # The derivative of g q with respect to ln g is g q for the gain of the same electrode, and otherwise 0. The
        # axes of a derivative are the touch, the electrode, and the variable of the derivative.
        electrode_gains = gains[:, None]
        by_state = np.zeros((*amplified_pC.shape, state.size))
        by_state[:, :, self._film] = electrode_gains * film.by_state
        by_state[:, :, self._gains] = amplified_pC[:, :, None] * np.eye(gains.size)
        by_state[:, :, self._offset] = self._offset_ratio
        return ModelValues(amplified_pC + offset_pC, electrode_gains * film.by_contact, by_state)

    def _log_contact(self, contact: Contact) -> Array:
        """Return (x, y, ln F) of a contact, moved into the bounds of the charge map, shape (1, 3)."""
        smallest_N = self._series.domain.force_range[0]
        log_force = math.log(max(contact.force_N, smallest_N))
        return np.clip([[contact.x_mm, contact.y_mm, log_force]], *self._contact_bounds)

    def follow_contact(self, contact: Contact, charge_pC: Array) -> Contact:
        """Return a contact after correction for the estimated changes of the film.

        The uncertainty of the state is added to the standard deviations of the contact. Before the first estimate of
        the film, the contact is returned unchanged.

        Args:
            contact: Contact that the model computed from the charges.
            charge_pC: Touch charges, shape (n_electrode,), pC.
        """
        state = self._applied_state
        if state is None:  # there is no estimate yet
            return contact
        conversion = self._conversion
        if conversion is None or not is_close(contact, conversion.uncorrected_contact):
            # The conversion to charges of the calibrated film depends on the corrected contact, which is not known yet.
            # A conversion at the given contact yields this contact roughly. The result is used again while the given
            # contact hardly changes. It is therefore stored with the given contact, with which `is_close` compares.
            rough_conversion = self._conversion_at(contact, state)
            rough_contact = self._setup.model.predict(charge_pC + rough_conversion.shift_pC)
            conversion = self._conversion_at(rough_contact, state)._replace(uncorrected_contact=contact)
            self._conversion = conversion
        corrected_contact = self._setup.model.predict(charge_pC + conversion.shift_pC)
        return corrected_contact.with_error(conversion.covariance)

    def _conversion_at(self, contact: Contact, state: Array) -> _Conversion:
        """Return the conversion from charges of the changed film to charges of the calibrated film, near a contact.

        The conversion contains a shift of the charges, and the covariance of the contact that errors of the state
        cause. `_applied_covariance` is the covariance of the state.

        Args:
            contact: Contact on the calibrated film.
            state: State of the film, shape (n_state,).
        """
        # Charges of the contact on the changed and on the calibrated film, and the derivatives of the latter charges
        # with respect to the contact (x, y, ln F), shape (n_electrode, 3)
        log_contact = self._log_contact(contact)  # an array with one row, so the results below have one row each
        changed_film = self._values(log_contact, state)
        (calibrated_pC,), (slopes_by_contact_pC,) = self._series.linearised(contacts_of(log_contact))
        shift_pC = calibrated_pC - changed_film.charge_pC[0]

        # An error of the state shifts the contact whose charges are nearest to the converted charges (least squares).
        # The distance of charges is measured in standard deviations of their noise.
        noise_std_pC = np.sqrt(self._setup.model.noise.variance(calibrated_pC))
        weight = 1.0 / noise_std_pC[:, None]
        # Derivatives of the contact (x, y, ln F) with respect to the state, shape (3, n_state)
        contact_slopes_by_state = np.linalg.pinv(weight * slopes_by_contact_pC) @ (weight * changed_film.by_state[0])
        contact_slopes_by_state[2] *= contact.force_N  # dF = F d(ln F)
        covariance = contact_slopes_by_state @ self._applied_covariance @ contact_slopes_by_state.T
        return _Conversion(contact, shift_pC, covariance)
