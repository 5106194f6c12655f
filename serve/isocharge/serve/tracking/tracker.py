"""Tracking of a contact over successive frames: its position, force and velocity, and the events of the touch.

On most films, a `ContactFilter` smooths the contacts that a model predicts. If the map from contacts to charges has a
fold, a model predicts only the contacts on one side of the fold. On such a film, a `ContactMixture` estimates the
contact directly from the charges.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from isocharge.serve.frames.frame import Frame
from isocharge.serve.model.charge_file import read_charge_map
from isocharge.serve.model.contact import disk_corners
from isocharge.serve.record.record import OtherContact, TrackedContact
from isocharge.serve.signal_chain.stage import Rule, Setup, Share, Stage
from isocharge.serve.tracking.contact_mixture import ContactMixture
from isocharge.serve.tracking.film_follower import FollowRule
from isocharge.serve.tracking.motion_filter import ContactFilter, MAX_GAP_s

SLIDE_PROBABILITY = 0.95
"""Probability of a movement above which the contact may slide."""

HOLD_TIME_s = 0.2
"""Time at rest after which a hold begins, and longest duration of a tap, s."""

SLIDE_DISTANCE_mm = 0.3
"""Distance from the latest rest position above which a moving contact slides, mm."""

REST_PROBABILITY = 0.5
"""Probability of a movement below which the contact is at rest."""


class TouchEvents:
    """Detector that derives the events of one touch from the tracked contacts of its frames."""

    def __init__(self, tracked: TrackedContact, t_s: float) -> None:
        """Begin a touch, whose first event is always `press`.

        Args:
            tracked: Tracked contact of the first frame of the touch.
            t_s: Time of the frame, s.
        """
        self._press_s = t_s
        self._rest_position = complex(tracked.x_mm, tracked.y_mm)  # where the contact last rested, mm
        self._rest_begin_s = t_s  # time at which the contact began to rest at this position
        self._latest_event = "press"

    def step(self, tracked: TrackedContact, t_s: float) -> str | None:
        """Return the event that begins with the next frame of a touch, or None if no event begins.

        A slide begins when the contact moves and has left its latest rest position. A hold begins when the contact has
        rested at one position for `HOLD_TIME_s`. No event occurs twice in succession. If it is uncertain whether the
        contact moves or rests, no event begins.

        Args:
            tracked: Tracked contact of the frame. Its attribute `moving` is the probability that the contact moves, not
                a truth value.
            t_s: Time of the frame, s.
        """
        position = complex(tracked.x_mm, tracked.y_mm)
        is_away = abs(position - self._rest_position) > SLIDE_DISTANCE_mm
        if tracked.moving > SLIDE_PROBABILITY:
            if is_away and self._latest_event != "slide":
                self._latest_event = "slide"
                return "slide"
        elif tracked.moving < REST_PROBABILITY:
            if is_away:  # the contact rests at another position than before
                self._rest_position = position
                self._rest_begin_s = t_s
            elif self._latest_event != "hold" and t_s - self._rest_begin_s >= HOLD_TIME_s:
                self._latest_event = "hold"
                return "hold"
        return None

    def end(self, t_s: float) -> str:
        """Return the event with which the touch ends: `tap` or `release`.

        A touch ends with a tap if the touch was short, and no other event has followed the press.

        Args:
            t_s: Time of the first frame without a contact, s.
        """
        is_short = t_s - self._press_s <= HOLD_TIME_s
        if self._latest_event == "press" and is_short:
            return "tap"
        return "release"


class TrackRule(Rule, frozen=True, kw_only=True):
    """Settings of the tracking, from the section `[track]` of a device file.

    Attributes:
        lasting: Standard deviation of the errors that are the same in every frame of a held contact, divided by the
            standard deviation that the model states, 0 to below 1. The default of 0.12 was measured for the
            approximation errors of a model. If the gains are known to only a few percent, set `lasting` to 0.99.
    """

    lasting: Share = 0.12


class Tracker(Stage):
    """Tracks the contact from frame to frame.

    On some films, several different contacts cause the same charges. The folder of the model of such a film contains
    the file `charges.npz`, which describes the charges of all contacts. The tracker then uses a mixture of Gaussian
    components that represents all possible contacts, and the most probable contact replaces the contact of the model.
    While the film is followed, the tracker uses no mixture, because the file describes the charges at the calibrated
    pretension.
    """

    section = "track"
    rule_class = TrackRule
    needs_contact = True

    def __init__(self, setup: Setup) -> None:
        """Start without a contact.

        Raises:
            ModelError: If the file `charges.npz` of the model is damaged.
        """
        # By default, each touch gets a filter of the predicted contacts. `lasting` is the standard deviation of the
        # errors that remain the same while a contact is held, divided by that of all errors. `_new_filter` is a
        # function that creates a filter.
        rule = setup.device.rule(TrackRule) or TrackRule()
        constant_variance_share = rule.lasting**2
        self._new_filter: Callable[[], ContactFilter | ContactMixture] = partial(ContactFilter, constant_variance_share)

        # If the film is not followed, and different contacts have the same charges (`is_folded`), each touch gets a
        # mixture instead. `FollowRule` is the section of the device file with which the film is followed.
        predictor = setup.predictor
        if predictor is not None and setup.device.rule(FollowRule) is None:
            charges = read_charge_map(predictor.folder, predictor.metadata.electrodes)  # None without the file
            if charges is not None and charges.is_folded:
                # The mixture does not use the predicted contacts. Its contacts are therefore valid wherever the file
                # describes the charges, and not only in the working area of the model.
                validity = replace(predictor.validity, corners_mm=disk_corners(charges.domain.radius))
                self._new_filter = lambda: ContactMixture(charges, setup.model.noise, validity)
        # Time of the latest valid frame, which is the sum of the time steps and therefore never set back
        self._time_s = 0.0
        self._events: TouchEvents | None = None  # None without a touch
        self.reset()

    def reset(self) -> None:
        """Discard the tracked contact, for example after an outage or a new tare.

        A touch that has begun ends with the next valid frame without a contact.
        """
        self._filter: ContactFilter | ContactMixture | None = None  # None without a contact
        self._tracked: TrackedContact | None = None
        self._other: OtherContact | None = None  # another contact that also explains the charges

    def step(self, frame: Frame) -> None:
        """Update the tracked contact with a frame, and add the tracked contact and its event to the frame.

        If another contact explains the charges as well, the frame also gets this contact, as the attribute `other`.

        The previous tracked contact is used again if the frame is invalid, or if the filter returns no contact. If more
        than `MAX_GAP_s` have passed without a contact, a new filter begins. If the clock was set back, the touch
        continues, because `dt_s` is then 0.
        """
        if frame.is_valid:
            self._time_s += frame.dt_s
        if frame.contact is not None:  # the touch begins or continues
            if self._filter is None or self._time_s - self._filter.time_s > MAX_GAP_s:
                self._filter = self._new_filter()
            tracked = self._filter.step(frame, self._time_s)
            if tracked is not None:
                self._tracked = tracked
                self._other = self._filter.other
                if self._events is None:
                    self._events = TouchEvents(tracked, self._time_s)
                    frame.event = "press"
                else:
                    frame.event = self._events.step(tracked, self._time_s)
        elif frame.is_valid:  # nothing touches the film, so a touch that had begun has ended
            if self._events is not None:
                frame.event = self._events.end(self._time_s)
                self._events = None
            self.reset()
        frame.tracked = self._tracked
        frame.other = self._other
