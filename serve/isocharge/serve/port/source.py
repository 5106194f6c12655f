"""Sources of bytes from a board: ports, files and the standard input.

A source yields the bytes in chunks. A chunk consists of the bytes that arrived together. `open_source` returns each
source as a context manager.

A port is a device path or a URL that pyserial accepts, such as `/dev/ttyACM0`, a pseudo-terminal, `socket://host:port`,
`rfc2217://host:port` or `loop://`. In addition, `tcp://host:port` means the same as `socket://host:port`, and
`udp://host:port` receives datagrams.

Other packages can add sources. A package that adds a source must declare an entry point in the group
"isocharge.sources". The name of the entry point is the scheme of the URLs of this source. The entry point must refer to
a function that accepts a URL and returns a context manager of a `Source`. A line of a recording can contain a chunk of
up to 700 kB. For example, this entry point in pyproject.toml adds URLs such as `can://vcan0`:

    [project.entry-points."isocharge.sources"]
    can = "my_package:open_bus"

If `reconnect` is true, a port that disappears or falls silent is opened repeatedly until it is back. The first chunk
after an outage contains the length of the outage. If a board sends frames only on request, the port sends the requests.
"""

import contextlib
import logging
import os
import sys
import time
from collections.abc import Iterator
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Protocol, Self

from msgspec import convert

from isocharge.common.errors import InputError, PortError, PortLost, plugin_errors
from isocharge.serve.port.file_source import STDIN, Chunk, FileSource, open_file
from isocharge.serve.port.serial_line import (
    MAX_READ_BYTES,
    OPEN_ERRORS,
    READ_ERRORS,
    UDP_SCHEME,
    Request,
    Requester,
    SerialLine,
    UdpSocket,
)

RETRY_PAUSE_s = 0.3
"""Pause before another attempt to open a port that could not be opened or was lost, s."""

START_UP_s = 10.0
"""Time for which a board may be silent after its port was opened, s.

Many boards restart when their port is opened, and send nothing for up to 6 s.
"""

log = logging.getLogger(__name__)


