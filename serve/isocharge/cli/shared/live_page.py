"""Command options for the live page, and the exchange of messages between a stream and its page."""

import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from msgspec import structs

from isocharge.cli.shared.terminal import say, warnings_passed_to
from isocharge.common.errors import InputError, require, shown
from isocharge.serve import PredictionRecord, Recorder, TouchStream
from isocharge.serve.live.recorded_stream import RecordedStream
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.network.address import Address, Tls, check_exposure
from isocharge.serve.network.browser_check import AccessCheck
from isocharge.serve.port import recording
from isocharge.serve.viewer.film_description import describe_film

if TYPE_CHECKING:
    from isocharge.serve.viewer.live_page import Action, LivePage

STATE_INTERVAL_S = 0.25
"""Time between two messages with the counters, s."""


LiveOption = Annotated[
    str | None,
    typer.Option(
        metavar="[HOST:]PORT",
        help="Show the film on a page for browsers at this address. A port alone is a port of this machine, and port 0 "
        "chooses a free port. An address that other machines can reach needs --token; the page asks for the "
        "token, or takes it from #TOKEN in its address. (default: no page)",
    ),
]

TokenOption = Annotated[
    str | None,
    typer.Option(
        envvar="ISOCHARGE_TOKEN",
        # If the variable is empty, the token is an empty text, which `AccessCheck` refuses. Typer alone would treat an
        # empty token as a missing token.
        callback=lambda token: os.environ.get("ISOCHARGE_TOKEN") if token is None else token,
        help="Secret that clients must send as `Authorization: Bearer TOKEN`. (default: none)",
    ),
]

AllowHostOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="Further host name by which browsers reach the server, for example through a reverse proxy; repeat it for "
        "more. (default: IP addresses, localhost and the host that it listens on)",
    ),
]

TlsCertOption = Annotated[
    Path | None,
    typer.Option(metavar="PEM", help="Certificate chain; turns TLS on. (default: no TLS)"),
]

TlsKeyOption = Annotated[
    Path | None,
    typer.Option(metavar="PEM", help="Private key of it. (default: in the certificate's file)"),
]


def given_tls(certificate: Path | None, key: Path | None) -> Tls | None:
    """Return the TLS files in the options, or None if no certificate is given.

    If only the certificate is given, its file must also contain the key.

    Args:
        certificate: Value of `--tls-cert`; None if the option is not given.
        key: Value of `--tls-key`; None if the option is not given.

    Raises:
        InputError: If the key is given without a certificate.
    """
    if certificate is not None:
        return Tls(certificate, key or certificate)
    if key is not None:
        raise InputError("--tls-key: expected --tls-cert too, got the key alone")
    return None


def page_address(live: str) -> Address:
    """Return the address at which the page listens.

    Args:
        live: Value of `--live`: PORT or HOST:PORT.

    Raises:
        InputError: If `live` has another form.
    """
    host, _, port = live.rpartition(":")
    if port not in map(str, range(1 << 16)):
        raise InputError(f"--live: expected PORT or HOST:PORT, as 8001 or 127.0.0.1:8001, got {shown(live)}")
    return Address(host.strip("[]") or "127.0.0.1", int(port))


@contextmanager
def live_page(
    live: str | None,
    name: str,
    metadata: ModelMetadata,
    *,
    is_recording: bool = False,
    token: str | None,
    tls_cert: Path | None,
    tls_key: Path | None,
    allow_host: Iterable[str] | None,
) -> Iterator["LivePage | None"]:
    """Context manager that serves the page of a stream in a separate thread, and prints the address of the page.

    The page also shows the warnings of `isocharge.serve` for some seconds. Without `--live`, the context manager yields
    None.

    Args:
        live: Value of `--live`; None if the option is not given.
        name: Name of the film or of the recording, which the page shows.
        metadata: Metadata of the model that estimates the contacts.
        is_recording: Whether the stream is a recording.
        token: Value of `--token`.
        tls_cert: Value of `--tls-cert`.
        tls_key: Value of `--tls-key`.
        allow_host: Values of `--allow-host`.

    Raises:
        MissingExtra: If the extra `http` is not installed.
        InputError: If the value of an option is wrong, other machines could see the page without a token, or a
            certificate is given without a page.
        ListenError: If the address is in use or impossible.
    """
    tls = given_tls(tls_cert, tls_key)
    if live is None:
        if tls is not None:
            raise InputError(
                "--tls-cert: expected --live too, because only the page uses TLS, got the certificate alone"
            )
        yield None
        return
    address = page_address(live)
    check_exposure(address, token)
    with require("http"):
        from isocharge.serve.viewer.live_page import LivePage, serve_page

    access = AccessCheck(address.host, allow_host or (), token=token)
    page = LivePage(describe_film(name, metadata), access, is_recording=is_recording)

    def show_warning(record: logging.LogRecord) -> None:
        """Show a warning on the page."""
        page.update(note={"text": record.getMessage(), "at": time.time()})

    with serve_page(page, address, tls) as url, warnings_passed_to(show_warning, "isocharge.serve"):
        say(f"{'replay' if is_recording else 'live'} page: {url}")
        yield page


