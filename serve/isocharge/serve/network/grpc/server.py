"""The gRPC server: a separate event loop, but the models, limits, token and certificate of the HTTP server.

An open call costs no thread, so that no number of clients that open calls and wait can hold up the others.
"""

import asyncio
from collections.abc import Coroutine, Iterator
from contextlib import contextmanager
from threading import Thread
from typing import Any

import grpc
import grpc.aio
import uvloop

from isocharge.common.errors import ListenError
from isocharge.serve.network.credentials import Tls
from isocharge.serve.network.grpc.service import Service
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.protocol import Handler

GRACE_SECONDS = 10
"""Time that requests which have begun get when the server stops, s."""

STREAMS = 100
"""Calls of one connection at a time, as HTTP/2 advises at least; a client's further calls wait on its side."""


@contextmanager
def grpc_server(handler: Handler, host: str, port: int, tls: Tls | None = None) -> Iterator[str]:
    """Serve for as long as the block lasts.

    Args:
        handler: Handler of the HTTP server; its models, limits and token are used. Clients send the token as metadata
            `authorization`.
        host, port: Where to listen; port 0 takes a free one.
        tls: Certificate and key; without them the connection is plain.

    Yields:
        The address, `grpc://host:port` or `grpcs://host:port`.

    Raises:
        ListenError: If the address is taken or impossible.
        InputError: If a TLS file cannot be used.
    """
    with _event_loop() as loop:

        def run(coroutine: Coroutine[Any, Any, Any]) -> Any:
            return asyncio.run_coroutine_threadsafe(coroutine, loop).result()

        place = f"[{host}]" if ":" in host else host
        server, listening = run(_start(handler, f"{place}:{port}", tls))
        try:
            yield f"{'grpcs' if tls else 'grpc'}://{place}:{listening}"
        finally:
            run(server.stop(GRACE_SECONDS))


@contextmanager
def _event_loop() -> Iterator[asyncio.AbstractEventLoop]:
    """An event loop that runs in its own thread."""
    loop = uvloop.new_event_loop()
    thread = Thread(target=loop.run_forever, name="grpc")
    thread.start()
    try:
        yield loop
    finally:
        asyncio.run_coroutine_threadsafe(loop.shutdown_default_executor(), loop).result()
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


async def _start(handler: Handler, place: str, tls: Tls | None) -> tuple[grpc.aio.Server, int]:
    """A server that answers, and the port that it listens on."""
    limits = handler.limits
    server = grpc.aio.server(options=_options(limits), maximum_concurrent_rpcs=2 * limits.connections)
    server.add_generic_rpc_handlers((Service(handler).handlers(),))
    listening = _listen(server, place, tls)
    await server.start()
    return server, listening


def _options(limits: ServerLimits) -> list[tuple[str, int]]:
    return [
        ("grpc.max_receive_message_length", limits.body_bytes),
        ("grpc.max_metadata_size", limits.header_bytes),
        ("grpc.absolute_max_metadata_size", limits.header_bytes),
        ("grpc.max_concurrent_streams", STREAMS),
        ("grpc.max_allowed_incoming_connections", limits.connections),
        ("grpc.server_handshake_timeout_ms", round(1e3 * limits.header_seconds)),
        ("grpc.max_connection_idle_ms", round(1e3 * limits.idle_seconds)),
        ("grpc.so_reuseport", 0),
    ]


def _listen(server: grpc.aio.Server, place: str, tls: Tls | None) -> int:
    """The port that the server listens on."""
    try:
        if tls is None:
            return int(server.add_insecure_port(place))
        return int(server.add_secure_port(place, grpc.ssl_server_credentials([tls.pair()])))
    except RuntimeError as error:
        raise ListenError(
            f"cannot listen on {place} for gRPC: {error}; choose another --grpc-port or --host"
        ) from error
