"""Dialogue of a press session, which proposes presses, records steady presses, and asks where they were made.

If a machine makes the presses of a list, nothing is proposed or asked, and the presses are recorded in the order of the
list.
"""

from collections.abc import Callable

import numpy as np

from isocharge.cli.shared.terminal import say
from isocharge.cli.train.press_events import PressEvents, SessionEnd
from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, PortLost, PressError
from isocharge.serve.live.steady_press import PORT_LOST, Phase, SteadyPress, WatchResult
from isocharge.train.calibration.session import Answer, PressSession, describe_press, read_answer

LINE_INTERVAL_s = 1.0
"""Time between two lines about a press that has not settled yet, s."""

SAME_CONTACT_TOLERANCE = 1e-9
"""Largest difference between a press of the session and the same press in the list of a machine, mm and N."""

PHASE_TEXTS = {
    Phase.taring: "measuring the tare: leave the film alone",
    Phase.lift: "lift the probe",
    Phase.waiting: "waiting for the press",
    Phase.settling: "hold it",
}
"""Instruction for the person in each phase of the press watch."""

QUESTION = '   Was it there, and as hard? Enter: yes; or type "x y force" (? is unknown), s: skip, u: undo, q: quit'

KEYS = "   (type s to skip this place, u to undo the last press, q to quit)"

OnTaken = Callable[[PressSession, SteadyPress], None]
"""Function that is called after the session has recorded a press. Its arguments are the session and the press."""


class Screen:
    """Printer of messages on stderr for the person who presses.

    The messages are sentences. While a press settles, the charges are also shown, about once per second.
    """

    def __init__(self, electrodes: tuple[str, ...]) -> None:
        """Set up the screen.

        Args:
            electrodes: Names of the electrodes, in the order of the charges.
        """
        self._electrodes = electrodes
        self._last_phase: Phase | None = None
        self._last_line_s = 0.0

    def say(self, sentence: str) -> None:
        """Print a sentence. After this call, `show_phase` prints its next line even if the phase has not changed."""
        self._last_phase = None
        say(sentence)

    def show_phase(self, watched: WatchResult) -> None:
        """Print the instruction of the present phase, and the charges while a press settles.

        Within one phase, the time between two lines is at least `LINE_INTERVAL_s`. In a phase without an instruction,
        for example the phase of a steady press, nothing is printed.

        Args:
            watched: Result of the press watch for the last reading: phase, time for which the press is held, charges.
        """
        if watched.phase not in PHASE_TEXTS:
            return
        is_new_phase = watched.phase != self._last_phase
        is_too_soon = watched.held_s - self._last_line_s < LINE_INTERVAL_s
        if not is_new_phase and is_too_soon:
            return
        self._last_phase = watched.phase
        self._last_line_s = watched.held_s

        line = f"   {PHASE_TEXTS[watched.phase]}"
        if watched.charge_pC is not None and watched.phase == Phase.settling:
            line += f", {watched.held_s:.1f} s: {self._charge_text(watched.charge_pC)}"
        if watched.reason:
            line += f" ({watched.reason})"
        say(line)  # not `self.say`, after which the same phase would be printed again too soon

    def show_steady(self, press: SteadyPress) -> None:
        """Print the charges of a steady press."""
        flags = f" [{', '.join(press.flags)}]" if press.flags else ""
        self.say(f"   steady after {press.held_s:.1f} s: {self._charge_text(press.charge_pC)}{flags}")

    def _charge_text(self, charge_pC: Array) -> str:
        """Return charges as a text such as "A 812.3, B 401.0 pC"."""
        charges = [f"{name} {charge:.1f}" for name, charge in zip(self._electrodes, charge_pC, strict=True)]
        return f"{', '.join(charges)} pC"


