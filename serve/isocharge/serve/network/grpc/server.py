"""gRPC server, which makes a `Service` available on a port and has its own event loop.

An open call needs no thread. Idle calls therefore do not delay other clients.
"""

import asyncio
from collections.abc import Coroutine, Iterator
from contextlib import contextmanager
from threading import Thread
from typing import Any, TypeVar

import grpc
import grpc.aio
import uvloop

from isocharge.common.errors import ListenError
from isocharge.serve.network.address import ServerLimits, Tls
from isocharge.serve.network.grpc.service import Service
from isocharge.serve.network.protocol import Handler

T = TypeVar("T")

GRACE_SECONDS = 10
"""Time that requests which have begun have to finish when the server stops, s."""

MAX_CALLS_PER_CONNECTION = 100
"""Largest number of open calls of one connection, which is the smallest number that HTTP/2 recommends.

Further calls of the connection wait on the side of the client.
"""


@contextmanager
def grpc_server(handler: Handler, host: str, port: int, tls: Tls | None = None) -> Iterator[str]:
    """Run a gRPC server while the block runs.

    Args:
        handler: Handler of the HTTP server, whose models, limits and token are used. Clients send the token as metadata
            `authorization`.
        host: Name or address on which to listen.
        port: TCP port; 0 selects a free port.
        tls: Certificate and key; None for no TLS.

    Yields:
        The address, `grpc://host:port` or `grpcs://host:port`.

    Raises:
        ListenError: If the address is in use or cannot be used.
        InputError: If a TLS file cannot be used.
    """
    is_ipv6 = ":" in host
    url_host = f"[{host}]" if is_ipv6 else host
    scheme = "grpcs" if tls else "grpc"
    with _event_loop() as loop:
        server, actual_port = _run_in(loop, _start(handler, f"{url_host}:{port}", tls))
        try:
            yield f"{scheme}://{url_host}:{actual_port}"
        finally:
            _run_in(loop, server.stop(GRACE_SECONDS))


@contextmanager
def _event_loop() -> Iterator[asyncio.AbstractEventLoop]:
    """Run an event loop in its own thread while the block runs, and yield the event loop."""
    loop = uvloop.new_event_loop()
    thread = Thread(target=loop.run_forever, name="grpc")
    thread.start()
    try:
        yield loop
    finally:
        # Wait for the calls that run in other threads, stop the loop, and wait for the thread of the loop.
        _run_in(loop, loop.shutdown_default_executor())
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


def _run_in(loop: asyncio.AbstractEventLoop, coroutine: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine in an event loop of another thread, wait for its end, and return its result."""
    return asyncio.run_coroutine_threadsafe(coroutine, loop).result()


async def _start(handler: Handler, address: str, tls: Tls | None) -> tuple[grpc.aio.Server, int]:
    """Start a gRPC server, and return it with the port on which it listens.

    Args:
        handler: Handler of the HTTP server, whose models, limits and token are used.
        address: `host:port`; the port 0 selects a free port.
        tls: Certificate and key; None for no TLS.
    """
    limits = handler.limits
    # The service itself limits the calls to `connections`, and ends a waiting call when a new call exceeds this limit.
    # The limit of grpcio must be higher, because grpcio refuses calls above it before they reach the service.
    max_calls = 2 * limits.connections
    server = grpc.aio.server(options=_options(limits), maximum_concurrent_rpcs=max_calls)
    server.add_generic_rpc_handlers((Service(handler).handlers(),))
    port = _listen(server, address, tls)
    await server.start()
    return server, port


def _options(limits: ServerLimits) -> list[tuple[str, int]]:
    """Return the options of grpcio that apply the limits of a server."""
    return [
        ("grpc.max_receive_message_length", limits.body_bytes),
        ("grpc.max_metadata_size", limits.header_bytes),
        ("grpc.absolute_max_metadata_size", limits.header_bytes),
        ("grpc.max_concurrent_streams", MAX_CALLS_PER_CONNECTION),
        ("grpc.max_allowed_incoming_connections", limits.connections),
        ("grpc.server_handshake_timeout_ms", round(1e3 * limits.header_seconds)),
        ("grpc.max_connection_idle_ms", round(1e3 * limits.idle_seconds)),
        ("grpc.so_reuseport", 0),
    ]


def _listen(server: grpc.aio.Server, address: str, tls: Tls | None) -> int:
    """Let a server listen on `host:port`, and return the port on which it listens.

    Args:
        server: The server, which has not been started.
        address: `host:port`; the port 0 selects a free port.
        tls: Certificate and key; None for no TLS.

    Raises:
        ListenError: If the address is in use or cannot be used.
        InputError: If a TLS file cannot be used.
    """
    try:
        if tls is None:
            return int(server.add_insecure_port(address))
        credentials = grpc.ssl_server_credentials([tls.key_and_certificate()])
        return int(server.add_secure_port(address, credentials))
    except RuntimeError as error:
        raise ListenError(
            f"cannot listen on {address} for gRPC: {error}; choose another --grpc-port or --host"
        ) from error
