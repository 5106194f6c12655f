"""Checksums against crcmod, the standard library and the check values of Cook's catalogue (of b"123456789")."""

import binascii
import zlib

import pytest
from crcmod.predefined import mkPredefinedCrcFun

from isocharge.serve.frames.checksums import CHECKSUMS

CATALOGUE = {
    "none": 0,
    "crc-8/sae-j1850": 0x4B,
    "sum-8": 0xDD,
    "sum-16": 0x01DD,
    "xor-8": 0x31,
    "sum-8/negative": 0x23,
    "sum-8/inverted": 0x22,
    "fletcher-16": 0x1EDE,
}

OTHERS = {
    "crc-8": mkPredefinedCrcFun("crc-8"),
    "crc-8/maxim": mkPredefinedCrcFun("crc-8-maxim"),
    "crc-16/arc": mkPredefinedCrcFun("crc-16"),
    "crc-16/x-25": mkPredefinedCrcFun("x-25"),
    "crc-16/xmodem": lambda data: binascii.crc_hqx(data, 0),
    "crc-16/modbus": mkPredefinedCrcFun("modbus"),
    "crc-16/kermit": mkPredefinedCrcFun("kermit"),
    "crc-16/ccitt-false": lambda data: binascii.crc_hqx(data, 0xFFFF),
    "crc-32": zlib.crc32,
    "crc-32/iscsi": mkPredefinedCrcFun("crc-32c"),
    "crc-32/mpeg-2": mkPredefinedCrcFun("crc-32-mpeg"),
}


@pytest.mark.parametrize("name", CHECKSUMS)
def test_every_checksum_is_that_of_its_name(name):
    compute = CHECKSUMS[name].compute
    if name in CATALOGUE:
        assert compute(b"123456789") == CATALOGUE[name]
    else:
        for data in (b"", b"123456789", bytes(range(256)), b"\xff" * 31):
            assert compute(data) == OTHERS[name](data)
