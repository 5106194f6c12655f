"""Checksums against the check values of Cook's catalogue (of b"123456789"), crcmod and the standard library."""

import binascii
import zlib

import pytest
from crcmod.predefined import mkPredefinedCrcFun
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve.frames.checksums import CHECKSUMS, CRCS

CATALOGUE = {
    "crc-8": 0xF4,
    "crc-8/maxim": 0xA1,
    "crc-16/ccitt-false": 0x29B1,
    "crc-16/xmodem": 0x31C3,
    "crc-16/x-25": 0x906E,
    "crc-16/modbus": 0x4B37,
    "crc-16/arc": 0xBB3D,
    "crc-32": 0xCBF43926,
    "sum-8": 0xDD,
    "sum-16": 0x01DD,
    "xor-8": 0x31,
    "sum-8/negative": 0x23,
    "sum-8/inverted": 0x22,
    "fletcher-16": 0x1EDE,
    "crc-8/sae-j1850": 0x4B,
}

CRCMOD = {
    "crc-8": "crc-8",
    "crc-8/maxim": "crc-8-maxim",
    "crc-16/arc": "crc-16",
    "crc-16/x-25": "x-25",
    "crc-16/xmodem": "xmodem",
    "crc-16/modbus": "modbus",
    "crc-16/kermit": "kermit",
    "crc-16/ccitt-false": "crc-ccitt-false",
    "crc-32": "crc-32",
    "crc-32/iscsi": "crc-32c",
    "crc-32/mpeg-2": "crc-32-mpeg",
}


@pytest.mark.parametrize(("name", "value"), CATALOGUE.items())
def test_published_check_values(name, value):
    assert CHECKSUMS[name].compute(b"123456789") == value


@settings(derandomize=True)
@given(st.binary(max_size=200))
def test_against_the_standard_library(data):
    assert CHECKSUMS["crc-16/ccitt-false"].compute(data) == binascii.crc_hqx(data, 0xFFFF)
    assert CHECKSUMS["crc-16/xmodem"].compute(data) == binascii.crc_hqx(data, 0)
    assert CHECKSUMS["crc-32"].compute(data) == zlib.crc32(data)


@pytest.mark.parametrize(("name", "other"), CRCMOD.items())
def test_against_crcmod(name, other):
    theirs = mkPredefinedCrcFun(other)
    for data in (b"", b"123456789", bytes(range(256)), b"\xff" * 31):
        assert CHECKSUMS[name].compute(data) == theirs(data)


def test_every_check_has_a_reference():
    assert set(CRCS) <= {*CATALOGUE, *CRCMOD}
