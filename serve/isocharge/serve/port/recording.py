"""Recordings: files of the chunks of a port and of the records that were computed from them.

Each line of the file is a JSON object:

    {"isocharge_recording": 1, "model": "three/1", "policy": "every", "device": {...}, "name": "left"}
    {"chunk": [timestamp, clock_ns, outage_s, "base64 of the bytes"]}
    {"timestamp": ..., ...}                       a record of that chunk
    {"tare": true}                                a request for a new tare
    {"back": true}                                a request to reset the followed film to its calibration
    {"use": "three/2"}                            the model of all records after this line
    {"marker": [timestamp, "text"]}               a moment that the user has marked

A replay computes all fields of the records again, except `latency_us`, which is copied from the recording. With the
same model, the records are the same, bit for bit. Whole lines are written at once. If a full disk or a power failure
leaves an incomplete last line, this line is ignored.
"""

import base64
import json
import logging
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self, TypeVar

from msgspec import Meta, Struct

from isocharge.common.errors import RecordingError, cut
from isocharge.common.files import AtomicWriter, bounded_lines
from isocharge.common.model_labels import ModelLabel
from isocharge.common.printable_text import is_printable
from isocharge.common.progress import report
from isocharge.common.structs import WrongKey, parse_json
from isocharge.serve.port.source import Chunk

VERSION = 1
"""Version of the format of the file."""

KIND = "isocharge_recording"
"""Key of the version in the first line, by which a recording is recognised."""

LONGEST_ENTRY = 1 << 20
"""Length of the longest line, characters. A chunk of 64 KiB in base64 has a tenth of this length."""

PROGRESS_LINES = 1000
"""Number of lines between two reports of the progress of reading."""

Latency = Annotated[float, Meta(ge=-1e12, le=1e12, description="a latency of some days at most, us")]
Moment = Annotated[float, Meta(ge=-1e11, le=1e11, description="a time before the year 5138, unix seconds")]
Nanoseconds = Annotated[int, Meta(ge=-(1 << 63), le=(1 << 63) - 1)]

log = logging.getLogger(__name__)

Line = TypeVar("Line")
"""Type of the struct as which a line is parsed."""


class Marker(NamedTuple):
    """A moment that the user has marked.

    Attributes:
        timestamp: Time of the marker, unix seconds.
        text: Note of the user; may be empty.
    """

    timestamp: float
    text: str


class Recorder:
    """Writes a recording.

    Attributes:
        path: The file.
        model_label: Label of the model at the beginning of the recording, `name/version`.
        failed: Whether writing has stopped because the disk is full. All lines before are complete.
    """

    def __init__(self, path: Path, model: str, policy: str, device: Mapping[str, Any], name: str | None = None) -> None:
        """Store the description of a recording. The file is created when the context is entered.

        Args:
            path: The file; it must not exist.
            model: Label of the model, `name/version`.
            policy: Which frames have a record; a `Policy`.
            device: Content of the device file.
            name: Name of the film in the records; None for the name of the sensor of the model.
        """
        self.path = path
        self.model_label = model
        self.failed = False
        self._header = {KIND: VERSION, "model": model, "policy": policy, "device": dict(device)}
        if name:
            self._header["name"] = name
        self._last_chunk: Chunk | None = None  # chunk of the latest call of `chunk`
        self._size_before_last_chunk = 0  # size of the file before this chunk was written, bytes

    def __enter__(self) -> Self:
        """Create the file.

        Raises:
            OutputExists: If the file exists already.
            OutputError: If the file cannot be created.
        """
        self._file = AtomicWriter(self.path)
        self._write(json.dumps(self._header))
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def chunk(self, chunk: Chunk, records: list[str]) -> None:
        """Write a chunk and the lines of its records.

        If a call was interrupted, for example by Ctrl-C, the caller passes the same chunk again. The chunk is written
        only once: nothing is written if the file has grown since the first call.

        Args:
            chunk: The chunk.
            records: Records of the frames in the chunk, each a line of JSON.
        """
        is_same_chunk = chunk is self._last_chunk
        if is_same_chunk and self._file.tell() > self._size_before_last_chunk:
            return
        base64_data = base64.b64encode(chunk.data).decode()
        chunk_line = json.dumps({"chunk": [chunk.timestamp, chunk.clock_ns, chunk.outage_s, base64_data]})
        self._last_chunk = chunk
        self._size_before_last_chunk = self._file.tell()
        self._write("\n".join([chunk_line, *records]))

    def tare(self) -> None:
        """Write a request for a new tare."""
        self._write('{"tare": true}')

    def back(self) -> None:
        """Write a request to reset the followed film to its calibration."""
        self._write('{"back": true}')

    def model(self, label: str) -> None:
        """Write the label (`name/version`) of the model that computes all later records."""
        self._write(json.dumps({"use": label}))

    def mark(self, marker: Marker) -> None:
        """Write a marker."""
        self._write(json.dumps({"marker": list(marker)}))

    def _write(self, lines: str) -> None:
        """Write complete lines. Lines that an interruption left incomplete are overwritten.

        If the disk is full, log an error and write nothing from then on.
        """
        if self.failed:
            return
        try:
            self._file.write(f"{lines}\n".encode())
        except OSError as error:
            self.failed = True
            log.error("%s: recording stopped (%s); what was written until now is whole", self.path, error.strerror)


