"""Stages that compute the contact of a record from the touch charges of a frame.

Each frame is processed by the following stages, in the listed order.

- `PredictionStage` predicts the contact with the model, and adds flags if the contact is not valid.
- `FilmStage` estimates how the pretension of the film changes from touch to touch (section `[follow]` of the device
  file).
- `TrackingStage` tracks the contact from frame to frame (section `[track]` of the device file).
- `ChargeScaleStage` increases the standard deviations of the contact if the common scale of all charges is uncertain
  (section `[memory]` of the device file).
- `TouchOffsetStage` increases the standard deviations of the contact if all charges of a touch may have a common offset
  (section `[touch_offset]` of the device file).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

from msgspec import structs

from isocharge.common.arrays import Array
from isocharge.serve.flags import FILM, INVALID
from isocharge.serve.prediction.contact import Contact, Sensitivity
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.record.record import NO_TRACKING, FollowedFilm, Tracking
from isocharge.serve.signal_chain.chain import Reading
from isocharge.serve.signal_chain.rule import Rule, Setting
from isocharge.serve.tracking.contact_mixture import contact_mixture
from isocharge.serve.tracking.film_follower import FilmFollower, FollowRule
from isocharge.serve.tracking.tracker import Tracker

CHARGE_SCALE_STEP = 0.01
"""Relative change of all touch charges for the numerical derivative of the contact with respect to their scale."""

TOUCH_OFFSET_STEP_pC = 1.0
"""Offset of the charges for the numerical derivative of the contact with respect to a common offset, pC."""

LARGEST_FORCE_EXPONENT = 1.5
"""Largest exponent p of the law that the force is proportional to the p-th power of the common scale of all charges.

