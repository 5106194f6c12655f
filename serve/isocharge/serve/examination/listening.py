"""Bytes of a port for a while, at the speed at which they are frames; and their frames, as a device file says."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PortLost
from isocharge.serve.frames.frame import Frame, Parser, SequenceGaps
from isocharge.serve.live.device import Device
from isocharge.serve.live.reading_stream import channel_names
from isocharge.serve.port.device_clock import DeviceClock
from isocharge.serve.port.serial_line import UDP_SCHEME, Request
from isocharge.serve.port.source import Chunk, Port, has_speed

BAUDS = (115200, 921600, 1000000, 2000000, 460800, 230400, 57600, 38400, 19200, 9600)
"""Baud rates to try, in this order, bit/s."""

TRY_S = 1.0
"""Time of listening at a baud rate before the next one is tried, s."""

ECHO_S = 0.3
"""Time of listening for an echo, s."""

ECHO_SHARE = 0.7
"""Share of requests that come back from which a line has an echo, dimensionless."""


@dataclass
class Heard:
    """What came through a port.

    Attributes:
        url, baud: The port and its speed, bit/s.
        request: What the board was asked.
        chunks: The bytes as they came.
        seconds: Time of listening, s.
        echo_share: Share of the requests that the line brought back, dimensionless.
    """

    url: str
    baud: int
    request: Request | None = None
    chunks: list[Chunk] = field(default_factory=list)
    seconds: float = 0.0
    echo_share: float = 0.0

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
        """Time in which the bytes came, s: from the first chunk to the last, and a chunk's share more."""
        if len(self.chunks) < 2:
            return max(self.seconds, 1e-3)
        span_s = self.chunks[-1].timestamp - self.chunks[0].timestamp
        return max(1e-3, span_s * len(self.chunks) / (len(self.chunks) - 1))

    @property
    def are_datagrams(self) -> bool:
        """Whether each chunk is a datagram."""
        return self.url.startswith(UDP_SCHEME)


def listen(
    url: str,
    bauds: Sequence[int],
    seconds: float,
    request: Request | None,
    is_clear: Callable[[Heard], bool],
    wait: float = 0.0,
) -> Heard:
    """Listen to a port, at the first of some speeds at which the bytes make sense; silence is silence at any speed.

    Args:
        url: The port.
        bauds: Speeds to try, each for a second, bit/s.
        seconds: Time of listening at the right one, s.
        request: What the board has to be asked; whether the line brings it back is found out.
        is_clear: Whether bytes make sense.
        wait: Time to wait until it can be opened, s.

    Raises:
        PortError: If the port cannot be opened.
    """
    if request is not None and not request.echo:
        request = replace(request, echo=_listen(url, bauds[0], ECHO_S, request, wait).echo_share >= ECHO_SHARE)
    if has_speed(url) and len(bauds) > 1:
        tries = (_listen(url, baud, TRY_S, request, wait) for baud in bauds)
        bauds = [next((heard.baud for heard in tries if not heard.chunks or is_clear(heard)), bauds[0])]
    return _listen(url, bauds[0], seconds, request, wait)


def _listen(url: str, baud: int, seconds: float, request: Request | None, wait: float) -> Heard:
    """Listen for a while; after the loss of a port, what came before counts."""
    heard = Heard(url, baud, request)
    with Port(url, baud=baud, request=request, wait=wait) as port:
        began = time.monotonic()
        try:
            while (left_s := began + seconds - time.monotonic()) > 0.0:
                chunk = port.read(left_s)
                heard.chunks += [chunk] if chunk else []
        except PortLost:
            pass
    heard.seconds, heard.echo_share = time.monotonic() - began, port.echo_share
    return heard


@dataclass
class Capture:
    """What came through a port in a while.

    Attributes:
        parser: The parser, with its counters.
        frames: Good frames.
        times_s: Time of each frame, by the device's clock if it sends one, s.
        gaps: Counters of the frame numbers.
        bytes_seen: Number of bytes that came.
    """

    parser: Parser
    frames: list[Frame] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    gaps: SequenceGaps = field(default_factory=SequenceGaps)
    bytes_seen: int = 0

    @property
    def share(self) -> float:
        """Share of bytes that were part of a good frame, dimensionless."""
        return 1.0 - self.parser.counts.bytes_dropped / self.bytes_seen if self.frames else 0.0

    @property
    def rate_Hz(self) -> float:
        """Frames per second, Hz; 0 for fewer than two frames."""
        span_s = self.times_s[-1] - self.times_s[0] if self.times_s else 0.0
        return (len(self.frames) - 1) / span_s if span_s > 0.0 else 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels; empty without frames."""
        return channel_names(self.frames[-1]) if self.frames else ()

    def values(self) -> tuple[Array, Array]:
        """Values (n, channels) of the frames that have as many as the last one, and their times (n,), s."""
        width = len(self.frames[-1].values)
        alike = [k for k, frame in enumerate(self.frames) if len(frame.values) == width]
        times_s = np.array([self.times_s[k] for k in alike])
        return np.array([self.frames[k].values for k in alike], dtype=float), times_s - times_s[0]


def read_frames(heard: Heard, device: Device) -> Capture:
    """The frames of what was heard."""
    capture, clock = Capture(device.parser(), bytes_seen=heard.bytes_seen), DeviceClock()
    for chunk in heard.chunks:
        for frame in capture.parser.feed(chunk.data):
            when = clock.read(frame.t_us, capture.parser.t_us_modulus, chunk.timestamp)
            capture.frames.append(frame)
            capture.times_s.append(when.clock_s)
            capture.gaps.update(frame.seq, capture.parser.seq_modulus)
    return capture
