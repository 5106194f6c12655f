"""Bytes of a port for a while, at the speed at which they are frames."""

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

from isocharge.common.errors import PortLost
from isocharge.serve.port.request import Request
from isocharge.serve.port.serial_port import Chunk, Port
from isocharge.serve.port.udp import SCHEME

BAUDS = (115200, 921600, 1000000, 2000000, 460800, 230400, 57600, 38400, 19200, 9600)
"""Baud rates to try, in this order, bit/s."""

TRY_S = 1.0
"""Time of listening at a baud rate before the next one is tried, s."""

ECHO_S = 0.3
"""Time of listening for an echo, s."""

ECHO_SHARE = 0.7
"""Share of requests that come back from which a line has an echo, dimensionless."""

STEP_S = 0.1
"""Longest wait for a byte before the clock is looked at, s."""


@dataclass
class Heard:
    """What came through a port.

    Attributes:
        url, baud: The port and its speed, bit/s.
        request: What the board was asked.
        chunks: The bytes as they came.
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
        """Time in which the bytes came, s: from the first chunk to the last, and a chunk's share more."""
        if len(self.chunks) < 2:
            return max(self.seconds, 1e-3)
        span_s = self.chunks[-1].timestamp - self.chunks[0].timestamp
        return max(1e-3, span_s * len(self.chunks) / (len(self.chunks) - 1))

    @property
    def are_datagrams(self) -> bool:
        """Whether each chunk is a datagram."""
        return self.url.startswith(SCHEME)


def has_speed(url: str) -> bool:
    """Whether a port has a baud rate: sockets and pseudo-terminals have none."""
    return "://" not in url and not os.path.realpath(url).startswith("/dev/pts/")


def listen(
    url: str,
    bauds: Sequence[int],
    seconds: float,
    request: Request | None,
    is_clear: Callable[[Heard], bool],
) -> Heard:
    """Listen to a port, at the first of some speeds at which the bytes make sense.

    Args:
        url: The port.
        bauds: Speeds to try, bit/s.
        seconds: Time of listening, s; what is heard in deciding for a speed is a part of it.
        request: What the board has to be asked; whether the line brings it back is found out.
        is_clear: Whether bytes make sense; asked once, while more come.

    Raises:
        PortError: If the port cannot be opened.
    """
    if not has_speed(url):
        bauds = bauds[:1]
    best: Heard | None = None
    for baud in bauds:
        heard, clear = _listen(Heard(url, baud, request), seconds, is_clear if len(bauds) > 1 else None)
        if clear or not heard.chunks:  # silence is silence at any speed
            return heard
        best = best or heard
    assert best is not None
    return best


def _listen(heard: Heard, seconds: float, is_clear: Callable[[Heard], bool] | None) -> tuple[Heard, bool]:
    if heard.request is not None and not heard.request.echo:
        heard.request = _with_echo(heard)
        seconds = max(STEP_S, seconds - ECHO_S)
    answer: Future[bool] | None = None
    began = time.monotonic()
    with (
        Port(heard.url, baud=heard.baud, request=heard.request) as port,
        ThreadPoolExecutor(1) as pool,
    ):
        while (left_s := began + seconds - time.monotonic()) > 0.0:
            try:
                chunk = port.read(min(STEP_S, left_s))
            except PortLost:
                break  # the check uses what came before
            heard.chunks += [chunk] if chunk else []
            heard.seconds = time.monotonic() - began
            if is_clear and answer is None and heard.seconds >= TRY_S and heard.chunks:
                answer = pool.submit(is_clear, replace(heard, chunks=list(heard.chunks)))
            if answer is not None and answer.done() and not answer.result():
                return heard, False
        heard.seconds = time.monotonic() - began
    if is_clear is None:
        return heard, True
    return heard, answer.result() if answer else is_clear(heard)


def _with_echo(heard: Heard) -> Request:
    """The request, with the knowledge whether the line brings it back."""
    assert heard.request is not None
    end_s = time.monotonic() + ECHO_S
    with Port(heard.url, baud=heard.baud, request=heard.request) as port:
        while (left_s := end_s - time.monotonic()) > 0.0:
            try:
                port.read(left_s)
            except PortLost:
                break
        return replace(heard.request, echo=port.echo_share >= ECHO_SHARE)
