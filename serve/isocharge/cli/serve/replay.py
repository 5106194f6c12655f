"""`isocharge serve replay`: the records of a recording, again."""

from collections import deque
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.serve.options import ModelsOption, Output, OutputOption, UdpOption
from isocharge.cli.serve.record_output import LATENCIES, record_writer, summary, write_records
from isocharge.cli.shared.standard_streams import stdout_writer
from isocharge.cli.shared.stopping import until_stopped
from isocharge.cli.shared.terminal import say


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
        write_records(replay(recording, path, clock, real_time=real_time, load=load), write, latencies)
    say(summary(path, latencies))
