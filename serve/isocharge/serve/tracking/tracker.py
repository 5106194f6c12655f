"""Tracking of a contact from frame to frame: its position, force and velocity, and the events of the touch.

A `ContactFilter` smooths the contacts that a model predicts. If the map from contacts to charges has a fold, the model
describes only the contacts on one side of the fold. For such films, a `ContactMixture` follows the contact by the
charges instead.
"""

from isocharge.common.arrays import Array
from isocharge.serve.flags import INVALID, SATURATED
from isocharge.serve.prediction.contact import Contact
from isocharge.serve.record.record import OtherContact, TrackedContact
from isocharge.serve.signal_chain.rule import Rule, Share
from isocharge.serve.tracking.contact_filter import ContactFilter
from isocharge.serve.tracking.contact_mixture import ContactMixture
from isocharge.serve.tracking.mixture_components import ContactHypothesis
from isocharge.serve.tracking.touch_events import TouchEvents

CERTAIN_PROBABILITY = 0.97
"""Probability of a contact above which no other contact is reported."""


class TrackRule(Rule, frozen=True, kw_only=True):
    """Settings of the tracking; the section `[track]` of a device file.

    Attributes:
        lasting: Share of the standard deviations stated by the model that is the same in every frame of a held contact,
            0 to 1. The default of 0.12 is the measured share of the approximation errors of a model. If the gains are
            known to only a few percent, set this to about 1.
    """

    lasting: Share = 0.12


class Tracker:
    """Tracks one contact at a time.

    A tracker belongs to one thread. The same frames give the same results, bit for bit.

    Attributes:
        mixture: The mixture that follows the contact by its charges; None for a film whose map has no fold.
        mixture_contact: The contact of the latest frame as estimated by the mixture. It replaces the contact of the
            model. None without a mixture.
        other: Another contact that also explains the charges; None if there is no such contact, or without a mixture.
    """

    def __init__(self, rule: TrackRule | None = None, mixture: ContactMixture | None = None) -> None:
        """Begin without a contact.

        Args:
            rule: Settings; by default the default values of all settings.
            mixture: The mixture for a film whose map has a fold; None for other films.
        """
        rule = rule or TrackRule()
        self.mixture = mixture
        self._filter = ContactFilter(constant_variance_share=rule.lasting**2)
        self.reset()

    def reset(self) -> None:
        """Discard the contact, as after an outage or a new tare."""
        self.mixture_contact: Contact | None = None
        self.other: OtherContact | None = None
        self._tracked: TrackedContact | None = None
        self._filter.reset()
        self._events = TouchEvents()
        if self.mixture is not None:
            self.mixture.reset()

    def update(
        self, contact: Contact | None, t_s: float, flags: tuple[str, ...] = (), charge_pC: Array | None = None
    ) -> tuple[TrackedContact | None, str | None]:
        """Process the next frame.

        On most films, a filter smooths the contacts that the model predicts. On a film on which several contacts may
        have the same charges, a mixture tracks these contacts by the charges themselves.

        Args:
            contact: Contact predicted by the model; None if nothing touches, or the frame is invalid.
            t_s: Time of the frame on any clock, s.
            flags: Flags of the frame.
            charge_pC: Touch charges of the frame, shape (n_electrode,), pC; only needed with a mixture.

        Returns:
            The tracked contact, and the event that begins with this frame. The contact is None if nothing touches, or
            if no contact has explained the charges since the touch began. The event is `press`, `hold`, `slide`, `tap`
            or `release`; None if no event begins.
        """
        self.mixture_contact = None
        if contact is None:
            if INVALID in flags:  # an invalid frame does not end a touch
                return self._tracked, None
            return None, self._end_touch(t_s)

        if self.mixture is None or charge_pC is None:
            tracked = self._filter.step(contact, t_s, flags)
        else:
            hypotheses: list[ContactHypothesis] = []  # possible contacts, the most probable first
            if SATURATED not in flags:
                hypotheses = self.mixture.update(charge_pC, t_s)
            if not hypotheses:  # the frame contains no information, so that the previous contact stays
                return self._tracked, None
            self.mixture_contact = hypotheses[0].contact
            self.other = _other_contact(hypotheses)
            tracked = _tracked_contact(hypotheses[0], self.mixture_contact)

        is_new_touch = self._tracked is None
        self._tracked = tracked
        if is_new_touch:
            return tracked, self._events.begin(tracked, t_s)
        return tracked, self._events.step(tracked, t_s)

    def _end_touch(self, t_s: float) -> str | None:
        """Discard the contact, and return the event with which its touch ends; None if there was no touch."""
        if self._tracked is None:
            # The mixture may have received charges that no contact explains. Discard them before the next touch.
            if self.mixture is not None:
                self.mixture.reset()
            return None
        event = self._events.end(t_s)
        self.reset()  # afterwards, because it also discards the events
        return event


def _tracked_contact(hypothesis: ContactHypothesis, contact: Contact) -> TrackedContact:
    """Return a hypothesis as a tracked contact.

    Args:
        hypothesis: A contact that explains the charges.
        contact: The contact of the hypothesis.
    """
    vx_mm_s, vy_mm_s = hypothesis.velocity_mm_per_s
    return TrackedContact(
        x_mm=contact.x_mm,
        y_mm=contact.y_mm,
        force_N=contact.force_N,
        x_std_mm=contact.x_std_mm,
        y_std_mm=contact.y_std_mm,
        force_std_N=contact.force_std_N,
        vx_mm_s=vx_mm_s,
        vy_mm_s=vy_mm_s,
        moving=hypothesis.moving_probability,
    )


def _other_contact(hypotheses: list[ContactHypothesis]) -> OtherContact | None:
    """Return the second most probable contact; None if the most probable contact is certain.

    Args:
        hypotheses: The contacts that explain the charges, in descending order of their probability.
    """
    if len(hypotheses) == 1 or hypotheses[0].probability > CERTAIN_PROBABILITY:
        return None
    _, second, *_ = hypotheses
    contact = second.contact
    return OtherContact(contact.x_mm, contact.y_mm, contact.force_N, second.probability)
