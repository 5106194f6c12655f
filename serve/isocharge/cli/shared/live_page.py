"""Options of commands for the live page, and the exchange of messages between a stream and its page."""

import logging
import math
import os
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer
from msgspec import structs

from isocharge.cli.shared.optional_values import DEFAULT_LIVE_ADDRESS
from isocharge.cli.shared.terminal import say
from isocharge.common.errors import InputError, IsochargeError, shown
from isocharge.common.extras import require
from isocharge.serve import PredictionRecord, Recorder, TouchStream
from isocharge.serve.live.recorded_stream import RecordedStream
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.network.address import Address, Tls, check_exposure
from isocharge.serve.port import recording
from isocharge.serve.viewer.link import ReaderEnd, make_link
from isocharge.serve.viewer.messages import (
    LiveRequest,
    Marker,
    Record,
    SampleFormat,
    Tare,
    describe_film,
    find_deflection_field,
)

RATE_RECORDS = 400
"""Number of the latest records from whose times the frame rate of the board is computed."""

LOOPBACK = "127.0.0.1"
"""Host of the page if `--live` contains only a port."""

MAX_PORT = 65535
"""Largest number of a TCP port."""

STATE_INTERVAL_S = 0.25
"""Time between two messages with the counters, s."""


class RecordingHeader(NamedTuple):
    """Header of a recording that the user begins on the live page.

    Attributes:
        policy: Value of `Policy`, which states for which frames records are computed.
        device: Content of the device file.
        name: Name of the film in the records; None or empty for the name of the sensor of the model.
    """

    policy: str
    device: Mapping[str, Any]
    name: str | None


LiveOption = Annotated[
    str | None,
    typer.Option(
        "--live",
        metavar="[HOST:PORT]",
        help=f"Show the film on a page for browsers, at {DEFAULT_LIVE_ADDRESS} or at the given address. A port alone "
        "is a port of this machine, and port 0 chooses a free port. An address that other machines can reach needs "
        "--token. (default: no page)",
    ),
]

TokenOption = Annotated[
    str | None,
    typer.Option(
        "--token",
        envvar="ISOCHARGE_TOKEN",
        help="Secret that clients must send as `Authorization: Bearer TOKEN`; the live page asks for it, or takes it "
        "from #TOKEN in its address. (default: none)",
    ),
]

AllowHostOption = Annotated[
    list[str] | None,
    typer.Option(
        "--allow-host",
        metavar="NAME",
        help="Further host name by which browsers reach the server, for example through a reverse proxy; repeat it for "
        "more. (default: IP addresses, localhost and the host that it listens on)",
    ),
]

TlsCertOption = Annotated[
    Path | None,
    typer.Option("--tls-cert", metavar="PEM", help="Certificate chain; turns TLS on. (default: no TLS)"),
]

TlsKeyOption = Annotated[
    Path | None,
    typer.Option("--tls-key", metavar="PEM", help="Private key of it. (default: in the certificate's file)"),
]


def given_tls(certificate: Path | None, key: Path | None) -> Tls | None:
    """Return the TLS files in the options, or None if no certificate is given.

    Args:
        certificate: Value of `--tls-cert`; None if the option is not given.
        key: Value of `--tls-key`; None if the option is not given.

    Raises:
        InputError: If the key is given without a certificate.
    """
    if certificate is not None:
        return Tls(certificate, key)
    if key is not None:
        raise InputError("--tls-key: expected --tls-cert too, got the key alone")
    return None


def page_tls(live: str | None, certificate: Path | None, key: Path | None) -> Tls | None:
    """Return the TLS files of the live page, or None if there is no certificate.

    Raises:
        InputError: If the key is given without a certificate, or a certificate without a page.
    """
    tls = given_tls(certificate, key)
    if tls is not None and live is None:
        raise InputError("--tls-cert: expected --live too, because only the page uses TLS, got the certificate alone")
    return tls


def given_token(token: str | None) -> str | None:
    """Return the token that the option or the environment contains.

    If the environment variable `ISOCHARGE_TOKEN` is empty, the function returns an empty text. Typer alone would treat
    an empty token as a missing token.
    """
    return os.environ.get("ISOCHARGE_TOKEN") if token is None else token


