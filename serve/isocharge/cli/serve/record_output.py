"""Where the records of `serve stream` and `serve replay` go, and the line that closes them.

Data go to stdout, words for people to stderr. Everything heavy is imported inside the command that needs it.
"""

import sys
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from typing import TYPE_CHECKING

from isocharge.cli.serve.options import Output
from isocharge.cli.shared.terminal import say

if TYPE_CHECKING:
    from isocharge.serve import PredictionRecord, TouchStream

LATENCIES = 100_000
"""The closing line's percentiles are over so many latest records at most."""

Lines = Callable[["PredictionRecord", str], None]
"""Takes each record and its line of JSON."""


def _pass_on(records: "Iterable[tuple[PredictionRecord, str]]", write: Lines, latencies: deque[float]) -> None:
    """Write records as they come; a new tare is said, latencies are kept."""
    tare = None
    for record, line in records:
        write(record, line)
        if record.tare_pC != tare:
            tare = record.tare_pC
            if tare is not None:
                say("tared: " + ", ".join(f"{name} {charge:.2f} pC" for name, charge in tare.items()))
        if record.latency_us is not None:
            latencies.append(record.latency_us)


def _writer(stack: ExitStack, output: Output, udp: str | None, electrodes: tuple[str, ...]) -> Lines:
    """What writes each record: to stdout at once, and to the network."""
    from isocharge.serve import UdpSink, csv_header, csv_line

    sink = stack.enter_context(UdpSink(udp)) if udp else None
    if output is Output.csv:
        print(csv_header(electrodes), flush=True)

    def write(record: "PredictionRecord", line: str) -> None:
        if sink:
            sink.send(line)
        if output is not Output.none:
            sys.stdout.write((line if output is Output.json else csv_line(record, electrodes)) + "\n")
            sys.stdout.flush()

    return write


def _closing_line(path: "TouchStream", latencies: deque[float]) -> str:
    counts, gaps, own = path.parser.counts, path.gaps, path.counts
    said = (
        f"{counts.frames} frames, {gaps.lost} lost, {gaps.repeated} repeated, {gaps.restarts} restarts; "
        f"{counts.crc_errors} CRC errors, {counts.malformed} malformed, {counts.bytes_dropped} bytes dropped, "
        f"{counts.resyncs} resynchronisations; {own.outages} reconnects, {own.skipped} skipped"
    )
    if not latencies:
        return said
    import numpy as np

    p50, p99 = np.percentile(latencies, (50, 99))
    return f"{said}; last byte to record p50 {p50:.0f} us, p99 {p99:.0f} us"
