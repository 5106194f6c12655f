"""Checksums of frames, under the names that catalogues and manuals use.

The package `anycrc` computes the cyclic redundancy checks (CRC), which have the names of the catalogue of parametrised
CRC algorithms (Cook, https://reveng.sourceforge.io/crc-catalogue/).
"""

import re
from collections.abc import Callable, Iterator
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


SUMS = {
    "none": Checksum(lambda _: 0, 0),
    "sum-8": Checksum(lambda data: sum(data) & 0xFF, 1),
    "sum-8/negative": Checksum(lambda data: -sum(data) & 0xFF, 1),
    "sum-8/inverted": Checksum(lambda data: ~sum(data) & 0xFF, 1),
    "xor-8": Checksum(lambda data: reduce(xor, data, 0), 1),
    "sum-16": Checksum(lambda data: sum(data) & 0xFFFF, 2),
    "fletcher-16": Checksum(_fletcher_16, 2),
}
"""Checksums that are no CRC, by name.

The checksum `sum-8/negative` is chosen such that the sum of all bytes, including the checksum, is zero modulo 256. The
checksum `sum-8/inverted` is the sum of the bytes with every bit inverted.
"""


def _crcs() -> Iterator[tuple[str, Checksum]]:
    """Yield each CRC of one to four bytes by its names, such as `crc-16/modbus` for the `CRC16-MODBUS` of `anycrc`."""
    for name in (*anycrc.models, *anycrc.aliases):
        match = re.fullmatch(r"CRC(8|16|24|32)(?:-(.+))?", name)
        if match is not None:
            suffix = f"/{match[2].lower()}" if match[2] else ""
            yield f"crc-{match[1]}{suffix}", Checksum(anycrc.Model(name).calc, int(match[1]) // 8)


CHECKSUMS = {**SUMS, **dict(_crcs())}
"""All checksums, by name."""
