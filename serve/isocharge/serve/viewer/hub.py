"""Distribution of the samples of a stream to the viewers of the live page.

The tape stores the samples by number: the latest samples of a live stream, or all samples of a recording. A viewer
confirms each message that it has drawn. The next message is sent only after this confirmation, and contains all samples
that have arrived in the meantime. If there are too many samples, they are coalesced. No messages are queued for a slow
viewer.
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
"""Number of stored samples of a live stream, which is 16 s at 1 kHz. Slower browsers miss samples."""

MAX_PIECES = 600
"""Largest number of pieces in the overview of a recording."""

FIRST_PIECE_S = 0.01
"""Duration of a piece in the overview of a short recording, s. It is doubled until `MAX_PIECES` pieces suffice."""


class Tape:
    """Ring buffer of the latest samples of a stream.

    Args:
        dtype: NumPy type of a sample.
        capacity: Number of samples that are stored.

    Attributes:
        total: Number of all samples that were appended.
    """

    def __init__(self, dtype: "np.dtype[Any]", capacity: int = LIVE_SAMPLES) -> None:
        """Begin without samples. The class describes the arguments."""
        self.total = 0
        self._ring: Samples = np.zeros(capacity, dtype)

    @property
    def oldest(self) -> int:
        """Number of the oldest stored sample."""
        return max(0, self.total - len(self._ring))

    def append(self, samples: Samples) -> None:
        """Append samples. If the buffer is full, the new samples replace the oldest samples."""
        latest = samples[-len(self._ring) :]
        first = self.total + len(samples) - len(latest)
        self._ring[np.arange(first, first + len(latest)) % len(self._ring)] = latest
        self.total += len(samples)

    def samples(self, start: int, stop: int) -> Samples:
        """Return the stored samples with numbers from `start` to `stop` - 1."""
        return self._ring[np.arange(max(start, self.oldest), stop) % len(self._ring)]

    def timestamp(self, number: int) -> float:
        """Return the Unix time of a sample, s."""
        return float(self._ring[number % len(self._ring)]["timestamp"])

    def index(self, timestamp: float) -> int:
        """Return the number of the first sample after a Unix time, s."""
        return bisect_right(range(self.total), timestamp, lo=self.oldest, key=self.timestamp)

    def span(self) -> tuple[float, float]:
        """Return the Unix times of the oldest and the latest sample, s; zeros if there are no samples."""
        if not self.total:
            return 0.0, 0.0
        return self.timestamp(self.oldest), self.timestamp(self.total - 1)

    def close(self) -> None:
        """Close the file of the samples, if there is one."""


class RecordedTape(Tape):
    """All samples of a recording, stored in a temporary file.

    A time that is smaller than the previous time is replaced by the previous time.
    """

    def __init__(self, dtype: "np.dtype[Any]") -> None:
        """Create the temporary file, and the overview of the forces.

        The overview divides the recording into pieces of equal time, and contains the largest force of each piece.

        Args:
            dtype: NumPy type of a sample.
        """
        super().__init__(dtype)
        self._file = tempfile.TemporaryFile()  # noqa: SIM115
        self._piece_s = FIRST_PIECE_S  # duration of a piece
        self._max_force_N: list[float] = []
        self._map(LIVE_SAMPLES)

    def append(self, samples: Samples) -> None:
        """Append samples, and update the overview.

        Missing or decreasing times are replaced by the previous time, so that the times never decrease. The memory is
        doubled repeatedly if necessary.

        Args:
            samples: The samples, shape (n,).
        """
        if not len(samples):
            return
        ordered = samples.copy()
        _, latest_s = self.span()
        known_s = np.nan_to_num(samples["timestamp"], nan=0.0)
        largest_so_far_s = np.maximum.accumulate(known_s)
        ordered["timestamp"] = np.maximum(largest_so_far_s, latest_s)
        while self.total + len(ordered) > len(self._ring):  # a recording is stored completely
            self._map(2 * len(self._ring))
        super().append(ordered)
        self._update_overview(ordered)

    def close(self) -> None:
        """Close the file of the samples."""
        self._file.close()

    def _map(self, capacity: int) -> None:
        """Map the file to memory. The mapped memory has room for a given number of samples."""
        self._ring = np.memmap(self._file, self._ring.dtype, "r+", shape=(capacity,))

    def overview(self) -> list[float]:
        """Return the largest force in each piece of the recording, N. All pieces have the same length."""
        return [round(force_N, 3) for force_N in self._max_force_N]

    def _update_overview(self, samples: Samples) -> None:
        """Update the largest force of each piece of time. If there are too many pieces, join them in pairs.

        Args:
            samples: New samples, shape (n,), whose times do not decrease.
        """
        elapsed_s = samples["timestamp"] - self.timestamp(0)  # time since the first sample of the recording
        while elapsed_s[-1] >= MAX_PIECES * self._piece_s:
            pairs = [self._max_force_N[first : first + 2] for first in range(0, len(self._max_force_N), 2)]
            self._max_force_N = [max(pair) for pair in pairs]
            self._piece_s *= 2.0
        piece_of_sample = (elapsed_s / self._piece_s).astype(int)
        piece_count = int(piece_of_sample[-1]) + 1
        new_piece_count = piece_count - len(self._max_force_N)
        self._max_force_N += [0.0] * new_piece_count

        # Neighbouring samples of one piece form a run, whose largest force NumPy computes in one call for all runs.
        force_N = np.nan_to_num(samples["force_N"], nan=0.0)
        begins_run = np.diff(piece_of_sample, prepend=-1) != 0  # the first sample always begins a run
        run_starts = np.flatnonzero(begins_run)
        run_pieces = piece_of_sample[run_starts].tolist()
        run_max_N = np.maximum.reduceat(force_N, run_starts).tolist()
        for piece, max_force_N in zip(run_pieces, run_max_N, strict=True):
            self._max_force_N[piece] = max(self._max_force_N[piece], max_force_N)


@dataclass
class Playhead:
    """Position of a viewer in a recording.

    Attributes:
        at_s: Time since the start of the recording, s.
        speed: Speed relative to the recorded speed.
        is_playing: Whether the position advances.
        has_jumped: Whether the viewer has selected another position and has not yet received samples from there.
    """

    at_s: float = 0.0
    speed: float = 1.0
    is_playing: bool = True
    has_jumped: bool = True

    def advance(self, step_s: float, end_s: float, *, is_complete: bool) -> bool:
        """Advance the position in a recording that is played. At its end, playing stops.

        The end of the part that has been read so far only limits the position, because the next part may follow.

        Args:
            step_s: Time since the latest call, s.
            end_s: Length of the part of the recording that has been read, s.
            is_complete: Whether the whole recording has been read.

        Returns:
            Whether the position has just reached the end of the recording.
        """
        if not self.is_playing:
            return False
        self.at_s = min(self.at_s + step_s * self.speed, end_s)
        self.is_playing = not (is_complete and self.at_s >= end_s)
        return not self.is_playing

    def apply(self, request: ReplayRequest, end_s: float) -> None:
        """Carry out a request of the page. Playing at the end of the recording begins at its start.

        Args:
            request: A new speed, a new position (s from the start of the recording), or a request to pause or to play.
            end_s: Length of the part of the recording that has been read, s.
        """
        match request:
            case Speed(value=value):
                self.speed = value
            case Seek(value=value):
                self._jump(min(value, end_s))
            case Pause():
                self.is_playing = False
            case Play():
                self.is_playing = True
                if self.at_s >= end_s:
                    self._jump(0.0)

    def _jump(self, at_s: float) -> None:
        """Set the position to a time since the start of the recording, s."""
        self.at_s = at_s
        self.has_jumped = True

    def to_json(self) -> dict[str, float | bool]:
        """Return the position for the page."""
        return {"at_s": round(self.at_s, 3), "speed": self.speed, "is_playing": self.is_playing}


POLL_INTERVAL_S = 1 / 120
"""Time between two checks for new samples while there are viewers, s."""

IDLE_POLL_INTERVAL_S = 0.05
"""Time between two checks for new samples while there are no viewers, s."""

MAX_UNCONFIRMED_MESSAGES = 2
"""Number of messages with samples that are sent to a viewer before it confirms that it has drawn them."""

MAX_SAMPLE_RATE_HZ = 240.0
"""Largest rate of the samples that are sent to a viewer, Hz: four samples for each frame of a display."""

MIN_MESSAGE_SAMPLES = 8
"""Smallest limit of the number of samples in one message."""

MAX_MESSAGE_SAMPLES = 600
"""Largest number of samples in one message."""

HISTORY_S = 10.0
"""Time span of the earlier samples that a new viewer receives, s. The traces of the page have this length."""

MAX_MARKERS = 200
"""Number of the latest markers that the page shows."""

PROGRESS_INTERVAL_S = 0.5
"""Time between two updates of the part of a recording that has been read, s."""


class Hub:
    """The stream and its viewers. All methods must be called in the same event loop.

    Attributes:
        is_recording: Whether the stream is a recording.
        request_type: Type of the requests that the page may send.
        tape: The samples.
        description: Description of the film for the page.
        state: Values for the page that change rarely, such as counters and markers.
        version: Number of changes of `state`.
        viewers: The connected viewers.
        has_ended: Whether the process that reads the stream has ended.
    """

    def __init__(self, link: PageEnd, description: dict[str, Any], *, is_recording: bool) -> None:
        """Begin without samples and without viewers.

        A recording is stored completely, and its viewers may select a position. Of a live stream, only the latest
        samples are stored.

        Args:
            link: Link to the process that reads the stream.
            description: Description of the film, as `describe_film` returns it.
            is_recording: Whether the stream is a recording.
        """
        self.description = description
        self.state: dict[str, Any] = {}
        self.version = 0
        self.viewers: set[Viewer] = set()
        self.has_ended = False
        self._link = link
        self._dtype = SampleFormat(tuple(description["electrodes"])).dtype
        self.is_recording = is_recording
        # The type is Any, because the type hints do not cover the union of the kinds of requests.
        self.request_type: Any = ReplayRequest if is_recording else LiveRequest
        self.tape: Tape = RecordedTape(self._dtype) if is_recording else Tape(self._dtype)

    def close(self) -> None:
        """Close the link and the file of a recording."""
        self._link.close_here()
        self.tape.close()

    def handle(self, request: LiveRequest | ReplayRequest, viewer: "Viewer") -> bool:
        """Carry out a request of a page, or pass it to the reader. Return whether one of these has succeeded."""
        if isinstance(request, ReplayRequest):
            viewer.apply(request)
            return True
        return self._link.send_request(request)

    async def run(self) -> None:
        """Receive samples and messages, and wake the viewers. The method ends when the reader has ended."""
        progress_update_s = 0.0  # Unix time of the latest update
        while self._link.is_open:  # the reader has not ended
            self._receive()
            if time.time() - progress_update_s > PROGRESS_INTERVAL_S:
                progress_update_s = time.time()
                self._update_progress()
            self._wake_viewers()
            await asyncio.sleep(POLL_INTERVAL_S if self.viewers else IDLE_POLL_INTERVAL_S)
        self.has_ended = True
        self._wake_viewers()  # so that they see `has_ended`

    def _wake_viewers(self) -> None:
        """Wake all viewers, which then check whether they have new samples."""
        for viewer in self.viewers:
            viewer.wake.set()

    def _receive(self) -> None:
        """Receive the samples and messages that the reader has sent."""
        data = self._link.receive_samples(self._dtype.itemsize)
        if data:
            self.tape.append(np.frombuffer(data, self._dtype))
        for message in self._link.receive_messages():
            self._update_state(message)
        if not self._link.is_open:  # the reader has closed its end
            self._update_state({"has_ended": True})

    def _update_progress(self) -> None:
        """Update the state with the part of a recording that has been read."""
        if isinstance(self.tape, RecordedTape) and self.state.get("samples") != self.tape.total:
            self._update_state({"samples": self.tape.total, "span": self.tape.span(), "overview": self.tape.overview()})

    def _update_state(self, message: dict[str, Any]) -> None:
        """Update the state with the values in a message of the reader.

        A marker is appended to the list of the latest markers. All other values replace those with the same names.
        """
        values = dict(message)
        marker = values.pop("marker", None)
        if marker is not None:
            markers = [*self.state.get("markers", ()), marker]
            self.state["markers"] = markers[-MAX_MARKERS:]
        self.state.update(values)
        self.version += 1  # each viewer sends the state again if the version has changed


class Viewer:
    """State of one browser, which contains the part of the stream that the browser has received.

    Args:
        hub: The stream.

    Attributes:
        wake: Event that is set when there may be something to send.
    """

    def __init__(self, hub: Hub) -> None:
        """Begin with the latest samples of a live stream, or at the start of a recording."""
        now_s = time.time()
        self.wake = asyncio.Event()
        self._hub = hub
        self._playhead = Playhead() if hub.is_recording else None  # the position that is shown

        # Samples and values that the page has received
        self._next_sample = hub.tape.index(now_s - HISTORY_S)  # number of the first sample that was not sent
        self._begins_anew = True  # whether the next message replaces everything that the page shows
        self._missed_samples = 0  # number of samples that were overwritten before they could be sent
        self._state_version = -1  # version of the state that was sent last
        self._must_send_playhead = True

        # Messages with samples, which the page confirms
        self._sent_messages = 0
        self._confirmed_messages = 0
        self._latest_message_s = now_s
        self._latest_advance_s = now_s

    def confirm(self, number: int) -> None:
        """Store that the page has drawn the message with this number."""
        self._confirmed_messages = max(self._confirmed_messages, min(number, self._sent_messages))
        self.wake.set()

    def apply(self, request: ReplayRequest) -> None:
        """Carry out a request that changes the position in the recording."""
        if self._playhead is not None:
            self._playhead.apply(request, self._length_s())
            self._must_send_playhead = True

    def messages(self, now_s: float) -> list[bytes | str]:
        """Return the messages to send now. No messages are returned while too many messages are unconfirmed.

        Args:
            now_s: Unix time, s.
        """
        if self._playhead is not None:
            self._advance(self._playhead, now_s)
        if self._sent_messages - self._confirmed_messages >= MAX_UNCONFIRMED_MESSAGES:
            return []

        # The number of samples in a message is limited by the time since the previous message.
        elapsed_s = now_s - self._latest_message_s
        self._latest_message_s = now_s
        max_samples = int(min(max(MAX_SAMPLE_RATE_HZ * elapsed_s, MIN_MESSAGE_SAMPLES), MAX_MESSAGE_SAMPLES))

        messages: list[bytes | str] = []
        if self._state_version != self._hub.version:
            self._state_version = self._hub.version
            messages.append(json.dumps({"state": self._hub.state}))
        samples = self._next_samples_message(max_samples, now_s)
        if samples is not None:
            messages.append(samples)
        if self._playhead is not None and self._must_send_playhead:
            messages.append(json.dumps({"play": self._playhead.to_json()}))
            self._must_send_playhead = False
        return messages

    def _next_samples_message(self, max_samples: int, now_s: float) -> bytes | None:
        """Return a message with the next samples; None if there are no new samples.

        Args:
            max_samples: Largest number of samples in the message. More samples are coalesced.
            now_s: Unix time, s.
        """
        tape = self._hub.tape
        self._begin_anew_after_jump()
        stop = self._first_hidden_sample()
        start = max(self._next_sample, tape.oldest)  # older samples are no longer on the tape
        begins_anew = self._begins_anew  # the page then discards what it shows, even if there are no samples
        self._begins_anew = False
        if stop <= start and not begins_anew:
            return None
        self._missed_samples += start - self._next_sample
        self._next_sample = stop
        self._sent_messages += 1
        limit = MAX_MESSAGE_SAMPLES if begins_anew else max_samples
        samples = coalesce(tape.samples(start, stop), limit)
        return samples_message(self._sent_messages, now_s, samples, self._missed_samples, begin_anew=begins_anew)

    def _begin_anew_after_jump(self) -> None:
        """If the viewer has selected a position, let the next message begin with the samples before this position."""
        playhead = self._playhead
        tape = self._hub.tape
        if playhead is None or not playhead.has_jumped or not tape.total:
            return
        playhead.has_jumped = False
        self._begins_anew = True
        start_s, _ = tape.span()  # time of the first sample of the recording
        self._next_sample = tape.index(start_s + playhead.at_s - HISTORY_S)

    def _first_hidden_sample(self) -> int:
        """Return the number of the first sample that the viewer must not receive yet.

        In a recording, this is the first sample after the position. In a live stream, this is the next sample that will
        arrive.
        """
        tape = self._hub.tape
        if self._playhead is None or not tape.total:
            return tape.total
        start_s, _ = tape.span()
        return tape.index(start_s + self._playhead.at_s)

    def _advance(self, playhead: Playhead, now_s: float) -> None:
        """Advance the position in the recording by the time since the latest call.

        Args:
            playhead: The position.
            now_s: Unix time, s.
        """
        step_s = max(now_s - self._latest_advance_s, 0.0)
        self._latest_advance_s = now_s
        is_complete = self._hub.state.get("is_complete", False)
        if playhead.advance(step_s, self._length_s(), is_complete=is_complete):
            self._must_send_playhead = True

    def _length_s(self) -> float:
        """Return the length of the part of the recording that has been read, s."""
        start_s, end_s = self._hub.tape.span()
        return end_s - start_s
