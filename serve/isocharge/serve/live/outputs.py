"""Where records go: CSV, and datagrams for PlotJuggler; lines of JSON are `PredictionRecord.to_json`.

PlotJuggler's UDP server with the JSON protocol takes one object per datagram, uses its number `timestamp`, makes a
series of every number by the path to it, as in `charge_pC/A`, and passes over nulls: a prediction record as it stands.
"""

import csv
import io
import socket
from collections.abc import Iterable
from types import TracebackType
from typing import Any, Self

from isocharge.common.errors import InputError
from isocharge.serve.prediction.record import FIELDS, PredictionRecord

BY_ELECTRODE = ("charge_pC", "charge_raw_pC", "tare_pC")
"""Fields of a record that have a value for each electrode."""


def csv_header(electrodes: tuple[str, ...]) -> str:
    """The columns of `csv_line`: charges have one for each electrode, `charge_pC.A`."""
    return _row(column for name in FIELDS for column in _columns(name, electrodes))


def _columns(name: str, electrodes: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{name}.{electrode}" for electrode in electrodes) if name in BY_ELECTRODE else (name,)


def csv_line(record: PredictionRecord, electrodes: tuple[str, ...]) -> str:
    """A record as a row, numbers to six decimals, flags with blanks between; what is not known is empty."""
    cells: list[str] = []
    for name in FIELDS:
        value = getattr(record, name)
        if name in BY_ELECTRODE:
            cells += [_cell(None if value is None else value[electrode]) for electrode in electrodes]
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
        """Look up where to send.

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
        self._family, self._address = family, socket_address
        self._socket: socket.socket | None = None

    def __enter__(self) -> Self:
        """Open the socket."""
        self._socket = socket.socket(self._family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()

    def send(self, line: str) -> None:
        """Send one datagram, or drop it where the network is not ready: the live path never waits."""
        assert self._socket is not None
        try:
            self._socket.sendto(line.encode(), self._address)
        except OSError:  # unreachable, or the buffer is full
            return
