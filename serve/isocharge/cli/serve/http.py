"""`isocharge serve http`: serve models over HTTP and, if a port is given, over gRPC."""

import logging
import os
import signal
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, closing, contextmanager, suppress
from pathlib import Path
from typing import Annotated, Literal

import typer

from isocharge.cli.shared.live_page import (
    AllowHostOption,
    TlsCertOption,
    TlsKeyOption,
    TokenOption,
    given_tls,
)
from isocharge.cli.shared.terminal import announce, on_signal, unless_hung_up, write_stderr
from isocharge.common.errors import IsochargeError, require
from isocharge.serve.network.address import Address, Tls, check_exposure
from isocharge.serve.network.browser_check import AccessCheck
from isocharge.serve.network.http.server import HttpServer
from isocharge.serve.network.metrics import RequestLog, Traffic
from isocharge.serve.network.model_store import ModelStore
from isocharge.serve.network.protocol.handler import Handler
from isocharge.serve.outputs.output import WriterQueue

log = logging.getLogger("isocharge.serve.http")
log.setLevel(logging.INFO)


def http_command(
    models: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the models to serve. (default: all in $ISOCHARGE_MODELS, `models` and the installation)",
        ),
    ] = None,
    host: Annotated[
        str,
        typer.Option(help="Name or IP address to listen on; one that other machines can reach needs --token."),
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port for HTTP; 0 takes a free one.")] = 8000,
    uds: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="Unix socket to listen on instead of host and port. (default: none)"),
    ] = None,
    grpc_port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="TCP port for gRPC; 0 takes a free one. (default: no gRPC)"),
    ] = None,
    allow_host: AllowHostOption = None,
    token: TokenOption = None,
    tls_cert: TlsCertOption = None,
    tls_key: TlsKeyOption = None,
    log_format: Annotated[
        Literal["text", "json"],
        typer.Option("--log", help="On stderr: sentences for people, or a line of JSON for each request and message."),
    ] = "text",
) -> None:
    """Serve models over HTTP and, with --grpc-port, over gRPC. The protocol is the Open Inference Protocol v2.

    Charges are in pC, positions in mm, and forces in N. Prints the address as soon as the server answers requests. The
    server has a description for programs at `/openapi.json`, and metrics for Prometheus at `/metrics`. SIGHUP loads
    all models again. After Ctrl-C, the server answers all requests that have begun, and stops.

    Example: isocharge serve http --port 8000
    """
    # Check the options that protect the server.
    address = Address(host, port, uds)
    # The gRPC server listens on the host even if the HTTP server listens on a Unix socket.
    check_exposure(address if grpc_port is None else Address(host), token)
    tls = given_tls(tls_cert, tls_key)
    # Pages of other sites cannot reach a Unix socket, so every host name is then accepted.
    access = AccessCheck(host, allow_host or (), token=token, any_host=uds is not None)

    # Load the models, and serve them until Ctrl-C.
    with suppress(KeyboardInterrupt), _traffic(log_format) as traffic:
        store = ModelStore(models)
        handler = Handler(store, traffic=traffic, access=access)
        server = HttpServer(handler, address, tls)
        # SIGHUP loads all models again, in a thread, so that the server continues to answer. The system also sends
        # SIGHUP when the terminal is closed. In this case, `unless_hung_up` stops the server instead.
        load_all = unless_hung_up(lambda: threading.Thread(target=_load_all, args=[store], name="load").start())
        with (
            closing(server),
            on_signal(signal.SIGTERM, server.stop),
            on_signal(signal.SIGINT, server.stop),
            on_signal(signal.SIGHUP, load_all),
        ):
            _log_models(store)
            # The context manager `beside` runs the gRPC server at the same time, and prints the addresses.
            server.run(beside=_grpc_server_and_urls(server, handler, host, grpc_port, tls))


def _log_models(store: ModelStore) -> None:
    """Log why versions were refused, and the labels of all loaded versions, separated by commas."""
    for reason in store.refusals():
        log.warning("refused: %s", reason)
    log.info("serving %s; Ctrl-C stops", ", ".join(loaded.metadata.label for loaded in store.versions_of()))


def _load_all(store: ModelStore) -> None:
    """Load all models of the repositories again.

    If a model cannot be loaded, the reason is logged, and its loaded version is kept.
    """
    try:
        store.load_all()
    except IsochargeError as error:  # a folder of models cannot be listed
        log.warning("%s", error)
        return
    _log_models(store)


@contextmanager
def _traffic(log_format: str) -> Iterator[Traffic]:
    """Context manager that yields the traffic counters of the servers and, for `--log json`, writes a log of requests.

    A separate thread writes the log to stderr, so that a slow reader of stderr does not delay the answers. The warnings
    of all packages are written to the same log. For `--log text`, there is no log. The settings of the module `logging`
    are not restored at the end, because the command ends then.

    Args:
        log_format: Value of `--log`.
    """
    if log_format == "text":
        yield Traffic()  # counters without a log of requests
        return
    with closing(WriterQueue(write_stderr)) as line_queue:
        request_log = RequestLog(line_queue.put)
        logging.basicConfig(level=logging.WARNING, handlers=[request_log], force=True)
        logging.getLogger("isocharge").handlers.clear()  # its messages also reach `request_log`
        logging.captureWarnings(True)
        traffic = Traffic(request_log)
        traffic.lost_lines.set_function(lambda: line_queue.lost)
        yield traffic


@asynccontextmanager
async def _grpc_server_and_urls(
    server: HttpServer, handler: Handler, host: str, grpc_port: int | None, tls: Tls | None
) -> AsyncIterator[None]:
    """Context manager that prints the address of the HTTP server. If a port for gRPC is given, the context manager also
    runs the gRPC server during its block, and prints the address of the gRPC server.

    Args:
        server: The HTTP server.
        handler: Handler of the HTTP server, whose models, limits and token are used by the gRPC server.
        host: Name or address on which the gRPC server listens.
        grpc_port: Port of the gRPC server; None for no gRPC server.
        tls: Certificate and key; None for no TLS.
    """
    if grpc_port is None:
        announce(server.url)
        yield
        return
    # The core of gRPC reads this variable when it is imported. It would print errors that are reported anyway.
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")
    with require("grpc"):
        from isocharge.serve.network.grpc.server import grpc_server
    async with grpc_server(handler, host, grpc_port, tls) as grpc_url:
        announce(server.url)
        announce(grpc_url)
        yield
