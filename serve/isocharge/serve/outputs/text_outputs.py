"""Outputs of records as lines of JSON or CSV, to standard output or to a new file, and as JSON in UDP datagrams.

The UDP server of PlotJuggler can receive the records if the protocol of the server is set to JSON. PlotJuggler expects
one JSON object in each datagram. PlotJuggler uses the number `timestamp` as the time, ignores values that are null, and
shows every other number as a time series. The name of a time series is the path of the number in the JSON object, such
as `charge_pC/A`.
"""

import socket
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

from isocharge.common.errors import InputError, shown
from isocharge.serve.outputs.output import FileOutput, OutputContext, OutputKind, is_file_with
from isocharge.serve.record.formats import csv_header, csv_row
from isocharge.serve.record.record import PredictionRecord, record_fields


class LineFormat(NamedTuple):
    """Format of the lines of a text.

    Attributes:
        header: First line, with the line feed; empty if there is no header.
        to_line: Function that converts a record to a line without the line feed.
    """

    header: str
    to_line: Callable[[PredictionRecord], str]


def json_lines(_: OutputContext) -> LineFormat:
    """Return the format of records as JSON, which has no header."""
    return LineFormat("", PredictionRecord.to_json)


def csv_lines(context: OutputContext) -> LineFormat:
    """Return the format of records as CSV with the columns that the stream needs."""
    header = csv_header(context.electrodes, record_fields(context.sections))
    return LineFormat(f"{header}\n", lambda record: csv_row(record, context.electrodes))


class TextOutput:
    """Output that writes one line for each record, such as to standard output."""

    def __init__(self, write_text: Callable[[str], object], lines: LineFormat) -> None:
        """Store the function that writes a text, and write the header if there is a header."""
        self._write_text = write_text
        self._to_line = lines.to_line
        if lines.header:
            write_text(lines.header)

    def write(self, record: PredictionRecord) -> None:
        """Write the line of a record."""
        self._write_text(self._to_line(record) + "\n")

    def close(self) -> None:
        """Leave standard output open."""


class TextFile(FileOutput):
    """Output that writes one line to a new file for each record.

    Attributes:
        write: Function that writes the line of a record. It raises an `OSError` if the disk is full.
    """

    def __init__(self, path: Path, lines: LineFormat, *, is_live: bool) -> None:
        """Create the file, and write the header if there is a header.

        Args:
            path: Path of the file, which must not exist yet.
            lines: Format of the lines.
            is_live: Whether the records come from a sensor.

        Raises:
            OutputExists: If the file exists already.
            OSError: If the file cannot be created.
        """
        super().__init__(path, is_live=is_live)
        self.write = TextOutput(lambda text: self._file.write(text.encode()), lines).write


def _text_kinds(name: str, suffix: str, lines: Callable[[OutputContext], LineFormat]) -> tuple[OutputKind, OutputKind]:
    """Return the kinds of outputs that write lines to standard output and to a file.

    Args:
        name: Target of standard output.
        suffix: End of the names of files.
        lines: Function that returns the format of the lines of a stream.
    """
    standard_output = OutputKind(
        form=name,
        accepts=name.__eq__,
        open=lambda _, context: TextOutput(context.write_stdout, lines(context)),
        is_standard_output=True,
    )
    file = OutputKind(
        form=f"FILE{suffix}",
        accepts=is_file_with(suffix),
        open=lambda target, context: TextFile(Path(target), lines(context), is_live=context.is_live),
    )
    return standard_output, file


STDOUT_JSON, JSON_FILE = _text_kinds("json", ".jsonl", json_lines)
STDOUT_CSV, CSV_FILE = _text_kinds("csv", ".csv", csv_lines)


SCHEME = "udp://"


class UdpOutput:
    """Output that sends each record as a datagram, even if no program receives the datagrams."""

    def __init__(self, target: str) -> None:
        """Resolve the address of the receiver, and open the socket.

        Args:
            target: Address of the receiver in the form `udp://HOST:PORT`.

        Raises:
            InputError: If the target has another form, or the host is unknown.
        """
        try:
            address = urlsplit(target)
            if not address.hostname or not address.port or address.path:  # `port` raises ValueError if it is no number
                raise ValueError("expected a host and a port")
            first_address = socket.getaddrinfo(address.hostname, address.port, type=socket.SOCK_DGRAM)[0]
        except (OSError, ValueError) as error:  # getaddrinfo raises ValueError if a part of the name is too long
            raise InputError(
                f"output {shown(target)}: expected {SCHEME}HOST:PORT, as in {SCHEME}127.0.0.1:9870 ({error})"
            ) from error
        family, _, _, _, socket_address = first_address  # the address that the system prefers, IPv4 or IPv6
        self._address = socket_address
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)  # a live stream must not wait for the network

    def write(self, record: PredictionRecord) -> None:
        """Send a record. If the record cannot be sent at once, drop it, because a live stream never waits."""
        with suppress(OSError):  # the receiver is unreachable, or the buffer is full
            self._socket.sendto(record.to_json().encode(), self._address)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


UDP = OutputKind(
    form=f"{SCHEME}HOST:PORT",
    accepts=lambda target: target.startswith(SCHEME),
    open=lambda target, _: UdpOutput(target),  # the output does not depend on the stream
)
