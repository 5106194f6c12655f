"""The dialogue at the bench: says what to press, takes the press when it is steady, asks whether it was there.

A machine that makes the presses of a list is asked nothing: its presses are taken in their order.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from isocharge.cli.train.bench.events import Ended, Typed
from isocharge.common.errors import InputError, PortLost, PressError

if TYPE_CHECKING:
    from isocharge.cli.train.bench.screen import Screen
    from isocharge.common.arrays import Array
    from isocharge.serve import SteadyPress
    from isocharge.serve.live.steady_press import Watched
    from isocharge.train import BenchSession
    from isocharge.train.calibration.session import Answer

QUESTION = '   There, and as hard? Enter: yes; or type "x y force" (? is unknown), s: skip, u: undo, q: end'

KEYS = "   (type s to skip this place, u to undo the last press, q to end)"

Taken = Callable[["BenchSession", "SteadyPress"], None]
"""Called after each press that is in the session."""


class Events(Protocol):
    """As `BenchEvents`."""

    def arm(self) -> None:
        """Take only presses that begin from now on."""

    def next(self) -> "Watched | Typed | Ended":
        """The next event."""


class Stopped(Exception):
    """The person ends the session, or the input or the port is over."""


class Dialogue:
    """One session, from the first press to the last."""

    def __init__(self, session: "BenchSession", events: Events, screen: "Screen", taken: Taken) -> None:
        """Put the parts together.

        Args:
            session: What is proposed and known.
            events: Of port and keyboard.
            screen: For people.
            taken: Called after each press.
        """
        self._session, self._events, self._screen, self._taken = session, events, screen, taken

    def with_person(self, *, asks: bool = True) -> None:
        """Propose presses and take them until the film is known well enough, or the person ends.

        Args:
            asks: Whether to ask of each press whether it was where it should be; otherwise it was.
        """
        if asks:
            self._screen.say(KEYS)
        try:
            while not self._session.enough:
                self._one_press(asks=asks)
        except Stopped:
            return
        self._screen.say("The film is known well enough; --until 0 goes on.")

    def with_machine(self, contacts: "Array") -> None:
        """Take the presses that a machine makes, as they come.

        Args:
            contacts: (x_mm, y_mm, force_N), shape (n, 3), NaN where unknown; those in the session were made before.

        Raises:
            PortLost: If the port goes away: nobody knows then which press is next.
        """
        from isocharge.serve.live.steady_press import AWAY
        from isocharge.train.calibration.session import press_words

        first = _done(self._session, contacts)
        self._await_rest()
        for number, contact in enumerate(contacts[first:], start=first + 1):
            self._screen.say(f"{number}. {press_words(contact)}")
            outcome = self._outcome()
            if isinstance(outcome, str):
                if outcome == AWAY:
                    raise PortLost(
                        f"{AWAY}; let the machine go on with row {number} of its list, with the same command"
                    )
                self._screen.say(f"   row {number} is left out: {outcome}")
                continue
            self._screen.taken(outcome)
            self._take(outcome, contact)

    def _await_rest(self) -> None:
        """Wait for the tare: a press before would be lost, and all after it be taken for others."""
        while (event := self._next_reading()).phase != "waiting":
            self._screen.show(event)
        self._screen.say("the film is tared: let the machine begin")

    def _next_reading(self) -> "Watched":
        """The next reading; what is typed means nothing to a machine."""
        while True:
            event = self._events.next()
            if isinstance(event, Ended):
                raise event.error or InputError("the port ended before the last press of the list")
            if not isinstance(event, Typed):
                return event

    def _outcome(self) -> "SteadyPress | str":
        """The next press, or why it is refused."""
        while True:
            event = self._next_reading()
            if event.press is not None:
                return event.press
            if event.phase == "refused":
                return event.reason
            self._screen.show(event)

    def _one_press(self, *, asks: bool) -> None:
        """Propose a press until one is taken, or something else is to be proposed."""
        from isocharge.train.calibration.session import press_words

        proposed = self._session.proposed
        self._screen.say(f"{len(self._session) + 1}. Press {press_words(proposed.contact)} and hold.")
        self._events.arm()
        while (press := self._steady_press()) is None:
            if self._session.proposed is not proposed:
                return  # skipped, or another press was undone
            self._events.arm()
        if asks:
            self._ask(press, proposed.contact)
        else:
            self._take(press, proposed.contact)

    def _steady_press(self) -> "SteadyPress | None":
        """The next press; None where it is refused or the person wants something else."""
        while True:
            event = self._events.next()
            if isinstance(event, Typed):
                self._typed(event)
                return None
            if isinstance(event, Ended):
                if event.error:
                    raise event.error
                raise Stopped
            if event.press is not None:
                self._screen.taken(event.press)
                return event.press
            if event.phase == "refused":
                self._screen.say(f"   not taken: {event.reason}; press again")
                return None
            self._screen.show(event)

    def _typed(self, typed: Typed) -> None:
        """A line that is typed while a press is awaited."""
        answer = self._read(typed)
        if answer is None:
            return
        if answer.reply == "take":
            self._screen.say("   press first: the question comes when the press is steady")
            return
        self._obey(answer)

    def _ask(self, press: "SteadyPress", proposed: "Array") -> None:
        """Ask whether the press was where it should be, until it is taken or given up."""
        self._screen.say(QUESTION)
        while True:
            event = self._events.next()
            if isinstance(event, Ended):
                raise event.error or Stopped
            answer = self._read(event) if isinstance(event, Typed) else None
            if answer is None:
                continue
            if answer.reply == "take":
                if self._take(press, proposed if answer.contact is None else answer.contact):
                    return
            elif answer.reply == "undo" and answer.number is None:
                self._screen.say("   this press is not taken")
                return
            else:
                self._obey(answer)
                if answer.reply == "skip":
                    return

    def _read(self, typed: Typed) -> "Answer | None":
        from isocharge.train.calibration.session import read_answer

        if typed.text is None:
            raise Stopped
        try:
            return read_answer(typed.text)
        except PressError as error:
            self._screen.say(f"   {error}")
            return None

    def _obey(self, answer: "Answer") -> None:
        """Skip, undo or end."""
        if answer.reply == "quit":
            raise Stopped
        if answer.reply == "skip":
            self._session.skip()
            return
        try:
            number = self._session.undo(answer.number)
        except PressError as error:
            self._screen.say(f"   {error}")
            return
        self._screen.say(f"   press {number} is taken back")
        self._say_what_is_known()

    def _take(self, press: "SteadyPress", contact: "Array") -> bool:
        """Whether the session takes a press."""
        try:
            self._session.take(press.charge_pC, contact)
        except PressError as error:
            self._screen.say(f"   {error}")
            return False
        self._taken(self._session, press)
        self._say_what_is_known()
        return True

    def _say_what_is_known(self) -> None:
        for sentence in self._session.words:
            self._screen.say(f"   {sentence}")


def _done(session: "BenchSession", contacts: "Array") -> int:
    """Number of rows of a list that were made before: up to the last press of the session."""
    import numpy as np

    if not len(session):
        return 0
    same = (np.isclose(contacts, session.presses.contact[-1], rtol=0.0, atol=1e-9, equal_nan=True)).all(axis=1)
    return int(np.flatnonzero(same)[-1]) + 1 if same.any() else 0
