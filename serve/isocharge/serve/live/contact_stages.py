"""Stages that compute the contact of a record from the touch charges of a frame."""

from abc import abstractmethod
from typing import ClassVar

from msgspec import structs

from isocharge.common.arrays import Array
from isocharge.serve.flags import FILM
from isocharge.serve.frames.frame import Frame
from isocharge.serve.model.contact import Contact, Sensitivity
from isocharge.serve.signal_chain.memory import MemoryRule
from isocharge.serve.signal_chain.rule import Rule, Setting, Share
from isocharge.serve.signal_chain.stage import Setup, Stage
from isocharge.serve.signal_chain.thermal import warming_ratios
from isocharge.serve.tracking.film_follower import FilmFollower, FollowRule

LARGEST_FORCE_EXPONENT = 1.5
"""Largest exponent p of the law that the force is proportional to the p-th power of the common scale of all charges.

The exponent has this value for a film without pretension, and is smaller for a film with pretension.
"""


class NoiseRule(Rule, frozen=True, kw_only=True):
    """Noise of the charges of a bench, from the section `[noise]` of a device file.

    The variance of the noise of a charge q is `white_pC`^2 + (`gain` q)^2.

    Attributes:
        white_pC: Standard deviation of the part that does not depend on the charge, pC.
        gain: Standard deviation of the part that is proportional to the charge, relative to the charge.
    """

    white_pC: Setting = 1.0
    gain: Share


class Prediction(Stage):
    """Predicts the contact of each frame with the present model, for the noise that the device file states."""

    section = "noise"
    rule_class = NoiseRule
    is_required = True
    needs_model = True
    needs_contact = True

    def __init__(self, setup: Setup) -> None:
        """Store the limits within which contacts are valid, which are those of the calibrated film."""
        self._setup = setup
        noise = setup.rule(NoiseRule)
        if noise is not None:
            setup.predictor = setup.model.with_noise(noise.white_pC, noise.gain)
        self._validity = setup.model.validity

    def step(self, frame: Frame) -> None:
        """Predict the contact of a frame, unless nothing touches the film or the frame has no charges."""
        if frame.charge_pC is None or not frame.is_contact:
            return
        predictor = self._setup.predictor
        assert predictor is not None
        frame.set_contact(predictor.predict(frame.charge_pC), self._validity)
        frame.model_charge_pC = frame.charge_pC


class FollowFilm(Stage):
    """Estimates the pretension of the film, and uses the model for the estimated pretension."""

    section = "follow"
    rule_class = FollowRule
    needs_contact = True

    def __init__(self, setup: Setup) -> None:
        """Begin with the pretension that the calibration of the film has found.

        Raises:
            ModelError: If the pretension of this film cannot be estimated with the model.
        """
        self._setup = setup
        predictor = setup.model
        self._validity = predictor.validity  # of the calibrated film
        self._follower = FilmFollower(predictor, setup.rule(FollowRule), warming_ratios(setup))

    def step(self, frame: Frame) -> None:
        """Correct the contact for the estimated pretension of the film, and then update the estimate with the frame.

        An invalid frame does not change the estimate, because it does not show whether the touch has ended.

        The model for the new estimate is used from the next frame on. If the pretension can no longer be estimated,
        every frame with a contact gets the flag `film`.
        """
        # Correct the contact with the estimate from the earlier frames. The frame reports this estimate.
        follower = self._follower
        if frame.contact is not None and frame.charge_pC is not None:
            corrected = follower.follow_contact(frame.contact, frame.charge_pC)
            frame.set_contact(corrected.contact, self._validity)
            frame.model_charge_pC = corrected.charge_pC
        frame.film = follower.film
        if not frame.is_valid:
            return

        # Update the estimate, and use its model for the next frame.
        flags = (*frame.flags, *frame.contact_flags)
        follower.observe_frame(frame.charge_pC, frame.contact, flags, frame.clock_s)
        self._setup.predictor = follower.predictor
        if frame.contact is not None and follower.is_lost:
            frame.flags.append(FILM)

    def reset(self) -> None:
        """Discard the state of the present touch. The estimated pretension is not changed."""
        self._follower.discard_touch()

    def reset_film(self) -> None:
        """Reset the estimate of the pretension to the pretension that the calibration of the film has found."""
        self._follower.reset()
        self._setup.predictor = self._follower.predictor


