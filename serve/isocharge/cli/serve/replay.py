"""`isocharge serve replay`: the records of a recording, again."""

from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.serve.options import (
    McapOption,
    McapRecords,
    McapRecordsOption,
    ModelsOption,
    Output,
    OutputOption,
    UdpOption,
)
from isocharge.cli.serve.record_output import LATENCIES, record_writer, summary, with_lines, write_records
from isocharge.cli.shared.standard_streams import stdout_writer
from isocharge.cli.shared.stopping import until_stopped
from isocharge.cli.shared.terminal import say
from isocharge.files import new_file


def replay_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Recording of `isocharge serve stream --record`.")],
    model: Annotated[
        str | None,
        typer.Option("--model", metavar="MODEL", help="Model to use, name or path. (default: that of the recording)"),
    ] = None,
    models: ModelsOption = None,
    real_time: Annotated[
        bool, typer.Option("--real-time/--fast", help="Play at the pace of the recording, or as fast as possible.")
    ] = False,
    output: OutputOption = Output.json,
    udp: UdpOption = None,
    mcap: McapOption = None,
    mcap_records: McapRecordsOption = McapRecords.json,
) -> None:
    """Play a recording of raw bytes again: the same model gives the same records, bit for bit.

    Example: isocharge serve replay touch.rec --real-time
    """
    from isocharge.serve import Policy, Predictor, RecordedClock, Recording, TouchStream, device_from_table
    from isocharge.serve.live.recorded_stream import replay

    recording, clock = Recording(file), RecordedClock()
    predictor = Predictor(model or recording.model, models=models)
    board = device_from_table(recording.device, str(file))
    path = TouchStream(predictor, board, policy=Policy(recording.policy), now_ns=clock, frame_id=recording.name or None)
    load = None if model else partial(Predictor, models=models)
    latencies: deque[float] = deque(maxlen=LATENCIES)
    with ExitStack() as stack:
        stack.enter_context(until_stopped())
        write = record_writer(stack, output, udp, predictor.metadata.electrodes, stdout_writer())
        write = with_lines(write, _new_mcap(stack, mcap, mcap_records, predictor.metadata.electrodes))
        write_records(replay(recording, path, clock, real_time=real_time, load=load), write, latencies)
    say(summary(path, latencies))
    if mcap is not None and not mcap.exists():
        say(f"{mcap} was not written, because the replay was stopped before its end")
        raise typer.Exit(1)


def _new_mcap(
    stack: ExitStack, path: Path | None, records: McapRecords, electrodes: tuple[str, ...]
) -> Callable[[str], None] | None:
    """What writes a line into the MCAP file, which exists once all of them are in it."""
    if path is None:
        return None
    from isocharge.serve.export.mcap_file import McapFile, RecordEncoding

    draft = stack.enter_context(new_file(path))
    return stack.enter_context(McapFile(draft, electrodes, RecordEncoding(records.value))).write