class Event(NamedTuple):
    """A chunk of the recording, or a request for a new tare.

    Attributes:
        chunk: The chunk; None for a request for a new tare.
        latencies_us: Latencies of the records of the chunk, us.
    """

    chunk: Chunk | None
    latencies_us: tuple[float, ...] = ()


class Back(NamedTuple):
    """A request to reset the followed film to its calibration."""


class NewModel(NamedTuple):
    """Label (`name/version`) of the model that computed all records after this line."""

    label: str


class Recording:
    """Reads a recording.

    Attributes:
        model: Label of the model, `name/version`, at the beginning of the recording.
        policy: Which frames have a record; a `Policy`.
        device: Content of the device file.
        name: Name of the film in the records; empty for the name of the sensor of the model.
    """

    def __init__(self, path: Path) -> None:
        """Read the first line.

        Raises:
            RecordingError: If the file cannot be read, or is not a recording of this version.
        """
        self._path = path
        try:
            if not path.is_file():
                raise RecordingError("there is no file of that name")
            with path.open(encoding="utf-8") as file:
                first_line = next(bounded_lines(file, LONGEST_ENTRY), "")  # empty if the file is empty
            header = parse_json(first_line, "first line", RecordingError, _Header)
        except (OSError, ValueError) as error:  # RecordingError is a ValueError
            raise RecordingError(
                f"{path}: expected a recording of `serve stream --record` ({cut(str(error))})"
            ) from error
        if header.isocharge_recording != VERSION:
            raise RecordingError(
                f"{path}: recording version {header.isocharge_recording} is not supported (this version reads "
                f"{VERSION})"
            )
        self.model = header.model
        self.policy = header.policy
        self.device = header.device
        self.name = header.name

    def events(self) -> Iterator[Event | Marker | NewModel | Back]:
        """Yield the chunks with the latencies of their records, and all other events of the recording, in their order.

        Raises:
            RecordingError: If a line other than the last one is damaged.
        """
        # The records of a chunk follow it, so a chunk is yielded at the next event or at the end of the file.
        chunk: Chunk | None = None
        latencies_us: list[float] = []
        for entry in self._lines(_Entry):
            if entry.latency_us is not None:  # only records have a latency
                latencies_us.append(entry.latency_us)
                continue
            if chunk is not None:
                yield Event(chunk, tuple(latencies_us))
            chunk = entry.recorded_chunk  # None if the entry is another event
            latencies_us = []
            if chunk is None:
                yield entry.other_event
        if chunk is not None:
            yield Event(chunk, tuple(latencies_us))

    def records(self, kind: type[Line]) -> Iterator[Line]:
        """Yield the records as they were written, in their order.

        Args:
            kind: Struct with the fields that are read of each record.

        Raises:
            RecordingError: If a line other than the last one is damaged, or a record lacks a field of the struct.
        """
        return self._lines(kind, beginning='{"timestamp"')

    def _lines(self, kind: type[Line], beginning: str = "") -> Iterator[Line]:
        """Parse the lines after the first line, yield their content, and report the progress of reading.

        Args:
            kind: Struct as which each line is parsed.
            beginning: First characters of the lines to parse; empty for all lines. A line that does not begin with a
                brace is damaged. It is always parsed, so that an error is raised.

        Raises:
            RecordingError: If a line other than the last one is damaged.
        """
        line_number = 1
        read_characters = 0  # nearly all characters are one byte
        file_bytes = self._path.stat().st_size
        try:
            with self._path.open(encoding="utf-8", errors="replace") as file:
                for line in bounded_lines(file, LONGEST_ENTRY):
                    is_complete = line.endswith("\n")
                    if not is_complete:
                        return  # the power failed while the line was written
                    is_damaged = not line.startswith("{")
                    is_selected = line.startswith(beginning) or is_damaged
                    if line_number > 1 and is_selected:
                        yield parse_json(line, "", RecordingError, kind)
                    line_number += 1
                    read_characters += len(line)
                    if line_number % PROGRESS_LINES == 0:
                        report("reading", min(read_characters, file_bytes), file_bytes)
        except (OSError, ValueError) as error:
            raise RecordingError(f"{self._path}, line {line_number}: damaged ({cut(str(error))})") from error


