"""`isocharge serve stream` and `isocharge serve replay`: the live path, and a recording of it.

Data go to stdout, words for people to stderr. Everything heavy is imported inside the command that needs it.
"""

import logging
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from enum import StrEnum
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.stopping import until_stopped
from isocharge.cli.terminal import say

if TYPE_CHECKING:
    from isocharge.serve import (
        Chunk,
        Device,
        PredictionRecord,
        RecordedClock,
        Recorder,
        Recording,
        TouchStream,
    )

LATENCIES = 100_000
"""The closing line's percentiles are over so many latest records at most."""

Lines = Callable[["PredictionRecord", str], None]
"""Takes each record and its line of JSON."""

ModelsOption = Annotated[
    Path | None,
    typer.Option(
        "--models", metavar="DIR", help="Folder of models in which a name is looked up first. (default: none)"
    ),
]
DeviceOption = Annotated[
    Path | None,
    typer.Option("--device", metavar="FILE", help="What is known about the board, TOML. (default: nothing)"),
]


class Output(StrEnum):
    """What goes to stdout."""

    json = "json"
    csv = "csv"
    none = "none"


class PolicyName(StrEnum):
    """Which frames get a record."""

    every = "every"
    latest = "latest"


OutputOption = Annotated[
    Output, typer.Option("--output", help="On stdout: lines of JSON, CSV with a header, or nothing.")
]


def stream_command(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="Model name, or path of a model folder.")],
    port: Annotated[
        str,
        typer.Option("--port", metavar="URL", help="Device path or pyserial URL of the sensor, a file, - for stdin."),
    ],
    models: ModelsOption = None,
    device: DeviceOption = None,
    output: OutputOption = Output.json,
    udp: Annotated[
        str | None,
        typer.Option(
            "--udp", metavar="HOST:PORT", help="Also send records there, as PlotJuggler reads them. (default: no)"
        ),
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option("--record", metavar="FILE", help="Keep raw bytes and records for `serve replay`. (default: no)"),
    ] = None,
    policy: Annotated[
        PolicyName, typer.Option("--policy", help="A record for every frame, or for the latest only if several came.")
    ] = PolicyName.every,
    reconnect: Annotated[
        bool, typer.Option("--reconnect/--no-reconnect", help="Open a lost port again, for ever, or fail.")
    ] = True,
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=0.0, help="Stop after so many seconds. (default: never)")
    ] = None,
    count: Annotated[
        int | None, typer.Option("--count", min=1, help="Stop after so many records. (default: never)")
    ] = None,
    wait: Annotated[float, typer.Option("--wait", min=0.0, max=3600.0, help="Wait so long for the port, s.")] = 0.0,
    baud: Annotated[int, typer.Option("--baud", min=1, help="Bits per second; USB ports ignore it.")] = 115200,
    offset_limit_pC: Annotated[
        float | None,
        typer.Option("--offset-limit-pC", min=0.0, help="Largest charge of an untouched electrode, pC. (default: 100)"),
    ] = None,
) -> None:
    """Follow a sensor live: a prediction record per frame, one line of JSON each, until Ctrl-C.

    The first 100 frames (0.5 s at 200 Hz) are used to tare: leave the film alone meanwhile. SIGUSR1 asks for a new one.

    Example: isocharge serve stream three-25um-biaxial --port /dev/ttyACM0 --seconds 10
    """
    from isocharge.serve import Policy, Predictor, Recorder, TouchStream, open_source

    predictor, board = Predictor(model, models=models), _with_offset_limit(board_of(device), offset_limit_pC)
    path = TouchStream(predictor, board, policy=Policy(policy.value))
    latencies: deque[float] = deque(maxlen=LATENCIES)
    recorder = Recorder(record, predictor.metadata.label, policy.value, board.table) if record else None
    with ExitStack() as stack:
        stack.enter_context(until_stopped())
        stack.enter_context(_log_to_stderr())
        source = stack.enter_context(open_source(_awaited(port, wait), baud=baud, reconnect=reconnect))
        wishes = stack.enter_context(_tare_on_signal())
        stack.enter_context(_alarm(seconds))
        write = _writer(stack, output, udp, predictor.metadata.electrodes)
        if recorder:
            stack.enter_context(recorder)
        # Closed before the recorder is, so that what was begun is written.
        records = stack.enter_context(closing(_follow(path, source, recorder, wishes)))
        say(f"{predictor.metadata.label} on {port}: taring, leave the film alone")
        try:
            _pass_on(islice(records, count), write, latencies)
        finally:
            say(_closing_line(path, latencies))
    if recorder is not None and recorder.failed:
        raise typer.Exit(1)