class Dialogue:
    """Dialogue of one session, from the first press to the last."""

    def __init__(self, session: PressSession, events: PressEvents, screen: Screen, on_taken: OnTaken) -> None:
        """Set up the dialogue.

        Args:
            session: Session that proposes and records presses.
            events: Readings of the port, and lines of the keyboard.
            screen: Messages for the person.
            on_taken: Function that is called after each press that the session has recorded.
        """
        self._session = session
        self._events = events
        self._screen = screen
        self._on_taken = on_taken

    def guide_person(self, *, asks: bool = True) -> None:
        """Propose and record presses until the film is known accurately enough, or the person quits.

        Args:
            asks: Whether to ask after each press where it was made. If not, each press counts as made at the proposed
                place with the proposed force.
        """
        if asks:
            self._screen.say(KEYS)
        try:
            while not self._session.enough:
                self._guide_press(asks=asks)
        except SessionEnd:
            return
        self._screen.say("The film is known well enough. With --until 0 the same command takes more presses.")

    def follow_machine(self, contacts: Array) -> None:
        """Record the presses that a machine makes, in the order of its list.

        Args:
            contacts: Presses (x, y, F) of the list, shape (n, 3), mm and N; unknown values are NaN. The rows up to the
                last press of the session were pressed earlier, and are not expected again.

        Raises:
            PortLost: If the port is lost, because it is then unknown which press comes next.
            InputError: If the port ends before the last press.
        """
        first_row = _count_rows_made(self._session, contacts)
        try:
            # A press before the tare would be lost, and each later press would be assigned to the wrong row.
            self._wait_for(Phase.waiting)
            self._screen.say("The tare is measured. Let the machine begin.")
            for row_number, contact in enumerate(contacts[first_row:], start=first_row + 1):
                self._follow_press(row_number, contact)
        except SessionEnd as end:
            raise InputError(
                "the port ended before the last press of the list; run the same command again for the remaining presses"
            ) from end

    def _follow_press(self, row_number: int, contact: Array) -> None:
        """Wait for the press that belongs to one row of a machine's list, and record the press.

        A refused press is left out, because the machine has already moved on to the next row.

        Args:
            row_number: Number of the row in the list, from 1.
            contact: Contact (x, y, F) of the row, shape (3,), mm and N.

        Raises:
            PortLost: If the connection to the board was lost during the press.
        """
        self._screen.say(f"{row_number}. {describe_press(contact)}")
        event = self._wait_for(Phase.taken, Phase.refused)
        if event.press is not None:
            self._screen.show_steady(event.press)
            self._take(event.press, contact)
        elif event.reason == PORT_LOST:
            raise PortLost(
                f"{PORT_LOST}; run the same command again, and let the machine continue with row {row_number} of its "
                "list"
            )
        else:
            self._screen.say(f"   row {row_number} is left out: {event.reason}")

    def _wait_for(self, *phases: Phase) -> WatchResult:
        """Wait for the next reading in one of the given phases.

        Readings in other phases are only displayed, and typed lines are ignored.

        Raises:
            SessionEnd: If the port or the input has ended.
            IsochargeError: If the port fails.
        """
        while True:
            event = self._events.next()
            if isinstance(event, str):  # a typed line
                continue
            if event.phase in phases:
                return event
            self._screen.show_phase(event)

    def _guide_press(self, *, asks: bool) -> None:
        """Propose a press, and wait until it has been recorded or until another press must be proposed.

        When the charges of a press are steady, the person is asked where the press was made. The answer records or
        discards the press. The person can also type a command at any time.

        Args:
            asks: Whether to ask where a steady press was made. If not, the press counts as made at the proposed place
                with the proposed force.
        """
        proposed = self._session.proposed
        steady_press: SteadyPress | None = None  # the press about which a question is open; None without a question
        self._screen.say(f"{len(self._session) + 1}. Press {describe_press(proposed.contact)} and hold.")
        self._events.arm()  # only presses from now on count

        # A command that removes an earlier press changes the proposal of the session. The loop then ends, so that the
        # new proposal is shown, but not before an open question has been answered.
        while steady_press is not None or self._session.proposed is proposed:
            event = self._events.next()
            if isinstance(event, str):  # a typed line: an answer or a command
                is_settled = self._handle_line(event, steady_press, proposed.contact)
                if is_settled:
                    return
            elif steady_press is not None:
                continue  # readings do not matter while the question is open
            elif event.press is not None:
                self._screen.show_steady(event.press)
                if not asks:
                    self._take(event.press, proposed.contact)
                    return
                steady_press = event.press
                self._screen.say(QUESTION)
            elif event.phase == Phase.refused:
                self._screen.say(f"   not taken: {event.reason}; press again")
                self._events.arm()
            else:
                self._screen.show_phase(event)

    def _handle_line(self, line: str, press: SteadyPress | None, proposed: Array) -> bool:
        """Carry out the command that a person typed, or print why it cannot be carried out.

        Args:
            line: The typed line.
            press: Steady press about which a question is open; None while no press is steady.
            proposed: The proposed press (x, y, F), shape (3,), mm and N.

        Returns:
            Whether the proposal is settled. If so, the next press must be proposed.
        """
        try:
            return self._carry_out(read_answer(line), press, proposed)
        except PressError as error:
            self._screen.say(f"   {error}")
            return False

    def _carry_out(self, answer: Answer, press: SteadyPress | None, proposed: Array) -> bool:
        """Carry out the command of an answer: quit, skip the proposal, record the steady press, or remove a press.

        A press can only be recorded while a question about it is open. While a question is open, the command to remove
        the last press discards the steady press. Otherwise, this command removes the last recorded press.

        Args:
            answer: The command, which was read from the typed line.
            press: Steady press about which a question is open; None while no press is steady.
            proposed: The proposed press (x, y, F), shape (3,), mm and N.

        Returns:
            Whether the proposal is settled. If so, the next press must be proposed.

        Raises:
            SessionEnd: If the command is to quit.
        """
        if answer.reply == "quit":
            raise SessionEnd
        if answer.reply == "skip":
            self._session.skip()
            return True
        if answer.reply == "take":
            if press is None:
                self._screen.say("   press first: the question comes when the press is steady")
                return False
            contact = proposed if isinstance(answer.contact, str) else answer.contact  # the text means "as proposed"
            return self._take(press, contact)

        # The remaining command is "undo". Discard the steady press, which is not recorded yet, or remove a recorded
        # press.
        if answer.number == "last" and press is not None:
            self._screen.say("   this press is not taken")
            return True
        removed_number = self._session.undo(answer.number)
        self._screen.say(f"   press {removed_number} is removed")
        self._say_summary()
        return False  # an open question remains open; without one, the caller compares the proposal with the new one

    def _take(self, press: SteadyPress, contact: Array) -> bool:
        """Record a press in the session, and return whether the session accepts it.

        If the session refuses the press, the reason is printed.

        Args:
            press: The steady press.
            contact: Contact (x, y, F) of the press, shape (3,), mm and N.
        """
        try:
            self._session.take(press.charge_pC, contact)
        except PressError as error:
            self._screen.say(f"   {error}")
            return False
        self._on_taken(self._session, press)
        self._say_summary()
        return True

    def _say_summary(self) -> None:
        """Print sentences that state how accurately the film is known."""
        for sentence in self._session.summary:
            self._screen.say(f"   {sentence}")


def _count_rows_made(session: PressSession, contacts: Array) -> int:
    """Count the rows in a machine's list up to and including the last press of the session.

    The number is 0 if the session has no press, or if its last press is not in the list. If several rows are equal to
    the last press, the last of these rows counts.

    Args:
        session: The session.
        contacts: Contacts of the list, shape (n_row, 3), mm and N.
    """
    if len(session) == 0:
        return 0
    last_contact = session.presses.contact[-1]
    is_equal = np.isclose(contacts, last_contact, rtol=0.0, atol=SAME_CONTACT_TOLERANCE, equal_nan=True)
    equal_rows = np.flatnonzero(is_equal.all(axis=1))  # x, y and F are equal
    if equal_rows.size == 0:
        return 0
    last_row = int(equal_rows[-1])
    return last_row + 1
