"""Correction of contacts for changes of the film. The changes are estimated from ordinary touches.

The charges of four electrodes have one degree of freedom more than a contact (x, y, force). If the pretension of a film
changes, for example because the room becomes warmer by 1 K, no contact explains the charges of touches exactly. The
module `isocharge.serve.tracking.film_state` estimates the state of the film, with which the latest touches can be
explained best. Each touch contributes its average charges of the frames with about the largest force.

The network was trained for the film as it was calibrated. The charges of a frame are therefore converted into charges
that the same contact would cause on the calibrated film, and the network computes the contact from the converted
charges. The conversion depends on the contact, so both are repeated a few times.

The film is considered lost if no state explains the latest touches, if the estimated pretension is at the end of the
range that the model describes, or if the common offset is larger than the settings allow. While the film is lost, the
estimate from before is used for contacts.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ModelError
from isocharge.serve.model.charge_file import FILE, read_charge_map
from isocharge.serve.model.contact import Contact, is_close
from isocharge.serve.model.predictor import Predictor
from isocharge.serve.record.record import FollowedFilm
from isocharge.serve.signal_chain.rule import Rule, Setting
from isocharge.serve.tracking.film_state import FilmModel, Touch
from isocharge.serve.tracking.touch_peak import TouchPeak

MAX_TOUCHES = 64
"""Number of the latest touches from which the state is estimated."""

RECENT_TOUCHES = 16
"""Number of the latest touches from which the follower decides whether the film is lost."""

FEWEST_TOUCHES = 8
"""Number of touches before the first correction of contacts."""

LARGEST_SQUARE = 9.0
"""Upper limit of the squared residual of a touch in the decision whether the film is lost, per degree of freedom."""

EXPLAINED_SQUARE = 3.0
"""Largest mean of the limited squared residuals, per degree of freedom, at which the latest touches are explained."""

MAX_RELATIVE_OFFSET = 2.0
"""Magnitude of the common offset, relative to the largest tolerated standard deviation, above which it is too large."""

CONVERSIONS = 3
"""Number of repetitions of the conversion of charges and of the computation of the contact."""


class FollowRule(Rule, frozen=True, kw_only=True):
    """Settings of the correction for changes of the film, from the section `[follow]` of a device file.

    Attributes:
        drift_MPa_per_root_hour: Standard deviation of the change of the pretension in an hour, MPa. The standard
            deviation is proportional to the square root of the time. On a ring of aluminium, a change of the
            temperature by 1 K changes the pretension by 0.3 to 0.44 MPa.
        largest_offset_pC: Largest standard deviation of the charge that warmth may add to all electrodes during a
            touch, pC. The film is not followed while the mean added charge exceeds twice this value. 0 means that
            warmth adds no charge.
    """

    drift_MPa_per_root_hour: Setting = 0.35
    largest_offset_pC: Setting = 30.0


class FollowedContact(NamedTuple):
    """A contact after the correction for the estimated changes of the film.

    Attributes:
        contact: The corrected contact.
        charge_pC: Charges from which the model predicts this contact, shape (n_electrode,), pC.
    """

    contact: Contact
    charge_pC: Array


class _Conversion(NamedTuple):
    """Conversion of charges near one contact into charges of the calibrated film: factor * charge + shift.

    Attributes:
        factor: Factors, shape (n_electrode,), dimensionless.
        shift_pC: Shifts, shape (n_electrode,), pC.
        contact_shifts: Changes of x (mm), y (mm) and the force (N) by independent errors of the state, shape (3, 3).
            Each row belongs to one error.
    """

    factor: Array
    shift_pC: Array
    contact_shifts: Array


class FilmFollower:
    """Estimator of the changes of one film, which corrects contacts for the estimated changes.

    The methods must be called from one thread. The same sequence of frames always gives bitwise equal contacts.

    Attributes:
        predictor: Model of the calibrated film.
        is_lost: Whether the film is lost.
    """

    def __init__(self, predictor: Predictor, rule: FollowRule | None = None, offset_ratio: Array | float = 1.0) -> None:
        """Start with the assumption that the film has not changed since the calibration.

        Args:
            predictor: Model of the calibrated film.
            rule: Settings; None for the default value of every setting.
            offset_ratio: Charge that warmth adds to each electrode, relative to the common offset, shape
                (n_electrode,), or one number for all electrodes.

        Raises:
            ModelError: If the model has fewer than four electrodes, or has no charge map with several pretensions, or
                the file of the charge map belongs to another model.
        """
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
                "film is followed from a model that `isocharge train calibrate` made of presses on it: calibrate it, "
                "or again with this version"
            )
        rule = rule or FollowRule()
        self.predictor = predictor
        self._series = series
        self._model = FilmModel(
            series=series,
            offset_ratio=np.broadcast_to(np.asarray(offset_ratio, dtype=float), (len(electrodes),)),
            drift_MPa_per_root_hour=rule.drift_MPa_per_root_hour,
            largest_offset_pC=rule.largest_offset_pC,
        )
        self.reset()

    def reset(self) -> None:
        """Discard all touches, and assume again that the film has not changed since the calibration."""
        self.is_lost = False
        self._touches: deque[Touch] = deque(maxlen=MAX_TOUCHES)
        self._contacts = np.empty((0, 3))  # estimated contacts (x, y, ln F) of the touches
        self._state = np.zeros(self._model.size)  # latest estimate, from which the next search starts
        self._first_touch_s: float | None = None
        self._touch_count = 0
        self._applied_state: Array | None = None  # state that contacts are corrected for; None before the first one
        self._applied_covariance = self._model.prior(0.0).covariance
        self._conversion: _Conversion | None = None  # latest conversion of charges, and its contact
        self._conversion_contact: Contact | None = None
        self.discard_touch()

    def discard_touch(self) -> None:
        """Discard the frames of the present touch, for example after an outage or a new tare."""
        self._peak = TouchPeak()

    @property
    def film(self) -> FollowedFilm:
        """Present estimate of the film, in the format of a prediction record."""
        change_MPa = 0.0 if self._applied_state is None else float(self._applied_state[0])
        std_MPa = math.sqrt(self._applied_covariance[0, 0])
        return FollowedFilm(self._series.pretension_MPa + change_MPa, std_MPa, self._touch_count)

    def observe_frame(
        self, charge_pC: Array | None, contact: Contact | None, flags: tuple[str, ...], clock_s: float
    ) -> None:
        """Process the next frame, and update the estimate of the film when a touch ends.

        Args:
            charge_pC: Touch charges, shape (n_electrode,), pC; None if nothing touches the film.
            contact: Contact after the correction; None if nothing touches the film.
            flags: Flags of the frame.
            clock_s: Time of the frame on a clock that does not jump, s.
        """
        if contact is not None:
            assert charge_pC is not None  # a frame with a contact has charges
            self._peak.add_frame(contact, charge_pC, flags)
            return
        peak = self._peak
        self.discard_touch()
        if peak.is_usable:
            frame_variance_pC2 = self.predictor.metadata.noise.variance(peak.mean_charge_pC)
            variance_pC2 = frame_variance_pC2 * peak.relative_noise_variance(frame_variance_pC2)
            touch_contact = self.predictor.predict(peak.mean_charge_pC)
            followed = self.follow_contact(touch_contact, peak.mean_charge_pC).contact
            self.observe_touch(Touch(peak.mean_charge_pC, variance_pC2, np.array(followed[:3]), clock_s))

    def observe_touch(self, touch: Touch) -> None:
        """Update the estimate of the film with a touch, and decide whether the film is lost."""
        if self._first_touch_s is None:
            self._first_touch_s = touch.clock_s
        lowest, highest = self._model.contact_bounds
        start = np.array(touch.contact, dtype=float)
        start[2] = math.log(max(start[2], math.exp(lowest[2])))
        start = np.clip(start, lowest, highest)
        self._touches.append(touch)
        self._touch_count += 1
        self._contacts = np.vstack([self._contacts, start])[-MAX_TOUCHES:]
        if len(self._touches) < FEWEST_TOUCHES:
            return

        elapsed_s = max(touch.clock_s - self._first_touch_s, 0.0)
        estimate = self._model.estimate(self._touches, self._state, self._contacts, elapsed_s)
        self._state = estimate.state
        self._contacts = estimate.contacts
        recent_squares = np.minimum(estimate.chi2 / estimate.degrees, LARGEST_SQUARE)[-RECENT_TOUCHES:]
        is_explained = recent_squares.mean() < EXPLAINED_SQUARE
        self.is_lost = not is_explained or self._is_out_of_range(estimate.state)
        if self.is_lost:
            # The film may have changed suddenly. The earlier touches then do not help to find its state.
            while len(self._touches) > RECENT_TOUCHES:
                self._touches.popleft()
            self._contacts = self._contacts[-RECENT_TOUCHES:]
        else:
            state, covariance = self._model.averaged_over_no_change(estimate, elapsed_s)
            self._applied_state = state
            self._applied_covariance = self._model.touch_covariance(state, covariance)
            self._discard_conversion()

    def _is_out_of_range(self, state: Array) -> bool:
        """Return whether the pretension is at the end of the range of the model, or the offset is too large."""
        low_MPa, high_MPa = self._series.node_MPa[[0, -1]]
        is_pretension_known = low_MPa < state[0] < high_MPa
        largest_pC = MAX_RELATIVE_OFFSET * self._model.largest_offset_pC
        return not is_pretension_known or abs(state[self._model.offset]) > max(largest_pC, 1e-3)

    def follow_contact(self, contact: Contact, charge_pC: Array) -> FollowedContact:
        """Correct a contact for the estimated changes of the film.

        The uncertainty of the state is added to the standard deviations of the contact. Before the first estimate of
        the film, the contact is returned unchanged.

        Args:
            contact: Contact that `predictor` computed from the charges.
            charge_pC: Touch charges, shape (n_electrode,), pC.
        """
        state = self._applied_state
        if state is None:  # there is no estimate yet
            return FollowedContact(contact, charge_pC)
        conversion = self._conversion
        if conversion is None or not is_close(contact, self._conversion_contact):
            conversion = self._conversion_at(contact, state)
            for _ in range(CONVERSIONS - 1):
                corrected = self.predictor.predict(conversion.factor * charge_pC + conversion.shift_pC)
                conversion = self._conversion_at(corrected, state)
            self._conversion = conversion
            self._conversion_contact = contact
        corrected_pC = conversion.factor * charge_pC + conversion.shift_pC
        covariance = conversion.contact_shifts.T @ conversion.contact_shifts
        corrected = self.predictor.predict(corrected_pC).with_covariance(covariance)
        return FollowedContact(corrected, corrected_pC)

    def _discard_conversion(self) -> None:
        """Discard the stored conversion, which belongs to an earlier contact or state."""
        self._conversion = None
        self._conversion_contact = None

    def _conversion_at(self, contact: Contact, state: Array) -> _Conversion:
        """Return the conversion of charges near a contact.

        Args:
            contact: Contact on the calibrated film.
            state: State of the film, shape (n_state,).
        """
        model = self._model
        lowest, highest = model.contact_bounds
        log_force = math.log(max(contact.force_N, math.exp(lowest[2])))
        log_contact = np.clip([[contact.x_mm, contact.y_mm, log_force]], lowest, highest)
        present = model.values(log_contact, state)
        near_contact = log_contact * [1.0, 1.0, 0.0] + [0.0, 0.0, math.exp(log_contact[0, 2])]  # (x, y, F)
        calibrated_charges_pC, calibrated_slopes_pC = self._series.linearised(near_contact)
        offset_pC = state[model.offset] * model.offset_ratio
        calibrated_pC = calibrated_charges_pC[0]
        if self._series.log_size is None:  # all charges are positive
            factor = calibrated_pC / (present.charge_pC[0] - offset_pC)
            shift_pC = -factor * offset_pC
        else:  # a ratio of charges near zero would be very large or small
            factor = np.ones_like(calibrated_pC)
            shift_pC = calibrated_pC - present.charge_pC[0]

        # An error of the state shifts the contact whose charges are nearest to the converted charges. The norm is that
        # of the noise of the charges.
        noise_std_pC = np.sqrt(self.predictor.metadata.noise.variance(calibrated_pC))
        charge_errors = factor[:, None] * present.by_state[0] @ np.linalg.cholesky(self._applied_covariance)
        slopes = calibrated_slopes_pC[0] / noise_std_pC[:, None]
        errors = np.linalg.pinv(slopes) @ (charge_errors / noise_std_pC[:, None])  # shape (3, n_state)
        errors[2] *= contact.force_N  # from ln F to F
        # Three independent errors with the same covariance: the rows of R in the decomposition errors' = Q R
        return _Conversion(factor, shift_pC, np.asarray(np.linalg.qr(errors.T, mode="r")))
