"""Recordings: the chunks of a port and the records that came of them, a line of JSON each, written as they come.

    {"isocharge_recording": 1, "model": "three/1", "policy": "every", "device": {...}, "name": "left"}
    {"chunk": [timestamp, clock_ns, outage_s, "base64 of the bytes"]}
    {"timestamp": ..., ...}                       the records of that chunk, as they went out
    {"tare": true}                                a request for a new tare
    {"use": "three/2"}                            the model of all that follows
    {"marker": [timestamp, "text"]}               a moment that somebody noted

Everything in a replay is recomputed except `latency_us`, which is copied from the recording because it belongs to the
original run. So the same model gives the same records, bit for bit. Whole lines are written at once; a line that a full
disk or a power cut left unfinished is ignored.
"""

import base64
import json
import logging
import os
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self, TypeVar

from isocharge.common.errors import OutputError, RecordingError
from isocharge.common.files import bounded_lines, refuse_existing
from isocharge.common.progress import Progress
from isocharge.common.tables import Table, cut, is_whole, parse_json
from isocharge.serve.port.serial_port import Chunk

VERSION = 1
"""Version of the file's format."""

KIND = "isocharge_recording"
"""Key of the version in the first line: what makes a file a recording."""

POLICIES = ("every", "latest")
"""Which frames get a record."""

LONGEST_ENTRY = 1 << 20
"""Longest line, characters: a chunk of 64 KiB in base64 is a tenth of it."""

LONGEST_US, LATEST_S = 1e12, 1e11
"""Largest latency that counts as one, us: eleven days; and latest time, unix seconds: the year 5138."""

WRITE_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
"""To open a new file, without changing line ends on Windows."""

LONGEST_MARKER = 1000
"""Characters of a marker's text."""

log = logging.getLogger(__name__)

Entry = TypeVar("Entry")
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

    def __init__(self, path: Path, model: str, policy: str, device: Mapping[str, Any], name: str = "") -> None:
        """Describe a recording; the file is created on entering the context.

        Args:
            path: The file; it must not exist.
            model: The model's label, `name/version`.
            policy: Which frames get a record.
            device: Content of the device file.
            name: The film's own name in the records; empty for that of the model's sensor.
        """
        self.path, self.model_label = path, model
        self.failed = False
        self._header = {KIND: VERSION, "model": model, "policy": policy, "device": dict(device)}
        if name:
            self._header["name"] = name
        self._descriptor = -1
        self._good = 0

    def __enter__(self) -> Self:
        """Create the file.

        Raises:
            OutputExists: If it is already there.
            OutputError: If it cannot be created.
        """
        refuse_existing(self.path)
        try:
            self._descriptor = os.open(self.path, WRITE_FLAGS, 0o666)
        except OSError as error:
            raise OutputError(f"{self.path} cannot be written: {error.strerror}; choose another file") from error
        self._write(json.dumps(self._header))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)

    def chunk(self, chunk: Chunk, records: list[str]) -> None:
        """Write a chunk and the lines of its records."""
        data = base64.b64encode(chunk.data).decode()
        head = json.dumps({"chunk": [chunk.timestamp, chunk.clock_ns, chunk.outage_s, data]})
        self._write("\n".join([head, *records]))

    def tare(self) -> None:
        """Write a request for a new tare."""
        self._write('{"tare": true}')

    def model(self, label: str) -> None:
        """Write the label, `name/version`, of the model of all that follows."""
        self._write(json.dumps({"use": label}))

    def mark(self, marker: Marker) -> None:
        """Write a marker."""
        self._write(json.dumps({"marker": list(marker)}))

    def _write(self, lines: str) -> None:
        """Write whole lines or none."""
        if self.failed:
            return
        data = f"{lines}\n".encode()
        try:
            unwritten = memoryview(data)
            while unwritten:
                unwritten = unwritten[os.write(self._descriptor, unwritten) :]
        except OSError as error:
            self.failed = True
            os.ftruncate(self._descriptor, self._good)
            log.error("%s: recording stopped (%s); what was written until now is whole", self.path, error.strerror)
            return
        self._good += len(data)


