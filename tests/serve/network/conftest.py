"""Fixtures with certificates for servers and clients on this machine."""

import asyncio
from contextlib import contextmanager
from threading import Thread

import pytest
import uvloop

from isocharge.serve.network.grpc.server import grpc_server


@pytest.fixture(scope="session")
def tls_files(authority, tmp_path_factory):
    """Return a folder with a certificate for 127.0.0.1, with its key, and with both in one file."""
    folder = tmp_path_factory.mktemp("tls")
    issued = authority.issue_cert("127.0.0.1")
    issued.cert_chain_pems[0].write_to_path(folder / "cert.pem")
    issued.private_key_pem.write_to_path(folder / "key.pem")
    issued.private_key_and_cert_chain_pem.write_to_path(folder / "both.pem")
    return folder


@pytest.fixture(scope="session")
def start_grpc():
    """Return a context manager that runs the gRPC server of a handler in the event loop of another thread."""

    @contextmanager
    def start(handler, **settings):
        loop = uvloop.new_event_loop()
        thread = Thread(target=loop.run_forever)
        thread.start()
        server = grpc_server(handler, "127.0.0.1", 0, **settings)
        try:
            url = asyncio.run_coroutine_threadsafe(server.__aenter__(), loop).result()
            try:
                yield url
            finally:
                asyncio.run_coroutine_threadsafe(server.__aexit__(None, None, None), loop).result()
        finally:
            asyncio.run_coroutine_threadsafe(loop.shutdown_default_executor(), loop).result()
            loop.call_soon_threadsafe(loop.stop)
            thread.join()
            loop.close()

    return start
