"""`isocharge serve replay`: the records of a recording, again."""

from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
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
    UdpOption,
)
from isocharge.cli.serve.record_output import LATENCIES, Lines, in_turn, record_writer, summary, write_records
from isocharge.cli.shared.live_page import (
    PORT,
    InsecureOption,
    LiveHostOption,
    LivePortOption,
    LiveTokenOption,
    TlsCertOption,
    TlsKeyOption,
    one_page,
    page_feed,
    page_settings,
)
from isocharge.cli.shared.standard_streams import stdout_writer
from isocharge.cli.shared.stopping import until_stopped
from isocharge.cli.shared.terminal import say
from isocharge.common.files import new_file

if TYPE_CHECKING:
    from isocharge.serve import Predictor
    from isocharge.serve.port.recording import Marker
    from isocharge.serve.viewer.link import ReaderEnd
    from isocharge.serve.viewer.server import PageSettings


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
    live_page: Annotated[
        bool,
        typer.Option(
            "--live",
            help="Play it on a page for browsers, with a time line; its address is said on stderr. (default: no)",
        ),
    ] = False,
    live_port: LivePortOption = PORT,
    live_host: LiveHostOption = "127.0.0.1",
    live_token: LiveTokenOption = None,
    insecure: InsecureOption = False,
    tls_cert: TlsCertOption = None,
    tls_key: TlsKeyOption = None,
) -> None:
    """Play a recording of raw bytes again: the same model gives the same records, bit for bit.

    With --live it is there to be played, at any speed, until Ctrl-C.

    Example: isocharge serve replay touch.rec --real-time
    """
    from isocharge.serve import Policy, Predictor, RecordedClock, Recording, TouchStream, device_from_table, find_model
    from isocharge.serve.live.recorded_stream import replay

    settings = None
    if live_page:
        settings = page_settings(live_host, live_port, live_token, insecure, tls_cert, tls_key, is_recording=True)
    recording, clock = Recording(file), RecordedClock()
    predictor = Predictor(model or recording.model, models=models)
    board = device_from_table(recording.device, str(file))
    path = TouchStream(predictor, board, policy=Policy(recording.policy), now_ns=clock, frame_id=recording.name or None)
    load = None if model else partial(Predictor, models=models)
    latencies: deque[float] = deque(maxlen=LATENCIES)
    with ExitStack() as stack:
        stack.enter_context(until_stopped())
        write = record_writer(stack, output, udp, predictor.metadata.electrodes, stdout_writer())
        file_output = stack.enter_context(ExitStack())
        if mcap is not None:
            write = in_turn(_mcap_writer(file_output, mcap, mcap_records, predictor.metadata.electrodes), write)
        if settings is None:
            write_records(replay(recording, path, clock, real_time=real_time, load=load), write, latencies)
        else:
            version = find_model(model or recording.model, models)
            link = stack.enter_context(_page(file.name, settings, version, predictor))
            feed = page_feed(link, path, None, predictor.metadata.electrodes)

            def mark(marker: "Marker") -> None:
                link.tell(marker=[*marker])

            marked = replay(recording, path, clock, real_time=real_time, load=load, on_marker=mark)
            write_records(marked, in_turn(write, lambda record, _: feed.put(record)), latencies)
            file_output.close()  # now, as Ctrl-C, the only end of the page, would throw the file away
            link.tell(is_complete=True)
            while link.request() is not None:  # until the page's process ends, or Ctrl-C
                pass
    say(summary(path, latencies))
    if mcap is not None and not mcap.exists():
        say(f"{mcap} was not written, because the replay was stopped before its end")
        raise typer.Exit(1)


@contextmanager
def _page(name: str, settings: "PageSettings", model: Path, predictor: "Predictor") -> "Iterator[ReaderEnd]":
    """The page of this recording, which takes all records; says where it is."""
    with one_page(name, predictor.metadata, model, settings) as (link, url):
        link.wait()
        say(f"replay page: {url}; Ctrl-C stops")
        yield link


def _mcap_writer(stack: ExitStack, path: Path, records: McapRecords, electrodes: tuple[str, ...]) -> Lines:
    """What writes a record into the MCAP file, which exists once all of them are in it."""
    from isocharge.serve.export.mcap_file import McapFile, RecordEncoding

    draft = stack.enter_context(new_file(path))
    file = stack.enter_context(McapFile(draft, electrodes, RecordEncoding(records.value)))
    return lambda _, line: file.write(line)
