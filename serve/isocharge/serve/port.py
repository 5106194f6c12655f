"""A serial port as a context manager and an iterator of chunks, each with the host time of its arrival.

Any URL that pyserial knows will do: `/dev/ttyACM0`, a pseudo-terminal, `socket://host:port`, `loop://`.
"""

import termios
import time
from collections.abc import Iterator
from types import TracebackType
from typing import NamedTuple, Self

import serial

from isocharge.errors import PortError, PortLost


class Chunk(NamedTuple):
    """Bytes as they came.

    Attributes:
        data: At least one byte.
        timestamp: Host time of arrival, unix seconds.
        clock_ns: The same moment on `time.perf_counter_ns`, for latencies.
    """

    data: bytes
    timestamp: float
    clock_ns: int


class Port:
    """An open port; iterate over it to get `Chunk`s, for ever.

    Example:
        >>> with Port("/dev/ttyACM0") as port:  # doctest: +SKIP
        ...     for chunk in port:
        ...         print(chunk.data)
    """

    def __init__(self, url: str, *, baud: int = 115200, silence_s: float = 5.0) -> None:
        """Describe a port; it is opened on entering the context.

        Args:
            url: Device path or pyserial URL.
            baud: Bits per second; without meaning for USB and pseudo-terminals.
            silence_s: Time without a byte after which reading gives up, s.
        """
        self.url = url
        self._baud = baud
        self._silence_s = silence_s
        self._serial: serial.SerialBase | None = None

    def __enter__(self) -> Self:
        """Open the port and forget what had piled up in it.

        Raises:
            PortError: If it cannot be opened.
        """
        try:
            self._serial = serial.serial_for_url(self.url, baudrate=self._baud, timeout=self._silence_s, exclusive=True)
            self._serial.reset_input_buffer()  # a tty does so by itself, a socket does not
        except (OSError, ValueError, termios.error) as error:
            self._close()
            raise PortError(
                f"{self.url}: cannot be opened at {self._baud} baud ({error}); check the cable and the name, that no "
                "other program has it open, and that you may read it (on Linux, the group 'dialout')"
            ) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the port."""
        self._close()

    def _close(self) -> None:
        if self._serial is not None:
            self._serial.close()
            self._serial = None

    def __iter__(self) -> Iterator[Chunk]:
        """Chunks as they arrive.

        Raises:
            PortLost: If the port goes away.
            PortError: If nothing comes for `silence_s`, or the port is not open.
        """
        while True:
            data = self._read()
            if not data:
                raise PortError(
                    f"{self.url}: no data for {self._silence_s:g} s; check that the board is powered and sends, "
                    f"and that {self._baud} baud is its speed"
                )
            yield Chunk(data, time.time(), time.perf_counter_ns())

    def _read(self) -> bytes:
        """Wait for a byte and take all that came with it; nothing at all if the port stays silent."""
        if self._serial is None:
            raise PortError(f"{self.url}: not open; use `with Port(...) as port`")
        try:
            first: bytes = self._serial.read(1)
            return first + self._serial.read(self._serial.in_waiting) if first else first
        except (OSError, termios.error) as error:  # pyserial lets both through; termios.error is not an OSError
            raise PortLost(f"{self.url}: went away while it was read ({error}); plug it in and start again") from error
