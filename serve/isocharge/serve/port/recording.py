"""Recordings, which are files with the bytes from a port and the records computed from these bytes.

The bytes are stored in chunks. A chunk consists of the bytes that arrived together. Each line of the file is a JSON
object:

    {"isocharge_recording": 1, "model": "three/1", "device": {...}, "name": "left"}
    {"chunk": ["base64 of the bytes", timestamp, clock_ns, outage_s]}
    {"timestamp": ..., ...}                       a record of that chunk
    {"tare": true}                                a request for a new tare
    {"use": "three/2"}                            the model of all records after this line
    {"marker": [timestamp, "text"]}               a moment that the user has marked

A replay computes all fields of the records again, except `latency_us`, which is copied from the recording. With the
same model, the records of the replay are bitwise equal to the recorded records. Each write appends complete lines. A
full disk or a power failure may leave an incomplete last line, which the reader of the file ignores.
"""

import json
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self, TypeVar

from msgspec import Meta, Struct
from msgspec.json import encode

from isocharge.common.errors import RecordingError, cut, is_printable
from isocharge.common.files import MAX_LINE_CHARACTERS, AtomicWriter, StrPath, as_output_errors, bounded_lines
from isocharge.common.structs import WrongKey, parse_json
from isocharge.serve.model.metadata import ModelLabel
from isocharge.serve.port.file_source import Chunk, Moment, foreign_kind

VERSION = 1
"""Version of the format of the file."""

KIND = "isocharge_recording"
"""Key of the version in the first line, by which a recording is recognised."""

Latency = Annotated[float, Meta(ge=-2e16, le=2e16, description="a difference of two monotonic clocks, us")]

log = logging.getLogger(__name__)

Line = TypeVar("Line")
"""Type of the struct to which a line is converted."""


class Marker(NamedTuple):
    """A moment that the user has marked, and the note of the user about this moment.

    Attributes:
        timestamp: Time of the marker, unix seconds.
        text: Note of the user. It may be empty.
    """

    timestamp: Moment
    text: Annotated[str, Meta(max_length=1000)]


class Recorder:
    """Context manager that writes a recording.

    Attributes:
        path: File to which the recording is written.
        failed: Whether writing has stopped because of an error, for example because the disk is full. All lines that
            were written before the error are complete.
    """

    def __init__(self, path: StrPath, model: str, device: Mapping[str, Any], name: str | None = None) -> None:
        """Store the description of a recording. The file is created when the context is entered.

        Args:
            path: File to which the recording is written. It must not exist.
            model: Label of the model, `name/version`.
            device: Content of the device file.
            name: Name of the film in the records; None to use the name of the sensor that the model states.

        Raises:
            RecordingError: If a reader would refuse the first line of the recording, for example because of the name.
        """
        self.path = Path(path)
        self.failed = False
        self._first_line = json.dumps({KIND: VERSION, "model": model, "device": dict(device), "name": name or ""})
        parse_json(self._first_line, "recording", RecordingError, _Header)  # checks the line as a reader does

    def open(self) -> None:
        """Create the file, and write its first line.

        Raises:
            OutputExists: If the file exists already.
            OutputError: If the file cannot be created.
        """
        with as_output_errors(self.path):
            self._file = AtomicWriter(self.path)
        self.write(self._first_line)

    def __enter__(self) -> Self:
        """Create the file, and return the recorder; see `open`."""
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self._file.close()

    def event(self, **event: bool | str | Marker | Chunk) -> None:
        """Write an event: `chunk=chunk`, `marker=marker`, `tare=True` for a new tare, `use=label` for a new model.

        The records of a chunk are written after the chunk, with the method `write`.
        """
        self.write(encode(event).decode())

    def write(self, lines: str) -> None:
        """Append complete lines to the file.

        If an earlier call was interrupted, for example by Ctrl-C, and has left an incomplete line, the new lines
        overwrite this line. If the disk is full, an error is logged, and all later calls write nothing.

        Args:
            lines: One or more lines, such as a record in JSON, without the line feed after the last line.
        """
        if self.failed:
            return
        try:
            # The `AtomicWriter` writes behind the latest complete line. If it raises an error, it has removed the bytes
            # of the incomplete line.
            self._file.write(f"{lines}\n".encode())
        except OSError as error:
            self.failed = True
            log.error("%s: recording stopped (%s); what was written until now is whole", self.path, error.strerror)


