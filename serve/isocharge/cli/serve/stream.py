"""`isocharge serve stream`: prediction records from a port as they come."""

import signal
from collections import deque
from contextlib import ExitStack, closing
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.serve.options import (
    McapOption,
    McapRecords,
    McapRecordsOption,
    ModelsOption,
    Output,
    OutputOption,
    PolicyName,
    UdpOption,
    WaitOption,
    awaited,
)
from isocharge.cli.serve.record_output import (
    LATENCIES,
    McapOutput,
    in_turn,
    record_writer,
    summary,
    write_records,
)
from isocharge.cli.shared.live_page import LiveOption, PageFeed, TokenOption, answering, live_page, page_address
from isocharge.cli.shared.options import DeviceOption, ModelArgument, board_of
from isocharge.cli.shared.standard_streams import stdout_is_ready, stdout_writer
from isocharge.cli.shared.stopping import on_signal, stop_after, unless_hung_up, until_stopped
from isocharge.cli.shared.terminal import say
from isocharge.common.errors import InputError, ModelError

if TYPE_CHECKING:
    from isocharge.serve import Device, Predictor


def stream_command(
    model: ModelArgument,
    port: Annotated[
        str,
        typer.Option(
            "--port",
            metavar="URL",
            help="Port of the sensor: device path, tcp:// or udp://HOST:PORT; or a file of bytes; - reads stdin.",
        ),
    ],
    models: ModelsOption = None,
    device: DeviceOption = None,
    output: OutputOption = Output.json,
    udp: UdpOption = None,
    record: Annotated[
        Path | None,
        typer.Option(
            "--record",
            metavar="FILE",
            help="Also write raw bytes and records for `isocharge serve replay`. (default: no)",
        ),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(
            "--name",
            metavar="TEXT",
            help="Name of this film, the `frame_id` of its records: tells two films on one computer apart. "
            "(default: name of the model's sensor)",
        ),
    ] = None,
    mcap: McapOption = None,
    mcap_records: McapRecordsOption = McapRecords.json,
    policy: Annotated[
        PolicyName,
        typer.Option(
            "--policy", help="If several frames come at once: a record for each of them, or for the latest alone."
        ),
    ] = PolicyName.every,
    reconnect: Annotated[
        bool,
        typer.Option("--reconnect/--no-reconnect", help="If the port is lost: try for ever to open it again, or fail."),
    ] = True,
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=0.0, help="Time after which to stop, s. (default: at Ctrl-C)")
    ] = None,
    count: Annotated[
        int | None, typer.Option("--count", min=1, help="Number of records after which to stop. (default: at Ctrl-C)")
    ] = None,
    wait: WaitOption = 0.0,
    baud: Annotated[
        int, typer.Option("--baud", min=1, help="Speed of the port, bits per second; USB ports ignore it.")
    ] = 115200,
    offset_limit_pC: Annotated[
        float | None,
        typer.Option(
            "--offset-limit-pC",
            min=0.0,
            help="Largest charge at rest that the tare accepts, pC. (default: 100, or as --device says)",
        ),
    ] = None,
    live: LiveOption = None,
    token: TokenOption = None,
) -> None:
    """Follow a sensor live: read its port, and print position (mm) and force (N) for every frame of charges.

    The first 100 frames (0.5 s at 200 Hz) are the tare, the charges at rest: leave the film alone meanwhile. The signal
    SIGUSR1 starts a new tare; SIGHUP takes the latest version of MODEL, without losing a frame. Ctrl-C stops. If the
    reader of stdout is too slow for a sensor, the oldest lines are dropped and counted in the summary; --record gets
    everything.

    Example: isocharge serve stream three-25um-biaxial --port /dev/ttyACM0 --seconds 10
    """
    from isocharge.serve import Policy, Predictor, Recorder, TouchStream, find_model, open_source
    from isocharge.serve.live.line_queue import LineQueue
    from isocharge.serve.live.recorded_stream import RecordedStream

    address = None if live is None else page_address(live, token)
    predictor, board = Predictor(model, models=models), _board(device, offset_limit_pC)
    path = TouchStream(predictor, board, policy=Policy(policy.value), frame_id=_checked_name(name))
    latencies: deque[float] = deque(maxlen=LATENCIES)
    recorder = Recorder(record, predictor.metadata.label, policy.value, board.table, name or "") if record else None
    recorded = RecordedStream(path, recorder)
    with ExitStack() as stack:
        stack.enter_context(until_stopped())
        page = None
        if address is not None:
            shown = live_page(address, token, path.frame_id, predictor.metadata, find_model(model, models))
            page, _ = stack.enter_context(shown)
        request = board.request
        source = stack.enter_context(open_source(awaited(port, wait), baud=baud, reconnect=reconnect, request=request))
        stack.enter_context(on_signal(signal.SIGUSR1, recorded.request_tare))
        renew = partial(recorded.request_model, partial(_load, model, models))
        stack.enter_context(on_signal(signal.SIGHUP, unless_hung_up(renew)))
        stack.enter_context(stop_after(seconds))
        lines = stack.enter_context(LineQueue(stdout_writer(), stdout_is_ready))
        put = lines.put if source.is_live else stdout_writer()  # a file waits for a slow reader, a sensor does not
        write = record_writer(stack, output, udp, predictor.metadata.electrodes, put)
        if page is not None:
            header = None if recorder else (policy.value, board.table, name or "")
            stack.enter_context(answering(page, recorded, header))
            feed = PageFeed(page, path, recorded)
            write = in_turn(write, lambda record, _: feed.put(record))
        mcap_output = (
            McapOutput(mcap, predictor.metadata.electrodes, mcap_records, source.is_live) if mcap is not None else None
        )
        if mcap_output:
            put_line = stack.enter_context(mcap_output).put
            write = in_turn(lambda _, line: put_line(line), write)
        if recorder:
            stack.enter_context(recorder)
        records = stack.enter_context(closing(recorded.follow(source)))  # closed before the recorder
        say(f"{predictor.metadata.label} on {port}: taring, leave the film alone")
        try:
            write_records(islice(records, count), write, latencies)
        finally:
            lines.close()
            say(summary(path, latencies, lines.lost))
    if (recorder and recorder.failed) or (mcap_output and not mcap_output.is_whole):
        raise typer.Exit(1)


def _board(device: Path | None, offset_limit_pC: float | None) -> "Device":
    from isocharge.serve.live.device import with_offset_limit

    board = board_of(device)
    return board if offset_limit_pC is None else with_offset_limit(board, offset_limit_pC)


def _load(model: str, models: Path | None) -> "Predictor":
    """The latest version of a model; it must answer on this machine as where it was trained."""
    from isocharge.serve import Predictor, check_golden, find_model, load_model

    folder = find_model(model, models)
    loaded = load_model(folder)
    check_golden(loaded)
    if folder.name.isdecimal() and folder.name != str(loaded.metadata.version):
        raise ModelError(f"{folder}: expected version {folder.name}, got {loaded.metadata.label}; export it again")
    return Predictor(folder)


def _checked_name(name: str | None) -> str | None:
    from isocharge.serve.prediction.record import LONGEST_NAME, NAME, is_name

    if name is not None and not is_name(name):
        raise InputError(f"--name: expected {NAME}, got {name[:LONGEST_NAME]!r}")
    return name
