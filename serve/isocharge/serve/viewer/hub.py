"""The stream that the page shows and its viewers: takes what the reader sends, and gives each viewer what it can show.

The tape has the samples by number: the latest ones of a live stream, or all of a recording. A viewer confirms what it
has drawn. It gets the next samples only then, coalesced with all that came meanwhile: nothing is queued for a viewer
that is slow, and a stalled one costs nothing.
"""

import asyncio
import json
import tempfile
import time
from bisect import bisect_right
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.serve.viewer.link import PageEnd
from isocharge.serve.viewer.messages import (
    LiveRequest,
    Pause,
    Play,
    ReplayRequest,
    SampleFormat,
    Samples,
    Seek,
    Speed,
    coalesce,
    samples_message,
)

LIVE_SAMPLES = 1 << 14
"""Samples that are kept of a live stream: 16 s at 1 kHz; a browser that is farther behind misses some."""

PIECES = 600
"""Largest number of pieces in the overview of a recording."""


class Tape:
    """The latest samples of a stream without end, in bounded memory.

    Attributes:
        total: Samples that ever came.
    """

    def __init__(self, dtype: "np.dtype[Any]", most: int = LIVE_SAMPLES) -> None:
        self.total = 0
        self._ring: Samples = np.zeros(most, dtype)

    @property
    def oldest(self) -> int:
        """Number of the oldest sample that is still there."""
        return max(0, self.total - len(self._ring))

    def append(self, samples: Samples) -> None:
        """Add samples, and forget as many old ones as need be."""
        latest = samples[-len(self._ring) :]
        first = self.total + len(samples) - len(latest)
        self._ring[np.arange(first, first + len(latest)) % len(self._ring)] = latest
        self.total += len(samples)

    def samples(self, start: int, stop: int) -> Samples:
        """Samples by number, those from `start` to before `stop` that are still there."""
        return self._ring[np.arange(max(start, self.oldest), stop) % len(self._ring)]

    def timestamp(self, number: int) -> float:
        """Time of a sample, unix seconds."""
        return float(self._ring[number % len(self._ring)]["timestamp"])

    def index(self, timestamp: float) -> int:
        """Number of the first sample after a time, unix seconds."""
        return bisect_right(range(self.total), timestamp, lo=self.oldest, key=self.timestamp)

    def span(self) -> tuple[float, float]:
        """Times of the oldest and the latest sample, unix seconds; zeros if there is none."""
        return (self.timestamp(self.oldest), self.timestamp(self.total - 1)) if self.total else (0.0, 0.0)

    def close(self) -> None:
        """Close the file, if there is one."""


class RecordedTape(Tape):
    """All samples of a recording, in a nameless file: a day of them needs no memory. Times never go back."""

    def __init__(self, dtype: "np.dtype[Any]") -> None:
        super().__init__(dtype)
        self._file = tempfile.TemporaryFile()  # noqa: SIM115
        self._piece_s = 0.01
        self._force_N: list[float] = []
        self._map(LIVE_SAMPLES)

    def append(self, samples: Samples) -> None:
        """Add samples."""
        if not len(samples):
            return
        samples = samples.copy()
        times = np.maximum.accumulate(np.nan_to_num(samples["timestamp"], nan=0.0))
        samples["timestamp"] = np.maximum(times, self.span()[1])
        while self.total + len(samples) > len(self._ring):
            self._map(2 * len(self._ring))
        super().append(samples)
        self._note_forces(samples)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _map(self, most: int) -> None:
        """Make room for so many samples."""
        self._ring = np.memmap(self._file, self._ring.dtype, "r+", shape=(most,))

    def overview(self) -> list[float]:
        """Largest force in each of the equal pieces of the recording, N."""
        return [round(force, 3) for force in self._force_N]

    def _note_forces(self, samples: Samples) -> None:
        """Keep the largest force of each piece; two pieces become one where there would be too many."""
        elapsed_s = samples["timestamp"] - self.timestamp(0)
        while elapsed_s[-1] >= PIECES * self._piece_s:
            self._force_N = [max(self._force_N[k : k + 2]) for k in range(0, len(self._force_N), 2)]
            self._piece_s *= 2.0
        piece = (elapsed_s / self._piece_s).astype(int)
        self._force_N += [0.0] * (int(piece[-1]) + 1 - len(self._force_N))
        force_N = np.nan_to_num(samples["force_N"], nan=0.0)
        starts = np.flatnonzero(np.diff(piece, prepend=-1))
        for number, force in zip(piece[starts].tolist(), np.maximum.reduceat(force_N, starts).tolist(), strict=True):
            self._force_N[number] = max(self._force_N[number], force)


