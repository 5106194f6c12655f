"""`isocharge serve live`: several sensors on one page."""

import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from multiprocessing import get_context
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.serve.options import ModelsOption
from isocharge.cli.shared.live_page import (
    PORT,
    InsecureOption,
    LiveHostOption,
    LivePortOption,
    LiveTokenOption,
    PageRequests,
    TlsCertOption,
    TlsKeyOption,
    answering,
    film_link,
    page_feed,
    page_settings,
)
from isocharge.cli.shared.options import board_of
from isocharge.cli.shared.stopping import until_stopped
from isocharge.cli.shared.terminal import log_to_stderr, say
from isocharge.common.errors import IsochargeError

if TYPE_CHECKING:
    from isocharge.serve.viewer.link import ReaderEnd
    from isocharge.serve.viewer.streams_file import StreamSettings

STOP_S = 5.0
"""Time for a reader to stop, s."""


def live_command(
    streams: Annotated[
        Path, typer.Argument(metavar="STREAMS", help="TOML file with a table [\\[stream]] for each: model, port, ...")
    ],
    models: ModelsOption = None,
    live_port: LivePortOption = PORT,
    live_host: LiveHostOption = "127.0.0.1",
    live_token: LiveTokenOption = None,
    insecure: InsecureOption = False,
    tls_cert: TlsCertOption = None,
    tls_key: TlsKeyOption = None,
) -> None:
    """Follow several sensors on one page: position (mm) and force (N) on each film.

    Each stream has a process of its own, so none waits for another. Prints nothing on stdout; `serve stream` does for
    one sensor. Ctrl-C stops.

    Example: isocharge serve live two-films.toml
    """
    settings = page_settings(live_host, live_port, live_token, insecure, tls_cert, tls_key)
    from isocharge.serve import find_model, load_model
    from isocharge.serve.viewer.server import run_page
    from isocharge.serve.viewer.streams_file import read_streams

    films, readers = [], []
    for stream in read_streams(streams):
        board_of(stream.device)  # a wrong file is said at once
        version = find_model(stream.model, models)
        reader, film = film_link(stream.name, load_model(version).metadata, version)
        films.append(film)
        readers.append((stream, models, reader))
    with until_stopped(), _reading(readers) as processes:
        run_page(films, settings, lambda url: say(f"live page: {url}; Ctrl-C stops"))
    if any(process.exitcode == 1 for process in processes):
        raise typer.Exit(1)


@contextmanager
def _reading(
    readers: "Sequence[tuple[StreamSettings, Path | None, ReaderEnd]]",
) -> Iterator[list[SpawnProcess]]:
    """A process for each stream, while the block runs."""
    context = get_context("spawn")
    processes = [context.Process(target=read_port, args=reader, daemon=True) for reader in readers]
    try:
        for process in processes:
            process.start()
        for _, _, end in readers:
            end.close_here()
        yield processes
    finally:
        for process in processes:
            if process.pid is not None:
                process.terminate()
                process.join(STOP_S)


def read_port(stream: "StreamSettings", models: Path | None, link: "ReaderEnd") -> None:
    """Follow one port until SIGTERM; the whole of a reader's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process of the page, which then ends this one
    with until_stopped(), log_to_stderr():
        try:
            _follow(stream, models, link)
            link.tell(reason="the stream has ended")
        except (IsochargeError, OSError) as error:
            say(f"{stream.name}: {type(error).__name__}: {error}")
            link.tell(reason=str(error))
            sys.exit(1)


def _follow(stream: "StreamSettings", models: Path | None, link: "ReaderEnd") -> None:
    from isocharge.serve import Policy, Predictor, Recorder, TouchStream, open_source
    from isocharge.serve.live.recorded_stream import RecordedStream
    from isocharge.serve.live.time_slice import ask_for_short_slices

    predictor, board = Predictor(stream.model, models=models), board_of(stream.device)
    touch = TouchStream(predictor, board, frame_id=stream.name)
    header = (Policy.every.value, board.table, stream.name)
    recorder = Recorder(stream.record, predictor.metadata.label, *header) if stream.record else None
    live = RecordedStream(touch, recorder)
    feed = page_feed(link, touch, live, predictor.metadata.electrodes)
    feed.ended = f"{stream.name}: the process of the live page has ended, and this stream ends with it"
    with ExitStack() as stack:
        stack.enter_context(answering(PageRequests(link, live, header, recorder is not None)))
        request = board.frames.request
        source = stack.enter_context(open_source(stream.port, baud=stream.baud, reconnect=True, request=request))
        if recorder:
            stack.enter_context(recorder)
        ask_for_short_slices()
        for record, _ in stack.enter_context(closing(live.follow(source))):
            feed.put(record)
            if not link.is_open:  # the page's process was killed: nobody else would ever end this one
                return
