"""Byte stuffing against the documents that define it, and against another library."""

import pytest
from cobs import cobs
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve.frames.stuffing import STUFFINGS, cobs_decode, cobs_encode

EXAMPLES = [
    ("slip", "C0", "DB DC"),
    ("slip", "DB", "DB DD"),
    ("slip", "DB DC", "DB DD DC"),
    ("slip", "01 C0 DB 02", "01 DB DC DB DD 02"),
    ("hdlc", "7E", "7D 5E"),
    ("hdlc", "7D", "7D 5D"),
    ("hdlc", "31 7D 7E 11", "31 7D 5D 7D 5E 7D 31"),
    ("cobs", "00", "01 01"),
    ("cobs", "11 22 00 33", "03 11 22 02 33"),
]
"""From RFC 1055, RFC 1662 (4.2) and Cheshire and Baker: data, stuffed."""


@pytest.mark.parametrize(("name", "data", "stuffed"), EXAMPLES)
def test_documented_examples(name, data, stuffed):
    assert STUFFINGS[name].decode(bytes.fromhex(stuffed)) == bytes.fromhex(data)


def slip(data):
    return b"".join({0xC0: b"\xdb\xdc", 0xDB: b"\xdb\xdd"}.get(byte, bytes([byte])) for byte in data)


def hdlc(data):
    return b"".join(bytes([0x7D, byte ^ 0x20]) if byte in (0x7D, 0x7E) else bytes([byte]) for byte in data)


@settings(derandomize=True)
@given(st.binary(max_size=300))
def test_what_was_stuffed_comes_back(data):
    for name, stuff in (("slip", slip), ("hdlc", hdlc), ("cobs", cobs.encode)):
        stuffed = stuff(data)
        assert STUFFINGS[name].delimiter not in stuffed
        assert STUFFINGS[name].decode(stuffed) == data


@pytest.mark.parametrize(("name", "stuffed"), [("slip", "DB"), ("slip", "DB 01"), ("hdlc", "31 7D"), ("cobs", "05 11")])
def test_damaged_pieces(name, stuffed):
    with pytest.raises(ValueError, match=r"."):
        STUFFINGS[name].decode(bytes.fromhex(stuffed))


@settings(derandomize=True)
@given(st.one_of(st.binary(max_size=600), st.binary(min_size=240, max_size=270).map(lambda data: data * 2)))
def test_cobs_equals_the_cobs_package(data):
    assert cobs_encode(data) == cobs.encode(data)
    assert cobs_decode(cobs.encode(data)) == data


@pytest.mark.parametrize("n", [253, 254, 255, 507, 508, 509])
@pytest.mark.parametrize("tail", [b"", b"\0", b"\0x", b"x\0"])
def test_cobs_about_the_block_length(n, tail):
    data = b"x" * n + tail
    assert cobs_encode(data) == cobs.encode(data)
    assert cobs_decode(cobs_encode(data)) == data


@settings(derandomize=True)
@given(st.binary(min_size=1, max_size=300))
def test_cobs_refuses_what_the_cobs_package_refuses(data):
    try:
        expected = cobs.decode(data)
    except cobs.DecodeError:
        with pytest.raises(ValueError, match="follow"):
            cobs_decode(data)
    else:
        assert cobs_decode(data) == expected
