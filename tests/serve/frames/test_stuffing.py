"""Byte stuffing against the documents that define it, and against another library."""

import pytest
from cobs import cobs
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve.frames.stuffing import STUFFINGS

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
