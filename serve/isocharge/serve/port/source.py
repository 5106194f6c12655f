"""Where bytes come from: a port, a file, or stdin, as a context manager and an iterator of chunks with their arrival.

A port is any URL that pyserial knows: `/dev/ttyACM0`, a pseudo-terminal, `socket://host:port`, `rfc2217://host:port`,
`loop://`; and `tcp://host:port`, the same as `socket://`, and `udp://host:port`, where datagrams are received. On
request, a port that goes away or falls silent is opened again until it is back; the first chunk after an outage says
how long it was. A board that has to be asked is asked.
"""

import contextlib
import logging
import os
import stat
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, Self

from isocharge.common.errors import InputError, PortError, PortLost
from isocharge.serve.port.serial_line import (
    HAS_POSIX_PORTS,
    OPEN_ERRORS,
    READ_ERRORS,
    SCHEME,
    Asker,
    Request,
    SerialLine,
    UdpSocket,
)

RETRY_S = 0.1
"""First pause before a lost port is opened again, s; each pause is twice as long as the one before."""

LONGEST_RETRY_S = 2.0
"""Longest pause, s."""

log = logging.getLogger(__name__)


class Chunk(NamedTuple):
    """Bytes as they came.

    Attributes:
        data: At least one byte.
        timestamp: Host time of arrival, unix seconds.
        clock_ns: The same moment on `time.perf_counter_ns`, for latencies.
        outage_s: Length of the outage just before, s; 0 if there was none.
    """

    data: bytes
    timestamp: float
    clock_ns: int
    outage_s: float = 0.0


class Port:
    """A port; iterate over it to get `Chunk`s without end.

    Attributes:
        url: Device path or pyserial URL.
        outages: Times that it came back.
        is_live: Bytes come whether they are read or not, and are lost if they are not.

    Example:
        >>> with Port("/dev/ttyACM0") as port:  # doctest: +SKIP
        ...     for chunk in port:
        ...         print(chunk.data)
    """

    is_live = True

    def __init__(
        self,
        url: str,
        *,
        baud: int = 115200,
        silence_s: float = 5.0,
        reconnect: bool = False,
        request: Request | None = None,
        wait: float = 0.0,
    ) -> None:
        """Describe a port; it is opened on entering the context.

        Args:
            url: Device path or pyserial URL.
            baud: Bits per second; ignored by USB and pseudo-terminals.
            silence_s: Time without a byte after which the port counts as lost, s.
            reconnect: Whether to open a lost port again until it is back, instead of raising.
            request: What the board has to be asked; None for a board that sends unasked.
            wait: Time to wait until it can be opened, s.
        """
        self.url, self._wait = url, wait
        self.outages = 0
        self._baud, self._silence_s, self._reconnect = baud, silence_s, reconnect
        self._asker = Asker(request) if request else None
        self._line: SerialLine | UdpSocket | None = None

    def __enter__(self) -> Self:
        """Open the port and drop the bytes that it has buffered.

        Raises:
            PortError: If it cannot be opened, or not in time.
        """
        end_s = time.monotonic() + self._wait
        while True:
            try:
                self._open()
                return self
            except PortError as error:
                if time.monotonic() >= end_s or isinstance(error.__cause__, ValueError):
                    raise
                time.sleep(RETRY_S)

    def _open(self) -> None:
        is_path = "://" not in self.url
        if is_path and HAS_POSIX_PORTS and not Path(self.url).exists():
            raise PortError(f"{self.url}: there is no such port: plug the board in, check the name, or wait for it")
        try:
            is_udp = self.url.startswith(SCHEME)
            self._line = UdpSocket(self.url) if is_udp else SerialLine(self.url, self._baud)
            self._line.reset_input_buffer()  # a tty drops them by itself, a socket does not
        except OPEN_ERRORS as error:
            self._close()
            speed = f" at {self._baud} baud" if is_path else ""
            hint = (
                "check the cable and the name, that no other program has it open, and that you may read it (on Linux, "
                "the group 'dialout')"
                if is_path
                else "check host and number, that the board is on, and that no other program has it"
            )
            raise PortError(f"{self.url}: cannot be opened{speed} ({error}); {hint}") from error
        if self._asker:
            self._asker.forget()

    def __exit__(self, *_: object) -> None:
        """Close the port."""
        self._close()

    def _close(self) -> None:
        if self._line is not None:
            self._line.close()
        self._line = None

    @property
    def echo_share(self) -> float:
        """Share of the requests that the line brought back, dimensionless; 0 for a board that sends unasked."""
        return self._asker.echo_share if self._asker else 0.0

    def __iter__(self) -> Iterator[Chunk]:
        """Chunks as they arrive.

        Raises:
            PortLost: If the port goes away or stays silent for `silence_s`, and is not to be opened again.
            PortError: If the port is not open.
        """
        while True:
            outage_s, lost_s = 0.0, time.monotonic()
            try:
                data = self._read()
            except PortLost as error:
                data = self._come_back(error)
                outage_s = time.monotonic() - lost_s
                self.outages += 1
            yield Chunk(data, time.time(), time.perf_counter_ns(), outage_s)

    def read(self, timeout_s: float) -> Chunk | None:
        """The bytes that come within a time, s; None if none do.

        Raises:
            PortLost: If the port goes away.
            PortError: If the port is not open.
        """
        data = self._receive(timeout_s)
        return Chunk(data, time.time(), time.perf_counter_ns()) if data else None

    def _come_back(self, reason: PortLost) -> bytes:
        """Open the port again and again until bytes come: these bytes."""
        if not self._reconnect:
            raise reason
        log.warning("%s; trying again until it is back", reason)
        pause_s = RETRY_S
        while True:
            self._close()
            time.sleep(pause_s)
            pause_s = min(2.0 * pause_s, LONGEST_RETRY_S)
            try:
                self._open()
                return self._read()
            except PortError:
                continue

    def _read(self) -> bytes:
        """Wait for a byte, and read all bytes that came with it.

        Raises:
            PortLost: If the port went away, or nothing came in time.
        """
        data = self._receive(self._silence_s)
        if not data:
            speed = f", and that {self._baud} baud is its speed" if has_speed(self.url) else ""
            raise PortLost(
                f"{self.url}: no data for {self._silence_s:g} s; check that the board is powered and sends{speed}"
            )
        return data

    def _receive(self, timeout_s: float) -> bytes:
        """The bytes that come within a time, s; nothing if none come."""
        if self._line is None:
            raise PortError(f"{self.url}: not open; use `with Port(...) as port`")
        try:
            if self._asker is None:
                return self._line.receive(timeout_s)
            return self._ask(self._line, self._asker, timeout_s)
        except READ_ERRORS as error:
            raise PortLost(
                f"{self.url}: went away while it was read ({error}); check the plug and the cable"
            ) from error

    def _ask(self, line: SerialLine | UdpSocket, asker: Asker, timeout_s: float) -> bytes:
        """Ask whenever it is time, until an answer comes."""
        end_s = time.monotonic() + timeout_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            if not (wait_s := asker.wait_s()):
                line.write(asker.asked())
                wait_s = asker.wait_s()
            if answer := asker.heard(line.receive(min(wait_s, left_s))):
                return answer
        return b""