def page_address(live: str, token: str | None) -> Address:
    """Return the address at which the page listens.

    Args:
        live: Value of `--live`: PORT or HOST:PORT.
        token: Value of `--token`; None if the option is not given.

    Raises:
        InputError: If `live` has another form, or if other machines could see the page without a token.
    """
    host, colon, port = live.rpartition(":")
    if not colon:  # only a port
        host = LOOPBACK
    # The length is checked before the conversion, because `int` refuses very long texts.
    is_short_number = port.isascii() and port.isdecimal() and len(port) <= len(str(MAX_PORT))
    is_port = is_short_number and int(port) <= MAX_PORT
    is_valid_address = host != "" and is_port
    if not is_valid_address:
        raise InputError(f"--live: expected PORT or HOST:PORT, as 8001 or {DEFAULT_LIVE_ADDRESS}, got {shown(live)}")
    bare_host = host.removeprefix("[").removesuffix("]")  # IPv6 addresses are written in brackets
    address = Address(bare_host, int(port))
    check_exposure(address, has_token=given_token(token) is not None)
    return address


@contextmanager
def live_page(
    address: Address,
    token: str | None,
    name: str,
    metadata: ModelMetadata,
    model_folder: Path,
    *,
    is_recording: bool = False,
    tls: Tls | None = None,
    allow_host: Iterable[str] | None = None,
) -> Iterator[ReaderEnd]:
    """Context manager that runs the page of a stream in a separate process, and prints the address of the page.

    Args:
        address: Address at which the page listens.
        token: Value of `--token`.
        name: Name of the stream, which the page shows.
        metadata: Metadata of the model that estimates the contacts.
        model_folder: Folder of the version of the model, which may contain a deflection field.
        is_recording: Whether the stream is a recording. Its replay waits for the page instead of losing records.
        tls: Certificate and key; None for no TLS.
        allow_host: Values of `--allow-host`; None if the option is not given.

    Yields:
        The reader's end of the link to the page.

    Raises:
        MissingExtra: If the extra `http` is not installed.
        InputError: If a value of `--allow-host` is not a host name.
        ListenError: If the address is in use or impossible.
    """
    with require("http"):
        from isocharge.serve.viewer.process import Page, page_process

    description = describe_film(name, metadata, find_deflection_field(model_folder, metadata))
    reader, page_end = make_link()
    page = Page(page_end, description, address, given_token(token), is_recording, tls, tuple(allow_host or ()))
    # The process of the page ends when the reader's end of the link is closed. At the end of the block, the contexts
    # are left in reverse order: the second `closing` closes the reader's end before `page_process` waits for the end of
    # the process. The first `closing` is needed if the process cannot be started. Closing twice is harmless.
    with closing(reader), page_process(page) as url, closing(reader):
        if is_recording:
            reader.enable_waiting()  # a slow page then delays the replay, instead of losing records
        page_name = "replay page" if is_recording else "live page"
        say(f"{page_name}: {url}")
        yield reader


