"""Checksums against the check values of Cook's catalogue (of b"123456789") and the standard library."""

import binascii
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve.frames.checksums import CHECKSUMS

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
