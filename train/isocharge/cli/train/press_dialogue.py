"""The dialogue about presses at a port: says what to press, takes it when it is steady, asks whether it was there.

A machine that makes the presses of a list is asked nothing: its presses are taken in their order.
"""

import threading
from collections.abc import Callable, Iterable
from io import FileIO
from queue import Queue
from typing import Self

import numpy as np

from isocharge.cli.shared.terminal import say
from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, PortLost, PressError
from isocharge.serve import Chunk, ReadingStream
from isocharge.serve.live.steady_press import AWAY, Phase, PressWatch, SteadyPress, Watched
from isocharge.train.calibration.session import PressSession, describe_press, read_answer

LINE_S = 1.0
"""Time between two lines about a press that settles, s."""

PHASES = {
    Phase.taring: "taring: leave the film alone",
    Phase.lift: "lift the probe",
    Phase.waiting: "waiting for the press",
    Phase.settling: "hold it",
}
"""Phase of the press watch in words."""

QUESTION = '   There, and as hard? Enter: yes; or type "x y force" (? is unknown), s: skip, u: undo, q: end'

KEYS = "   (type s to skip this place, u to undo the last press, q to end)"

Taken = Callable[[PressSession, SteadyPress], None]
"""Called after each press that is in the session."""


class Stopped(Exception):
    """The person ends the session, or the input or the port is over."""


