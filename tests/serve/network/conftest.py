"""Fixtures with certificates for servers and clients on this machine."""

import ssl

import pytest
import trustme


@pytest.fixture(scope="session")
def authority():
    return trustme.CA()


@pytest.fixture(scope="session")
def tls_files(authority, tmp_path_factory):
    """Return a folder with a certificate for 127.0.0.1, with its key, and with both in one file."""
    folder = tmp_path_factory.mktemp("tls")
    issued = authority.issue_cert("127.0.0.1")
    issued.cert_chain_pems[0].write_to_path(folder / "cert.pem")
    issued.private_key_pem.write_to_path(folder / "key.pem")
    issued.private_key_and_cert_chain_pem.write_to_path(folder / "both.pem")
    return folder


@pytest.fixture
def trusted(authority):
    """Return the TLS context of a client that trusts the authority of the tests."""
    context = ssl.create_default_context()
    authority.configure_trust(context)
    return context
