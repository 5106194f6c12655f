"""The gRPC server: separate threads, but the models, limits, token and certificate of the HTTP server."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import grpc

from isocharge.errors import ListenError
from isocharge.serve.network.grpc.service import Service, handlers
from isocharge.serve.network.protocol import Handler
from isocharge.serve.network.tls import Tls
from isocharge.serve.network.token import Token

THREADS, GRACE_SECONDS = 4, 10
"""Requests answered at a time, and the time that requests which have begun get when the server stops, s."""


@contextmanager
def grpc_server(
    handler: Handler, host: str, port: int, token: Token | None = None, tls: Tls | None = None
) -> Iterator[str]:
    """Serve for as long as the block lasts.

    Args:
        handler: Handler of the HTTP server; its models and limits are used.
        host, port: Where to listen; port 0 takes a free one.
        token: What clients must send, as metadata `authorization`; without it everybody is answered.
        tls: Certificate and key; without them the connection is plain.

    Yields:
        The address, `grpc://host:port` or `grpcs://host:port`.

    Raises:
        ListenError: If the address is taken or impossible.
        InputError: If a TLS file cannot be used.
    """
    server = grpc.server(
        ThreadPoolExecutor(THREADS, thread_name_prefix="grpc"),
        options=[("grpc.max_receive_message_length", handler.limits.body_bytes), ("grpc.so_reuseport", 0)],
        maximum_concurrent_rpcs=handler.limits.connections,
    )
    server.add_generic_rpc_handlers((handlers(Service(handler), token),))
    place = f"[{host}]" if ":" in host else host
    listening = _listen(server, f"{place}:{port}", tls)
    server.start()
    try:
        yield f"{'grpcs' if tls else 'grpc'}://{place}:{listening}"
    finally:
        server.stop(GRACE_SECONDS).wait()


def _listen(server: grpc.Server, place: str, tls: Tls | None) -> int:
    """The port that the server listens on."""
    try:
        if tls is None:
            return int(server.add_insecure_port(place))
        return int(server.add_secure_port(place, grpc.ssl_server_credentials([tls.pair()])))
    except RuntimeError as error:
        raise ListenError(
            f"cannot listen on {place} for gRPC: {error}; choose another --grpc-port or --host"
        ) from error
