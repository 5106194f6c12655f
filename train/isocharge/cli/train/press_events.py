"""Readings of a port and lines of the keyboard, merged into one sequence of events."""

import threading
from collections.abc import Iterable
from io import FileIO
from queue import Queue
from typing import Self

from isocharge.serve import Chunk, ReadingStream
from isocharge.serve.live.steady_press import PressWatch, WatchResult

JOIN_TIMEOUT_s = 1.0
"""Longest time to wait for the end of the thread that reads the port, s. With a silent port, the thread ends later."""


class SessionEnd(Exception):
    """End of a press session, because the person quits, or because the input or the port has ended."""


class PressEvents:
    """Events of a port and a keyboard, in the order in which they happen.

    The object is a context manager that starts and stops the reading threads.

    No reading is lost, because the port is also read while a person answers a question and while a fit runs. Therefore,
    the watch also detects that a probe is lifted while a question is open.
    """

    def __init__(
        self, chunks: Iterable[Chunk], stream: ReadingStream, watch: PressWatch, keyboard: int | None = None
    ) -> None:
        """Initialise the events. Reading starts when the context is entered.

        Args:
            chunks: Iterable over the bytes of an open port.
            stream: Decoder of the bytes.
            watch: Detector of steady presses.
            keyboard: File descriptor of the keyboard; None for no keyboard.
        """
        self._chunks = chunks
        self._stream = stream
        self._watch = watch
        self._keyboard = keyboard
        self._queue: Queue[tuple[int, WatchResult | str | Exception]] = Queue()
        self._stop = threading.Event()
        self._arm_count = 0  # number of calls of `arm`
        self._port_thread = threading.Thread(target=self._read_port, name="press port", daemon=True)

    def __enter__(self) -> Self:
        """Start the threads that read the port and the keyboard."""
        self._port_thread.start()
        if self._keyboard is not None:
            threading.Thread(target=self._read_keyboard, args=[self._keyboard], daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        """Stop the threads. A thread that waits for a silent port or for the keyboard ends only with the process."""
        self._stop.set()
        self._port_thread.join(timeout=JOIN_TIMEOUT_s)

    def arm(self) -> None:
        """Discard all earlier readings, and detect only presses that begin after this call."""
        self._arm_count += 1

    def next(self) -> WatchResult | str:
        """Wait for the next reading or typed line.

        Readings that were made before the last call of `arm` are discarded.

        Returns:
            Result of the watch for a reading, or the typed line.

        Raises:
            SessionEnd: If the port or the input has ended.
            IsochargeError: If the port fails.
        """
        while True:
            arm_count, event = self._queue.get()
            if isinstance(event, Exception):
                raise event
            is_typed_line = isinstance(event, str)
            is_recent = arm_count == self._arm_count
            if is_typed_line or is_recent:
                return event

    def _read_port(self) -> None:
        """Read the port until its end, and put the events of the readings into the queue.

        The press watch finds steady presses in the readings. If another thread calls `arm`, the press watch begins
        again. Each event is stored with the number of earlier calls of `arm`. The method `next` can therefore discard
        the events before the last call of `arm`. The method runs in its own thread.
        """
        arm_count = self._arm_count  # number of calls for which the watch is armed
        try:
            for chunk in self._chunks:
                if self._stop.is_set():
                    return
                must_be_armed = arm_count != self._arm_count
                if must_be_armed:
                    arm_count = self._arm_count
                    self._watch.arm()
                for frame in self._stream.frames(chunk):
                    self._queue.put((arm_count, self._watch.feed(frame)))
            self._stream.finish()
            self._queue.put((arm_count, SessionEnd()))
        except Exception as error:  # raised again by `next`, in the thread that waits for events
            self._queue.put((arm_count, error))

    def _read_keyboard(self, keyboard: int) -> None:
        """Read lines from the keyboard until its end, and put them into the queue.

        The method runs in its own thread.

        Args:
            keyboard: File descriptor of the keyboard.
        """
        # The file is not buffered, because a buffer would hold a lock when the program ends.
        for line in FileIO(keyboard, closefd=False):
            self._queue.put((self._arm_count, line.decode(errors="replace")))
        self._queue.put((self._arm_count, SessionEnd()))
