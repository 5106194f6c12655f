"""Stages that compute the contact of a record from a reading of the charges.

The stages process each frame in the following order.

- `PredictionStage` predicts the contact with the model, and adds the flags of the model.
- `FilmStage` follows the pretension of the film from touch to touch (section `[follow]` of the device file).
- `TrackingStage` follows the contact from frame to frame (section `[track]`).
- `ChargeScaleStage` increases the standard deviations if the scale of all charges is uncertain (section `[memory]`).
- `TouchOffsetStage` increases the standard deviations if touches may have a common offset (section `[touch_offset]`).
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
"""Relative change of all touch charges for the finite difference with respect to their common scale."""

TOUCH_OFFSET_STEP_pC = 1.0
"""Step of the finite difference with respect to a common offset of the charges, pC."""

LARGEST_FORCE_EXPONENT = 1.5
"""Largest exponent p with which the force is proportional to the p-th power of a common scale of all charges.

A film without pretension has this exponent.
"""


@dataclass(slots=True)
class CurrentModel:
    """The current model, which all stages share.

    Attributes:
        predictor: The loaded model. If the film is followed, the model of the film at its estimated pretension.
    """

    predictor: Predictor


@dataclass(slots=True)
class ContactFrame:
    """A frame of the stages. The stages change it in place.

    Attributes:
        reading: Charges of the frame after the signal chain.
        clock_s: Time of the frame on a clock that does not jump, s.
        flags: Flags of `isocharge.serve.flags`.
        contact: The contact; None if nothing touches, or the frame is invalid.
        film: State of the followed film; None if the film is not followed.
        tracking: The tracked contact; None if contacts are not tracked.
        is_mixture_contact: Whether the contact comes from a `ContactMixture` and not from the model.
        model_charge_pC: Charges for which the current model gives the contact, shape (n_electrode,), pC; None out of
            contact. On a followed film, these charges differ from the charges of the reading.
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
    """A stage with its settings and its state."""

    @abstractmethod
    def step(self, frame: ContactFrame) -> None:
        """Process the next frame in place."""

    def reset(self) -> None:  # noqa: B027  # some stages have no state
        """Discard the present contact, as after an outage or a new tare."""


class PredictionStage(ContactStage):
    """Predicts the contact with the current model."""

    def __init__(self, model: CurrentModel) -> None:
        """Set the model.

        Args:
            model: The current model. Its predictor may change later, but the limits of the flags do not.
        """
        self._model = model
        self._validity = model.predictor.validity

    def step(self, frame: ContactFrame) -> None:
        """Predict the contact of a frame in which something touches, and add its flags.

        A frame out of contact, or with the flag `invalid`, remains without a contact.
        """
        reading = frame.reading
        if INVALID in reading.flags or not reading.contact or reading.charge_pC is None:
            return
        frame.contact = self._model.predictor.predict(reading.charge_pC)
        frame.model_charge_pC = reading.charge_pC
        frame.flags = reading.flags + self._validity.flags(frame.contact)


class FilmStage(ContactStage):
    """Follows the pretension of the film, and changes the current model accordingly.

    Attributes:
        follower: The follower of the film.
    """

    def __init__(self, model: CurrentModel, rule: FollowRule, warming_ratio: Array | float) -> None:
        """Begin with the film as it was calibrated.

        Args:
            model: The current model.
            rule: Settings.
            warming_ratio: Charge that warming adds to each electrode, relative to the mean over all electrodes, shape
                (n_electrode,).

        Raises:
            ModelError: If the film of the model cannot be followed.
        """
        self._model = model
        self.follower = FilmFollower(model.predictor, rule, warming_ratio)

    def step(self, frame: ContactFrame) -> None:
        """Correct the contact for the estimated film, and then update the estimate of the film with the frame.

        If the film is lost, which means that it cannot be followed, the contact gets the flag `film`. The updated model
        is used from the next frame on.
        """
        charge_pC = frame.reading.charge_pC
        if frame.contact is not None and charge_pC is not None:
            frame.contact, frame.model_charge_pC = self.follower.follow_contact(frame.contact, charge_pC)
        frame.film = self.follower.film  # the estimate with which this contact was corrected

        # Only after that, the estimate may change.
        self.follower.observe_frame(charge_pC, frame.contact, frame.flags, frame.clock_s)
        self._model.predictor = self.follower.predictor
        if frame.contact is not None and self.follower.is_lost:
            frame.flags = (*frame.flags, FILM)

    def reset(self) -> None:
        """Discard the present touch. The estimated pretension is kept."""
        self.follower.discard_touch()

    def reset_film(self) -> None:
        """Return to the film as it was calibrated."""
        self.follower.reset()
        self._model.predictor = self.follower.predictor