class PageFeed:
    """Writer that sends the records and, a few times per second, the counters of a stream to its live page."""

    def __init__(self, link: ReaderEnd, touch: TouchStream, stream: RecordedStream | None = None) -> None:
        """Store the stream and its link. No records have been sent yet.

        Args:
            link: The reader's end of the link to the page.
            touch: The stream whose records are sent.
            stream: The same stream with its recording; None for a replay.
        """
        self._link = link
        self._touch = touch
        self._stream = stream
        self._pack = SampleFormat(touch.predictor.metadata.electrodes).pack
        self._last_state_s = 0.0
        self._timestamps_s: deque[float] = deque(maxlen=RATE_RECORDS)

    def write(self, record: PredictionRecord) -> None:
        """Send a record without waiting for the page. From time to time, also send the state of the stream.

        If the process of the page has ended, a message is printed once, and the stream continues.
        """
        was_open = self._link.is_open
        self._link.send_sample(self._pack(record))
        self._timestamps_s.append(math.nan if record.timestamp is None else record.timestamp)
        if was_open and not self._link.is_open:  # sending closes the link if the process of the page has ended
            say("the process of the live page has ended; the stream goes on without it")
        now_s = time.monotonic()
        if now_s - self._last_state_s > STATE_INTERVAL_S:
            self._last_state_s = now_s
            self._send_state(record)

    def _rate_Hz(self) -> float | None:
        """Compute the frame rate (Hz) from the times of the latest records, or return None if the rate is unknown."""
        elapsed_s = self._timestamps_s[-1] - self._timestamps_s[0]
        if not elapsed_s > 0.0:  # also if a time is NaN
            return None
        return (len(self._timestamps_s) - 1) / elapsed_s

    def _send_state(self, record: PredictionRecord) -> None:
        """Send the counters and the state of the stream to the page.

        Args:
            record: The latest record.
        """
        recorder = self._stream.recorder if self._stream else None
        page_counters = {"reconnects": self._touch.counts.outages, "not_shown": self._link.dropped}
        self._link.send_message(
            counters=self._touch.totals()._asdict() | page_counters,
            rate_Hz=self._rate_Hz(),
            model=record.model,
            film=None if record.film is None else structs.asdict(record.film),
            tare_pC=record.tare_pC,
            recording=None if recorder is None else str(recorder.path.name),
            recording_failed=recorder is not None and recorder.failed,
        )


@contextmanager
def answering(link: ReaderEnd, stream: RecordedStream, header: RecordingHeader | None) -> Iterator[None]:
    """Context manager that carries out the requests of the page, and shows warnings of `isocharge.serve` on the page.

    A separate thread waits for requests and carries them out. The thread ends when the link is closed.

    Args:
        link: The reader's end of the link to the page.
        stream: The stream, which carries out the requests.
        header: Header of the recordings that the page begins. If it is None, because the command itself records the
            stream, requests for recordings are refused.
    """
    handler = logging.Handler()
    handler.emit = lambda record: _show_note(link, record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger("isocharge.serve")
    logger.addHandler(handler)
    request_thread = threading.Thread(
        target=_answer_requests, args=(link, stream, header), name="page requests", daemon=True
    )
    request_thread.start()
    try:
        yield
    finally:
        logger.removeHandler(handler)


def _answer_requests(link: ReaderEnd, stream: RecordedStream, header: RecordingHeader | None) -> None:
    """Carry out requests of the page until the link is closed, and show each error on the page."""
    while (request := link.wait_for_request()) is not None:
        try:
            _carry_out(request, link, stream, header)
        except IsochargeError as error:
            _show_note(link, str(error))


def _carry_out(request: LiveRequest, link: ReaderEnd, stream: RecordedStream, header: RecordingHeader | None) -> None:
    """Carry out one request of the page.

    The page can request to write a marker, to begin or end a recording, to measure the tare again, or to reset the
    estimated pretension of the film to the value of its calibration. The page is informed of markers and recordings.

    Args:
        request: The request.
        link: The reader's end of the link to the page.
        stream: The stream, which carries out the requests.
        header: Header of the recordings that the page begins; None if the command itself records the stream.

    Raises:
        InputError: If the page requests a recording while the command records the stream.
    """
    match request:
        case Marker(text=text):
            marker = recording.Marker(time.time(), text)
            stream.request_marker(marker)
            link.send_message(marker=[*marker])
        case Record(on=must_record):
            if header is None:
                raise InputError("the command that runs the stream records it already (--record)")
            if must_record:
                model_label = stream.predictor.metadata.label
                path = Path(f"{model_label.replace('/', '-')}-{time.strftime('%Y%m%d-%H%M%S')}.rec")
                recorder = Recorder(path, model_label, header.policy, header.device, header.name)
                stream.request_recording(recorder)
                link.send_message(recording=f"{path.name}, which waits for data")
            else:
                stream.request_recording(None)
                link.send_message(recording=None)
        case Tare():
            stream.request_tare()


def _show_note(link: ReaderEnd, text: str) -> None:
    """Show a message on the page for some seconds."""
    link.send_message(note={"text": text, "at": time.time()})
