"""Byte stuffing and checksums of frames, under the names that catalogues and manuals use.

Byte stuffing ensures that the delimiter between frames never occurs inside a frame.

- COBS (Consistent Overhead Byte Stuffing, Cheshire and Baker 1999) ends each frame with a zero byte. The package `cobs`
  replaces each zero byte in the data by the distance to the next zero byte.
- SLIP (RFC 1055) and the asynchronous framing of HDLC (RFC 1662) separate frames by a reserved byte. If the reserved
  byte occurs in the data, two other bytes are sent in its place.

The package `anycrc` computes the cyclic redundancy checks (CRC). Their names are those in the catalogue of parametrised
CRC algorithms (Cook, https://reveng.sourceforge.io/crc-catalogue/).
"""

import re
from collections.abc import Callable, Iterator
from functools import reduce
from operator import xor
from typing import Literal, NamedTuple

import anycrc
from cobs import cobs


class Stuffing(NamedTuple):
    """A kind of byte stuffing.

    Attributes:
        delimiter: The byte between frames.
        decode: Function that converts the bytes between two delimiters to the bytes of the frame. It raises ValueError
            or `cobs.DecodeError` for bytes that no encoder produces.
    """

    delimiter: bytes
    decode: Callable[[bytes], bytes]


def _slip_decode(stuffed: bytes) -> bytes:
    """Remove the byte stuffing of SLIP, which sends the byte C0 as DB DC and the byte DB as DB DD.

    Raises:
        ValueError: If the byte DB is not followed by DC or DD.
    """
    escape_count = stuffed.count(b"\xdb")
    valid_count = stuffed.count(b"\xdb\xdc") + stuffed.count(b"\xdb\xdd")
    if escape_count != valid_count:
        raise ValueError("expected DC or DD after the byte DB")
    # The sequence DB DD is replaced last, because a DB that results from it may stand before a byte DC of the data.
    return stuffed.replace(b"\xdb\xdc", b"\xc0").replace(b"\xdb\xdd", b"\xdb")


def _hdlc_decode(stuffed: bytes) -> bytes:
    """Remove the byte stuffing of HDLC.

    The encoder has inverted the bit 0x20 of every byte that follows a byte 7D. The decoder therefore drops the byte 7D,
    and inverts the bit 0x20 of the following byte again.

    Raises:
        ValueError: If the byte 7D is not followed by another byte.
    """
    first_part, *parts_after_7d = stuffed.split(b"\x7d")
    decoded = bytearray(first_part)
    for part in parts_after_7d:
        if not part:
            raise ValueError("expected a byte after 7D")
        decoded.append(part[0] ^ 0x20)
        decoded += part[1:]
    return bytes(decoded)


STUFFINGS: dict[Literal["cobs", "slip", "hdlc"], Stuffing] = {
    "cobs": Stuffing(b"\x00", cobs.decode),
    "slip": Stuffing(b"\xc0", _slip_decode),
    "hdlc": Stuffing(b"\x7e", _hdlc_decode),
}
"""Every kind of byte stuffing, by its name in a device file."""


class Checksum(NamedTuple):
    """A checksum.

    Attributes:
        compute: Function that computes the checksum from the bytes that it covers.
        size: Number of bytes of the checksum in a frame; 0 if the frame has no checksum.
    """

    compute: Callable[[bytes], int]
    size: int


def _fletcher_16(data: bytes) -> int:
    """Compute Fletcher's checksum (1982), which has two bytes.

    The low byte of the checksum is the sum of all data bytes, modulo 255. After each data byte, the new low byte is
    added to the high byte, modulo 255.
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
    """Yield each CRC of one to four bytes under each of its names, such as `crc-16/modbus` for `CRC16-MODBUS`."""
    for name in (*anycrc.models, *anycrc.aliases):
        match = re.fullmatch(r"CRC(8|16|24|32)(?:-(.+))?", name)  # groups: number of bits, and suffix
        if match is not None:
            suffix = f"/{match[2].lower()}" if match[2] else ""
            yield f"crc-{match[1]}{suffix}", Checksum(anycrc.Model(name).calc, int(match[1]) // 8)


CHECKSUMS = {**SUMS, **dict(_crcs())}
"""All checksums, by name."""
