"""Hub that distributes the samples of a stream to the viewers. A viewer is a browser that shows the live page.

A tape stores the samples under consecutive numbers. A viewer confirms each message that it has drawn. While too many
messages are unconfirmed, the viewer receives no further message. The next message contains all samples that have
arrived since the previous message. If there are too many samples for one message, neighbouring samples are coalesced.
The hub therefore stores no queue of messages for a slow viewer.
"""

import asyncio
import json
import time
from typing import Any

import numpy as np

from isocharge.serve.viewer.link import PageEnd
from isocharge.serve.viewer.messages import (
    LiveRequest,
    ReplayRequest,
    SampleFormat,
    coalesce,
    samples_message,
)
from isocharge.serve.viewer.playhead import Playhead
from isocharge.serve.viewer.tape import RecordedTape, Tape

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
    """Hub that receives the samples of a stream and manages the viewers of the stream.

    All methods must be called in the same event loop.

    Attributes:
        is_recording: Whether the stream is a recording.
        request_type: Type of the requests that the page may send.
        tape: The stored samples of the stream.
        description: Description of the film for the page.
        state: Values for the page that change rarely, such as counters and markers.
        version: Number of times that `state` has changed.
        viewers: The connected viewers.
        has_ended: Whether the process that reads the stream has ended.
    """

    def __init__(self, link: PageEnd, description: dict[str, Any], *, is_recording: bool) -> None:
        """Create a hub without samples and without viewers.

        For a recording, all samples are stored, and each viewer may select a position in the recording. For a live
        stream, only the latest samples are stored.

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
        """Close the link to the reader. For a recording, also close the file of the samples."""
        self._link.close_here()
        self.tape.close()

    def handle(self, request: LiveRequest | ReplayRequest, viewer: "Viewer") -> bool:
        """Carry out the request of a viewer, or pass the request to the reader of the stream.

        Args:
            request: The request. A request of the type `ReplayRequest` only concerns the position of the viewer, and is
                carried out here. A request of the type `LiveRequest` is passed to the reader.
            viewer: The viewer that has sent the request.

        Returns:
            True if the request was carried out or passed to the reader, and False if the reader cannot receive it.
        """
        if isinstance(request, ReplayRequest):
            viewer.apply(request)
            return True
        return self._link.send_request(request)

    async def run(self) -> None:
        """Receive samples and messages from the reader, and wake the viewers, until the reader has ended."""
        latest_update_s = 0.0  # Unix time of the latest update of the progress
        while self._link.is_open:  # the reader has not ended
            self._receive()
            if time.time() - latest_update_s > PROGRESS_INTERVAL_S:
                latest_update_s = time.time()
                self._update_progress()
            self._wake_viewers()
            await asyncio.sleep(POLL_INTERVAL_S if self.viewers else IDLE_POLL_INTERVAL_S)
        self.has_ended = True
        self._wake_viewers()  # the tasks that send to the viewers then notice `has_ended`

    def _wake_viewers(self) -> None:
        """Wake the tasks of all viewers, so that each task checks for new samples to send."""
        for viewer in self.viewers:
            viewer.wake.set()

    def _receive(self) -> None:
        """Receive the samples and messages that the reader has already sent, without waiting."""
        data = self._link.receive_samples(self._dtype.itemsize)
        if data:
            self.tape.append(np.frombuffer(data, self._dtype))
        for message in self._link.receive_messages():
            self._update_state(message)
        if not self._link.is_open:  # the reader has closed its end
            self._update_state({"has_ended": True})

    def _update_progress(self) -> None:
        """For a recording, store in the state which part of the recording has been read so far, if it has grown."""
        if isinstance(self.tape, RecordedTape) and self.state.get("samples") != self.tape.total:
            self._update_state({"samples": self.tape.total, "span": self.tape.span(), "overview": self.tape.overview()})

    def _update_state(self, message: dict[str, Any]) -> None:
        """Update the state with the values of a message from the reader.

        A marker in the message is appended to the list of the latest markers. Every other value replaces the earlier
        value of the same name.
        """
        values = dict(message)
        marker = values.pop("marker", None)
        if marker is not None:
            markers = [*self.state.get("markers", ()), marker]
            self.state["markers"] = markers[-MAX_MARKERS:]
        self.state.update(values)
        self.version += 1  # each viewer sends the state again if the version has changed


class Viewer:
    """Browser that shows the page, with a record of the part of the stream that the browser has received.

    Args:
        hub: Hub of the stream that the browser shows.

    Attributes:
        wake: Event that is set when there may be something to send.
    """

    def __init__(self, hub: Hub) -> None:
        """Begin with the samples of the last `HISTORY_S` seconds of a live stream, or at the start of a recording."""
        now_s = time.time()
        self.wake = asyncio.Event()
        self._hub = hub
        self._playhead = Playhead() if hub.is_recording else None  # the position that is shown

        # What was sent to the page. The samples of the stream are numbered. `_next_sample` is the number of the first
        # sample that was not sent. In a recording, `_begin_anew_after_jump` replaces this number.
        self._next_sample = hub.tape.first_number_after(now_s - HISTORY_S)
        self._begins_anew = True  # whether the page clears its plots when it receives the next message
        self._missed_samples = 0  # number of samples that were overwritten before they could be sent
        self._state_version = -1  # version of the state that was sent last
        self._must_send_playhead = True  # whether the position has changed since it was sent

        # Numbers of messages with samples. The page confirms such a message after it has drawn the samples.
        self._sent_messages = 0
        self._confirmed_messages = 0

        self._latest_message_s = now_s  # Unix time at which the number of samples in a message was last limited
        self._latest_advance_s = now_s  # Unix time at which the position was last advanced

    def confirm(self, number: int) -> None:
        """Store that the page has drawn all messages up to the given number.

        A number that was not sent yet counts as the number of the latest message.
        """
        valid_number = min(number, self._sent_messages)
        self._confirmed_messages = max(self._confirmed_messages, valid_number)
        self.wake.set()

    def apply(self, request: ReplayRequest) -> None:
        """Carry out a request to play or pause the recording, or to change the position or the speed."""
        if self._playhead is not None:
            self._playhead.apply(request, self._length_s())
            self._must_send_playhead = True

    def messages(self, now_s: float) -> list[bytes | str]:
        """Return the messages that are due now. While too many messages are unconfirmed, return an empty list.

        Messages without samples are JSON texts: the state of the stream if it has changed, and the position in a
        recording if it has changed.

        Args:
            now_s: Unix time, s.
        """
        if self._playhead is not None:
            self._advance(self._playhead, now_s)
        unconfirmed_messages = self._sent_messages - self._confirmed_messages
        if unconfirmed_messages >= MAX_UNCONFIRMED_MESSAGES:
            return []

        # The number of samples in a message is limited in proportion to the time since the previous message.
        elapsed_s = now_s - self._latest_message_s
        self._latest_message_s = now_s
        proportional_limit = MAX_SAMPLE_RATE_HZ * elapsed_s
        max_samples = int(min(max(proportional_limit, MIN_MESSAGE_SAMPLES), MAX_MESSAGE_SAMPLES))

        messages: list[bytes | str] = []
        if self._state_version != self._hub.version:
            self._state_version = self._hub.version
            messages.append(json.dumps({"state": self._hub.state}))
        message_with_samples = self._next_samples_message(max_samples, now_s)
        if message_with_samples is not None:
            messages.append(message_with_samples)
        if self._playhead is not None and self._must_send_playhead:
            messages.append(json.dumps({"play": self._playhead.to_json()}))
            self._must_send_playhead = False
        return messages

    def _next_samples_message(self, max_samples: int, now_s: float) -> bytes | None:
        """Return a message with the next samples, or None if there is nothing to send.

        Args:
            max_samples: Largest number of samples in the message. If there are more new samples, they are coalesced.
            now_s: Unix time, s.
        """
        # The samples with the numbers from `start` to `stop` - 1 are sent.
        tape = self._hub.tape
        self._begin_anew_after_jump()
        stop = self._first_hidden_sample()
        start = max(self._next_sample, tape.oldest)  # samples before `oldest` were overwritten

        # If the page must clear its plots, the message is sent even without samples.
        begins_anew = self._begins_anew
        self._begins_anew = False
        if stop <= start and not begins_anew:
            return None
        self._missed_samples += start - self._next_sample
        self._next_sample = stop
        self._sent_messages += 1
        limit = MAX_MESSAGE_SAMPLES if begins_anew else max_samples  # after clearing, the message covers a long time
        samples = coalesce(tape.samples(start, stop), limit)
        return samples_message(self._sent_messages, now_s, samples, self._missed_samples, begin_anew=begins_anew)

    def _begin_anew_after_jump(self) -> None:
        """If the viewer has selected another position in a recording, let the next message replace all plots.

        The next message then begins with the samples of the last `HISTORY_S` seconds before the new position. If the
        viewer has not selected another position, nothing changes.
        """
        playhead = self._playhead
        tape = self._hub.tape
        if playhead is None or not playhead.has_jumped or not tape.total:
            return
        playhead.has_jumped = False
        self._begins_anew = True
        start_s, _ = tape.span()  # time of the first sample of the recording
        self._next_sample = tape.first_number_after(start_s + playhead.at_s - HISTORY_S)

    def _first_hidden_sample(self) -> int:
        """Return the number of the first sample that must not be sent to the viewer yet.

        In a recording, the result is the number of the first sample after the position of the viewer. In a live stream,
        no sample is hidden. The result is then the number of the next sample that will arrive.
        """
        tape = self._hub.tape
        if self._playhead is None or not tape.total:
            return tape.total
        start_s, _ = tape.span()
        return tape.first_number_after(start_s + self._playhead.at_s)

    def _advance(self, playhead: Playhead, now_s: float) -> None:
        """Advance the position in the recording by the time that has passed since the previous call.

        Args:
            playhead: The position of the viewer, which is changed.
            now_s: Unix time, s.
        """
        step_s = max(now_s - self._latest_advance_s, 0.0)  # the clock may have been set back
        self._latest_advance_s = now_s
        is_completely_read = self._hub.state.get("is_complete", False)
        has_just_ended = playhead.advance(step_s, self._length_s(), is_complete=is_completely_read)
        if has_just_ended:  # the page must show that playing has stopped
            self._must_send_playhead = True

    def _length_s(self) -> float:
        """Return the duration of the part of the recording that has been read so far, s."""
        start_s, end_s = self._hub.tape.span()
        return end_s - start_s
