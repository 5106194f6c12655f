"""What happens at the bench, in its order: readings of the port and lines of the keyboard, from a thread each.

The port is read also while a person answers and while a fit runs: nothing is lost, and a lift in between is seen.
"""

import os
import select
import threading
from collections.abc import Iterable
from queue import Empty, Queue
from types import TracebackType
from typing import TYPE_CHECKING, NamedTuple, Self

if TYPE_CHECKING:
    from isocharge.serve import Chunk, PressWatch, ReadingStream
    from isocharge.serve.live.steady_press import Watched

SHOWN_S = 0.1
"""Time between two readings that are passed on while nothing else changes, s."""

POLL_S = 0.1
"""How often the threads look whether they shall end, s."""

LONGEST_LINE = 1000
"""Bytes of a line from the keyboard; what is longer is cut."""


class Typed(NamedTuple):
    """A line that was typed; None at the end of the input."""

    text: str | None


class Ended(NamedTuple):
    """The port ends: with an error, or because a file is over."""

    error: Exception | None


Event = "Watched | Typed | Ended"


class BenchEvents:
    """Events in their order, from entering the context to leaving it.

    `arm` forgets what has come so far: only presses that begin afterwards are passed on.
    """

    def __init__(
        self, chunks: "Iterable[Chunk]", stream: "ReadingStream", watch: "PressWatch", keyboard: int | None = None
    ) -> None:
        """Set up; nothing is read yet.

        Args:
            chunks: An open port.
            stream: From chunks to readings.
            watch: From readings to steady presses.
            keyboard: Descriptor of the keyboard; None for no keyboard.
        """
        self._chunks, self._stream, self._watch, self._keyboard = chunks, stream, watch, keyboard
        self._queue: Queue[tuple[int, Watched | Typed | Ended]] = Queue()
        self._stop = threading.Event()
        self._armed = 0
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> Self:
        """Start to read."""
        jobs = [self._read_port] + [self._read_keyboard] * (self._keyboard is not None)
        self._threads = [threading.Thread(target=job, name=job.__name__, daemon=True) for job in jobs]
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop reading; a port that is silent is left to its thread."""
        self._stop.set()
        for thread in self._threads:
            thread.join(timeout=1.0)

    def arm(self) -> None:
        """From now on, take only a press that has not begun yet."""
        self._armed += 1

    def next(self) -> "Watched | Typed | Ended":
        """The next event; readings from before the last `arm` are left out."""
        while True:
            try:
                armed, event = self._queue.get(timeout=POLL_S)  # with a timeout, so that Ctrl-C is heard
            except Empty:
                continue
            if isinstance(event, Typed | Ended) or armed == self._armed:
                return event

    def _read_port(self) -> None:
        error = None
        try:
            self._watch_port()
        except Exception as reason:  # passed on to the thread that asks
            error = reason
        self._queue.put((self._armed, Ended(error)))

    def _watch_port(self) -> None:
        armed, last_phase, last_s = self._armed, None, -1.0
        for chunk in self._chunks:
            if self._stop.is_set():
                return
            if armed != self._armed:
                armed, last_phase = self._armed, None
                self._watch.arm()
            for timed in self._stream.feed(chunk):
                watched = self._watch.feed(timed)
                if watched.phase is not last_phase or timed.time.clock_s - last_s >= SHOWN_S or watched.press:
                    last_phase, last_s = watched.phase, timed.time.clock_s
                    self._queue.put((armed, watched))
        self._stream.finish()

    def _read_keyboard(self) -> None:
        assert self._keyboard is not None
        rest = b""
        while not self._stop.is_set():
            if os.name != "nt" and not select.select([self._keyboard], [], [], POLL_S)[0]:  # Windows: sockets only
                continue
            data = os.read(self._keyboard, LONGEST_LINE)
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                self._queue.put((0, Typed(line[:LONGEST_LINE].decode(errors="replace"))))
            rest = rest[:LONGEST_LINE]
            if not data:
                self._queue.put((0, Typed(None)))
                return