@dataclass
class Playhead:
    """Where a viewer is in a recording.

    Attributes:
        at_s: Time since the start of the recording, s.
        speed: Times the recorded pace.
        is_playing: Whether time goes on.
        has_jumped: Whether the viewer sought another place, and has nothing of it yet.
    """

    at_s: float = 0.0
    speed: float = 1.0
    is_playing: bool = True
    has_jumped: bool = True

    def advance(self, step_s: float, end_s: float, *, is_complete: bool) -> bool:
        """Let time go on.

        Args:
            step_s: Time that has passed, s.
            end_s: How far the recording is known, s.
            is_complete: Whether that is all of it.

        Returns:
            Whether the end has just been reached.
        """
        if not self.is_playing:
            return False
        self.at_s = min(self.at_s + step_s * self.speed, end_s)
        self.is_playing = not (is_complete and self.at_s >= end_s)
        return not self.is_playing

    def apply(self, request: ReplayRequest, end_s: float) -> None:
        """Do what the page asks for; at the end, playing begins anew."""
        match request:
            case Speed(value=value):
                self.speed = value
            case Seek(value=value):
                self.at_s, self.has_jumped = min(value, end_s), True
            case Pause():
                self.is_playing = False
            case Play():
                self.is_playing = True
                if self.at_s >= end_s:
                    self.at_s, self.has_jumped = 0.0, True

    def to_json(self) -> dict[str, float | bool]:
        """For the page."""
        return {"at_s": round(self.at_s, 3), "speed": self.speed, "is_playing": self.is_playing}


TICK_S, IDLE_S = 1 / 120, 0.05
"""Time between two looks at the reader, s: with viewers, and without."""

IN_FLIGHT = 2
"""Messages of samples that a viewer may have without having drawn them."""

SHOWN_HZ = 240.0
"""Samples of a second that a viewer gets at most, Hz: four for each picture."""

FEWEST, MOST = 8, 600
"""Bounds of the samples in one message."""

BACKFILL_S = 10.0
"""How far back a new viewer sees, s: the length of the traces."""

MARKERS = 200
"""Markers that the page shows, the latest."""

STATE_S = 0.5
"""Time between two looks at how far a recording is known, s."""


class Hub:
    """The stream and its viewers; belongs to one event loop.

    Attributes:
        is_replay: Whether the stream is a recording.
        requests: The type of the requests that this page takes.
        tape: The samples.
        description: Of the film, for the page, see `describe_film`.
        state: What changes seldom: counters, recording, notes; for the page.
        version: Counts the changes of `state`.
        viewers: Those that are there.
        has_ended: Whether the reader has ended.
    """

    def __init__(self, link: PageEnd, description: dict[str, Any], *, is_recording: bool) -> None:
        """Show a live stream or a recording, of which nothing has come yet."""
        self.description = description
        self.state: dict[str, Any] = {}
        self.version = 0
        self.viewers: set[Viewer] = set()
        self.has_ended = False
        self._link = link
        self._dtype = SampleFormat(tuple(description["electrodes"])).dtype
        self.is_replay = is_recording
        self.requests: Any = ReplayRequest if is_recording else LiveRequest
        self.tape: Tape = RecordedTape(self._dtype) if is_recording else Tape(self._dtype)

    def close(self) -> None:
        """Close the link and the file of a recording."""
        self._link.close_here()
        self.tape.close()

    def do(self, request: LiveRequest | ReplayRequest, viewer: "Viewer") -> bool:
        """Do what a page asks for; False if the reader takes no requests any more."""
        if isinstance(request, ReplayRequest):
            viewer.apply(request)
            return True
        return self._link.ask(request)

    async def run(self) -> None:
        """Take what comes, and wake the viewers, until the reader has ended."""
        looked_s = 0.0
        while self._link.is_open:
            self._drain()
            if time.time() - looked_s > STATE_S:
                looked_s = time.time()
                self._show_progress()
            self._wake()
            await asyncio.sleep(TICK_S if self.viewers else IDLE_S)
        self.has_ended = True
        self._wake()

    def _wake(self) -> None:
        for viewer in self.viewers:
            viewer.wake.set()

    def _drain(self) -> None:
        """Take what the reader has sent."""
        if data := self._link.take(self._dtype.itemsize):
            self.tape.append(np.frombuffer(data, self._dtype))
        for message in self._link.replies():
            self._note(message)
        if not self._link.is_open:
            self._note({"has_ended": True})

    def _show_progress(self) -> None:
        """Bring the state of a recording up to date."""
        if isinstance(self.tape, RecordedTape) and self.state.get("samples") != self.tape.total:
            self._note({"samples": self.tape.total, "span": self.tape.span(), "overview": self.tape.overview()})

    def _note(self, message: dict[str, Any]) -> None:
        marker = message.pop("marker", None)
        if marker is not None:
            self.state["markers"] = [*self.state.get("markers", ()), marker][-MARKERS:]
        self.state.update(message)
        self.version += 1


