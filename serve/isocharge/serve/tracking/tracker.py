"""A contact followed from frame to frame: place, force and velocity, less noisy than a frame, and what the touch does.

Two filters of `modes`, one for the place and one for ln F, take in each frame's answer with its covariance. A part of
the model's errors is the same in every frame of a held contact (its own errors, gains): it is kept out of the filters
and added to what they say, so that the deviations stay true. Frames that are saturated, beyond the model or of a large
misfit count for less, one that is far from this contact not at all; two of these in a row are another contact.

Where the map from contacts to charges folds, `branches` follow the contact by its charges instead.
"""

import math

from isocharge.common.arrays import Array
from isocharge.serve.flags import BEYOND, INVALID, MISFIT, SATURATED
from isocharge.serve.prediction.contact import Contact
from isocharge.serve.record.record import OtherContact, TrackedContact
from isocharge.serve.signal_chain.rule import Rule, Share
from isocharge.serve.tracking.branches import Branch, Branches
from isocharge.serve.tracking.modes import Modes, Movement
from isocharge.serve.tracking.noise import LINE, Shape

PLACE = Movement(creep=5e-4, speed=30.0**2, change=800.0)
"""A finger: 0.02 mm in a second while it holds still, speeds of 30 mm/s; what moves so fast is 28 mm/s faster or slower
after a second, others in proportion to their speed, and 13 mm/s at least."""

FORCE = Movement(creep=5e-4, speed=10.0**2, change=1e3)
"""A held force wanders by 2 % in a second; one that changes becomes e times as large in a tenth of a second."""

DOUBTS = {SATURATED: 100.0, BEYOND: 100.0, MISFIT: 10.0}
"""Flags of frames that count for less, with the factor on their variance."""

FAR_FRAMES = 2
"""Frames in a row that are none of this contact, after which it is another one."""

FASTEST_MM_S = 300.0
"""Speed up to which a contact that moves suddenly is the same one, followed from there, and no frame far off."""

LONGEST_STEP_S = 1.0
"""Time without a frame after which nothing of the contact is known any more, s."""

HOLD_S, TAP_S = 0.2, 0.25
"""Time at rest that makes a hold; longest time of a tap, s."""

SLIDE_MM, MOVES = 0.3, 0.95
"""Distance from the place of rest, and probability of the moving mode, that make a slide."""


KNOWN = 0.97
"""Probability from which on a contact is known, and no other is said."""


class TrackRule(Rule, frozen=True, kw_only=True):
    """How contacts are followed; the section `[track]` of a device file.

    Attributes:
        lasting: Part of the model's deviations that is the same in every frame of a held contact, 0 to 1: 0.12 are the
            model's own errors (measured); nearly 1 where gains are known to some percent.
    """

    lasting: Share = 0.12