class Event(NamedTuple):
    """A chunk with the latencies of its records (us), or a request for a new tare (no chunk)."""

    chunk: Chunk | None
    latencies_us: tuple[float, ...] = ()


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
            header = _header(path)
            version = header.whole(KIND)
            self.model, self.policy = header.text("model"), header.choice("policy", POLICIES)
            self.device = dict(header.table("device").values)
            self.name = header.text("name", "", or_empty=True)
        except (OSError, ValueError) as error:
            raise RecordingError(
                f"{path}: expected a recording of `serve stream --record` ({cut(str(error))})"
            ) from error
        if version != VERSION:
            raise RecordingError(f"{path}: recording version {version} is not supported (this version reads {VERSION})")

    def events(self) -> Iterator[Event | NewModel]:
        """Chunks, requests for a new tare and changes of the model, in their order.

        Raises:
            RecordingError: If a line other than the last one is damaged.
        """
        return (event for event in self.events_and_markers() if not isinstance(event, Marker))

    def events_and_markers(self) -> Iterator[Event | Marker | NewModel]:
        """As `events`, with the markers between them."""
        chunk: Chunk | None = None
        latencies_us: list[float] = []
        for entry in self._entries():
            if isinstance(entry, float):
                latencies_us.append(entry)
                continue
            if chunk is not None:
                yield Event(chunk, tuple(latencies_us))
            chunk, latencies_us = entry if isinstance(entry, Chunk) else None, []
            if chunk is None:
                yield entry if isinstance(entry, Marker | NewModel) else Event(None)
        if chunk is not None:
            yield Event(chunk, tuple(latencies_us))

    def for_each_record(self, take: Callable[[Table], None], progress: Progress | None = None) -> None:
        """Call `take` with each record as it was written, in their order.

        Args:
            take: An InputError that it raises is raised again with file and line.
            progress: Called now and then with the characters read until then, and the size of the file.

        Raises:
            RecordingError: If a line other than the last one is damaged, or `take` refuses its record.
        """
        for _ in self._parsed(lambda entry: take(entry) if "timestamp" in entry else None, progress):
            pass

    def _entries(self) -> Iterator[Chunk | Marker | float | NewModel | None]:
        """The content of each line, as `_entry` gives it."""
        return self._parsed(_entry)

    def _parsed(self, parse: Callable[[Table], Entry], progress: Progress | None = None) -> Iterator[Entry]:
        """What `parse` makes of each line after the first."""
        number, characters, size = 1, 0, self._path.stat().st_size
        try:
            with self._path.open(encoding="utf-8", errors="replace") as file:
                for line in bounded_lines(file, LONGEST_ENTRY):
                    if not line.endswith("\n"):
                        return  # the power failed while it was written
                    if number > 1:
                        yield parse(Table(parse_json(line, "entry", RecordingError), "", RecordingError))
                    number, characters = number + 1, characters + len(line)
                    if progress is not None and number % 1000 == 0:
                        progress(min(characters, size), size)
        except (OSError, ValueError) as error:
            raise RecordingError(f"{self._path}, line {number}: damaged ({cut(str(error))})") from error


def _header(path: Path) -> Table:
    """The first line of a recording."""
    if not path.is_file():
        raise RecordingError("there is no file of that name")
    with path.open(encoding="utf-8") as file:
        line = next(bounded_lines(file, LONGEST_ENTRY), "")
    return Table(parse_json(line, "first line", RecordingError), "first line", RecordingError)


def _entry(content: Table) -> Chunk | Marker | float | NewModel | None:
    """A chunk, a marker, the latency of a record (us), a new model, or None for a request for a new tare.

    Raises:
        RecordingError, ValueError: If it is none of these.
    """
    if "timestamp" in content:
        return content.number("latency_us", least=-LONGEST_US, most=LONGEST_US)
    if "tare" in content:
        return None
    if "use" in content:
        return NewModel(content.text("use"))
    if "marker" in content:
        return _marker(content)
    *times, data = content.sequence("chunk", of="timestamp, clock, outage and bytes")
    timestamp, _, outage_s = content.as_numbers("chunk", times, count=3, of="three numbers and bytes")
    if not isinstance(data, str):
        content.refuse("chunk", "three numbers and bytes in base64")
    if not (abs(timestamp) <= LATEST_S and outage_s >= 0.0 and is_whole(times[1])):
        content.refuse("chunk", "a time of this age, nanoseconds and an outage")
    return Chunk(base64.b64decode(data, validate=True), timestamp, times[1], outage_s)


def _marker(content: Table) -> Marker:
    timestamp, *texts = content.sequence("marker", of="timestamp and text")
    (moment,) = content.as_numbers("marker", [timestamp], count=1, of="a time and a text")
    if len(texts) != 1 or not isinstance(texts[0], str) or len(texts[0]) > LONGEST_MARKER or abs(moment) > LATEST_S:
        content.refuse("marker", f"a time of this age and a text of at most {LONGEST_MARKER} characters")
    return Marker(moment, texts[0])


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
