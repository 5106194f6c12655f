"""Where the records of `serve stream` and `serve replay` go: options, writers, and the summary at the end."""

from collections import deque
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Self

import numpy as np
import typer

from isocharge.cli.shared.terminal import say
from isocharge.serve import PredictionRecord, TouchStream
from isocharge.serve.export.record_messages import RecordEncoding
from isocharge.serve.live.outputs import LineQueue, UdpSink, csv_header, csv_line

WaitOption = Annotated[
    float, typer.Option("--wait", min=0.0, max=3600.0, help="Time to wait until the port can be opened, s.")
]


class Output(StrEnum):
    """Format of the records on stdout."""

    json = "json"
    csv = "csv"
    none = "none"


class LogFormat(StrEnum):
    """What a server writes on stderr."""

    text = "text"
    json = "json"


OutputOption = Annotated[
    Output, typer.Option("--output", help="Records on stdout: a line of JSON each, CSV with a header, or none.")
]

UdpOption = Annotated[
    str | None,
    typer.Option(
        "--udp",
        metavar="HOST:PORT",
        help="Also send each record as JSON in a UDP packet, as to PlotJuggler. (default: no)",
    ),
]

McapOption = Annotated[
    Path | None,
    typer.Option(
        "--mcap",
        metavar="FILE",
        help="Also write the records into a new MCAP file, with wrench and pose as ROS 2 messages. (default: no)",
    ),
]


McapRecordsOption = Annotated[
    RecordEncoding,
    typer.Option(
        "--mcap-records",
        help="Records in the MCAP file: JSON with its schema, as Foxglove, Lichtblick and PlotJuggler read it; or the "
        "same text in ROS 2 messages, for `ros2 bag` and rosbags, which refuse a file with anything else.",
    ),
]


LATENCIES = 100_000
"""Number of records, the latest ones, over which the summary's percentiles are taken."""

Lines = Callable[[PredictionRecord, str], None]
"""Called with each record and its line of JSON."""


def write_records(
    records: Iterable[tuple[PredictionRecord, str]], writers: Iterable[Lines], latencies: deque[float]
) -> None:
    """Give records as they come to one writer after the other, announce each new tare, and remember the latencies."""
    tare = None
    for record, line in records:
        for write in writers:
            write(record, line)
        if record.tare_pC != tare:
            tare = record.tare_pC
            if tare is not None:
                say("tared: " + ", ".join(f"{name} {charge:.2f} pC" for name, charge in tare.items()))
        if record.latency_us is not None:
            latencies.append(record.latency_us)


def record_writer(
    stack: ExitStack,
    output: Output,
    udp: str | None,
    electrodes: tuple[str, ...],
    put: Callable[[str], object],
    fields: tuple[str, ...],
) -> Lines:
    """The function that gives each record to `put` as a line, and sends it to the network."""
    sink = stack.enter_context(closing(UdpSink(udp))) if udp else None
    if output is Output.csv:
        put(csv_header(electrodes, fields) + "\n")

    def write(record: PredictionRecord, line: str) -> None:
        if sink:
            sink.send(line)
        if output is not Output.none:
            put((line if output is Output.json else csv_line(record, electrodes)) + "\n")

    return write


class McapOutput:
    """Records on their way into an MCAP file, through a queue of their own; a context manager.

    Attributes:
        put: Takes a record's line of JSON.
    """

    def __init__(self, path: Path, electrodes: tuple[str, ...], records: RecordEncoding, is_live: bool) -> None:
        """Describe the file; it is created on entering the context.

        Args:
            path: The new file.
            electrodes: Names of the electrodes.
            records: How the records are written.
            is_live: Whether they come from a sensor, which must not wait for the disk.

        Raises:
            MissingExtra: If the extra `record` is not installed.
        """
        from isocharge.serve.export.mcap_file import McapFile

        self._file = McapFile(path, electrodes, records)
        self._queue = LineQueue(self._file.write_live)
        self.put = self._queue.put if is_live else self._file.write_live
        self._stack = ExitStack()

    @property
    def is_whole(self) -> bool:
        """Whether every record was written."""
        return not (self._file.failed or self._queue.lost)

    def __enter__(self) -> Self:
        """Create the file.

        Raises:
            OutputExists: If it is already there.
            OutputError: If it cannot be created.
        """
        self._stack.enter_context(self._file)
        self._stack.enter_context(self._queue)
        return self

    def __exit__(self, *_: object) -> None:
        """Write what waits and close the file."""
        try:
            self._stack.close()
        except OSError as failure:
            self._file.give_up(failure)
        if self._queue.lost:
            say(f"{self._file.path}: {self._queue.lost} records not written, the oldest: the disk was too slow")


def summary(touch: TouchStream, latencies: deque[float], unwritten: int = 0) -> str:
    """Counts of frames and faults, of records that stdout did not take in time, and percentiles of the latency."""
    totals, stream = touch.totals(), touch.counts
    text = (
        f"{totals.frames} frames, {totals.lost} lost, {totals.repeated} repeated, {totals.restarts} restarts; "
        f"{totals.crc_errors} CRC errors, {totals.malformed} malformed, {totals.bytes_dropped} bytes dropped, "
        f"{totals.resyncs} resynchronisations; {stream.outages} reconnects, {stream.skipped} skipped"
    )
    if unwritten:
        text += f"; {unwritten} records not written, the oldest: the reader of stdout was too slow"
    if not latencies:
        return text
    p50, p99 = np.percentile(latencies, (50, 99))
    return f"{text}; last byte to record p50 {p50:.0f} us, p99 {p99:.0f} us"
