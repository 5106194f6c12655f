"""The live page in commands: its options, and the link between a stream and the page."""

import logging
import os
import threading
import time
import webbrowser
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isocharge.cli.shared.terminal import say
from isocharge.common.errors import InputError, IsochargeError
from isocharge.common.extras import require

if TYPE_CHECKING:
    from isocharge.serve import PredictionRecord, TouchStream
    from isocharge.serve.live.recorded_stream import RecordedStream
    from isocharge.serve.model.metadata import ModelMetadata
    from isocharge.serve.viewer.link import Message, ReaderEnd
    from isocharge.serve.viewer.server import FilmLink, PageSettings

RATE_RECORDS = 400
"""Records, the latest, over which the rate is taken."""

STATE_S = 0.25
"""Time between two messages with the counters, s."""

PORT = 8001

LivePortOption = Annotated[
    int, typer.Option("--live-port", min=0, max=65535, help="TCP port of the live page; 0 takes a free one.")
]

LiveHostOption = Annotated[str, typer.Option("--live-host", help="Name or IP address on which the page listens.")]

LiveTokenOption = Annotated[
    str | None,
    typer.Option(
        "--live-token",
        envvar="ISOCHARGE_TOKEN",
        help="Secret that viewers must know: the page asks for it, or takes it from #TOKEN in its address. "
        "(default: none)",
    ),
]

InsecureOption = Annotated[
    bool, typer.Option("--insecure", help="Let other machines see the page without a token. (default: refuse to start)")
]

TlsCertOption = Annotated[
    Path | None,
    typer.Option("--live-tls-cert", metavar="PEM", help="Certificate chain; turns TLS on. (default: no TLS)"),
]

TlsKeyOption = Annotated[
    Path | None,
    typer.Option("--live-tls-key", metavar="PEM", help="Private key of it. (default: in the certificate's file)"),
]


def page_settings(
    host: str,
    port: int,
    token: str | None,
    insecure: bool,
    tls_cert: Path | None,
    tls_key: Path | None,
    *,
    is_recording: bool = False,
) -> "PageSettings":
    """Where the page is and who may see it.

    Raises:
        InputError: If others could see it by accident, or the options do not go together.
    """
    with require("http"):
        from isocharge.serve.viewer.server import PageSettings
    from isocharge.serve.network.address import Address, check_exposure
    from isocharge.serve.network.tls import Tls

    address = Address(host, port)
    if token is None:
        token = os.environ.get("ISOCHARGE_TOKEN")  # the option takes an empty variable for none
    check_exposure(address, token=token is not None, insecure=insecure)
    if tls_key is not None and tls_cert is None:
        raise InputError("--live-tls-key: expected --live-tls-cert too, got the key alone")
    return PageSettings(address, token, None if tls_cert is None else Tls(tls_cert, tls_key), is_recording)


def film_link(name: str, metadata: "ModelMetadata", model: Path) -> "tuple[ReaderEnd, FilmLink]":
    """A film for the page, and the reader's end of its link.

    Args:
        name: Of the stream, for people.
        metadata: Of the model that answers.
        model: Folder of its version.
    """
    with require("http"):
        from isocharge.serve.viewer.server import FilmLink
    from isocharge.serve.viewer.description import describe_film, find_field
    from isocharge.serve.viewer.link import make_link

    reader, page = make_link()
    return reader, FilmLink(page, describe_film(name, metadata, find_field(model, metadata)))


@contextmanager
def one_page(
    name: str, metadata: "ModelMetadata", model: Path, settings: "PageSettings"
) -> "Iterator[tuple[ReaderEnd, str]]":
    """The page of one film in a process of its own: the reader's end of the link, and the page's URL."""
    from isocharge.serve.viewer.server import page_process

    reader, film = film_link(name, metadata, model)
    try:
        with page_process([film], settings) as url:
            try:
                yield reader, url
            finally:
                reader.close()  # the page's process ends by that
    finally:
        reader.close()


