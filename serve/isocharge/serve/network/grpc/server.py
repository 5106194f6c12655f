"""gRPC server that makes a `Service` available on a port.

No thread waits for the messages of an open call. A call that sends no messages therefore does not delay other clients.
"""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial

import grpc
import grpc.aio

from isocharge.common.errors import ListenError
from isocharge.common.files import read_whole
from isocharge.serve.network.address import Tls, url_host
from isocharge.serve.network.grpc.service import METHODS, SERVICE, Service
from isocharge.serve.network.protocol.handler import Handler

MIN_PING_MS = 5000
"""Shortest time between two keep-alive pings of a client, ms. A client that pings more often is disconnected."""


@asynccontextmanager
async def grpc_server(handler: Handler, host: str, port: int, tls: Tls | None = None) -> AsyncIterator[str]:
    """Run a gRPC server in the present event loop until the `async with` block ends.

    The decorator turns the function into a context manager. At the end of the block, all calls that have begun are
    finished. grpcio cancels the calls that it has received but not begun. If the exit of the block is cancelled, all
    calls are ended at once.

    Args:
        handler: Handler of the HTTP server. The gRPC server uses its models, limits and token. Clients send the token
            in the metadata field `authorization`.
        host: Host name or IP address on which to listen.
        port: TCP port. The port 0 selects a free port.
        tls: Certificate and private key for TLS, which the HTTP server has checked, or None for a server without TLS.

    Yields:
        The URL of the server, `grpc://host:port` or, with TLS, `grpcs://host:port`.

    Raises:
        ListenError: If the address is in use or cannot be used.
    """
    limits = handler.limits
    address = f"{url_host(host)}:{port}"
    options = [
        ("grpc.max_receive_message_length", limits.body_bytes),
        ("grpc.max_concurrent_streams", limits.connection_requests),  # further calls wait in the client
        ("grpc.max_allowed_incoming_connections", limits.connections),
        ("grpc.server_handshake_timeout_ms", round(1e3 * limits.header_seconds)),
        ("grpc.max_connection_idle_ms", round(1e3 * limits.idle_seconds)),
        ("grpc.http2.min_ping_interval_without_data_ms", MIN_PING_MS),
        ("grpc.keepalive_permit_without_calls", 1),  # the client may also ping while it has no open call
        ("grpc.so_reuseport", 0),
    ]
    # The service limits the number of open calls to `connections`. If a new call exceeds this limit, the service ends a
    # waiting call instead of refusing the new call. grpcio would refuse the new call, so its own limit must be higher,
    # here twice as high.
    server = grpc.aio.server(options=options, maximum_concurrent_rpcs=2 * limits.connections)
    service = Service(handler)
    methods = {name: grpc.stream_stream_rpc_method_handler(partial(service.handle, name)) for name in METHODS}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, methods),))
    try:
        if tls is None:
            actual_port = server.add_insecure_port(address)
        else:
            credentials = grpc.ssl_server_credentials([(read_whole(tls.key), read_whole(tls.certificate))])
            actual_port = server.add_secure_port(address, credentials)
    except RuntimeError as error:
        raise ListenError(
            f"cannot listen on {address} for gRPC: {error}; choose another --grpc-port or --host"
        ) from error
    await server.start()
    try:
        yield f"{'grpcs' if tls else 'grpc'}://{url_host(host)}:{actual_port}"
    finally:
        service.end_streams()
        try:
            await server.stop(limits.grace_seconds)
        finally:  # ends all calls at once if the stop is cancelled, and has no effect otherwise
            await server.stop(None)
