"""Reception of bytes from a port, at a baud rate that is found by trial, and parsing of the frames in these bytes.

The class `ReceivedData` contains the bytes, which do not depend on the format of the frames. The class `Capture`
contains the frames that a parser of one format has found in the bytes. The received bytes can therefore be parsed in
several formats.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from isocharge.common.arrays import LARGEST, Array
from isocharge.common.errors import PortLost
from isocharge.serve.frames.device_clock import DeviceClock, elapsed_s
from isocharge.serve.frames.frame import Frame, Parser
from isocharge.serve.port.file_source import Chunk
from isocharge.serve.port.serial_line import UDP_SCHEME, Request
from isocharge.serve.port.source import Port, has_speed
from isocharge.serve.signal_chain.channels import channel_names
from isocharge.serve.signal_chain.stage import Device

BAUDS = (115200, 921600, 1000000, 2000000, 460800, 230400, 57600, 38400, 19200, 9600)
"""Baud rates to try, in this order, bit/s."""


@dataclass
class ReceivedData:
    """Bytes that were received from a port.

    Attributes:
        url: The port.
        baud: Baud rate of the port, bit/s.
        request: Request that was sent to the board; None if the board sends frames by itself.
        chunks: The bytes with the times of their arrival.
        seconds: Time of listening, s.
    """

    url: str
    baud: int
    request: Request | None = None
    chunks: list[Chunk] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def data(self) -> list[bytes]:
        """The bytes, chunk by chunk."""
        return [chunk.data for chunk in self.chunks]

    @property
    def bytes_seen(self) -> int:
        """Number of bytes."""
        return sum(map(len, self.data))

    @property
    def span_s(self) -> float:
        """Time span in which the bytes arrived, s.

        The result is the time from the first chunk to the last chunk plus the mean time between two chunks, so that n
        chunks span n intervals. With fewer than two chunks, the result is the time of listening. The result is never
        0, so that a rate computed from it is finite.
        """
        duration_s = self.seconds  # time of listening
        if len(self.chunks) > 1:
            first_to_last_s = elapsed_s(self.chunks[0], self.chunks[-1])
            duration_s = first_to_last_s * len(self.chunks) / (len(self.chunks) - 1)
        return max(duration_s, np.finfo(float).eps)

    @property
    def are_datagrams(self) -> bool:
        """Whether each chunk is a datagram."""
        return self.url.startswith(UDP_SCHEME)


def listen(
    url: str,
    bauds: Sequence[int],
    seconds: float,
    request: Request | None,
    has_frames: Callable[[ReceivedData], bool],
    wait: float = 0.0,
    try_s: float = 1.0,
) -> ReceivedData:
    """Find the baud rate of a port, and listen to the port at this baud rate.

    The function chooses the first baud rate at which most of the bytes belong to frames. A board that sends frames by
    itself and is silent at one baud rate is silent at every baud rate, so further attempts would be useless. A board
    that needs requests does not understand them at a wrong baud rate.

    The bytes of the attempts are dropped. After the attempts, the function listens again, for `seconds`.

    Args:
        url: The port.
        bauds: Baud rates to try, bit/s.
        seconds: Time of listening at the right baud rate, s.
        request: Request that the board needs; None if the board sends frames by itself.
        has_frames: Function that returns whether most of the bytes are frames.
        wait: Longest time until the port can be opened, s.
        try_s: Time of listening at a baud rate before the next one is tried, s.

    Returns:
        The bytes at the chosen baud rate, which is the first of `bauds` if no baud rate is suitable. If the board is
        silent, the result of the first attempt, without bytes.

    Raises:
        PortError: If the port cannot be opened.
    """
    # Try the baud rates. Some ports, such as network ports, have no baud rate.
    chosen_baud = bauds[0]
    if has_speed(url) and len(bauds) > 1:
        for baud in bauds:
            received = _listen_at_baud(url, baud, try_s, request, wait)
            if not (received.chunks or request):  # the board is silent at every baud rate
                return received
            if has_frames(received):
                chosen_baud = baud
                break
    return _listen_at_baud(url, chosen_baud, seconds, request, wait)


def _listen_at_baud(url: str, baud: int, seconds: float, request: Request | None, wait: float) -> ReceivedData:
    """Open a port, listen at one baud rate, and return the received bytes with the times of their arrival.

    Args:
        url: The port.
        baud: Baud rate, bit/s.
        seconds: Time of listening since the first byte, s. The first byte may arrive late, because many boards restart
            when their port is opened. Listening ends earlier if the port is lost.
        request: Request that the board needs; None if the board sends frames by itself.
        wait: Time to wait until the port can be opened, s.
    """
    received = ReceivedData(url, baud, request)
    # If the port is lost, the bytes that were received before the loss are returned.
    with Port(url, baud=baud, request=request, wait=wait) as port, suppress(PortLost):
        start_s = time.monotonic()
        chunk = port.read(port.start_up_s)
        if chunk is not None:  # the time of listening begins at the first byte
            start_s = time.monotonic()
        while chunk is not None:
            received.chunks.append(chunk)
            remaining_s = start_s + seconds - time.monotonic()
            chunk = port.read(remaining_s) if remaining_s > 0.0 else None
    received.seconds = time.monotonic() - start_s
    return received


@dataclass
class Capture:
    """Frames that were received from a port.

    Attributes:
        received: The bytes of the frames.
        parser: The parser, with its counters.
        frames: Good frames with one channel or more. If the frames contain a time, their times are those of the clock
            of the device.
    """

    received: ReceivedData
    parser: Parser
    frames: list[Frame]

    @property
    def intact_share(self) -> float:
        """Share of the received bytes that were part of a good frame, dimensionless. The share is 0 without frames."""
        if not self.frames:
            return 0.0
        return 1.0 - self.parser.counts.bytes_dropped / self.received.bytes_seen

    @property
    def rate_Hz(self) -> float:
        """Frame rate in the second half of the frames, Hz; 0 if the times of these frames do not increase.

        The first half is left out, because the times of the first frames are mere assumptions if the frames contain no
        time.
        """
        later_times_s = elapsed_times(self.frames)[len(self.frames) // 2 :]
        span_s = float(np.ptp(later_times_s)) if self.frames else 0.0
        return (len(later_times_s) - 1) / span_s if span_s > 0.0 else 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels; empty without frames."""
        return channel_names(self.frames[-1]) if self.frames else ()

    def values(self) -> tuple[Array, Array]:
        """Return the values and the times of all frames that have as many channels as the last frame.

        Frames with another number of channels are left out, because the values form one array.

        Returns:
            Values, shape (n, channels), and times since the first of these frames, shape (n,), s. A value whose
            magnitude is larger than `LARGEST` is replaced by infinity.
        """
        channel_count = len(self.frames[-1].values)
        frames = [frame for frame in self.frames if len(frame.values) == channel_count]
        values = np.array([frame.values for frame in frames], dtype=float)
        is_too_large = np.abs(values) > LARGEST
        limited_values = np.where(is_too_large, np.copysign(np.inf, values), values)
        return limited_values, elapsed_times(frames)


def elapsed_times(frames: Sequence[Frame]) -> Array:
    """Return the times of frames since the first frame, shape (n,), s. Negative steps (restarts) count as 0 s."""
    clock_s = [frame.clock_s for frame in frames]
    return np.cumsum(np.maximum(np.diff(clock_s, prepend=clock_s[:1]), 0.0))


def read_frames(received: ReceivedData, device: Device) -> Capture:
    """Find the frames in the bytes that were received from a port, and determine their times.

    The parser of the result has also counted the lost and repeated frames.

    Args:
        received: The bytes.
        device: Settings of the board, which define the format.

    Returns:
        The frames, their times, and the counters of the parser.
    """
    parser = device.parser()
    clock = DeviceClock()
    all_frames: list[Frame] = []
    for chunk in received.chunks:
        frames = [frame for frame in parser.feed(chunk.data) if frame.values]  # not those with only a clock or counter
        clock.stamp(chunk, frames, parser.t_us_modulus)  # writes the times into the frames
        all_frames += frames
        for frame in frames:  # counts lost and repeated frames in `parser.counts`; the returned flags are not used
            parser.sequence_flags(frame.seq)
    return Capture(received, parser, all_frames)