class Port:
    """A port as a context manager and as an iterator, which yields a `Chunk` whenever bytes arrive.

    The port is opened when the context is entered. The iterator does not end by itself.

    Args:
        url: Device path or URL.
        baud: Speed of a serial port, bits per second. USB ports and pseudo-terminals ignore it.
        silence_s: Time without a byte after which the port is considered lost, s.
        reconnect: Whether to open a lost port repeatedly until it is back, instead of raising an error.
        request: Request that the board needs for each frame; None for a board that sends frames by itself.
        wait: Time to wait until the port can be opened, s. The longest wait for the first byte is the largest of this
            time, `silence_s` and `START_UP_s`.

    Attributes:
        start_up_s: Longest wait for the first byte after the port was opened, s.
        is_live: Always True, because bytes that the program does not read in time are lost.

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
        """Store the settings. The docstring of the class describes the arguments.

        Raises:
            InputError: If requests would have to be sent to a UDP port.
        """
        if request is not None and url.startswith(UDP_SCHEME):
            raise InputError(
                f"{url}: expected a board that sends by itself, got a request in its settings; this port does not know "
                "the address of the board before its first datagram, so use tcp:// or a serial port"
            )
        self.url = url
        self._baud = baud
        self._silence_s = silence_s
        self._reconnect = reconnect
        self._request = request
        self._wait = wait
        self.start_up_s = max(wait, silence_s, START_UP_s)
        self._max_silence_s = self.start_up_s  # longest wait for the next byte; shorter after the board has started
        self._line: SerialLine | UdpSocket | Requester | None = None

    def __enter__(self) -> Self:
        """Open the port, and discard the bytes in its buffer.

        If the port cannot be opened, try again until `wait` seconds have passed. A wrong URL is not tried again.

        Raises:
            PortError: If the port cannot be opened within `wait` seconds, or its URL is wrong.
            InputError: If the port is a file.
        """
        deadline_s = time.monotonic() + self._wait
        while True:
            try:
                self._open()
                return self
            except PortError as error:
                is_wrong_url = isinstance(error.__cause__, ValueError)
                if is_wrong_url or time.monotonic() >= deadline_s:
                    raise
                time.sleep(RETRY_PAUSE_s)

    def _open(self) -> None:
        """Open the line to the board, and discard the bytes in its buffer.

        Raises:
            PortError: If the line cannot be opened.
            InputError: If the port is a file.
        """
        is_path = "://" not in self.url
        path = Path(self.url)
        if is_path and not path.exists():
            raise PortError(f"{self.url}: there is no such port: plug the board in, check the name, or wait for it")
        if is_path and path.is_file():
            raise InputError(
                f"{self.url}: expected a port, got a file; only `isocharge serve stream` reads the bytes of a board "
                "from a file"
            )
        try:
            if self.url.startswith(UDP_SCHEME):
                self._line = UdpSocket(self.url)
            else:
                line = SerialLine(self.url, self._baud)  # discards the bytes in the buffer of the port
                self._line = line if self._request is None else Requester(line, self._request)
        except OPEN_ERRORS as error:
            self._close()
            speed = f" at {self._baud} baud" if is_path else ""
            hint = "check the host and the port number, that the board is on, and that no other program uses it"
            if is_path:
                hint = (
                    "check the cable and the name, that no other program has it open, and that you may read it (on "
                    "Linux, the group 'dialout')"
                )
            raise PortError(f"{self.url}: cannot be opened{speed} ({error}); {hint}") from error
        self._max_silence_s = self.start_up_s  # the opening may have restarted the board, which then starts slowly

    def __exit__(self, *_: object) -> None:
        """Close the port when the context is left."""
        self._close()

    def _close(self) -> None:
        """Close the line if it is open."""
        if self._line is not None:
            self._line.close()
        self._line = None

    def __iter__(self) -> Iterator[Chunk]:
        """Yield chunks as they arrive. If the port is lost and `reconnect` is true, open the port again.

        The port counts as lost if it sends no byte within `start_up_s` after it was opened, or if it later sends no
        byte for `silence_s`. After two successive chunks of the largest size, a warning is logged once, because many
        bytes are waiting to be read.

        Raises:
            PortLost: If the port disappears or stays silent for too long, and `reconnect` is false.
            PortError: If the port is not open.
        """
        full_chunk_count = 0  # number of successive chunks of the largest size; stays 2 after the only warning
        while True:
            wait_start_s = time.monotonic()
            try:
                chunk = self.read(self._max_silence_s)
                if chunk is None:
                    speed_advice = f", and that {self._baud} baud is its speed" if has_speed(self.url) else ""
                    raise PortLost(
                        f"{self.url}: no data for {self._max_silence_s:g} s; check that the board is powered and sends"
                        f"{speed_advice}"
                    )
            except PortLost as error:
                if not self._reconnect:
                    raise
                log.warning("%s; trying again until it is back", error)
                chunk = self._read_after_reconnecting()._replace(outage_s=time.monotonic() - wait_start_s)
            self._max_silence_s = self._silence_s  # the board has started, so that it must send more often
            if full_chunk_count < 2:
                full_chunk_count = full_chunk_count + 1 if len(chunk.data) >= MAX_READ_BYTES else 0
                if full_chunk_count == 2:
                    log.warning(
                        "%s: the program reads more slowly than the board sends: records are late; do less for each "
                        "record, or lower the frame rate",
                        self.url,
                    )
            yield chunk

    def read(self, timeout_s: float) -> Chunk | None:
        """Wait for bytes, and return them as a chunk.

        Args:
            timeout_s: Longest time to wait, s.

        Returns:
            The chunk; None if no bytes arrive in time.

        Raises:
            PortLost: If the port disappears.
            PortError: If the port is not open.
        """
        if self._line is None:
            raise PortError(f"{self.url}: the port is not open; use `with Port(...) as port`")
        try:
            data = self._line.receive(timeout_s)
        except BlockingIOError as error:  # bytes had arrived, but another program has read them
            raise PortLost(
                f"{self.url}: another program reads this port, too, and takes some of its bytes; end that program (on "
                f"Linux, `fuser {self.url}` shows its number)"
            ) from error
        except READ_ERRORS as error:
            raise PortLost(
                f"{self.url}: the port disappeared while it was read ({error}); check the plug and the cable"
            ) from error
        return Chunk(data, time.time(), time.perf_counter_ns()) if data else None

    def _read_after_reconnecting(self) -> Chunk:
        """Open the port repeatedly until bytes arrive, and return the first chunk.

        Opening a port restarts many boards. Each time that an opened port sends nothing, the pause before the next
        attempt is therefore doubled, up to `start_up_s`.
        """
        pause_s = RETRY_PAUSE_s
        chunk: Chunk | None = None
        while chunk is None:
            self._close()
            time.sleep(pause_s)
            with contextlib.suppress(PortError):  # also PortLost
                self._open()
                pause_s = min(2.0 * pause_s, self.start_up_s)
                chunk = self.read(self.start_up_s)  # None if the board sends nothing
        return chunk


def has_speed(url: str) -> bool:
    """Return whether a port has a baud rate. Sockets and pseudo-terminals have no baud rate."""
    return "://" not in url and not os.path.realpath(url).startswith("/dev/pts/")


ENTRY_POINTS = "isocharge.sources"
"""Group of the entry points through which other packages add sources."""


class Source(Protocol):
    """A source of the bytes of a board.

    Attributes:
        is_live: Whether bytes are lost if they are not read in time.
    """

    is_live: bool

    def __iter__(self) -> Iterator[Chunk]:
        """Yield chunks as they arrive, until the source ends."""


class AddedSource(contextlib.ExitStack):
    """Source that another package provides. Its error messages state the entry point of the package.

    Each chunk is checked, so that a recording never contains a chunk that a replay would refuse.

    Attributes:
        is_live: Whether bytes are lost if they are not read in time.
    """

    def __init__(self, entry_point: EntryPoint, url: str) -> None:
        """Open the source, which is closed when the context is left.

        Args:
            entry_point: Entry point that refers to a function. The function returns the source for a URL.
            url: The URL.

        Raises:
            PluginError: If the package cannot be imported, or returns no source.
        """
        super().__init__()
        # Each call returns a new context, which states the entry point in all errors.
        self._named_errors = partial(plugin_errors, url, f"source {entry_point.value}")
        with self._named_errors():
            self._source = self.enter_context(entry_point.load()(url))  # loads the function, and calls it
            self.is_live = self._source.is_live

    def __iter__(self) -> Iterator[Chunk]:
        """Yield the chunks of the source.

        Raises:
            PluginError: If the source fails, or yields something other than a chunk.
        """
        with self._named_errors():
            for chunk in self._source:
                yield convert(tuple(chunk), Chunk, builtin_types=[bytes])  # a text is no bytes


def open_source(url: str, *, wait: float = 0.0, **port_settings: Any) -> contextlib.AbstractContextManager[Source]:
    """Return a context manager that opens a port, a file or the standard input as a source of chunks.

    The function waits until the path exists, but not longer than `wait`. The port or the file is opened when the
    context is entered.

    Args:
        url: Device path or URL of a port, path of a file or of a named pipe, or - for the standard input.
        wait: Time to wait until the port can be opened or the file exists, s; see `Port`.
        port_settings: Other settings of a `Port`, such as `baud` and `reconnect`.

    Raises:
        InputError: If the file cannot be read, or is a recording, a table or another file that does not come from a
            board.
    """
    if url == STDIN:
        return contextlib.nullcontext(FileSource(sys.stdin.fileno(), STDIN))

    scheme, separator, _address = url.partition("://")
    is_path = not separator
    if not is_path:
        # If other packages have added sources for the scheme, the first source is used. Without one, the loop is empty.
        for entry_point in entry_points(group=ENTRY_POINTS, name=scheme):
            return AddedSource(entry_point, url)

    # Wait until the path exists, because the type of a missing path (a file or a port) is unknown.
    path = Path(url)
    deadline_s = time.monotonic() + wait
    while is_path and not path.exists() and time.monotonic() < deadline_s:
        time.sleep(RETRY_PAUSE_s)
    is_file = is_path and (path.is_file() or path.is_fifo())  # false for a device, and if the path does not exist
    if is_file:
        return open_file(path)
    remaining_s = max(0.0, deadline_s - time.monotonic())
    return Port(url, wait=remaining_s, **port_settings)
