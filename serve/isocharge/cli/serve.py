"""`isocharge serve ...`: charges to contacts from a file and from a port, and a virtual sensor to try it on.

Data go to stdout, words for people to stderr. Everything heavy is imported inside the command that needs it.
"""

import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.http import http_command
from isocharge.cli.terminal import progress, say
from isocharge.errors import InputError, OutputExists

if TYPE_CHECKING:
    from isocharge.serve import FrameParser, PredictionRecord, SequenceGaps

LATENCIES = 100_000
"""The closing line's percentiles are over so many latest records at most."""

FORCE_MIN_N = 0.05
"""Smallest force that a virtual sensor plays, N."""

serve_app = typer.Typer(
    no_args_is_help=True, help="Charges to contacts: from a file, from a port, over HTTP, from a virtual sensor."
)
serve_app.command("http")(http_command)

ModelArgument = Annotated[str, typer.Argument(metavar="MODEL", help="Model name, or path of a model folder.")]
ModelsOption = Annotated[
    Path | None,
    typer.Option(
        "--models", metavar="DIR", help="Folder of models in which a name is looked up first. (default: none)"
    ),
]


@serve_app.command("predict")
def predict_command(
    model: ModelArgument,
    file: Annotated[
        str,
        typer.Argument(
            metavar="FILE.csv", help="CSV with the electrodes as header and touch charges in pC; - reads stdin."
        ),
    ],
    json: Annotated[
        bool, typer.Option("--json", help="One prediction record per line instead of CSV. (default: CSV)")
    ] = False,
    models: ModelsOption = None,
) -> None:
    """Turn touch charges (pC) into contacts (mm, N) with standard deviations.

    Example: isocharge serve predict three-25um-biaxial presses.csv > contacts.csv
    """
    from isocharge.serve import Predictor, read_charges, table_records, write_contacts

    predictor = Predictor(model, models=models)
    where = "stdin" if file == "-" else file
    charge_pC = read_charges(_text(file), predictor.metadata.electrodes, where)
    with _until_stopped():
        if json:
            _print_lines(record.to_json() for record in table_records(charge_pC, predictor))
        else:
            write_contacts(predictor.predict_batch(charge_pC), sys.stdout)
            sys.stdout.flush()


@serve_app.command("stream")
def stream_command(
    model: ModelArgument,
    port: Annotated[str, typer.Option("--port", metavar="URL", help="Device path or pyserial URL of the sensor.")],
    models: ModelsOption = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=0.0, help="Stop after so many seconds. (default: never)")
    ] = None,
    count: Annotated[
        int | None, typer.Option("--count", min=1, help="Stop after so many records. (default: never)")
    ] = None,
    wait: Annotated[float, typer.Option("--wait", min=0.0, max=3600.0, help="Wait so long for the port, s.")] = 0.0,
    baud: Annotated[int, typer.Option("--baud", min=1, help="Bits per second; USB ports ignore it.")] = 115200,
    offset_limit_pC: Annotated[
        float, typer.Option("--offset-limit-pC", min=0.0, help="Largest charge of an untouched electrode, pC.")
    ] = 100.0,
) -> None:
    """Follow a sensor live: a prediction record per frame, one line of JSON each, until Ctrl-C.

    The first 0.5 s (100 frames) are used to tare: leave the film alone meanwhile.

    Example: isocharge serve stream three-25um-biaxial --port /dev/ttyACM0 --seconds 10
    """
    from isocharge.serve import Chain, FrameParser, Port, Predictor, SequenceGaps, TareRule, stream

    predictor, parser, gaps = Predictor(model, models=models), FrameParser(), SequenceGaps()
    chain = Chain(tare=TareRule(offset_limit_pC=offset_limit_pC))
    latencies: deque[float] = deque(maxlen=LATENCIES)
    with _until_stopped(), Port(_awaited(port, wait), baud=baud) as source:
        say(f"{predictor.metadata.label} on {port}: taring, leave the film alone")
        records = _limited(stream(source, predictor, chain, parser=parser, gaps=gaps), seconds, count)
        try:
            _print_lines(record.to_json() for record in _watched(records, latencies))
        finally:
            say(_closing_line(parser, gaps, latencies))


def _awaited(port: str, wait: float) -> str:
    """The port, as soon as there is something under its path, or when the time is over."""
    end = time.monotonic() + wait
    while "://" not in port and not Path(port).exists() and time.monotonic() < end:
        time.sleep(0.05)
    return port


def _limited(
    records: "Iterable[PredictionRecord]", seconds: float | None, count: int | None
) -> "Iterator[PredictionRecord]":
    """Records until the time is over or there were enough."""
    end = None if seconds is None else time.monotonic() + seconds
    for number, record in enumerate(records, start=1):
        yield record
        if number == count or (end is not None and time.monotonic() >= end):
            return


