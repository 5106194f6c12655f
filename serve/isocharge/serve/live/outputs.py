"""Where records go: CSV, datagrams for PlotJuggler, and lines on their way to a consumer that may be slow.

PlotJuggler's UDP server with the JSON protocol takes one object per datagram, uses its number `timestamp`, makes a
series of every number by the path to it, as in `charge_pC/A`, and passes over nulls: a prediction record as it stands.

Who has lines to give never waits. A thread writes what waits, oldest first. When the consumer is so slow that too much
waits, the oldest lines are dropped and counted: what it gets next is as new as can be, and chain and recording never
stop for it.
"""

import csv
import io
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from typing import Any, Self

from isocharge.common.errors import InputError
from isocharge.serve.prediction.record import FIELDS, PredictionRecord
from isocharge.serve.tracking.film_follower import FollowedFilm
from isocharge.serve.tracking.tracker import Other, Tracked

BY_ELECTRODE = ("charge_pC", "charge_raw_pC", "tare_pC")
"""Fields of a record that have a value for each electrode."""


def csv_header(electrodes: tuple[str, ...], fields: tuple[str, ...] = FIELDS) -> str:
    """The columns of `csv_line` for records with these fields: `charge_pC.A` and so on."""
    parts = _parts(electrodes)
    return _row(
        column
        for name in fields
        for column in ([f"{name}.{part}" for part in parts[name]] if name in parts else [name])
    )


def _parts(electrodes: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Fields of a record that have several columns, with the names of their parts."""
    followed = {"tracked": Tracked._fields, "other": Other._fields, "film": FollowedFilm._fields}
    return dict.fromkeys(BY_ELECTRODE, electrodes) | followed


def csv_line(record: PredictionRecord, electrodes: tuple[str, ...]) -> str:
    """A record as a row, numbers to six decimals, flags with blanks between; what is not known is empty."""
    cells: list[str] = []
    parts = _parts(electrodes)
    for name in record.written:
        value = getattr(record, name)
        if name in parts:
            cells += [_cell(None if value is None else value[part]) for part in parts[name]]
        else:
            cells.append(_cell(value))
    return _row(cells)


def _row(cells: Iterable[str]) -> str:
    """Cells with commas between, quoted where they must be."""
    line = io.StringIO()
    csv.writer(line).writerow(cells)
    return line.getvalue().removesuffix("\r\n")


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, tuple):
        return " ".join(value)
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.6f}" if isinstance(value, float) else str(value)


class UdpSink:
    """Sends lines as datagrams, whether anybody listens or not."""

    def __init__(self, address: str) -> None:
        """Look up where to send, and open the socket.

        Args:
            address: `HOST:PORT`.

        Raises:
            InputError: If it is of another form, or the host is unknown.
        """
        host, _, port = address.rpartition(":")
        try:
            if not 0 < int(port) < 1 << 16:
                raise ValueError("no such port")
            family, _, _, _, socket_address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except (OSError, ValueError) as error:  # ValueError: a part of the name is too long
            raise InputError(f"UDP address {address!r}: expected HOST:PORT, as in 127.0.0.1:9870 ({error})") from error
        self._socket, self._address = socket.socket(family, socket.SOCK_DGRAM), socket_address
        self._socket.setblocking(False)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def send(self, line: str) -> None:
        """Send one datagram, or drop it where the network is not ready: the live path never waits."""
        with suppress(OSError):  # unreachable, or the buffer is full
            self._socket.sendto(line.encode(), self._address)


MOST_LINES = 10_000
"""Lines that may wait: ten seconds at 1 kHz, some 10 MB."""

PATIENCE_S = 1.0
"""Time at the end for which a consumer may take no line before the rest is counted as lost, s."""


class LineQueue:
    """A bounded queue of lines and the thread that writes them; a context manager.

    Attributes:
        lost: Lines that were never written, the oldest of those that waited.
    """

    def __init__(self, write: Callable[[str], object], is_ready: Callable[[], bool] = lambda: True) -> None:
        """Set up the queue.

        Args:
            write: Called in the thread with each line.
            is_ready: Called before that; waits a little while, and says whether the consumer would take a line now.
        """
        self.lost = 0
        self._write, self._is_ready = write, is_ready
        self._lines: deque[str] = deque()
        self._change = threading.Condition()
        self._taken, self._is_closed = 0, False  # taken: lines that went to `write`
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="lines", daemon=True)  # it may hang in a write for ever

    def __enter__(self) -> Self:
        """Start the thread."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """As `close`."""
        self.close()

    def put(self, line: str) -> None:
        """Let a line wait for its turn; the oldest one is dropped if too many wait.

        Raises:
            Whatever `write` has raised in the thread.
        """
        with self._change:
            self._raise_error()
            if len(self._lines) >= MOST_LINES:
                self._lines.popleft()
                self.lost += 1
            self._lines.append(line)
            self._change.notify_all()

    def close(self) -> None:
        """Write what waits for as long as the consumer goes on taking it; count the rest as lost.

        Raises:
            As `put`, once.
        """
        with self._change:
            while self._lines and self._thread.is_alive():
                if not self._change.wait_for(partial(self._goes_on, self._taken), PATIENCE_S):
                    break
            self.lost += len(self._lines)
            self._lines.clear()
            self._is_closed = True
            self._change.notify_all()
        self._thread.join(PATIENCE_S)  # the last line may be on its way
        self.lost += self._thread.is_alive()
        self._raise_error()

    def _goes_on(self, taken: int) -> bool:
        """Whether a line was taken since, or none will be any more."""
        return self._taken > taken or self._error is not None

    def _raise_error(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _run(self) -> None:
        try:
            while (line := self._next()) is not None:
                self._write(line)
        except Exception as error:  # raised again where lines are put in
            with self._change:
                self._error = error
                self._change.notify_all()

    def _next(self) -> str | None:
        """The next line, once the consumer would take it; None at the end."""
        while True:
            with self._change:
                self._change.wait_for(lambda: self._lines or self._is_closed)
            if self._is_ready() or self._is_closed:
                with self._change:
                    if not self._lines:
                        return None
                    self._taken += 1
                    self._change.notify_all()
                    return self._lines.popleft()