def replay_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Recording of `serve stream --record`.")],
    model: Annotated[
        str | None, typer.Option("--model", metavar="MODEL", help="Another model. (default: the one of the recording)")
    ] = None,
    models: ModelsOption = None,
    real_time: Annotated[bool, typer.Option("--real-time/--fast", help="At the pace of then, or all at once.")] = False,
    output: OutputOption = Output.json,
    udp: Annotated[
        str | None, typer.Option("--udp", metavar="HOST:PORT", help="Also send each record there. (default: no)")
    ] = None,
) -> None:
    """Play a recording through the same path: the same model gives the same records, bit for bit.

    Example: isocharge serve replay touch.rec --real-time
    """
    from isocharge.serve import Policy, Predictor, RecordedClock, Recording, TouchStream, device_from_table

    recording, clock = Recording(file), RecordedClock()
    predictor = Predictor(model or recording.model, models=models)
    board = device_from_table(recording.device, str(file))
    path = TouchStream(predictor, board, policy=Policy(recording.policy), now_ns=clock)
    latencies: deque[float] = deque(maxlen=LATENCIES)
    with ExitStack() as stack:
        stack.enter_context(until_stopped())
        write = _writer(stack, output, udp, predictor.metadata.electrodes)
        _pass_on(_replayed(recording, path, clock, real_time), write, latencies)
    say(_closing_line(path, latencies))


def board_of(path: Path | None) -> "Device":
    from isocharge.serve import load_device
    from isocharge.serve.live.device_file import ANY_BOARD

    return load_device(path) if path else ANY_BOARD


def _with_offset_limit(board: "Device", offset_limit_pC: float | None) -> "Device":
    """The board with another limit in its file, so that a recording keeps it."""
    from isocharge.serve import device_from_table

    if offset_limit_pC is None:
        return board
    tare = {**board.table.get("tare", {}), "offset_limit_pC": offset_limit_pC}
    return device_from_table({**board.table, "tare": tare}, board.where)


def _awaited(port: str, wait: float) -> str:
    """The port, as soon as there is something under its path, or when the time is over."""
    end = time.monotonic() + wait
    while "://" not in port and port != "-" and not Path(port).exists() and time.monotonic() < end:
        time.sleep(0.05)
    return port


def _follow(
    path: "TouchStream", source: "Iterable[Chunk]", recorder: "Recorder | None", wishes: list[bool]
) -> "Generator[tuple[PredictionRecord, str]]":
    """Records with their lines of JSON; chunks and records go into the recording as they come."""
    for chunk in source:
        if wishes:
            wishes.clear()
            path.tare()
            if recorder:
                recorder.tare()
        lines: list[str] = []
        try:
            for record in path.feed(chunk):
                lines.append(record.to_json())
                yield record, lines[-1]
        finally:
            if recorder:
                recorder.chunk(chunk, lines)
    path.finish()


def _replayed(
    recording: "Recording", path: "TouchStream", clock: "RecordedClock", real_time: bool
) -> "Iterator[tuple[PredictionRecord, str]]":
    """Records with their lines; as many for each chunk as there were."""
    ahead_s: float | None = None
    for event in recording.events():
        clock.set(event)
        if event.chunk is None:
            path.tare()
            continue
        if real_time:
            ahead_s = time.time() - event.chunk.timestamp if ahead_s is None else ahead_s
            time.sleep(max(0.0, event.chunk.timestamp + ahead_s - time.time()))
        for number, record in enumerate(path.feed(event.chunk)):
            if number < len(event.latencies_us):
                yield record, record.to_json()


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


@contextmanager
def _alarm(seconds: float | None) -> Iterator[None]:
    """As if Ctrl-C were pressed after some time, also where nothing comes from the port."""
    if seconds is None:
        yield
        return
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def _tare_on_signal() -> Iterator[list[bool]]:
    """A list that is not empty when somebody has asked for a new tare, by SIGUSR1."""
    wishes: list[bool] = []
    before = signal.signal(signal.SIGUSR1, lambda *_: wishes.append(True))
    try:
        yield wishes
    finally:
        signal.signal(signal.SIGUSR1, before)


@contextmanager
def _log_to_stderr() -> Iterator[None]:
    """Warnings of the live path are words for people."""
    handler = logging.StreamHandler()
    logger = logging.getLogger("isocharge.serve")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


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