class PressEvents:
    """Readings of a port and lines of the keyboard, in their order, from entering the context to leaving it.

    The port is read also while a person answers and while a fit runs: nothing is lost, and a lift in between is seen.
    `arm` forgets what has come so far: only presses that begin afterwards are passed on.
    """

    def __init__(
        self, chunks: Iterable[Chunk], stream: ReadingStream, watch: PressWatch, keyboard: int | None = None
    ) -> None:
        """Set up; nothing is read yet.

        Args:
            chunks: An open port.
            stream: From chunks to readings.
            watch: From readings to steady presses.
            keyboard: Descriptor of the keyboard; None for no keyboard.
        """
        self._chunks, self._stream, self._watch, self._keyboard = chunks, stream, watch, keyboard
        self._queue: Queue[tuple[int, Watched | str | Exception]] = Queue()
        self._stop, self._armed = threading.Event(), 0
        self._reader = threading.Thread(target=self._read_port, name="press port", daemon=True)

    def __enter__(self) -> Self:
        """Start to read."""
        self._reader.start()
        if self._keyboard is not None:
            threading.Thread(target=self._read_keyboard, args=[self._keyboard], daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        """Stop reading; a port or a keyboard that is silent is left to its thread."""
        self._stop.set()
        self._reader.join(timeout=1.0)

    def arm(self) -> None:
        """From now on, take only a press that has not begun yet."""
        self._armed += 1

    def next(self) -> Watched | str:
        """The next reading or line that was typed; readings from before the last `arm` are left out.

        Raises:
            Stopped: At the end of the port or of the input.
            IsochargeError: Of the port.
        """
        while True:
            armed, event = self._queue.get()
            if isinstance(event, Exception):
                raise event
            if isinstance(event, str) or armed == self._armed:
                return event

    def _read_port(self) -> None:
        armed = self._armed
        try:
            for chunk in self._chunks:
                if self._stop.is_set():
                    return
                if armed != self._armed:
                    armed = self._armed
                    self._watch.arm()
                for reading in self._stream.feed(chunk):
                    self._queue.put((armed, self._watch.feed(reading)))
            self._stream.finish()
            self._queue.put((0, Stopped()))
        except Exception as error:  # passed on to the thread that asks
            self._queue.put((0, error))

    def _read_keyboard(self, keyboard: int) -> None:
        for line in FileIO(keyboard, closefd=False):  # unbuffered: no lock that is held when the program ends
            self._queue.put((0, line.decode(errors="replace")))
        self._queue.put((0, Stopped()))


class Screen:
    """What a person sees on stderr: sentences, and now and then the charges as they settle."""

    def __init__(self, electrodes: tuple[str, ...]) -> None:
        """Set up; `electrodes` are names, in the order of the charges."""
        self._electrodes = electrodes
        self._last: tuple[str, float] = ("", 0.0)

    def say(self, sentence: str) -> None:
        """A sentence."""
        self._last = ("", 0.0)
        say(sentence)

    def show(self, watched: Watched) -> None:
        """The charges of a reading, and what the watch waits for."""
        if watched.phase not in PHASES:
            return
        line = f"   {PHASES[watched.phase]}"
        if watched.charge_pC is not None and watched.phase == Phase.settling:
            line += f", {watched.held_s:.1f} s: {self._charges(watched.charge_pC)}"
        line += f" ({watched.reason})" if watched.reason else ""
        phase, shown_s = self._last
        if watched.phase != phase or watched.held_s - shown_s >= LINE_S:
            self._last = watched.phase, watched.held_s
            say(line)

    def taken(self, press: SteadyPress) -> None:
        """A press that was steady."""
        flags = f" [{', '.join(press.flags)}]" if press.flags else ""
        self.say(f"   steady after {press.held_s:.1f} s: {self._charges(press.charge_pC)}{flags}")

    def _charges(self, charge_pC: Array) -> str:
        """Charges as "A 812.3, B 401.0 pC"."""
        return ", ".join(f"{name} {q:.1f}" for name, q in zip(self._electrodes, charge_pC, strict=True)) + " pC"


class Dialogue:
    """One session, from the first press to the last."""

    def __init__(self, session: PressSession, events: PressEvents, screen: Screen, taken: Taken) -> None:
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

    def with_machine(self, contacts: Array) -> None:
        """Take the presses that a machine makes, as they come.

        Args:
            contacts: (x, y, F), shape (n, 3), NaN where unknown; those in the session were made before.

        Raises:
            PortLost: If the port goes away: nobody knows then which press is next.
            InputError: If the port ends before the last press.
        """
        first = _done(self._session, contacts)
        try:
            self._until(Phase.waiting)  # a press before the tare would be lost, and all after it be taken for others
            self._screen.say("the film is tared: let the machine begin")
            for number, contact in enumerate(contacts[first:], start=first + 1):
                self._screen.say(f"{number}. {describe_press(contact)}")
                event = self._until(Phase.taken, Phase.refused)
                if event.press is not None:
                    self._screen.taken(event.press)
                    self._take(event.press, contact)
                elif event.reason == AWAY:
                    raise PortLost(
                        f"{AWAY}; let the machine go on with row {number} of its list, with the same command"
                    )
                else:
                    self._screen.say(f"   row {number} is left out: {event.reason}")
        except Stopped as end:
            raise InputError("the port ended before the last press of the list") from end

    def _until(self, *phases: Phase) -> Watched:
        """The next reading in one of these phases; those before it are shown."""
        while True:
            event = self._events.next()
            if isinstance(event, Watched):
                if event.phase in phases:
                    return event
                self._screen.show(event)

    def _one_press(self, *, asks: bool) -> None:
        """Propose a press until one is taken, or something else is to be proposed."""
        proposed, press = self._session.proposed, None
        self._screen.say(f"{len(self._session) + 1}. Press {describe_press(proposed.contact)} and hold.")
        self._events.arm()
        while press is not None or self._session.proposed is proposed:  # until another press is undone
            event = self._events.next()
            if isinstance(event, str):
                if self._is_over(event, press, proposed.contact):
                    return
            elif press is not None:
                continue  # readings while the question stands
            elif event.press is not None:
                self._screen.taken(event.press)
                if not asks:
                    self._take(event.press, proposed.contact)
                    return
                press = event.press
                self._screen.say(QUESTION)
            elif event.phase == Phase.refused:
                self._screen.say(f"   not taken: {event.reason}; press again")
                self._events.arm()
            else:
                self._screen.show(event)

    def _is_over(self, typed: str, press: SteadyPress | None, proposed: Array) -> bool:
        """Do what was typed, while a press is waited for or asked about: whether something else is to be proposed."""
        try:
            answer = read_answer(typed)
            if answer.reply == "quit":
                raise Stopped
            if answer.reply == "take" and press is None:
                self._screen.say("   press first: the question comes when the press is steady")
            elif answer.reply == "take" and press is not None:
                return self._take(press, proposed if isinstance(answer.contact, str) else answer.contact)
            elif answer.reply == "skip":
                self._session.skip()
            elif answer.number == "last" and press is not None:
                self._screen.say("   this press is not taken")
            else:
                self._screen.say(f"   press {self._session.undo(answer.number)} is taken back")
                self._say_summary()
                return False
        except PressError as error:
            self._screen.say(f"   {error}")
            return False
        return answer.reply != "take"

    def _take(self, press: SteadyPress, contact: Array) -> bool:
        """Whether the session takes a press."""
        try:
            self._session.take(press.charge_pC, contact)
        except PressError as error:
            self._screen.say(f"   {error}")
            return False
        self._taken(self._session, press)
        self._say_summary()
        return True

    def _say_summary(self) -> None:
        for sentence in self._session.summary:
            self._screen.say(f"   {sentence}")


def _done(session: PressSession, contacts: Array) -> int:
    """Number of rows of a list that were made before: up to the last press of the session."""
    if not len(session):
        return 0
    same = (np.isclose(contacts, session.presses.contact[-1], rtol=0.0, atol=1e-9, equal_nan=True)).all(axis=1)
    return max(np.flatnonzero(same).tolist(), default=-1) + 1
