"""Tracking of a contact over successive frames: its position, force and velocity, and the events of the touch.

On most films, a `ContactFilter` smooths the contacts that a model predicts. If the map from contacts to charges has a
fold, a model predicts only the contacts on one side of the fold. On such a film, a `ContactMixture` estimates the
contact directly from the charges.
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
    """Settings of the tracking, from the section `[track]` of a device file.

    Attributes:
        lasting: Standard deviation of the errors that are the same in every frame of a held contact, divided by the
            standard deviation that the model states, 0 to 1. The default of 0.12 was measured for the approximation
            errors of a model. If the gains are known to only a few percent, set this to about 1.
    """

    lasting: Share = 0.12


class Tracker:
    """Tracker of one contact, which processes the frames one after another.

    The methods must be called from one thread. The same sequence of frames always gives bitwise equal results.

    Attributes:
        mixture: Mixture that estimates the contact from the charges; None for a film whose map has no fold.
        mixture_contact: Contact that the mixture estimated for the latest frame. It replaces the contact that the model
            predicted. None if there is no mixture, or if the mixture has no estimate.
        other: Another contact that also explains the charges; None if there is no such contact, or no mixture.
    """

    def __init__(self, rule: TrackRule | None = None, mixture: ContactMixture | None = None) -> None:
        """Start without a contact.

        Args:
            rule: Settings; None for the default value of every setting.
            mixture: Mixture for a film whose map has a fold; None for other films.
        """
        rule = rule or TrackRule()
        self.mixture = mixture
        self._filter = ContactFilter(constant_variance_share=rule.lasting**2)
        self.reset()

    def reset(self) -> None:
        """Discard the tracked contact, for example after an outage or a new tare."""
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
        """Process the next frame, and return the tracked contact and the event that begins with this frame.

        Without a mixture or without charges, a filter smooths the contact that the model predicted. With a mixture, the
        tracked contact is the most probable of the contacts that the mixture estimates from the charges. The previous
        tracked contact is returned again if the frame is invalid, if its charges are saturated, or if no contact
        explains them.

        If the clock was set back, the filter or the mixture begins again with the frame, but the touch continues. The
        time between the two frames is then not counted for the events.

        Args:
            contact: Contact predicted by the model; None if nothing touches the film, or if the frame is invalid.
            t_s: Time of the frame on any clock, s.
            flags: Flags of the frame.
            charge_pC: Touch charges of the frame, shape (n_electrode,), pC; only needed with a mixture.

        Returns:
            The tracked contact, and the event that begins with this frame. The contact is None if nothing touches the
            film, or if the touch has not yet had a tracked contact. The event is `press`, `hold`, `slide`, `tap` or
            `release`; None if no event begins.
        """
        self.mixture_contact = None
        if contact is None:
            if INVALID in flags:  # an invalid frame does not show whether the touch has ended
                return self._tracked, None
            return None, self._end_touch(t_s)

        if self.mixture is None or charge_pC is None:
            tracked = self._filter.step(contact, t_s, flags)
        else:
            hypotheses: list[ContactHypothesis] = []  # possible contacts, the most probable first
            if SATURATED not in flags:  # the charges of a saturated frame are wrong
                hypotheses = self.mixture.update(charge_pC, t_s)
            if not hypotheses:  # the frame contains no information, so the previous contact is returned again
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
        """Discard the tracked contact, and return the event with which its touch ends.

        Args:
            t_s: Time of the first frame without a contact, s.

        Returns:
            The event `tap` or `release`; None if there was no touch.
        """
        if self._tracked is None:
            # The mixture may have received charges that no contact explains. Discard them before the next touch.
            if self.mixture is not None:
                self.mixture.reset()
            return None
        event = self._events.end(t_s)
        self.reset()  # only now, because `reset` also discards the events of the touch
        return event


def _tracked_contact(hypothesis: ContactHypothesis, contact: Contact) -> TrackedContact:
    """Convert a hypothesis of the mixture to a tracked contact.

    Args:
        hypothesis: Hypothesis that explains the charges, which contains the velocity of the contact.
        contact: The attribute `contact` of the hypothesis, which is passed because it is expensive to compute again.
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
    """Return the second most probable contact, or None if the most probable contact is nearly certain.

    Args:
        hypotheses: The contacts that explain the charges, at least one, in descending order of their probability.
    """
    most_probable = hypotheses[0]
    if len(hypotheses) == 1 or most_probable.probability > CERTAIN_PROBABILITY:
        return None
    second_most_probable = hypotheses[1]
    contact = second_most_probable.contact
    return OtherContact(contact.x_mm, contact.y_mm, contact.force_N, second_most_probable.probability)
