"""Stages that compute the contact of a record from the touch charges of a frame."""

from isocharge.serve.flags import FILM
from isocharge.serve.frames.frame import Frame
from isocharge.serve.signal_chain.rule import Rule, Setting, Share
from isocharge.serve.signal_chain.stage import Setup, Stage
from isocharge.serve.signal_chain.thermal import warming_ratios
from isocharge.serve.tracking.film_follower import FilmFollower, FollowRule


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


class FollowFilm(Stage):
    """Estimates the pretension of the film, and corrects contacts for the estimated pretension."""

    section = "follow"
    rule_class = FollowRule
    needs_contact = True

    def __init__(self, setup: Setup) -> None:
        """Begin with the pretension that the calibration of the film has found.

        Raises:
            ModelError: If the pretension of this film cannot be estimated with the model.
        """
        predictor = setup.model
        self._validity = predictor.validity  # of the calibrated film
        self._follower = FilmFollower(predictor, setup.rule(FollowRule), warming_ratios(setup))

    def step(self, frame: Frame) -> None:
        """Correct the contact for the estimated pretension of the film, and then update the estimate with the frame.

        An invalid frame does not change the estimate, because it does not show whether the touch has ended. If the
        pretension can no longer be estimated, every frame with a contact gets the flag `film`.
        """
        # Correct the contact with the estimate from the earlier frames. The frame reports this estimate.
        follower = self._follower
        if frame.contact is not None and frame.charge_pC is not None:
            frame.set_contact(follower.follow_contact(frame.contact, frame.charge_pC), self._validity)
        frame.film = follower.film
        if not frame.is_valid:
            return

        # Update the estimate.
        flags = (*frame.flags, *frame.contact_flags)
        follower.observe_frame(frame.charge_pC, frame.contact, flags, frame.clock_s)
        if frame.contact is not None and follower.is_lost:
            frame.flags.append(FILM)

    def reset(self) -> None:
        """Discard the state of the present touch. The estimated pretension is not changed."""
        self._follower.discard_touch()
