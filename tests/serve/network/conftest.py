"""Certificates for servers and clients on this machine."""

import ssl

import pytest
import trustme


@pytest.fixture(scope="session")
def authority():
    return trustme.CA()


@pytest.fixture(scope="session")
def tls_files(authority, tmp_path_factory):
    """A folder with a certificate for 127.0.0.1, its key, and both in one file."""
    folder, issued = tmp_path_factory.mktemp("tls"), authority.issue_cert("127.0.0.1")
    issued.cert_chain_pems[0].write_to_path(folder / "cert.pem")
    issued.private_key_pem.write_to_path(folder / "key.pem")
    issued.private_key_and_cert_chain_pem.write_to_path(folder / "both.pem")
    return folder


@pytest.fixture
def trusted(authority):
    """The TLS of a client that trusts our authority."""
    context = ssl.create_default_context()
    authority.configure_trust(context)
    return context
