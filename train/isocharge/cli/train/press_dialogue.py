"""Dialogue of a press session, which proposes presses, records steady presses, and asks where they were made.

If a machine makes the presses of a list, nothing is proposed or asked, and the presses are recorded in the order of the
list.

A session has two sources of events: the readings of a port and the lines of the keyboard. The events of both sources
are merged into one sequence.
"""

import threading
from collections.abc import Iterable, Iterator
from io import FileIO
from queue import Queue

import numpy as np

from isocharge.cli.shared.terminal import say
from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, PortLost, PressError
from isocharge.serve import Chunk, ReadingStream
from isocharge.serve.frames.frame import Frame
from isocharge.serve.live.steady_press import PORT_LOST, Phase, PressWatch, SteadyPress, WatchResult
from isocharge.train.calibration.session import PressSession, describe_press, read_answer


class SessionEnd(Exception):
    """End of a press session, because the person quits, or because the input or the port has ended."""


class PressEvents:
    """Events of a port and a keyboard, in the order in which they happen.

    No reading is lost, because the port is also read while a person answers a question and while a fit runs. Therefore,
    the watch also detects that a probe was lifted while a question was open.
    """

    def __init__(
        self, chunks: Iterable[Chunk], stream: ReadingStream, watch: PressWatch, keyboard: int | None = None
    ) -> None:
        """Start the threads that read the port and the keyboard.

        The threads put readings and typed lines into one queue. The method `next` takes them from the queue.

        Args:
            chunks: Iterable over the bytes of an open port.
            stream: Decoder of the bytes.
            watch: Detector of steady presses, to which the method `next` passes the readings.
            keyboard: File descriptor of the keyboard; None for no keyboard.
        """
        self._watch = watch
        # The queue contains readings, typed lines, the error with which a thread ends, and None for a call of `arm`.
        # The method `arm` makes the watch wait for a new press.
        self._queue: Queue[Frame | str | Exception | None] = Queue()
        self._queued_arm_calls = 0  # number of calls of `arm` that are still in the queue
        self._stop = threading.Event()
        self._port_thread = self._start_reading(_frames(chunks, stream))
        if keyboard is not None:
            # The file is not buffered, because a buffer would hold a lock when the program ends.
            lines = FileIO(keyboard, closefd=False)
            # The method `close` does not wait for this thread, which may wait for a typed line for ever.
            self._start_reading(line.decode(errors="replace") for line in lines)

    def close(self) -> None:
        """Stop the threads. A thread that waits for a silent port or for the keyboard ends only with the process."""
        self._stop.set()
        self._port_thread.join(timeout=1.0)

    def arm(self) -> None:
        """Discard all earlier readings, and detect only presses that begin after this call."""
        self._queued_arm_calls += 1
        self._queue.put(None)

    def next(self) -> WatchResult | str:
        """Wait for the next reading or typed line.

        The method `arm` makes the watch, which detects steady presses, wait for a new press. Readings that were made
        before the last call of `arm` are passed to the watch, but are not returned.

        Returns:
            Result of the watch for a reading, or the typed line.

        Raises:
            SessionEnd: If the port or the input has ended.
            IsochargeError: If the port fails.
        """
        while True:
            event = self._queue.get()  # the error of a thread, a typed line, a call of `arm`, or a reading
            if isinstance(event, Exception):
                raise event
            if isinstance(event, str):
                return event
            if event is None:  # stands for a call of `arm`
                self._watch.arm()
                self._queued_arm_calls -= 1
                continue
            watched = self._watch.feed(event)
            if not self._queued_arm_calls:  # otherwise, the reading is older than the last call of `arm`
                return watched

    def _start_reading(self, items: Iterable[Frame | str]) -> threading.Thread:
        """Start a thread that puts readings or typed lines into the queue, and return the thread."""
        thread = threading.Thread(target=self._fill_queue, args=[items], daemon=True)
        thread.start()
        return thread

    def _fill_queue(self, items: Iterable[Frame | str]) -> None:
        """Put readings or typed lines into the queue until they end.

        The method runs in its own thread. An error is put into the queue, too. The method `next` raises the error again
        in the thread that waits for events.
        """
        try:
            for item in items:
                if self._stop.is_set():
                    return
                self._queue.put(item)
            self._queue.put(SessionEnd())
        except Exception as error:
            self._queue.put(error)


