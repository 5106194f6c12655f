"""Checksums of frames, under the names that catalogues and manuals use.

The package `anycrc` computes the cyclic redundancy checks (CRC). If a CRC has no name in this module, a device file can
state the parameters of the CRC, which Williams defines in "A painless guide to CRC error detection algorithms" (1993).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from operator import xor

import anycrc


@dataclass(frozen=True)
class Checksum:
    """A checksum.

    Attributes:
        compute: Function that computes the checksum from the bytes that it covers.
        size: Number of bytes of the checksum in a frame; 0 if the frame has no checksum.
    """

    compute: Callable[[bytes], int]
    size: int


def crc_with_parameters(width: int, polynomial: int, start: int, reflected: bool, final: int) -> Checksum:
    """Return the cyclic redundancy check with given parameters.

    Args:
        width: Number of bits: 8, 16, 24 or 32.
        polynomial: Polynomial without its highest power. The highest bit is the coefficient of the highest power.
        start: Initial value of the register, in the bit order of the polynomial.
        reflected: Whether the bits of the bytes and of the register are processed from the lowest to the highest bit.
        final: Value with which the register is combined by an exclusive or after the last byte.
    """
    crc = anycrc.CRC(width, polynomial, start, reflected, reflected, final)
    return Checksum(crc.calc, width // 8)


def _fletcher_16(data: bytes) -> int:
    """Compute Fletcher's checksum (1982), which has two bytes.

    The low byte of the checksum is the sum of all data bytes, modulo 255. Each time a data byte was added to the low
    byte, the new low byte is added to the high byte, modulo 255.
    """
    byte_sum = 0
    sum_of_sums = 0
    for byte in data:
        byte_sum = (byte_sum + byte) % 255
        sum_of_sums = (sum_of_sums + byte_sum) % 255
    return (sum_of_sums << 8) | byte_sum


CRC_SIZES = {
    "crc-8": 1,
    "crc-8/maxim": 1,
    "crc-8/sae-j1850": 1,
    "crc-16/ccitt-false": 2,
    "crc-16/xmodem": 2,
    "crc-16/x-25": 2,
    "crc-16/kermit": 2,
    "crc-16/modbus": 2,
    "crc-16/arc": 2,
    "crc-32": 4,
    "crc-32/mpeg-2": 4,
    "crc-32/iscsi": 4,
}
"""Sizes of the cyclic redundancy checks with a name, in bytes."""

CHECKSUMS = {
    "none": Checksum(lambda _: 0, 0),
    "sum-8": Checksum(lambda data: sum(data) & 0xFF, 1),
    "sum-8/negative": Checksum(lambda data: -sum(data) & 0xFF, 1),
    "sum-8/inverted": Checksum(lambda data: ~sum(data) & 0xFF, 1),
    "xor-8": Checksum(lambda data: reduce(xor, data, 0), 1),
    "sum-16": Checksum(lambda data: sum(data) & 0xFFFF, 2),
    "fletcher-16": Checksum(_fletcher_16, 2),
    **{
        name: Checksum(anycrc.Model(name.upper().replace("-", "", 1).replace("/", "-")).calc, size)
        for name, size in CRC_SIZES.items()
    },
}
"""All checksums, by name. The package `anycrc` writes the names in another way, for example CRC16-MODBUS.

The checksum `sum-8/negative` is chosen such that the sum of all bytes, including the checksum, is zero modulo 256. The
checksum `sum-8/inverted` is the sum of the bytes with every bit inverted.
"""
