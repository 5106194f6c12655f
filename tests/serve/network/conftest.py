"""Fixtures with certificates for servers and clients on this machine."""

from contextlib import contextmanager

import pytest
from anyio.from_thread import start_blocking_portal

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
        with (
            start_blocking_portal(backend_options={"use_uvloop": True}) as portal,
            portal.wrap_async_context_manager(grpc_server(handler, "127.0.0.1", 0, **settings)) as url,
        ):
            yield url

    return start
