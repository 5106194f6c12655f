"""`isocharge serve replay`: the records of a recording, again."""

from collections import deque
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
)
from isocharge.cli.serve.record_output import LATENCIES, Lines, in_turn, record_writer, summary, write_records
from isocharge.cli.shared.live_page import LiveOption, PageFeed, TokenOption, live_page, page_address
from isocharge.cli.shared.options import DeviceOption
from isocharge.cli.shared.standard_streams import stdout_writer
from isocharge.cli.shared.stopping import until_stopped
from isocharge.cli.shared.terminal import say
from isocharge.common.files import new_file
from isocharge.serve import (
    Policy,
    Predictor,
    RecordedClock,
    Recording,
    TouchStream,
    device_from_table,
    find_model,
    load_device,
)
from isocharge.serve.live.recorded_stream import replay
from isocharge.serve.port.recording import Marker


def replay_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Recording of `isocharge serve stream --record`.")],
    model: Annotated[
        str | None,
        typer.Option("--model", metavar="MODEL", help="Model to use, name or path. (default: that of the recording)"),
    ] = None,
    models: ModelsOption = None,
    device: DeviceOption = None,
    real_time: Annotated[
        bool, typer.Option("--real-time/--fast", help="Play at the pace of the recording, or as fast as possible.")
    ] = False,
    output: OutputOption = Output.json,
    mcap: McapOption = None,
    mcap_records: McapRecordsOption = McapRecords.json,
    live: LiveOption = None,
    token: TokenOption = None,
) -> None:
    """Play a recording of raw bytes again: the same model and device give the same records, bit for bit.

    --device takes the place of the recorded description of the board, if that was wrong. With --live the recording is
    there to be played, at any speed, until Ctrl-C.

    Example: isocharge serve replay touch.rec --real-time
    """
    address = None if live is None else page_address(live, token)
    recording, clock = Recording(file), RecordedClock()
    predictor = Predictor(model or recording.model, models=models)
    board = load_device(device) if device else device_from_table(recording.device, str(file))
    path = TouchStream(predictor, board, policy=Policy(recording.policy), now_ns=clock, frame_id=recording.name or None)
    load = None if model else partial(Predictor, models=models)
    played = partial(replay, recording, path, clock, real_time=real_time, load=load)
    latencies: deque[float] = deque(maxlen=LATENCIES)
    with ExitStack() as stack:
        stack.enter_context(until_stopped())
        write = record_writer(stack, output, None, predictor.metadata.electrodes, stdout_writer())
        file_output = stack.enter_context(ExitStack())
        if mcap is not None:
            write = in_turn(_mcap_writer(file_output, mcap, mcap_records, predictor.metadata.electrodes), write)
        if address is None:
            write_records(played(), write, latencies)
        else:
            folder = find_model(model or recording.model, models)
            page = live_page(address, token, file.name, predictor.metadata, folder, is_recording=True)
            link, _ = stack.enter_context(page)
            feed = PageFeed(link, path)

            def mark(marker: Marker) -> None:
                link.tell(marker=[*marker])

            write_records(played(on_marker=mark), in_turn(write, lambda record, _: feed.put(record)), latencies)
            file_output.close()  # now, as Ctrl-C, the only end of the page, would throw the file away
            link.tell(is_complete=True)
            while link.request() is not None:  # until the page's process ends, or Ctrl-C
                pass
    say(summary(path, latencies))
    if mcap is not None and not mcap.exists():
        say(f"{mcap} was not written, because the replay was stopped before its end")
        raise typer.Exit(1)


def _mcap_writer(stack: ExitStack, path: Path, records: McapRecords, electrodes: tuple[str, ...]) -> Lines:
    """What writes a record into the MCAP file, which exists once all of them are in it."""
    from isocharge.serve.export.mcap_file import McapFile, RecordEncoding  # needs the extra `record`

    draft = stack.enter_context(new_file(path))
    file = stack.enter_context(McapFile(draft, electrodes, RecordEncoding(records.value)))
    return lambda _, line: file.write(line)