class TrackingStage(ContactStage):
    """Tracks the contact from frame to frame."""

    def __init__(self, tracker: Tracker, predictor: Predictor, *, is_film_followed: bool) -> None:
        """Set the model of a tracker. The tracker keeps its present contact.

        On some films, several contacts cause the same charges. A mixture of Gaussian components tracks these contacts.
        It needs the file `charges.npz` beside the model, which describes the charges of every contact.

        Args:
            tracker: The tracker with its state.
            predictor: The loaded model.
            is_film_followed: Whether the film is followed. If so, no mixture is used, because the file of charges
                describes the calibrated film and not the current film.

        Raises:
            ModelError: If the file of charges of the model is damaged.
        """
        mixture = None
        if not is_film_followed:
            mixture = contact_mixture(predictor)  # None if the model has no such file
        self._mixture_validity = predictor.validity
        if mixture is not None:
            # The contacts of the mixture are valid in the area for which the file describes charges.
            self._mixture_validity = replace(predictor.validity, corners_mm=mixture.charges.corners_mm)
        self._tracker = tracker
        self._tracker.mixture = mixture

    def step(self, frame: ContactFrame) -> None:
        """Update the tracker with the contact of the frame, and add the tracked contact and its event to the frame.

        If a mixture of several possible contacts tracks the touch, its most probable contact replaces the contact of
        the model, and the flags are determined for the new contact.
        """
        tracker = self._tracker
        reading = frame.reading
        tracked, event = tracker.update(frame.contact, frame.clock_s, frame.flags, reading.charge_pC)
        other = tracker.other  # another contact that also explains the charges, if there is one
        if tracked is None and event is None and other is None:
            frame.tracking = NO_TRACKING
        else:
            frame.tracking = Tracking(tracked, event, other)
        if tracker.mixture_contact is not None:
            frame.contact = tracker.mixture_contact
            frame.flags = reading.flags + self._mixture_validity.flags(frame.contact)
            frame.is_mixture_contact = True

    def reset(self) -> None:
        """Discard the tracked contact."""
        self._tracker.reset()


def _add_error(frame: ContactFrame, contact: Contact, shift: tuple[float, float, float]) -> None:
    """Include an error in the standard deviations of two contacts: the contact of a frame, and the tracked contact.

    Args:
        frame: The frame, which is changed.
        contact: The contact of the frame.
        shift: Changes of x and y, mm, and of the force, N, that one standard deviation of the error causes.
    """
    frame.contact = contact.widened(shift)
    if frame.tracking is not None and frame.tracking.tracked is not None:
        frame.tracking = structs.replace(frame.tracking, tracked=frame.tracking.tracked.widened(shift))