def _frames(chunks: Iterable[Chunk], stream: ReadingStream) -> Iterator[Frame]:
    """Decode the bytes of a port, and yield its readings until the port ends."""
    for chunk in chunks:
        yield from stream.frames(chunk)
    stream.finish()


PHASE_TEXTS = {
    Phase.taring: "measuring the tare: leave the film alone",
    Phase.lift: "lift the probe",
    Phase.waiting: "waiting for the press",
    Phase.settling: "hold it",
}
"""Instruction for the person in each phase of the press watch."""


class Dialogue:
    """Dialogue of one session, from the first press to the last. Its messages are sentences on stderr."""

    def __init__(self, session: PressSession, events: PressEvents) -> None:
        """Set up the dialogue.

        Args:
            session: Session that proposes and records presses.
            events: Readings of the port, and lines of the keyboard.
        """
        self._session = session
        self._events = events
        self._shown_phase = ""  # instruction that was printed last for the present press

    def _say_phase(self, watched: WatchResult) -> None:
        """Print the instruction and the reason of the present phase, unless the same instruction was printed last.

        In a phase without an instruction, for example the phase of a steady press, nothing is printed.
        """
        if watched.phase in PHASE_TEXTS:
            reason = f" ({watched.reason})" if watched.reason else ""
            phase_text = f"   {PHASE_TEXTS[watched.phase]}{reason}"
            if phase_text != self._shown_phase:
                self._shown_phase = phase_text
                say(phase_text)

    def _say_steady(self, press: SteadyPress) -> None:
        """Print the charges of a steady press."""
        electrodes = self._session.presses.electrodes
        charges = ", ".join(f"{name} {charge:.1f}" for name, charge in zip(electrodes, press.charge_pC, strict=True))
        flags = f" [{', '.join(press.flags)}]" if press.flags else ""
        say(f"   steady after {press.held_s:.1f} s: {charges} pC{flags}")

    def guide_person(self) -> None:
        """Propose and record presses until the film is known accurately enough, or the person quits."""
        say("   (press elsewhere if you cannot reach a place; type u to undo the last press, q to quit)")
        try:
            while not self._session.enough:
                self._guide_press()
        except SessionEnd:
            return
        say("The film is known well enough. With --until 0 the same command takes more presses.")

    def follow_machine(self, contacts: Array) -> None:
        """Record the presses that a machine makes, in the order of its list.

        Args:
            contacts: Presses (x, y, F) of the list, shape (n, 3), mm and N; unknown values are NaN. If the session
                continues an earlier session, the rows up to its last recorded press are skipped.

        Raises:
            PortLost: If the port is lost, because it is then unknown which press comes next.
            InputError: If the port ends before the last press.
        """
        # The session may already contain presses of an earlier session. Find them in the list, one after the other, so
        # that the machine continues below the last of them. Rows between them were left out earlier.
        next_row = 0  # index of the row below the recorded presses that are found so far
        for recorded in self._session.presses.contact:
            is_same_press = np.isclose(contacts[next_row:], recorded, equal_nan=True).all(axis=1)
            if is_same_press.any():
                next_row += is_same_press.argmax() + 1  # argmax finds the first row with this press
        try:
            # A press before the tare would be lost, and each later press would be assigned to the wrong row.
            self._wait_for(Phase.waiting)
            say(f"The tare is measured. Let the machine begin with row {next_row + 1} of its list.")
            for row_number, contact in enumerate(contacts[next_row:], next_row + 1):
                say(f"{row_number}. {describe_press(contact)}")
                self._shown_phase = ""  # print the instruction of each phase again for this press
                event = self._wait_for(Phase.taken, Phase.refused)
                if event.press is not None:
                    self._say_steady(event.press)
                    self._take(event.press, contact)
                elif event.reason == PORT_LOST:
                    raise PortLost(f"{PORT_LOST}; run the same command again, which names the row to continue with")
                else:  # the machine has already moved on to the next row
                    say(f"   row {row_number} is left out: {event.reason}")
        except SessionEnd as end:
            raise InputError(
                "the port ended before the last press of the list; run the same command again for the remaining presses"
            ) from end

    def _wait_for(self, *phases: Phase) -> WatchResult:
        """Wait until the detector of steady presses reports one of the given phases, and return its result.

        The results with other phases are displayed. Lines that a person types are ignored, because a machine makes the
        presses.

        Args:
            phases: Phases, each of which ends the waiting.

        Raises:
            SessionEnd: If the port or the input has ended.
            IsochargeError: If the port fails.
        """
        while True:
            event = self._events.next()
            if isinstance(event, WatchResult):
                if event.phase in phases:
                    return event
                self._say_phase(event)

    def _guide_press(self) -> None:
        """Propose a press, and wait until it has been recorded or until another press must be proposed.

        When the charges of a press are steady, the person is asked where the press was made. The answer records or
        discards the press. The person can also type a command at any time.
        """
        proposed = self._session.proposed
        steady_press: SteadyPress | None = None  # the press about which a question is open; None without a question
        say(f"{len(self._session) + 1}. Press {describe_press(proposed.contact)} and hold.")
        self._shown_phase = ""  # print the instruction of each phase again for this press
        self._events.arm()  # only presses from now on count

        # A command that removes an earlier press changes the proposal of the session. The loop then ends, so that the
        # new proposal is shown, but not before an open question has been answered.
        while steady_press is not None or self._session.proposed is proposed:
            event = self._events.next()
            if isinstance(event, str):  # a typed line: an answer or a command
                is_settled = self._handle_line(event, steady_press, proposed.contact)
                if is_settled:  # the press was recorded or discarded
                    return
            elif steady_press is not None:
                continue  # readings do not matter while the question is open
            elif event.press is not None:
                self._say_steady(event.press)
                steady_press = event.press
                say('   Was it there, and as hard? Enter: yes; or type "x y force" (? is unknown), u: undo, q: quit')
            elif event.phase == Phase.refused:
                say(f"   not taken: {event.reason}; press again")
                self._events.arm()
            else:
                self._say_phase(event)

    def _handle_line(self, line: str, press: SteadyPress | None, proposed: Array) -> bool:
        """Carry out the command that a person typed, or print why the command cannot be carried out.

        A press can only be recorded while a question about it is open. While a question about a steady press is open,
        the command to remove a press concerns this press. At any other time, the command concerns the press that was
        recorded last.

        Args:
            line: The typed line.
            press: Steady press about which a question is open; None while no press is steady.
            proposed: The proposed press (x, y, F), shape (3,), mm and N.

        Returns:
            True if the press about which a question was open was recorded or discarded. The next press must then be
            proposed. Otherwise False, also after the removal of an earlier press.

        Raises:
            SessionEnd: If the command is to quit.
        """
        try:
            answer = read_answer(line)
            if answer.reply == "quit":
                raise SessionEnd
            if answer.reply == "take" and press is not None:
                return self._take(press, proposed if answer.contact is None else answer.contact)
            if answer.reply == "take":
                say("   press first: the question comes when the press is steady")
                return False
            # The remaining command is to remove a press.
            if press is not None:  # a question is open, and its answer discards the press
                say("   this press is not taken")
                return True
            say(f"   press {self._session.undo()} is removed")  # the press that was recorded last
            self._say_summary()
        except PressError as error:
            say(f"   {error}")
        return False  # an open question remains open; the caller checks whether the session proposes another press

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
            say(f"   {error}")
            return False
        self._say_summary()
        return True

    def _say_summary(self) -> None:
        """Print sentences that state how accurately the film is known."""
        for sentence in self._session.summary:
            say(f"   {sentence}")