class PageFeed:
    """Writer that passes the records and, a few times per second, the counters of a stream to its live page."""

    def __init__(
        self,
        page: "LivePage",
        touch: TouchStream,
        stream: RecordedStream | None = None,
        new_recorder: Callable[[Path, str], Recorder] | None = None,
    ) -> None:
        """Store the page and the stream. If `stream` is given, the buttons of the page control this stream.

        Args:
            page: The page.
            touch: The stream that computes the records. Its counters and its model are shown on the page.
            stream: Object that records `touch` and executes requests, for example to measure a new tare. None for a
                replay, which cannot be controlled.
            new_recorder: Function that creates a recorder from the path of the recording and the label of the model.
                The function is called when the page begins a recording. None if the page cannot begin a recording.
        """
        self._page = page
        self._touch = touch
        self._controlled_stream = stream
        self._create_recorder = new_recorder
        self._is_recording = False  # whether the page has begun a recording
        self._last_state_update_s = 0.0  # monotonic time at which the state was last sent to the page, s
        self._latest_record: PredictionRecord | None = None
        if stream is not None:
            page.act = partial(self._handle_button, stream)  # is called for each request that changes the stream

    def write(self, record: PredictionRecord) -> None:
        """Add a record to the page. From time to time, also update the state of the stream."""
        self._page.add(record)
        self._latest_record = record
        now_s = time.monotonic()
        if now_s - self._last_state_update_s > STATE_INTERVAL_S:
            self._last_state_update_s = now_s
            self.update_state()

    def update_state(self) -> None:
        """Update the counters and the state of the stream on the page, unless the stream has no record yet.

        The state contains the counts of frames and faults, the rate, the model, the followed pretension of the film,
        the tare, the name of the recording, and whether the recording has failed.
        """
        record = self._latest_record
        if record is None:
            return
        recorder = self._controlled_stream.recorder if self._controlled_stream else None
        self._page.update(
            counters=asdict(self._touch.parser.counts),
            rate_Hz=self._page.tape.rate_Hz(),  # the tape contains the samples of the page
            model=record.model,
            film=None if record.film is None else structs.asdict(record.film),
            tare_pC=record.tare_pC,
            recording=None if recorder is None else recorder.path.name,
            recording_failed=recorder is not None and recorder.failed,
        )

    def _handle_button(self, stream: RecordedStream, action: "Action") -> None:
        """Carry out a request of the page to write a marker, to begin or end a recording, or to measure a new tare.

        Args:
            stream: The stream that the page controls.
            action: Request of the class `Marker`, `Tare` or `Record`. A `Record` begins a recording if its attribute
                `on` is true, and otherwise ends the recording.

        Raises:
            InputError: If the page requests a recording while the stream is already recorded, even if another browser
                has begun the recording.
            OutputError: If the file of the recording cannot be created.
        """
        from isocharge.serve.viewer.live_page import Marker, Tare

        if isinstance(action, Marker):
            # `recording.Marker` is another class: the marker in a recording, which also has a time.
            marker = recording.Marker(time.time(), action.text)
            stream.request_marker(marker)
            self._page.add_marker(marker)
        elif isinstance(action, Tare):
            stream.request_tare()
        # Below, the action is a `Record`. Without a function that creates recorders, the command itself records the
        # stream, and the page may neither begin nor end a recording.
        elif self._create_recorder is None or (action.on and self._is_recording):
            raise InputError("the command that runs the stream (--record), or another browser, records it already")
        elif action.on:
            model_label = self._touch.predictor.metadata.label
            path = Path(f"{model_label.replace('/', '-')}-{datetime.now():%Y%m%d-%H%M%S-%f}.rec")
            stream.request_recording(self._create_recorder(path, model_label))
            self._is_recording = True
            self._page.update(recording=f"{path.name}, which waits for data")
        else:
            stream.request_recording(None)
            self._is_recording = False
            self._page.update(recording=None)
