"""Process that serves the live page.

The live page has its own process. The reader, which is the process that reads the port, therefore never waits for the
page.
"""

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
from isocharge.serve.network.address import Address, Tls, Token
from isocharge.serve.network.http import HttpServer
from isocharge.serve.viewer.connection import ViewerConnection
from isocharge.serve.viewer.hub import Hub
from isocharge.serve.viewer.link import PageEnd
from isocharge.serve.viewer.server import Access, PageApplication

NICE = 10
"""Increase of the nice value of the process. The reader therefore has priority if both use the same core."""

START_TIMEOUT_S = 60.0
"""Longest time to wait until the server of the page listens, s."""

STOP_TIMEOUT_S = 5.0
"""Longest time to wait until the process ends by itself, s. After this time, the process is terminated."""

MAX_MESSAGE_BYTES = 1 << 12
"""Largest size of a message from a viewer, bytes."""


@dataclass(frozen=True)
class Page:
    """Settings of the live page.

    Attributes:
        link: Link to the process that reads the port or the recording.
        description: Description of the film, as `describe_film` returns it.
        address: Address on which the page listens.
        token: Secret token that viewers must send, or None if viewers need no token.
        is_recording: Whether the stream is a recording.
        tls: Certificate and private key for TLS, or None to serve the page without TLS.
        allowed_hosts: Further host names of the page, for example the name of a reverse proxy.
    """

    link: PageEnd
    description: dict[str, Any]
    address: Address
    token: str | None = None
    is_recording: bool = False
    tls: Tls | None = None
    allowed_hosts: tuple[str, ...] = ()


@contextmanager
def page_process(page: Page) -> Iterator[str]:
    """Return a context manager that serves the page in a separate process until the `with` block ends.

    The calling process is the reader of the stream. It must close its end of the link before the block ends. The new
    process then ends by itself.

    Args:
        page: Settings of the page.

    Yields:
        The URL of the page.

    Raises:
        InputError: If the token, the TLS files or an allowed host name cannot be used.
        ListenError: If the address is in use or cannot be used.
    """
    # The new process sends the URL of the page, or an error, through a pipe.
    context = get_context("spawn")
    url_receiver, url_sender = context.Pipe(duplex=False)
    process = context.Process(target=_run_and_send_url, args=(page, url_sender), name="page", daemon=True)
    with _interrupts_ignored():
        process.start()
    # The new process has its own copies of the following two ends. This process closes its copies, because it can only
    # notice the end of the new process if no copy is open any more.
    url_sender.close()
    page.link.close_here()
    try:
        yield _receive_url(url_receiver)
    finally:
        # The reader has closed the link, so that the process ends by itself. If it does not, it is terminated.
        process.join(STOP_TIMEOUT_S)
        if process.is_alive():
            process.terminate()
            process.join()


def run_page(page: Page, announce: Callable[[str], object]) -> None:
    """Serve the page in the present process until the reader of the stream has ended.

    Args:
        page: Settings of the page.
        announce: Function that is called with the URL when the server listens.

    Raises:
        InputError: If the token, the TLS files or an allowed host name cannot be used.
        ListenError: If the address is in use or cannot be used.
    """
    # The token is checked before the server listens, because it must not listen if the token is invalid.
    token = None if page.token is None else Token(page.token)
    access = Access(token, page.address.host, page.allowed_hosts)
    hub = Hub(page.link, page.description, is_recording=page.is_recording)
    with closing(hub):
        server = HttpServer(
            PageApplication(hub, access),
            page.address,
            tls=page.tls,
            ws=ViewerConnection,
            ws_max_size=MAX_MESSAGE_BYTES,
            ws_per_message_deflate=False,
        )
        with closing(server), asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            announce(server.url)
            runner.run(_serve(server, hub))


async def _serve(server: HttpServer, hub: Hub) -> None:
    """Answer the requests of browsers until the reader of the stream has ended.

    Args:
        server: Server of the page.
        hub: Hub that distributes the samples of the stream to the viewers.
    """
    serving = asyncio.create_task(server.serve())
    await hub.run()  # ends when the reader has ended
    server.stop()
    await serving


def _run_and_send_url(page: Page, url_sender: Connection) -> None:
    """Serve the page, and send its URL to the process of the reader when the server listens.

    The separate process of the page runs this function. If the page cannot be served, the function sends the error
    instead of the URL.

    Args:
        page: Settings of the page.
        url_sender: End of a pipe to the process that has started the page.
    """
    with suppress(OSError):  # if the system does not allow a lower priority, the page runs with the normal priority
        os.nice(NICE)
    try:
        run_page(page, url_sender.send)
    except IsochargeError as error:
        url_sender.send(error)


def _receive_url(url_receiver: Connection) -> str:
    """Wait until the process of the page sends its URL, and return the URL.

    Args:
        url_receiver: End of the pipe through which the process of the page sends its URL or an error.

    Raises:
        IsochargeError: The error that prevents the page from starting.
        ListenError: If the process ends without sending anything, or sends nothing within `START_TIMEOUT_S`.
    """
    result = None
    try:
        if url_receiver.poll(START_TIMEOUT_S):
            result = url_receiver.recv()
    except EOFError:  # the process has ended without sending anything
        pass
    if isinstance(result, IsochargeError):
        raise result
    if result is None:
        raise ListenError("the process of the live page did not start; run again without --live, and report this")
    return str(result)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Return a context manager that ignores Ctrl-C until the `with` block ends.

    A process that is started in the block also ignores Ctrl-C, and continues to ignore it after the block. The process
    of the page therefore ends only when the reader ends. If the block runs in another thread than the main thread,
    Ctrl-C is not ignored, because Python allows only the main thread to set signal handlers.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous_handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous_handler)