class Viewer:
    """One browser: what it has of the stream.

    Attributes:
        wake: Set when there may be something to send.
    """

    def __init__(self, hub: Hub) -> None:
        now_s = time.time()
        self.wake = asyncio.Event()
        self._hub, self._playhead = hub, Playhead() if hub.is_replay else None
        self._next = hub.tape.index(now_s - BACKFILL_S)
        self._begins, self._missed, self._version = True, 0, -1
        self._sent = self._confirmed = 0
        self._served_s = self._played_s = now_s
        self._shows_playhead = True

    def confirm(self, number: int) -> None:
        """The page has drawn a message."""
        self._confirmed = max(self._confirmed, min(number, self._sent))
        self.wake.set()

    def apply(self, request: ReplayRequest) -> None:
        """Do what the page asks for with its place in the recording."""
        if self._playhead is not None:
            self._playhead.apply(request, self._length_s())
            self._shows_playhead = True

    def messages(self, now_s: float) -> list[bytes | str]:
        """What to send now; nothing as long as the viewer has not drawn what it has.

        Args:
            now_s: Unix seconds.
        """
        if self._playhead is not None:
            self._play(self._playhead, now_s)
        if self._sent - self._confirmed >= IN_FLIGHT:
            return []
        elapsed_s, self._served_s = now_s - self._served_s, now_s
        messages: list[bytes | str] = []
        if self._version != self._hub.version:
            self._version = self._hub.version
            messages.append(json.dumps({"state": self._hub.state}))
        if (samples := self._samples(int(min(max(SHOWN_HZ * elapsed_s, FEWEST), MOST)), now_s)) is not None:
            messages.append(samples)
        if self._playhead is not None and self._shows_playhead:
            messages.append(json.dumps({"play": self._playhead.to_json()}))
            self._shows_playhead = False
        return messages

    def _samples(self, most: int, now_s: float) -> bytes | None:
        """The next samples, or None if there is nothing new."""
        tape = self._hub.tape
        stop, start = self._stop(), max(self._next, tape.oldest)
        begins, self._begins = self._begins, False
        if stop <= start and not begins:
            return None
        self._missed += start - self._next
        self._next = stop
        self._sent += 1
        shown = coalesce(tape.samples(start, stop), MOST if begins else most)
        return samples_message(self._sent, now_s, shown, self._missed, begin_anew=begins)

    def _stop(self) -> int:
        """Number of the first sample that is not to be shown yet."""
        tape, playhead = self._hub.tape, self._playhead
        if playhead is None or not tape.total:
            return tape.total
        at_s = tape.span()[0] + playhead.at_s
        if playhead.has_jumped:
            playhead.has_jumped, self._begins = False, True
            self._next = tape.index(at_s - BACKFILL_S)
        return tape.index(at_s)

    def _play(self, playhead: Playhead, now_s: float) -> None:
        step_s, self._played_s = now_s - self._played_s, now_s
        is_complete = self._hub.state.get("is_complete", False)
        self._shows_playhead |= playhead.advance(max(step_s, 0.0), self._length_s(), is_complete=is_complete)

    def _length_s(self) -> float:
        start, end = self._hub.tape.span()
        return end - start
