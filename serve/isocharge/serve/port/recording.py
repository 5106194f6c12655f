"""Recordings: the chunks of a port and the records that came of them, a line of JSON each, written as they come.

    {"isocharge_recording": 1, "model": "three/1", "policy": "every", "device": {...}, "name": "left"}
    {"chunk": [timestamp, clock_ns, outage_s, "base64 of the bytes"]}
    {"timestamp": ..., ...}                       the records of that chunk, as they went out
    {"tare": true}                                a request for a new tare
    {"back": true}                                a request to go back to the film as it was calibrated
    {"use": "three/2"}                            the model of all that follows
    {"marker": [timestamp, "text"]}               a moment that somebody noted

Everything in a replay is recomputed except `latency_us`, which is copied from the recording because it belongs to the
original run. So the same model gives the same records, bit for bit. Whole lines are written at once; a line that a full
disk or a power cut left unfinished is ignored.
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
from isocharge.common.files import WholeWrites, bounded_lines
from isocharge.common.model_labels import ModelLabel
from isocharge.common.printable_text import is_printable
from isocharge.common.progress import report
from isocharge.common.structs import WrongKey, parse_json
from isocharge.serve.port.source import Chunk

VERSION = 1
"""Version of the file's format."""

KIND = "isocharge_recording"
"""Key of the version in the first line: what makes a file a recording."""

LONGEST_ENTRY = 1 << 20
"""Longest line, characters: a chunk of 64 KiB in base64 is a tenth of it."""

Latency = Annotated[float, Meta(ge=-1e12, le=1e12, description="a latency of some days at most, us")]
Moment = Annotated[float, Meta(ge=-1e11, le=1e11, description="a time before the year 5138, unix seconds")]
Nanoseconds = Annotated[int, Meta(ge=-(1 << 63), le=(1 << 63) - 1)]

log = logging.getLogger(__name__)

Line = TypeVar("Line")
"""What a line is read as."""


class Marker(NamedTuple):
    """A moment that somebody noted.

    Attributes:
        timestamp: Unix seconds.
        text: May be empty.
    """

    timestamp: float
    text: str


class Recorder:
    """Writes a recording.

    Attributes:
        path: The file.
        model_label: `name/version` of the model at its begin.
        failed: Whether writing has stopped because the disk is full. What was written before is whole.
    """

    def __init__(self, path: Path, model: str, policy: str, device: Mapping[str, Any], name: str | None = None) -> None:
        """Describe a recording; the file is created on entering the context.

        Args:
            path: The file; it must not exist.
            model: The model's label, `name/version`.
            policy: Which frames get a record.
            device: Content of the device file.
            name: The film's own name in the records; None for that of the model's sensor.
        """
        self.path, self.model_label = path, model
        self.failed = False
        self._header = {KIND: VERSION, "model": model, "policy": policy, "device": dict(device)}
        if name:
            self._header["name"] = name
        self._last: Chunk | None = None  # the chunk that was given last, and the size of the file before it
        self._begin = 0

    def __enter__(self) -> Self:
        """Create the file.

        Raises:
            OutputExists: If it is already there.
            OutputError: If it cannot be created.
        """
        self._file = WholeWrites(self.path)
        self._write(json.dumps(self._header))
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def chunk(self, chunk: Chunk, records: list[str]) -> None:
        """Write a chunk and the lines of its records, once: after an interruption it may be given again."""
        if chunk is self._last and self._file.tell() > self._begin:
            return
        data = base64.b64encode(chunk.data).decode()
        head = json.dumps({"chunk": [chunk.timestamp, chunk.clock_ns, chunk.outage_s, data]})
        self._last, self._begin = chunk, self._file.tell()
        self._write("\n".join([head, *records]))

    def tare(self) -> None:
        """Write a request for a new tare."""
        self._write('{"tare": true}')

    def back(self) -> None:
        """Write a request to go back to the film as it was calibrated."""
        self._write('{"back": true}')

    def model(self, label: str) -> None:
        """Write the label, `name/version`, of the model of all that follows."""
        self._write(json.dumps({"use": label}))

    def mark(self, marker: Marker) -> None:
        """Write a marker."""
        self._write(json.dumps({"marker": list(marker)}))

    def _write(self, lines: str) -> None:
        """Write whole lines or none, over what an interruption left of them."""
        if self.failed:
            return
        try:
            self._file.write(f"{lines}\n".encode())
        except OSError as error:
            self.failed = True
            log.error("%s: recording stopped (%s); what was written until now is whole", self.path, error.strerror)


class Event(NamedTuple):
    """A chunk with the latencies of its records (us), or a request for a new tare (no chunk)."""

    chunk: Chunk | None
    latencies_us: tuple[float, ...] = ()