class ChargeScaleStage(ContactStage):
    """Increases the standard deviations of a contact if the common scale of all charges is uncertain.

    The scale is uncertain if the memory of the film is not known exactly.
    """

    def __init__(self, model: CurrentModel) -> None:
        """Begin without a sensitivity.

        Args:
            model: The current model, with which the sensitivity of the contact is computed.
        """
        self._model = model
        self.reset()

    def step(self, frame: ContactFrame) -> None:
        """Add the error of the common scale to the standard deviations of the contact and of the tracked contact."""
        if frame.contact is None:
            return
        shift = self._shift(frame, frame.contact)
        if shift is None:
            return
        _add_error(frame, frame.contact, shift)

    def reset(self) -> None:
        """Discard the sensitivity of the previous contact."""
        self._sensitivity = Sensitivity(CHARGE_SCALE_STEP)
        self._sensitivity_predictor = self._model.predictor

    def _shift(self, frame: ContactFrame, contact: Contact) -> tuple[float, float, float] | None:
        """Return the changes of x and y (mm) and of the force (N) that one standard deviation of the scale causes.

        The changes are computed from a second prediction with slightly larger charges. This is not possible for a
        contact of the mixture, which the model does not predict. For such a contact, only the force is assumed to
        depend on the scale: F is proportional to scale^p with the largest exponent p, so that dF = p F d(scale).

        Args:
            frame: The frame.
            contact: The contact of the frame.

        Returns:
            The changes; None if the scale is known exactly.
        """
        charge_scale_std = frame.reading.charge_scale_std  # relative standard deviation of the scale
        if frame.is_mixture_contact:
            return 0.0, 0.0, LARGEST_FORCE_EXPONENT * charge_scale_std * contact.force_N
        charge_pC = frame.model_charge_pC
        if charge_scale_std <= 0.0 or charge_pC is None:
            return None
        predictor = self._model.predictor
        if predictor is not self._sensitivity_predictor:  # the sensitivity was computed with another model
            self.reset()
        scaled_pC = charge_pC * (1.0 + CHARGE_SCALE_STEP)
        # The second prediction is only made if the contact has moved since the previous one.
        return self._sensitivity.shift(contact, charge_scale_std, lambda: predictor.predict(scaled_pC))


class TouchOffsetRule(Rule, frozen=True, kw_only=True):
    """Description of an offset that all charges of a touch may have in common.

    Examples are a triboelectric and a pyroelectric charge.

    Attributes:
        std_pC: Standard deviation of the offset, pC. The offset is constant within a touch, and its mean is 0.
    """

    std_pC: Setting = 5.0


class TouchOffsetStage(ContactStage):
    """Increases the standard deviations of a contact, because the charges of its touch may have a common offset.

    An offset shifts light presses more than strong presses. The standard deviations of a contact of the mixture are not
    changed. The sensitivity is computed with the model, and the model does not predict this contact.
    """

    def __init__(self, model: CurrentModel, rule: TouchOffsetRule, warming_ratio: Array | float) -> None:
        """Begin without a sensitivity.

        Args:
            model: The current model, with which the sensitivity of the contact is computed.
            rule: Settings.
            warming_ratio: Charge that the offset adds to each electrode, relative to the common offset, shape
                (n_electrode,), or one number for all electrodes.
        """
        self._model = model
        self._rule = rule
        self._warming_ratio = warming_ratio
        self.reset()

    def step(self, frame: ContactFrame) -> None:
        """Add the error of the common offset to the standard deviations of the contact and of the tracked contact.

        The error is computed from a second prediction with charges that are shifted by an offset. A contact of the
        mixture is not changed, because the model does not predict it.
        """
        charge_pC = frame.model_charge_pC
        contact = frame.contact
        if contact is None or charge_pC is None or frame.is_mixture_contact:
            return
        predictor = self._model.predictor
        if predictor is not self._sensitivity_predictor:  # the sensitivity was computed with another model
            self.reset()
        shifted_pC = charge_pC + TOUCH_OFFSET_STEP_pC * self._warming_ratio
        # The second prediction is only made if the contact has moved since the previous one.
        shift = self._sensitivity.shift(contact, self._rule.std_pC, lambda: predictor.predict(shifted_pC))
        _add_error(frame, contact, shift)

    def reset(self) -> None:
        """Discard the sensitivity of the previous contact."""
        self._sensitivity = Sensitivity(TOUCH_OFFSET_STEP_pC)
        self._sensitivity_predictor = self._model.predictor