def has_speed(url: str) -> bool:
    """Whether a port has a baud rate: sockets and pseudo-terminals have none."""
    return "://" not in url and not os.path.realpath(url).startswith("/dev/pts/")


STDIN = "-"
"""Name of the standard input."""

CHUNK_BYTES = 4096
"""Largest chunk from a file, bytes."""

Chunks = contextlib.AbstractContextManager["Port | FileSource"]


class FileSource:
    """Chunks of a file, a pipe or stdin, up to its end; they wait until somebody reads them."""

    outages = 0
    is_live = False

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def __iter__(self) -> Iterator[Chunk]:
        """Chunks until the file ends; what is on a disk arrives at once, when it is opened."""
        opened_s = time.time()
        at_once = stat.S_ISREG(os.fstat(self._descriptor).st_mode)
        while data := os.read(self._descriptor, CHUNK_BYTES):
            yield Chunk(data, opened_s if at_once else time.time(), time.perf_counter_ns())


def open_source(
    url: str,
    *,
    baud: int = 115200,
    silence_s: float = 5.0,
    reconnect: bool = False,
    request: Request | None = None,
    wait: float = 0.0,
) -> Chunks:
    """The source of chunks behind a name, as a context manager.

    Args:
        url: A device path or URL, the path of a file or named pipe, or - for stdin.
        baud, silence_s, reconnect, request, wait: As `Port` takes them; a file is waited for, too, until it exists.

    Raises:
        InputError: If the file cannot be read.
    """
    if url == STDIN:
        return contextlib.nullcontext(FileSource(sys.stdin.fileno()))
    end_s = time.monotonic() + wait
    while "://" not in url and not Path(url).exists() and time.monotonic() < end_s:
        time.sleep(RETRY_S)
    if "://" not in url and _is_file(Path(url)):
        return _file(Path(url))
    left_s = max(0.0, end_s - time.monotonic())
    return Port(url, baud=baud, silence_s=silence_s, reconnect=reconnect, request=request, wait=left_s)


def _is_file(path: Path) -> bool:
    with contextlib.suppress(OSError):
        mode = path.stat().st_mode
        return stat.S_ISREG(mode) or stat.S_ISFIFO(mode)
    return False


@contextlib.contextmanager
def _file(path: Path) -> Iterator[FileSource]:
    try:
        file = path.open("rb", buffering=0)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected a file of frames") from error
    with file:
        yield FileSource(file.fileno())