class Event(Struct):
    """A line of a recording after the first line.

    A record contains `latency_us`. A chunk, a request for a new tare, a change of the model and a marker each contain
    one of the other keys. All further keys are ignored.

    Attributes:
        latency_us: Latency of a record, us.
        tare: Whether a new tare was requested.
        use: Label of a new model, `name/version`. The model computed all records after this line.
        marker: A moment that the user has marked.
        chunk: A chunk.
    """

    latency_us: Latency | None = None
    tare: bool | None = None
    use: ModelLabel | None = None
    marker: Marker | None = None
    chunk: Chunk | None = None


class Recording:
    """Reader of a recording.

    Attributes:
        model: Label of the model, `name/version`, at the beginning of the recording.
        device: Content of the device file.
        name: Name of the film in the records; empty to use the name of the sensor that the model states.
    """

    def __init__(self, path: StrPath) -> None:
        """Read the first line of the file, which describes the recording.

        Args:
            path: File of the recording.

        Raises:
            RecordingError: If the file cannot be read, or is not a recording of this version.
        """
        self._path = path = Path(path)  # kept, because the other methods read the file again
        first_line = b""
        try:
            # A pipe is refused, because it can be read only once, and the other methods open the file again. The error
            # becomes the reason in the error below, as all other errors do.
            if not path.is_file():
                raise RecordingError("there is no regular file of that name")
            with path.open("rb") as file:
                first_line = file.readline(MAX_LINE_CHARACTERS)  # empty if the file is empty
            header = parse_json(first_line.decode("utf-8", "replace"), "first line", RecordingError, _Header)
        except (OSError, ValueError) as error:  # RecordingError is a ValueError
            # A file of another known kind, such as a table, is named. For all other files, the reason is the error.
            reason = foreign_kind(str(path), first_line) or cut(str(error))
            raise RecordingError(f"{path}: expected a recording of `serve stream --record` ({reason})") from error
        if header.isocharge_recording != VERSION:
            raise RecordingError(
                f"{path}: recording version {header.isocharge_recording} is not supported (this version reads "
                f"{VERSION})"
            )
        self.model = header.model
        self.device = header.device
        self.name = header.name  # name of the film in the records

    def events(self) -> Iterator[Event]:
        """Yield all lines of the recording after the first line in their order.

        The records of a chunk follow the chunk.

        Raises:
            RecordingError: If a line other than the last line is damaged.
        """
        return self._parsed_lines(Event)

    def records(self, record_type: type[Line]) -> Iterator[Line]:
        """Yield the prediction records of the recording in their order.

        Args:
            record_type: Struct type whose fields are read from each record.

        Raises:
            RecordingError: If a line other than the last line is damaged, or a record lacks a field of the struct.
        """
        return self._parsed_lines(record_type, beginning='{"timestamp"')  # only records begin in this way

    def _parsed_lines(self, line_type: type[Line], beginning: str = "") -> Iterator[Line]:
        """Parse the lines after the first line, and yield their content.

        An incomplete last line is ignored, because the program that wrote the line was interrupted.

        Args:
            line_type: Struct type to which each line is converted.
            beginning: First characters of the lines to parse; empty for all lines. Lines that do not begin with a brace
                are also parsed. Such a line is damaged, and parsing it raises an error.

        Raises:
            RecordingError: If a line other than the last line is damaged.
        """
        line_number = 1
        try:
            with self._path.open(encoding="utf-8", errors="replace") as file:
                for line in bounded_lines(file):
                    if not line.endswith("\n"):  # only the last line of the file can be incomplete
                        return
                    is_header = line_number == 1
                    is_damaged = not line.startswith("{")
                    is_selected = line.startswith(beginning) or is_damaged  # to parse a damaged line raises an error
                    if is_selected and not is_header:
                        yield parse_json(line, "", RecordingError, line_type)
                    line_number += 1
        except (OSError, ValueError) as error:
            raise RecordingError(f"{self._path}, line {line_number}: damaged ({cut(str(error))})") from error


class _Header(Struct, forbid_unknown_fields=True):
    """The first line of a recording."""

    isocharge_recording: int
    model: ModelLabel
    device: dict[str, Any]
    name: str = ""

    def __post_init__(self) -> None:
        if not is_printable(self.name):
            raise WrongKey("name", "printable characters", self.name)
