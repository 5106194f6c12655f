"""The process of the page: a server of its own, beside the process that reads the port."""

import asyncio
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import uvloop

from isocharge.common.errors import IsochargeError, ListenError
from isocharge.serve.network.address import Address
from isocharge.serve.network.http import HttpServer
from isocharge.serve.network.http.websocket import bounded_websocket
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.tls import Tls
from isocharge.serve.network.token import Token
from isocharge.serve.viewer.access import Access
from isocharge.serve.viewer.app import PageApp
from isocharge.serve.viewer.hub import Hub, make_film
from isocharge.serve.viewer.link import PageEnd

NICE = 10
"""How much later than the reader the page's process gets its turn where both want the same core."""

START_S, STOP_S = 60.0, 5.0
"""Time to start and to stop, s."""

CONNECTIONS = 128
"""Connections at a time: a browser opens six."""


class FilmLink(NamedTuple):
    """A film for the page's process: the link to its reader, and its description."""

    link: PageEnd
    description: dict[str, Any]


@dataclass(frozen=True)
class PageSettings:
    """Where the page is, and who may see it.

    Attributes:
        address: Where to listen.
        token: The secret; None for none.
        tls: Certificate and key; None for no TLS.
        is_recording: Whether the films are recordings.
    """

    address: Address
    token: str | None = None
    tls: Tls | None = None
    is_recording: bool = False


@contextmanager
def page_process(films: Sequence[FilmLink], settings: PageSettings) -> Iterator[str]:
    """Run the page in a process of its own; yields its URL.

    Raises:
        InputError: If a TLS file or the token cannot be used.
        ListenError: If the address is taken or impossible.
    """
    context = get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_run, args=(list(films), settings, theirs), name="page", daemon=True)
    with _interrupts_ignored():
        process.start()
    theirs.close()
    for film in films:
        film.link.close_here()
    try:
        yield _url(ours)
    finally:
        process.join(STOP_S)
        if process.is_alive():
            process.terminate()
            process.join()


def run_page(films: Sequence[FilmLink], settings: PageSettings, announce: Any = None) -> None:
    """Answer browsers in this process until all readers have ended, or SIGTERM or SIGINT comes.

    Args:
        films: In their order on the page.
        settings: Where, and for whom.
        announce: Called with the URL once the server listens.

    Raises:
        As `page_process`.
    """
    hub = Hub(
        [
            make_film(number, film.link, film.description, is_recording=settings.is_recording)
            for number, film in enumerate(films)
        ]
    )
    access = Access(None if settings.token is None else Token(settings.token), settings.address.host)
    limits = ServerLimits(connections=CONNECTIONS)
    server = HttpServer(
        PageApp(hub, access), settings.address, limits=limits, tls=settings.tls, websocket=bounded_websocket(limits)
    )
    with closing(server), closing(hub):
        if announce is not None:
            announce(server.url)
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(_serve(server, hub))


async def _serve(server: HttpServer, hub: Hub) -> None:
    following = asyncio.create_task(hub.run())
    following.add_done_callback(lambda _: server.stop())
    await server.serve()
    following.cancel()
    with suppress(asyncio.CancelledError):
        await following


def _run(films: list[FilmLink], settings: PageSettings, ready: Connection) -> None:
    """The page's process: says the URL, or what is wrong."""
    with suppress(OSError):
        os.nice(NICE)
    try:
        run_page(films, settings, lambda url: ready.send(url))
    except IsochargeError as error:
        ready.send(error)


def _url(ready: Connection) -> str:
    """The URL that the page's process says.

    Raises:
        IsochargeError: What it raised.
        ListenError: If it says nothing.
    """
    try:
        answer = ready.recv() if ready.poll(START_S) else None
    except EOFError:
        answer = None
    if isinstance(answer, IsochargeError):
        raise answer
    if answer is None:
        raise ListenError("the process of the live page did not start; run again without --live, and report this")
    return str(answer)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """A process that is started here does not see Ctrl-C: it ends with its readers."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
