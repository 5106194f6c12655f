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
    "xor-8/inverted": 0xCE,
    "sum-16/negative": 0xFE23,
    "sum-16/inverted": 0xFE22,
    "fletcher-16": 0x1EDE,
    "fletcher-16/256": 0x15DD,
    "crc-8/nrsc-5": 0xF7,
    "crc-8/sae-j1850": 0x4B,
    "crc-8/gsm-a": 0x37,
    "crc-8/autosar": 0xDF,
    "crc-8/cdma2000": 0xDA,
    "crc-8/dvb-s2": 0xBC,
    "crc-8/ebu": 0x97,
    "crc-16/gsm": 0xCE3C,
    "crc-16/tms37157": 0x26B1,
    "crc-16/cms": 0xAEE7,
    "crc-16/cdma2000": 0x4C06,
    "crc-16/dect-x": 0x007F,
    "crc-16/profibus": 0xA819,
}

CRCMOD = {
    "crc-8": "crc-8",
    "crc-8/darc": "crc-8-darc",
    "crc-8/i-code": "crc-8-i-code",
    "crc-8/itu": "crc-8-itu",
    "crc-8/maxim": "crc-8-maxim",
    "crc-8/rohc": "crc-8-rohc",
    "crc-8/wcdma": "crc-8-wcdma",
    "crc-16/arc": "crc-16",
    "crc-16/umts": "crc-16-buypass",
    "crc-16/dds-110": "crc-16-dds-110",
    "crc-16/dect-r": "crc-16-dect",
    "crc-16/dnp": "crc-16-dnp",
    "crc-16/en-13757": "crc-16-en-13757",
    "crc-16/genibus": "crc-16-genibus",
    "crc-16/maxim": "crc-16-maxim",
    "crc-16/mcrf4xx": "crc-16-mcrf4xx",
    "crc-16/riello": "crc-16-riello",
    "crc-16/t10-dif": "crc-16-t10-dif",
    "crc-16/teledisk": "crc-16-teledisk",
    "crc-16/usb": "crc-16-usb",
    "crc-16/x-25": "x-25",
    "crc-16/xmodem": "xmodem",
    "crc-16/modbus": "modbus",
    "crc-16/kermit": "kermit",
    "crc-16/ccitt-false": "crc-ccitt-false",
    "crc-16/spi-fujitsu": "crc-aug-ccitt",
    "crc-24/openpgp": "crc-24",
    "crc-32": "crc-32",
    "crc-32/bzip2": "crc-32-bzip2",
    "crc-32/iscsi": "crc-32c",
    "crc-32/base91-d": "crc-32d",
    "crc-32/mpeg-2": "crc-32-mpeg",
    "crc-32/cksum": "posix",
    "crc-32/aixm": "crc-32q",
    "crc-32/jamcrc": "jamcrc",
    "crc-32/xfer": "xfer",
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