class Back(NamedTuple):
    """A request to go back to the film as it was calibrated."""


class NewModel(NamedTuple):
    """The label, `name/version`, of the model that computed all that follows."""

    label: str


class Recording:
    """A recording to read.

    Attributes:
        model: The model's label, `name/version`.
        policy: Which frames got a record.
        device: Content of the device file.
        name: The film's own name in the records; empty for that of the model's sensor.
    """

    def __init__(self, path: Path) -> None:
        """Read the first line.

        Raises:
            RecordingError: If it cannot be read, or is no recording of this version.
        """
        self._path = path
        try:
            if not path.is_file():
                raise RecordingError("there is no file of that name")
            with path.open(encoding="utf-8") as file:
                first = next(bounded_lines(file, LONGEST_ENTRY), "")
            header = parse_json(first, "first line", RecordingError, _Header)
        except (OSError, ValueError) as error:
            raise RecordingError(
                f"{path}: expected a recording of `serve stream --record` ({cut(str(error))})"
            ) from error
        if header.isocharge_recording != VERSION:
            raise RecordingError(
                f"{path}: recording version {header.isocharge_recording} is not supported (this version reads "
                f"{VERSION})"
            )
        self.model, self.policy, self.device, self.name = header.model, header.policy, header.device, header.name

    def events(self) -> Iterator[Event | Marker | NewModel | Back]:
        """Chunks, requests for a new tare, markers and changes of the model, in their order.

        Raises:
            RecordingError: If a line other than the last one is damaged.
        """
        chunk: Chunk | None = None
        latencies_us: list[float] = []
        for entry in self._lines(_Entry):
            if entry.latency_us is not None:
                latencies_us.append(entry.latency_us)
                continue
            if chunk is not None:
                yield Event(chunk, tuple(latencies_us))
            chunk, latencies_us = entry.bytes_that_came, []
            if chunk is None:
                yield entry.moment
        if chunk is not None:
            yield Event(chunk, tuple(latencies_us))

    def records(self, kind: type[Line]) -> Iterator[Line]:
        """The records as they were written, in their order, each as a struct of the fields that are wanted.

        Raises:
            RecordingError: If a line other than the last one is damaged, or a record is another one.
        """
        return self._lines(kind, only='{"timestamp"')

    def _lines(self, kind: type[Line], only: str = "") -> Iterator[Line]:
        """Each line after the first, those alone that begin so."""
        number, characters, size = 1, 0, self._path.stat().st_size
        try:
            with self._path.open(encoding="utf-8", errors="replace") as file:
                for line in bounded_lines(file, LONGEST_ENTRY):
                    if not line.endswith("\n"):
                        return  # the power failed while it was written
                    if number > 1 and (line.startswith(only) or not line.startswith("{")):
                        yield parse_json(line, "", RecordingError, kind)
                    number, characters = number + 1, characters + len(line)
                    if number % 1000 == 0:
                        report("reading", min(characters, size), size)
        except (OSError, ValueError) as error:
            raise RecordingError(f"{self._path}, line {number}: damaged ({cut(str(error))})") from error


class _Header(Struct):
    """The first line."""

    isocharge_recording: int
    model: ModelLabel
    policy: Literal["every", "latest"]
    device: dict[str, Any]
    name: str = ""

    def __post_init__(self) -> None:
        if not is_printable(self.name):
            raise WrongKey("name", "printable characters", self.name)


class _Entry(Struct):
    """A later line: one of these keys, or a record."""

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
    def bytes_that_came(self) -> Chunk | None:
        """The chunk, if it is one."""
        if self.chunk is None:
            return None
        timestamp, clock_ns, outage_s, data = self.chunk
        return Chunk(data, timestamp, clock_ns, outage_s)

    @property
    def moment(self) -> Event | Marker | NewModel | Back:
        """What happened, if it is neither record nor chunk."""
        if self.marker is not None:
            return Marker(*self.marker)
        if self.back is not None:
            return Back()
        return Event(None) if self.use is None else NewModel(self.use)


class RecordedClock:
    """The clock of a replay: for each record it shows the time at which that record was built."""

    def __init__(self) -> None:
        self._base_ns = 0
        self._latencies_us: deque[float] = deque()

    def set(self, event: Event) -> None:
        """The next records are those of this chunk."""
        self._base_ns = event.chunk.clock_ns if event.chunk else 0
        self._latencies_us = deque(event.latencies_us)

    def __call__(self) -> int:
        """Nanoseconds on the clock of `Chunk.clock_ns`: the arrival itself once the records of the chunk are over."""
        latency_us = self._latencies_us.popleft() if self._latencies_us else 0.0
        return self._base_ns + round(latency_us * 1e3)