The exponent has this value for a film without pretension, and is smaller for a film with pretension.
"""


@dataclass(slots=True)
class CurrentModel:
    """Holder of the current model, which all stages share.

    Attributes:
        predictor: The loaded model. If a `FilmStage` estimates the pretension of the film, this is instead the model of
            the film at its estimated pretension.
    """

    predictor: Predictor


@dataclass(slots=True)
class ContactFrame:
    """Frame that the stages process. Each stage changes the attributes of the frame.

    Attributes:
        reading: Charges of the frame after the signal chain.
        clock_s: Time of the frame on a monotonic clock, s.
        flags: Flags of the frame, as in `isocharge.serve.flags`.
        contact: The estimated contact. None if nothing touches the film, or if the frame is invalid.
        film: Estimated pretension of the film; None if the pretension is not estimated.
        tracking: The tracked contact; None if contacts are not tracked.
        is_mixture_contact: Whether the contact comes from a `ContactMixture` and not from the model.
        model_charge_pC: Charges from which the current model predicts the contact, shape (n_electrode,), pC. None if
            there is no contact. If the pretension is estimated, these charges differ from the charges of the reading.
    """

    reading: Reading
    clock_s: float
    flags: tuple[str, ...]
    contact: Contact | None = None
    film: FollowedFilm | None = None
    tracking: Tracking | None = None
    is_mixture_contact: bool = False
    model_charge_pC: Array | None = None


class ContactStage(ABC):
    """Base class of the stages. A stage contains its settings and its state."""

    @abstractmethod
    def step(self, frame: ContactFrame) -> None:
        """Process the next frame by changing the attributes of `frame`."""

    def reset(self) -> None:  # noqa: B027  # some stages have no state
        """Discard the state of the present contact, for example after an outage or when a new tare is measured."""


class PredictionStage(ContactStage):
    """Stage that predicts the contact of each frame with the current model."""

    def __init__(self, model: CurrentModel) -> None:
        """Store the model, and the limits within which contacts of the model are valid.

        Args:
            model: The current model. Its predictor may be replaced later by the model of the same film at another
                pretension. The limits of valid contacts then stay the same.
        """
        self._model = model
        self._validity = model.predictor.validity

    def step(self, frame: ContactFrame) -> None:
        """Predict the contact of a frame, and add the flags of the contact to the frame.

        If nothing touches the film, if there is no tare yet, or if the frame has the flag `invalid`, no contact is
        predicted.
        """
        reading = frame.reading
        if INVALID in reading.flags or not reading.contact or reading.charge_pC is None:
            return
        frame.contact = self._model.predictor.predict(reading.charge_pC)
        frame.model_charge_pC = reading.charge_pC
        frame.flags = reading.flags + self._validity.flags(frame.contact)


class FilmStage(ContactStage):
    """Stage that estimates the pretension of the film, and uses the model for the estimated pretension.

    Attributes:
        follower: Object that estimates the pretension.
    """

    def __init__(self, model: CurrentModel, rule: FollowRule, warming_ratio: Array | float) -> None:
        """Begin with the pretension that the calibration of the film has found.

        Args:
            model: The current model, whose predictor this stage replaces.
            rule: Settings of the estimation, from the section `[follow]` of the device file.
            warming_ratio: Charge that warming adds to each electrode, relative to the mean magnitude over all
                electrodes, shape (n_electrode,), or one number for all electrodes.

        Raises:
            ModelError: If the pretension of this film cannot be estimated with the model.
        """
        self._model = model
        self._validity = model.predictor.validity  # of the calibrated film
        self.follower = FilmFollower(model.predictor, rule, warming_ratio)

    def step(self, frame: ContactFrame) -> None:
        """Correct the contact for the estimated pretension of the film, and then update the estimate with the frame.

        The flags of the frame become those of the corrected contact. A frame with the flag `invalid` does not change
        the estimate, because it does not show whether the touch has ended.

        The model for the new estimate is used from the next frame on. If the pretension can no longer be estimated,
        every frame with a contact gets the flag `film`.
        """
        # Correct the contact with the estimate from the earlier frames. The frame reports this estimate.
        charge_pC = frame.reading.charge_pC
        if frame.contact is not None and charge_pC is not None:
            frame.contact, frame.model_charge_pC = self.follower.follow_contact(frame.contact, charge_pC)
            frame.flags = frame.reading.flags + self._validity.flags(frame.contact)
        frame.film = self.follower.film
        if INVALID in frame.flags:
            return

        # Update the estimate, and use its model for the next frame.
        self.follower.observe_frame(charge_pC, frame.contact, frame.flags, frame.clock_s)
        self._model.predictor = self.follower.predictor
        if frame.contact is not None and self.follower.is_lost:
            frame.flags = (*frame.flags, FILM)

    def reset(self) -> None:
        """Discard the state of the present touch. The estimated pretension is not changed."""
        self.follower.discard_touch()

    def reset_film(self) -> None:
        """Reset the estimate of the pretension to the pretension that the calibration of the film has found."""
        self.follower.reset()
        self._model.predictor = self.follower.predictor


class TrackingStage(ContactStage):
    """Stage that tracks the contact from frame to frame."""

    def __init__(self, tracker: Tracker, predictor: Predictor, *, is_pretension_estimated: bool) -> None:
        """Store the tracker, and replace its mixture of several possible contacts.

        On some films, several different contacts cause the same charges. The folder of the model of such a film
        contains the file `charges.npz`, which describes the charges of all contacts. The tracker then uses a mixture
        of Gaussian components that represents all possible contacts. Without the file, the tracker uses no mixture.

        Args:
            tracker: The tracker. Its mixture is replaced. It keeps the contact that it tracks at present.
            predictor: The loaded model.
            is_pretension_estimated: Whether a `FilmStage` estimates the present pretension of the film. The tracker
                then uses no mixture, because the file describes the charges at the calibrated pretension.

        Raises:
            ModelError: If the file `charges.npz` is damaged.
        """
        mixture = None
        if not is_pretension_estimated:
            mixture = contact_mixture(predictor)  # None if the model has no file `charges.npz`
        self._mixture_validity = predictor.validity
        if mixture is not None:
            # A contact of the mixture is valid in the whole area for which the file describes the charges.
            self._mixture_validity = replace(predictor.validity, corners_mm=mixture.charges.corners_mm)
        self._tracker = tracker
        self._tracker.mixture = mixture

    def step(self, frame: ContactFrame) -> None:
        """Update the tracker with the contact of the frame, and add the tracked contact and its event to the frame.

        An event is, for example, the beginning of a press or its release. If the tracker uses a mixture of several
        possible contacts, the most probable contact replaces the contact of the model, and determines the flags of the
        frame.
        """
        tracker = self._tracker
        reading = frame.reading
        tracked, event = tracker.update(frame.contact, frame.clock_s, frame.flags, reading.charge_pC)
        other = tracker.other  # another contact that also explains the charges, if there is one
        if tracked is None and event is None and other is None:
            frame.tracking = NO_TRACKING
        else:
            frame.tracking = Tracking(tracked, event, other)

        # `mixture_contact` is None without a mixture, and for a frame from which the mixture estimates no contact.
        if tracker.mixture_contact is not None:
            frame.contact = tracker.mixture_contact
            frame.flags = reading.flags + self._mixture_validity.flags(frame.contact)
            frame.is_mixture_contact = True

    def reset(self) -> None:
        """Discard the tracked contact."""
        self._tracker.reset()


def _widen_contacts(frame: ContactFrame, contact: Contact, shift: tuple[float, float, float]) -> None:
    """Add an independent error to the standard deviations of the contact of a frame and of its tracked contact.

    Args:
        frame: The frame, whose contact and tracked contact are replaced.
        contact: The contact of the frame.
        shift: Changes of x, mm, of y, mm, and of the force, N, that an error of one standard deviation causes.
    """
    frame.contact = contact.widened(shift)
    if frame.tracking is not None and frame.tracking.tracked is not None:
        frame.tracking = structs.replace(frame.tracking, tracked=frame.tracking.tracked.widened(shift))


class ChargeScaleStage(ContactStage):
    """Stage that adds the uncertainty of the charge scale to the standard deviations of a contact.

    The charge scale is the common factor of all charges. It is uncertain if the parameters of the film's memory, which
    changes the charges of a held press, are not known exactly.
    """

    def __init__(self, model: CurrentModel) -> None:
        """Create the stage. The stage computes the sensitivity of a contact when the first contact is processed.

        Args:
            model: The current model, with which the sensitivity of the contact is computed.
        """
        self._model = model
        self.reset()

    def step(self, frame: ContactFrame) -> None:
        """Add the error of the charge scale to the standard deviations of the contact and the tracked contact."""
        if frame.contact is None:
            return
        shift = self._contact_shift(frame, frame.contact)
        if shift is not None:
            _widen_contacts(frame, frame.contact, shift)

    def reset(self) -> None:
        """Discard the sensitivity of the previous contact."""
        self._sensitivity = Sensitivity(CHARGE_SCALE_STEP)
        self._sensitivity_predictor = self._model.predictor

    def _contact_shift(self, frame: ContactFrame, contact: Contact) -> tuple[float, float, float] | None:
        """Return how much the contact changes if the charge scale is wrong by one standard deviation.

        If the model has predicted the contact, the change is computed from a second prediction with slightly larger
        charges. If the contact comes from the mixture of the tracker, only its force F is assumed to depend on the
        scale: F is proportional to scale^p, with the exponent p = `LARGEST_FORCE_EXPONENT`. A small relative change of
        the scale then changes F by p F times this relative change.

        Args:
            frame: The frame.
            contact: The contact of the frame.

        Returns:
            Changes of x, mm, of y, mm, and of the force, N. None if the model has predicted the contact and the scale
            is known exactly.
        """
        charge_scale_std = frame.reading.charge_scale_std  # relative standard deviation of the scale
        if frame.is_mixture_contact:
            return 0.0, 0.0, LARGEST_FORCE_EXPONENT * charge_scale_std * contact.force_N
        charge_pC = frame.model_charge_pC
        if charge_scale_std <= 0.0 or charge_pC is None:
            return None

        # `_sensitivity` stores the result of the latest second prediction. If another model is used since then, the
        # stored result is discarded.
        predictor = self._model.predictor
        if predictor is not self._sensitivity_predictor:
            self.reset()
        scaled_pC = charge_pC * (1.0 + CHARGE_SCALE_STEP)

        # `shift` calls this function only if the contact has moved since the latest second prediction.
        def predict_scaled() -> Contact:
            return predictor.predict(scaled_pC)

        return self._sensitivity.shift(contact, charge_scale_std, predict_scaled)


class TouchOffsetRule(Rule, frozen=True, kw_only=True):
    """Settings that describe a common offset of all charges of a touch.

    A triboelectric charge or a pyroelectric charge can cause a common offset.

    Attributes:
        std_pC: Standard deviation of the offset, pC. The offset is constant during a touch, and its mean over many
            touches is 0.
    """

    std_pC: Setting = 5.0


class TouchOffsetStage(ContactStage):
    """Stage that adds the uncertainty of a common offset of all charges to the standard deviations of a contact.

    A common offset changes the contact of a light press more than the contact of a strong press. If a contact comes
    from the mixture of the tracker, its standard deviations are not changed. The model does not predict such a contact,
    so that the effect of an offset on the contact is not known.
    """

    def __init__(self, model: CurrentModel, rule: TouchOffsetRule, offset_ratio: Array | float) -> None:
        """Create the stage. The stage computes the sensitivity of a contact when the first contact is processed.

        Args:
            model: The current model, with which the sensitivity of the contact is computed.
            rule: Settings that describe the offset.
            offset_ratio: Charge that the offset adds to each electrode, relative to the common offset, shape
                (n_electrode,), or one number for all electrodes.
        """
        self._model = model
        self._rule = rule
        self._offset_ratio = offset_ratio
        self.reset()

    def step(self, frame: ContactFrame) -> None:
        """Add the error of a common offset to the standard deviations of the contact and the tracked contact.

        The error is computed from a second prediction, in which an offset is added to the charges. If the contact comes
        from the mixture of the tracker, it is not changed, because the model does not predict such a contact.
        """
        charge_pC = frame.model_charge_pC
        contact = frame.contact
        if contact is None or charge_pC is None or frame.is_mixture_contact:
            return

        # `_sensitivity` stores the result of the latest second prediction. If another model is used since then, the
        # stored result is discarded.
        predictor = self._model.predictor
        if predictor is not self._sensitivity_predictor:
            self.reset()
        offset_charge_pC = charge_pC + TOUCH_OFFSET_STEP_pC * self._offset_ratio

        # `shift` calls this function only if the contact has moved since the latest second prediction.
        def predict_with_offset() -> Contact:
            return predictor.predict(offset_charge_pC)

        shift = self._sensitivity.shift(contact, self._rule.std_pC, predict_with_offset)
        _widen_contacts(frame, contact, shift)

    def reset(self) -> None:
        """Discard the sensitivity of the previous contact."""
        self._sensitivity = Sensitivity(TOUCH_OFFSET_STEP_pC)
        self._sensitivity_predictor = self._model.predictor