@dataclass
class PageFeed:
    """What a stream tells the page: each record, and a few times a second its counters."""

    link: "ReaderEnd"
    pack: "Callable[[PredictionRecord], bytes]"
    touch: "TouchStream"
    live: "RecordedStream | None" = None
    ended: str = "the process of the live page has ended; the stream goes on without it"
    _told_s: float = 0.0
    _times: deque[float] = field(default_factory=lambda: deque(maxlen=RATE_RECORDS))

    def put(self, record: "PredictionRecord") -> None:
        """Hand over a record; does not wait."""
        was_open, now_s = self.link.is_open, time.monotonic()
        self.link.put(self.pack(record))
        self._times.append(now_s)
        if was_open and not self.link.is_open:
            say(self.ended)
        if now_s - self._told_s > STATE_S:
            self._told_s = now_s
            self._tell_state(record, now_s - self._times[0])

    def _tell_state(self, record: "PredictionRecord", elapsed_s: float) -> None:
        rate_Hz = (len(self._times) - 1) / elapsed_s if len(self._times) > 1 and elapsed_s > 0.0 else None
        recorder = self.live.recorder if self.live else None
        self.link.tell(
            counters=self.touch.totals()._asdict()
            | {"reconnects": self.touch.counts.outages, "not_shown": self.link.dropped},
            rate_Hz=rate_Hz,
            model=record.model,
            tare_pC=record.tare_pC,
            recording=None if recorder is None else str(recorder.path.name),
            recording_failed=recorder is not None and recorder.failed,
        )


def page_feed(link: "ReaderEnd", touch: "TouchStream", live: "RecordedStream | None", electrodes: Any) -> PageFeed:
    """The feed of a stream with these electrodes."""
    from isocharge.serve.viewer.sample import SampleFormat

    return PageFeed(link, SampleFormat(tuple(electrodes)).pack, touch, live)


@dataclass
class PageRequests:
    """Does what the page asks of a live stream, in a thread of its own.

    Attributes:
        link: The reader's end.
        live: The stream.
        header: Policy, device table and the film's own name, for recordings that the page begins.
        records_itself: Whether the command records by itself; then the page may not.
    """

    link: "ReaderEnd"
    live: "RecordedStream"
    header: tuple[str, Any, str]
    records_itself: bool

    def follow(self) -> None:
        """Do what is asked until the page's process ends."""
        while (request := self.link.request()) is not None:
            try:
                self._do(request)
            except IsochargeError as error:
                self.link.tell(note=_note(str(error)))

    def _do(self, request: "Message") -> None:
        from isocharge.serve.port.recording import Marker

        if request["do"] == "tare":
            self.live.request_tare()
        elif request["do"] == "marker":
            marker = Marker(time.time(), request["text"])
            self.live.request_marker(marker)
            self.link.tell(marker=[*marker])
        elif self.records_itself:
            raise InputError("the command that runs the stream records it already (--record)")
        else:
            self._record(request["on"])

    def _record(self, is_on: bool) -> None:
        from isocharge.serve import Recorder

        if not is_on:
            self.live.request_recording(None)
            return
        label = self.live.predictor.metadata.label
        path = Path(f"{label.replace('/', '-')}-{time.strftime('%Y%m%d-%H%M%S')}.rec")
        recorder = Recorder(path, label, *self.header)
        self.live.request_recording(recorder.__enter__())


@contextmanager
def answering(requests: PageRequests) -> Iterator[None]:
    """Do what the page asks while the block runs, and show the live path's warnings on the page, too."""
    handler = _NoteHandler(requests.link)
    logger = logging.getLogger("isocharge.serve")
    logger.addHandler(handler)
    threading.Thread(target=requests.follow, name="page requests", daemon=True).start()
    try:
        yield
    finally:
        logger.removeHandler(handler)


class _NoteHandler(logging.Handler):
    """Shows warnings on the page."""

    def __init__(self, link: "ReaderEnd") -> None:
        super().__init__()
        self._link = link

    def emit(self, record: logging.LogRecord) -> None:
        self._link.tell(note=_note(record.getMessage()))


def _note(text: str) -> dict[str, Any]:
    """A message for the page, which shows it for a while."""
    return {"text": text, "at": time.time()}


def open_in_browser(url: str) -> None:
    """Open the page where there is a browser."""
    with suppress(webbrowser.Error, OSError):
        if webbrowser.open(url):
            return
    say(f"open {url} in a browser")
