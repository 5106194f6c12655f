"""`isocharge serve http`: the models over HTTP, and over gRPC beside it if a port is given."""

import os
from contextlib import AbstractContextManager, closing, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.shared.terminal import say
from isocharge.errors import InputError
from isocharge.extras import require
from isocharge.server_defaults import BODY_BYTES, CONNECTIONS, HEADER_SECONDS, IDLE_SECONDS, MAX_BATCH

if TYPE_CHECKING:
    from isocharge.serve.network.protocol import Handler
    from isocharge.serve.network.tls import Tls
    from isocharge.serve.network.token import Token


def http_command(
    models: Annotated[
        Path | None,
        typer.Option("--models", metavar="DIR", help="Folder of models. (default: where names are looked up)"),
    ] = None,
    host: Annotated[str, typer.Option("--host", help="Name or address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="TCP port; 0 takes a free one.")] = 8000,
    uds: Annotated[
        Path | None, typer.Option("--uds", metavar="PATH", help="Unix socket instead of host and port. (default: none)")
    ] = None,
    grpc_port: Annotated[
        int | None, typer.Option("--grpc-port", min=0, max=65535, help="Serve gRPC here too. (default: no gRPC)")
    ] = None,
    token: Annotated[
        str | None,
        typer.Option(
            "--token", envvar="ISOCHARGE_TOKEN", help="What clients must send as Bearer token. (default: none)"
        ),
    ] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Let other machines in without a token. (default: no)")
    ] = False,
    tls_cert: Annotated[
        Path | None, typer.Option("--tls-cert", metavar="PEM", help="Certificate chain: serve TLS. (default: plain)")
    ] = None,
    tls_key: Annotated[
        Path | None,
        typer.Option("--tls-key", metavar="PEM", help="Its private key. (default: in the certificate's file)"),
    ] = None,
    max_batch: Annotated[int, typer.Option("--max-batch", min=1, help="Presses in one request.")] = MAX_BATCH,
    max_body_bytes: Annotated[int, typer.Option("--max-body-bytes", min=1, help="Body of a request.")] = BODY_BYTES,
    max_connections: Annotated[int, typer.Option("--max-connections", min=1, help="Open at a time.")] = CONNECTIONS,
    idle_s: Annotated[
        float, typer.Option("--idle-s", min=0.1, help="A connection may idle so long, s.")
    ] = IDLE_SECONDS,
    header_s: Annotated[
        float, typer.Option("--header-s", min=0.1, help="Headers may take so long, s.")
    ] = HEADER_SECONDS,
) -> None:
    """Serve models over HTTP: the Open Inference Protocol, version 2, as Triton and KServe speak it.

    Prints the address once it answers there; `/` is a page for people, `/openapi.json` for programs. Ctrl-C stops it
    after the requests that are under way.

    Example: isocharge serve http --port 8000
    """
    with require("http"):
        from isocharge.serve.network.http import App, HttpServer
    from isocharge.serve.network.address import Address, check_exposure
    from isocharge.serve.network.limits import ServerLimits
    from isocharge.serve.network.model_store import open_model_store
    from isocharge.serve.network.protocol import Handler
    from isocharge.serve.network.tls import Tls
    from isocharge.serve.network.token import Token

    address = Address(host, port, uds)
    check_exposure(address if grpc_port is None else Address(host), token=token is not None, insecure=insecure)
    if tls_key is not None and tls_cert is None:
        raise InputError("--tls-key: expected --tls-cert with it")
    limits = ServerLimits(
        batch=max_batch,
        body_bytes=max_body_bytes,
        connections=max_connections,
        idle_seconds=idle_s,
        header_seconds=header_s,
    )
    secret = None if token is None else Token(token)
    tls = None if tls_cert is None else Tls(tls_cert, tls_key)
    store = open_model_store(models)
    for reason in store.refusals():
        say(f"refused: {reason}")
    handler = Handler(store, limits)
    server = HttpServer(App(handler, secret), address, limits=limits, tls=tls)
    with suppress(KeyboardInterrupt), closing(server), _grpc(handler, host, grpc_port, secret, tls) as grpc_url:
        say("serving " + ", ".join(served.metadata.label for served in store.all()) + "; Ctrl-C stops")
        for url in filter(None, (server.url, grpc_url)):
            print(url, flush=True)
        server.run()


def _grpc(
    handler: "Handler", host: str, port: int | None, token: "Token | None", tls: "Tls | None"
) -> AbstractContextManager[str]:
    """The gRPC server beside the other one; its address."""
    if port is None:
        return nullcontext("")
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")  # its core would say in its own way what our errors say
    with require("grpc"):
        from isocharge.serve.network.grpc import grpc_server
    return grpc_server(handler, host, port, token, tls)
