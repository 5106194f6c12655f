"""The process of the page: a server of its own, beside the process that reads the port."""

import asyncio
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import uvloop

from isocharge.common.errors import IsochargeError, ListenError
from isocharge.serve.network.address import Address, Token
from isocharge.serve.viewer.hub import Hub
from isocharge.serve.viewer.link import PageEnd
from isocharge.serve.viewer.server import Access, PageServer

NICE = 10
"""How much later than the reader the page's process gets its turn where both want the same core."""

START_S, STOP_S = 60.0, 5.0
"""Time to start and to stop, s."""

BACKLOG = 128
"""Connections that may wait to be accepted."""


@dataclass(frozen=True)
class Page:
    """What the page shows, where, and to whom.

    Attributes:
        link: To the process that reads the port or the recording.
        description: Of the film, see `describe_film`.
        address: Where to listen.
        token: The secret that viewers must know; None for none.
        is_recording: Whether the stream is a recording.
    """

    link: PageEnd
    description: dict[str, Any]
    address: Address
    token: str | None = None
    is_recording: bool = False


@contextmanager
def page_process(page: Page) -> Iterator[str]:
    """Run the page in a process of its own; yields its URL. It ends when the reader closes its end of the link.

    Raises:
        InputError: If the token cannot be used.
        ListenError: If the address is taken or impossible.
    """
    context = get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_run, args=(page, theirs), name="page", daemon=True)
    with _interrupts_ignored():
        process.start()
    theirs.close()
    page.link.close_here()
    try:
        yield _url(ours)
    finally:
        process.join(STOP_S)
        if process.is_alive():
            process.terminate()
            process.join()


def run_page(page: Page, announce: Callable[[str], object]) -> None:
    """Answer browsers in this process until the reader has ended.

    Args:
        page: What to show.
        announce: Called with the URL once the server listens.

    Raises:
        As `page_process`.
    """
    access = Access(None if page.token is None else Token(page.token), page.address.host)
    hub = Hub(page.link, page.description, is_recording=page.is_recording)
    with closing(hub), page.address.listen(BACKLOG) as listening:
        announce(page.address.url(listening, secure=False))

        async def serve() -> None:
            async with PageServer(hub, access).listening(listening):
                await hub.run()

        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(serve())


def _run(page: Page, ready: Connection) -> None:
    """The page's process: says the URL, or what is wrong."""
    with suppress(OSError):
        os.nice(NICE)
    try:
        run_page(page, ready.send)
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
    """A process that is started here does not see Ctrl-C: it ends with its reader."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
