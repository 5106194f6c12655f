"""Output of the records of `isocharge serve stream` and `isocharge serve replay`, and the summary at the end."""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated

import numpy as np
import typer

from isocharge.cli.shared.terminal import say, stdout_is_ready, stdout_writer
from isocharge.serve import PredictionRecord, TouchStream
from isocharge.serve.flags import TARE
from isocharge.serve.outputs.output import OutputContext
from isocharge.serve.outputs.targets import Outputs, target_forms

WaitOption = Annotated[
    float,
    typer.Option(
        "--wait",
        min=0.0,
        max=3600.0,
        help="Time to wait until the port can be opened, and until the first byte if this is more than 10 s, s.",
    ),
]


OutputOption = Annotated[
    list[str] | None,
    typer.Option(
        "--output",
        metavar="TARGET",
        help=f"Where to write the records; repeat the option for several targets. Forms: {target_forms()}. `json` and "
        "`csv` are standard output. Other packages can add forms. (default: json)",
    ),
]

DEFAULT_TARGETS = ("json",)
"""Targets of the output if the option `--output` is not given."""

LATENCIES = 100_000
"""Number of the latest records from whose latencies the summary computes percentiles."""

RecordWriter = Callable[[PredictionRecord], object]
"""Function that is called with each record."""


def write_records(
    records: Iterable[PredictionRecord], writers: Iterable[RecordWriter], latencies: deque[float]
) -> None:
    """Pass each record to all writers, print each new tare, and collect the latencies.

    Args:
        records: The records.
        writers: Functions that write a record, which are called in their order.
        latencies: Queue to which the latency of each record is added, us.
    """
    is_tare_new = True
    for record in records:
        for write in writers:
            write(record)
        if TARE in record.flags:  # the tare is being measured
            is_tare_new = True
        elif is_tare_new and record.tare_pC is not None:  # an invalid record has no tare
            is_tare_new = False
            tare_text = ", ".join(f"{electrode} {charge:.2f} pC" for electrode, charge in record.tare_pC.items())
            say(f"tared: {tare_text}")
        if record.latency_us is not None:
            latencies.append(record.latency_us)


def command_outputs(targets: Sequence[str] | None, touch: TouchStream, *, is_live: bool) -> Outputs:
    """Return the outputs for the targets of `--output`. They are opened when their context is entered.

    Args:
        targets: Values of the option; None or empty for `DEFAULT_TARGETS`.
        touch: The stream whose records are written.
        is_live: Whether the records come from a sensor.

    Raises:
        InputError: If a target has none of the forms, two targets are equal, or two targets write to standard output.
    """
    context = OutputContext(
        electrodes=touch.predictor.metadata.electrodes,
        with_tracking=touch.has_tracking,
        with_film=touch.has_film,
        is_live=is_live,
        write_stdout=stdout_writer(),
        stdout_is_ready=stdout_is_ready,
    )
    return Outputs(targets or DEFAULT_TARGETS, context)


def say_missing_records(outputs: Outputs) -> None:
    """Print how many records are missing in each output. The outputs must have been closed.

    Args:
        outputs: The outputs. `not_written` contains the number of missing records of each incomplete output by its
            target; None if an error ended the output.
    """
    for target, missing_records in outputs.not_written.items():
        if missing_records is not None:
            say(f"{target}: {missing_records} records not written, the oldest: the output was too slow")
        else:
            say(f"{target}: incomplete")


def summary(touch: TouchStream, latencies: deque[float]) -> str:
    """Return the summary of a stream: the numbers of frames and faults, and percentiles of the latency.

    Args:
        touch: The stream.
        latencies: Latencies of the latest records, us.
    """
    totals = touch.totals()  # numbers of frames, damaged frames and dropped bytes
    counts = touch.counts  # numbers of outages and of skipped frames
    frames_text = (
        f"{totals.frames} frames, {totals.lost} lost, {totals.repeated} repeated, {totals.restarts} restarts; "
        f"{totals.crc_errors} CRC errors, {totals.malformed} malformed, {totals.bytes_dropped} bytes dropped; "
        f"{counts.outages} reconnects, {counts.skipped} skipped"
    )
    if not latencies:
        return frames_text
    p50, p99 = np.percentile(latencies, (50, 99))
    return f"{frames_text}; last byte to record p50 {p50:.0f} us, p99 {p99:.0f} us"