def _watched(records: "Iterable[PredictionRecord]", latencies: deque[float]) -> "Iterator[PredictionRecord]":
    """Records as they pass; the tare is said when it is found, latencies are kept."""
    tared = False
    for record in records:
        if record.tare_pC is not None and not tared:
            tared = True
            say("tared: " + ", ".join(f"{name} {charge:.2f} pC" for name, charge in record.tare_pC.items()))
        if record.latency_us is not None:
            latencies.append(record.latency_us)
        yield record


def _closing_line(parser: "FrameParser", gaps: "SequenceGaps", latencies: deque[float]) -> str:
    counts = parser.counts
    said = (
        f"{counts.frames} frames, {gaps.lost} lost, {gaps.repeated} repeated, {gaps.restarts} restarts; "
        f"{counts.crc_errors} CRC errors, {counts.malformed} malformed, {counts.bytes_dropped} bytes dropped"
    )
    if not latencies:
        return said
    import numpy as np

    p50, p99 = np.percentile(latencies, (50, 99))
    return f"{said}; last byte to record p50 {p50:.0f} us, p99 {p99:.0f} us"


class NoiseLevel(StrEnum):
    """Noise of the virtual amplifier."""

    reference = "reference"
    clean = "clean"


@serve_app.command("virtual")
def virtual_command(
    sensor: Annotated[str, typer.Argument(metavar="SENSOR", help="Built-in sensor, or a TOML file.")],
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", min=0.0, max=1e6, help="Play for so many seconds. (default: until Ctrl-C)"),
    ] = None,
    rate_Hz: Annotated[float, typer.Option("--rate-Hz", min=1.0, max=5000.0, help="Frames per second, Hz.")] = 200.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of presses, noise and offsets.")] = 0,
    force_max: Annotated[
        float, typer.Option("--force-max", min=0.05, help="Largest force, N; the smallest is 0.05 N.")
    ] = 2.0,
    noise: Annotated[NoiseLevel, typer.Option("--noise", help="Noise of the amplifier.")] = NoiseLevel.reference,
    probe: Annotated[str, typer.Option("--probe", help="What presses; circle:R with the radius in mm.")] = "circle:1.0",
    link: Annotated[
        Path | None, typer.Option("--link", metavar="PATH", help="Make a link to the port here. (default: none)")
    ] = None,
) -> None:
    """Play a sensor: presses that wander over the film, sent as frames on a pseudo-terminal.

    Prints the path of the port, then plays until Ctrl-C. The presses are simulated; the first second is without touch.

    Example: isocharge serve virtual three-25um-biaxial --link /tmp/film
    """
    from isocharge.cli.virtual import virtual_sensor
    from isocharge.simulate import ForwardMap, load_sensor, parse_probe

    scene = load_sensor(sensor), parse_probe(probe)
    with progress("solving the film") as advance:
        film = ForwardMap.build(*scene, force_range=(FORCE_MIN_N, force_max), progress=advance)
    player = virtual_sensor(film, noise.value, seed, rate_Hz)
    with _until_stopped(), player, _linked(link, player.url):
        _print_lines([player.url])
        say(f"playing {sensor} at {rate_Hz:g} Hz; Ctrl-C stops")
        threading.Event().wait(seconds)
    say(f"{player.sent} frames sent, {player.withheld} withheld because nobody read them")


@contextmanager
def _linked(link: Path | None, target: str) -> Iterator[None]:
    """A symbolic link for as long as the port is there."""
    if link is None:
        yield
        return
    try:
        link.symlink_to(target)
    except FileExistsError as error:
        raise OutputExists(f"--link {link}: something is there already; remove it or choose another path") from error
    except OSError as error:
        raise InputError(f"--link {link}: cannot be made ({error.strerror}); choose another path") from error
    try:
        yield
    finally:
        link.unlink(missing_ok=True)


@contextmanager
def _until_stopped() -> Iterator[None]:
    """Ctrl-C, a SIGTERM and a reader that closes the pipe all mean: enough, and well done."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:
        # What is still in stdout's buffer goes nowhere, without a complaint at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    finally:
        signal.signal(signal.SIGTERM, before)


def _text(file: str) -> TextIOWrapper:
    """A file, or stdin for `-`, as text for the csv module; a byte order mark is swallowed."""
    try:
        data = sys.stdin.buffer.read() if file == "-" else Path(file).read_bytes()
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); expected a CSV file, or - for stdin") from error
    return TextIOWrapper(BytesIO(data), encoding="utf-8-sig", newline="")


def _print_lines(lines: Iterable[str]) -> None:
    """Data to stdout, each line at once."""
    for line in lines:
        print(line, flush=True)
