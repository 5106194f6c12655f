"""A serial port as a context manager and an iterator of chunks, each with the host time of its arrival.

Any URL that pyserial knows will do: `/dev/ttyACM0`, a pseudo-terminal, `socket://host:port`, `rfc2217://host:port`,
`loop://`; and `tcp://host:port`, the same as `socket://`, and `udp://host:port`, where datagrams are received. On
request, a port that goes away or falls silent is opened again until it is back; the first chunk after an outage says
how long it was. A board that has to be asked is asked.
"""

import importlib
import io
import logging
import os
import select
import time
from collections.abc import Iterator
from types import TracebackType
from typing import Any, NamedTuple, Self

from isocharge.common.errors import PortError, PortLost
from isocharge.serve.port.request import Asker, Request
from isocharge.serve.port.udp import SCHEME, UdpSocket

RETRY_S = 0.1
"""First pause before a lost port is opened again, s; each pause is twice as long as the one before."""

LONGEST_RETRY_S = 2.0
"""Longest pause, s."""

MOST_BYTES = 65536
"""Largest chunk, bytes."""

log = logging.getLogger(__name__)


def _terminal_errors() -> tuple[type[Exception], ...]:
    """What pyserial lets through besides OSError; empty on systems without POSIX terminals."""
    try:
        return (importlib.import_module("termios").error,)
    except ImportError:
        return ()


HAS_POSIX_PORTS = bool(_terminal_errors())
"""Whether ports are file descriptors for which `select` can wait; where not, pyserial reads them."""

READ_ERRORS: tuple[type[Exception], ...] = (OSError, *_terminal_errors())
OPEN_ERRORS: tuple[type[Exception], ...] = (ValueError, *READ_ERRORS)
"""What opening a port raises besides errors of ours."""


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
    ) -> None:
        """Describe a port; it is opened on entering the context.

        Args:
            url: Device path or pyserial URL.
            baud: Bits per second; ignored by USB and pseudo-terminals.
            silence_s: Time without a byte after which the port counts as lost, s.
            reconnect: Whether to open a lost port again until it is back, instead of raising.
            request: What the board has to be asked; None for a board that sends unasked.
        """
        self.url = url
        self.outages = 0
        self._baud = baud
        self._silence_s = silence_s
        self._reconnect = reconnect
        self._asker = Asker(request) if request else None
        self._serial: Any = None
        self._descriptor: int | None = None

    def __enter__(self) -> Self:
        """Open the port and drop the bytes that it has buffered.

        Raises:
            PortError: If it cannot be opened.
        """
        try:
            self._serial = self._opened()
            self._serial.reset_input_buffer()  # a tty drops them by itself, a socket does not
        except OPEN_ERRORS as error:
            self._close()
            raise PortError(
                f"{self.url}: cannot be opened at {self._baud} baud ({error}); check the cable and the name, that no "
                "other program has it open, and that you may read it (on Linux, the group 'dialout')"
            ) from error
        _ask_for_low_latency(self._serial)
        self._descriptor = _descriptor(self._serial)
        if self._asker:
            self._asker.forget()
        return self

    def _opened(self) -> Any:
        if self.url.startswith(SCHEME):
            return UdpSocket(self.url, self._silence_s)
        url = self.url.replace("tcp://", "socket://", 1) if self.url.startswith("tcp://") else self.url
        serial = importlib.import_module("serial")  # late: who only predicts does not wait for it
        return serial.serial_for_url(url, baudrate=self._baud, timeout=self._silence_s, exclusive=True)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the port."""
        self._close()

    def _close(self) -> None:
        if self._serial is not None:
            self._serial.close()
        self._serial = self._descriptor = None

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
        outage_s = 0.0
        while True:
            lost_s = time.monotonic()
            try:
                data = self._read()
            except PortLost as error:
                data = self._come_back(error)
                outage_s = time.monotonic() - lost_s
                self.outages += 1
            yield Chunk(data, time.time(), time.perf_counter_ns(), outage_s)
            outage_s = 0.0

    def read(self, timeout_s: float) -> Chunk | None:
        """The bytes that come within a time, s; None if none do.

        Raises:
            PortLost: If the port goes away.
            PortError: If the port is not open.
        """
        data = self._read_until(time.monotonic() + timeout_s)
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
                self.__enter__()
                return self._read()
            except PortError:
                continue

    def _read(self) -> bytes:
        """Wait for a byte, and read all bytes that came with it.

        Raises:
            PortLost: If the port went away, or nothing came in time.
        """
        data = self._read_until(None)
        if not data:
            raise PortLost(
                f"{self.url}: no data for {self._silence_s:g} s; check that the board is powered and sends, "
                f"and that {self._baud} baud is its speed"
            )
        return data

    def _read_until(self, end_s: float | None) -> bytes:
        """The bytes that come until a time on `time.monotonic`; None for as long as silence may last."""
        if self._serial is None:
            raise PortError(f"{self.url}: not open; use `with Port(...) as port`")
        timeout_s = self._silence_s if end_s is None else max(0.0, end_s - time.monotonic())
        try:
            return self._ask_and_read(self._asker, timeout_s) if self._asker else self._read_in_time(timeout_s)
        except READ_ERRORS as error:
            raise PortLost(
                f"{self.url}: went away while it was read ({error}); check the plug and the cable"
            ) from error

    def _ask_and_read(self, asker: Asker, timeout_s: float) -> bytes:
        """Ask whenever it is time, until an answer comes."""
        assert self._serial is not None
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            if not (wait_s := asker.wait_s()):
                self._serial.write(asker.asked())
                wait_s = asker.wait_s()
            if answer := asker.heard(self._read_in_time(min(wait_s, max(0.0, end_s - time.monotonic())))):
                return answer
        return b""

    def _read_in_time(self, timeout_s: float) -> bytes:
        """The bytes that come within a time; nothing if none come."""
        if isinstance(self._serial, UdpSocket):
            return self._serial.receive(timeout_s)
        return self._read_directly(timeout_s) if self._descriptor is not None else self._read_by_pyserial(timeout_s)

    def _read_directly(self, timeout_s: float) -> bytes:
        """Read all bytes in two system calls: pyserial takes five, and one for every byte of a socket."""
        assert self._descriptor is not None
        if not select.select([self._descriptor], [], [], timeout_s)[0]:
            return b""
        data = os.read(self._descriptor, MOST_BYTES)
        if not data:
            raise OSError("it is readable and has no data: it was unplugged, or the other end has closed")
        return data

    def _read_by_pyserial(self, timeout_s: float) -> bytes:
        if timeout_s != self._silence_s:  # to set it costs pyserial a system call
            self._serial.timeout = timeout_s
        first: bytes = self._serial.read(1)
        return first + self._serial.read(self._serial.in_waiting) if first else first


def _ask_for_low_latency(port: Any) -> None:
    """Turn off the 16 ms for which USB adapters collect bytes; a port without that mode raises an error of its own."""
    if isinstance(port, UdpSocket):
        return
    try:
        port.set_low_latency_mode(True)
    except (AttributeError, NotImplementedError, OSError, ValueError):
        return


def _descriptor(port: Any) -> int | None:
    """The file descriptor; None for ports that exist only inside pyserial, for datagrams, and on Windows for all."""
    if isinstance(port, UdpSocket):
        return None
    try:
        return int(port.fileno()) if HAS_POSIX_PORTS else None
    except (AttributeError, io.UnsupportedOperation):
        return None