class Tracker:
    """Follows one contact at a time; belongs to one thread. The same frames give the same answers, bit for bit.

    Attributes:
        branches: What follows the contact by its charges where the map folds; None where it does not.
        answer: Where the map folds, the contact in the place of the model's, which knows one side alone; else None.
        other: What the contact may be besides; None where it is known, as it is wherever the map does not fold.
    """

    def __init__(self, rule: TrackRule | None = None, branches: Branches | None = None) -> None:
        """Begin without a contact; by default with the settings of an empty section, and of a film without folds."""
        self._lasting, self.branches = (rule or TrackRule()).lasting ** 2, branches
        self.forget()

    def forget(self) -> None:
        """Forget the contact, as after an outage or a new tare."""
        self._of_place, self._of_force = Modes.start(0j, 1.0, PLACE), Modes.start(0.0, 1.0, FORCE)
        self._last: TrackedContact | None = None
        self.answer: Contact | None = None
        self.other: OtherContact | None = None
        if self.branches is not None:
            self.branches.forget()
        self._far, self._t_s = 0, 0.0
        self._began_s = self._rest_s = 0.0
        self._rest, self._state = 0j, ""

    def update(
        self, contact: Contact | None, t_s: float, flags: tuple[str, ...] = (), charge_pC: Array | None = None
    ) -> tuple[TrackedContact | None, str | None]:
        """Take the next frame in.

        Args:
            contact: The model's answer; None if nothing touches, or nothing was computed.
            t_s: Time of the frame, s, on any clock.
            flags: Of the frame.
            charge_pC: Its touch charges, shape (n_electrode,), pC: needed where the map folds.

        Returns:
            The contact by now, None if nothing touches or no contact explains the charges; and which of `press`,
            `hold`, `slide`, `tap` and `release` this frame begins with.
        """
        self.answer = None
        if contact is None:
            if INVALID in flags:
                return self._last, None
            if self._last is None:
                if self.branches is not None:
                    self.branches.forget()
                return None, None
            ended = "tap" if self._state == "press" and t_s - self._began_s <= TAP_S else "release"
            self.forget()
            return None, ended
        began = self._last is None
        if began:
            self._began_s = t_s
        if self.branches is None or charge_pC is None:
            tracked = self._advance(contact, t_s, flags)
        elif SATURATED in flags or not (found := self.branches.update(charge_pC, t_s)):
            return self._last, None
        else:
            self.answer, self.other = found[0].contact, _other(found)
            vx, vy = found[0].mean[3:5].tolist()
            tracked = TrackedContact(*self.answer[:6], vx, vy, found[0].moves)
        event = self._event(tracked, t_s, began=began)
        self._last = tracked
        return tracked, event

    def _advance(self, contact: Contact, t_s: float, flags: tuple[str, ...]) -> TrackedContact:
        x, y, force, x_std, y_std, force_std, _, correlation, _, _ = contact
        place, force = complex(x, y), force if force > 1e-6 else 1e-6
        log_force, relative = math.log(force), force_std / force
        correlation = correlation if correlation == correlation else 0.0  # a model may give none
        shape, variance = Shape.of_place(x_std, y_std, correlation)
        white = 1.0 - self._lasting
        for flag in flags:
            white *= DOUBTS.get(flag, 1.0)
        place_white, force_white = white * variance, white * relative * relative
        of_place, of_force, by_place, by_force = self._of_place, self._of_force, None, None
        dt_s = t_s - self._t_s
        if self._last is not None and 0.0 < dt_s <= LONGEST_STEP_S:
            by_place = of_place.step(place, dt_s, shape, place_white)
            if by_place is not None:
                by_force = of_force.step(log_force, dt_s, LINE, force_white)
            else:
                way_mm = abs(place - complex(self._last.x_mm, self._last.y_mm))
                self._far = 0 if way_mm < FASTEST_MM_S * dt_s else self._far + 1
                if 0 < self._far < FAR_FRAMES:
                    return self._last
        if by_place is None:
            self._of_place = of_place = Modes.start(place, place_white, PLACE)
            by_place = place, place_white
        if by_force is None:  # a force that jumps begins anew alone
            self._of_force, by_force = Modes.start(log_force, force_white, FORCE), (log_force, force_white)
        self._far, self._t_s = 0, t_s
        (place, spread), (mean, force_spread) = by_place, by_force
        share, force = math.sqrt(spread / variance + self._lasting), math.exp(mean.real)
        velocity = of_place.moving * of_place.velocity
        return TrackedContact(
            place.real,
            place.imag,
            force,
            x_std * share,
            y_std * share,
            force * math.sqrt(force_spread + relative * relative * self._lasting),
            velocity.real,
            velocity.imag,
            of_place.moving,
        )

    def _event(self, tracked: TrackedContact, t_s: float, *, began: bool) -> str | None:
        """What begins with this frame."""
        place = complex(tracked.x_mm, tracked.y_mm)
        if began:
            self._rest, self._rest_s, self._state = place, t_s, "press"
            return "press"
        if tracked.moving > MOVES:
            if self._state != "slide" and abs(place - self._rest) > SLIDE_MM:
                self._state = "slide"
                return "slide"
        elif tracked.moving < 0.5:
            if abs(place - self._rest) > SLIDE_MM:
                self._rest, self._rest_s = place, t_s
            elif self._state != "hold" and t_s - self._rest_s >= HOLD_S:
                self._state = "hold"
                return "hold"
        return None


def _other(found: list[Branch]) -> OtherContact | None:
    if found[0].probability > KNOWN or len(found) == 1:
        return None
    return OtherContact(*found[1].contact[:3], found[1].probability)