class Widening(Stage):
    """Adds the effect of an error that all frames of a touch have in common to the standard deviations of a contact.

    The effect is computed from a second prediction with changed charges. A second prediction is only computed if the
    contact has moved, or if another model is used.
    """

    needs_contact = True
    step_size: ClassVar[float]

    def __init__(self, setup: Setup) -> None:
        """Begin without a contact."""
        self._setup = setup
        self.reset()

    def reset(self) -> None:
        """Discard the sensitivity of the previous contact."""
        self._sensitivity = Sensitivity(self.step_size)
        self._sensitivity_predictor = self._setup.predictor

    def step(self, frame: Frame) -> None:
        """Add the effect of the error to the standard deviations of the contact and of the tracked contact."""
        if frame.contact is None:
            return
        shift = self._shift(frame, frame.contact)
        if shift is None:
            return
        frame.contact = frame.contact.widened(shift)
        if frame.tracking is not None and frame.tracking.tracked is not None:
            frame.tracking = structs.replace(frame.tracking, tracked=frame.tracking.tracked.widened(shift))

    @abstractmethod
    def _error(self, frame: Frame, charge_pC: Array) -> tuple[float, Array]:
        """Return the standard deviation of the error, and the charges that an error of the size `step_size` changes.

        Args:
            frame: The frame.
            charge_pC: Charges from which the model has predicted the contact, shape (n_electrode,), pC.
        """

    def _shift(self, frame: Frame, contact: Contact) -> tuple[float, float, float] | None:
        """Return how much the contact changes if the error has the size of one standard deviation.

        Args:
            frame: The frame.
            contact: The contact of the frame.

        Returns:
            Changes of x, mm, of y, mm, and of the force, N. None if there is no error, or if the model has not
            predicted the contact, so that the effect is not known.
        """
        if frame.model_charge_pC is None:
            return None
        std, changed_pC = self._error(frame, frame.model_charge_pC)
        if std <= 0.0:
            return None
        predictor = self._setup.model
        if predictor is not self._sensitivity_predictor:
            self.reset()
        return self._sensitivity.shift(contact, std, lambda: predictor.predict(changed_pC))


class ChargeScale(Widening):
    """Adds the uncertainty of the common factor of all charges to the standard deviations of a contact.

    The factor is uncertain if the parameters of the film's memory, which changes the charges of a held press, are not
    known exactly.
    """

    rule_class = MemoryRule
    step_size = 0.01

    def _error(self, frame: Frame, charge_pC: Array) -> tuple[float, Array]:
        return frame.charge_scale_std, charge_pC * (1.0 + self.step_size)

    def _shift(self, frame: Frame, contact: Contact) -> tuple[float, float, float] | None:
        """Return how much the contact changes if the factor is wrong by one standard deviation.

        If the contact comes from the mixture of the tracker, only its force F is assumed to depend on the factor: F is
        proportional to scale^p, with the exponent p = `LARGEST_FORCE_EXPONENT`. A small relative change of the scale
        then changes F by p F times this relative change.
        """
        if frame.model_charge_pC is None:
            return 0.0, 0.0, LARGEST_FORCE_EXPONENT * frame.charge_scale_std * contact.force_N
        return super()._shift(frame, contact)


class TouchOffsetRule(Rule, frozen=True, kw_only=True):
    """Settings that describe a common offset of all charges of a touch.

    A triboelectric charge or a pyroelectric charge can cause a common offset.

    Attributes:
        std_pC: Standard deviation of the offset, pC. The offset is constant during a touch, and its mean over many
            touches is 0.
    """

    std_pC: Setting = 5.0


class TouchOffset(Widening):
    """Adds the uncertainty of a common offset of all charges to the standard deviations of a contact.

    A common offset changes the contact of a light press more than the contact of a strong press. If a contact comes
    from the mixture of the tracker, its standard deviations are not changed.
    """

    section = "touch_offset"
    rule_class = TouchOffsetRule
    step_size = 1.0

    def __init__(self, setup: Setup) -> None:
        """Begin without a contact."""
        super().__init__(setup)
        self._rule = setup.rule(TouchOffsetRule) or TouchOffsetRule()
        self._offset_ratio = warming_ratios(setup)

    def _error(self, frame: Frame, charge_pC: Array) -> tuple[float, Array]:  # noqa: ARG002
        return self._rule.std_pC, charge_pC + self.step_size * self._offset_ratio