class _Header(Struct):
    """The first line of a recording."""

    isocharge_recording: int
    model: ModelLabel
    policy: Literal["every", "latest"]
    device: dict[str, Any]
    name: str = ""

    def __post_init__(self) -> None:
        if not is_printable(self.name):
            raise WrongKey("name", "printable characters", self.name)


class _Entry(Struct):
    """A line of a recording after the first line. The line is a record, or an object with one of the other keys."""

    timestamp: float | None = None
    latency_us: Latency | None = None
    tare: bool | None = None
    back: bool | None = None
    use: ModelLabel | None = None
    marker: tuple[Moment, Annotated[str, Meta(max_length=1000)]] | None = None
    chunk: tuple[Moment, Nanoseconds, Annotated[float, Meta(ge=0.0)], bytes] | None = None

    def __post_init__(self) -> None:
        if (self.timestamp is None) != (self.latency_us is None):
            raise WrongKey("latency_us")
        if all(key is None for key in (self.timestamp, self.tare, self.back, self.use, self.marker, self.chunk)):
            raise WrongKey("chunk")

    @property
    def recorded_chunk(self) -> Chunk | None:
        """The chunk of this line; None if the line is not a chunk."""
        if self.chunk is None:
            return None
        timestamp, clock_ns, outage_s, data = self.chunk
        return Chunk(data, timestamp, clock_ns, outage_s)

    @property
    def other_event(self) -> Event | Marker | NewModel | Back:
        """The event of this line, if the line is neither a record nor a chunk."""
        if self.marker is not None:
            return Marker(*self.marker)
        if self.back is not None:
            return Back()
        if self.use is not None:
            return NewModel(self.use)
        return Event(None)  # a request for a new tare


class RecordedClock:
    """The clock of a replay. For each record, the clock returns the time at which the original record was created."""

    def __init__(self) -> None:
        """Begin at the time 0."""
        self._base_ns = 0
        self._latencies_us: deque[float] = deque()

    def set(self, event: Event) -> None:
        """Set the clock to a chunk, whose records are created next."""
        self._base_ns = event.chunk.clock_ns if event.chunk else 0
        self._latencies_us = deque(event.latencies_us)

    def __call__(self) -> int:
        """Return the time of the next record, ns. The clock is the same as for `Chunk.clock_ns`.

        After the last record of the chunk, the time of its arrival is returned.
        """
        latency_us = self._latencies_us.popleft() if self._latencies_us else 0.0
        return self._base_ns + round(latency_us * 1e3)
