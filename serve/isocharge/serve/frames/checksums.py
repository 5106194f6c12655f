"""Checksums of frames, by the names that catalogues and manuals use.

The parameters of a cyclic redundancy check are those of Williams's model ("A painless guide to CRC error detection
algorithms", 1993), the names and values those of Cook's catalogue. CRC-16/CCITT-FALSE is IBM-3740 there. A check that
has no name is described by its parameters.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property


@dataclass(frozen=True)
class Crc:
    """A cyclic redundancy check.

    Attributes:
        width: Bits; 8, 16, 24 or 32.
        polynomial: Without its highest bit, highest power first.
        start: Register before the first byte, highest power first.
        reflected: Whether bytes and register go lowest bit first.
        final: What the register is xored with at the end.
    """

    width: int
    polynomial: int
    start: int
    reflected: bool
    final: int

    @cached_property
    def table(self) -> tuple[int, ...]:
        """What each byte does to the register."""
        return tuple(map(self._row, range(256)))

    @cached_property
    def first(self) -> int:
        """The register before the first byte, as it is held."""
        return self._held(self.start)

    def _held(self, number: int) -> int:
        """A number as the register holds it: lowest power first if reflected."""
        return int(f"{number:0{self.width}b}"[::-1], 2) if self.reflected else number

    def _row(self, byte: int) -> int:
        register = byte if self.reflected else byte << (self.width - 8)
        polynomial = self._held(self.polynomial)
        top = 1 if self.reflected else 1 << (self.width - 1)
        for _ in range(8):
            shifted = register >> 1 if self.reflected else register << 1
            register = shifted ^ polynomial if register & top else shifted
        return register & ((1 << self.width) - 1)

    def __call__(self, data: bytes) -> int:
        """The check value of some bytes."""
        table, register, high = self.table, self.first, self.width - 8
        if self.reflected:
            for byte in data:
                register = (register >> 8) ^ table[(register ^ byte) & 0xFF]
            return register ^ self.final
        mask = (1 << self.width) - 1
        for byte in data:
            register = ((register << 8) & mask) ^ table[(register >> high) ^ byte]
        return register ^ self.final


def _xor(data: bytes) -> int:
    result = 0
    for byte in data:
        result ^= byte
    return result


def _fletcher(data: bytes, modulus: int) -> int:
    """Fletcher's checksum (1982): the sum in the low byte, the sum of the sums in the high one."""
    low = high = 0
    for byte in data:
        low = (low + byte) % modulus
        high = (high + low) % modulus
    return high << 8 | low


@dataclass(frozen=True)
class Checksum:
    """How to compute a checksum, and how many bytes it takes: 0 for a frame without one."""

    compute: Callable[[bytes], int]
    size: int


CRCS = {
    "crc-8": Crc(8, 0x07, 0x00, False, 0x00),
    "crc-8/itu": Crc(8, 0x07, 0x00, False, 0x55),
    "crc-8/rohc": Crc(8, 0x07, 0xFF, True, 0x00),
    "crc-8/maxim": Crc(8, 0x31, 0x00, True, 0x00),
    "crc-8/nrsc-5": Crc(8, 0x31, 0xFF, False, 0x00),
    "crc-8/sae-j1850": Crc(8, 0x1D, 0xFF, False, 0xFF),
    "crc-8/gsm-a": Crc(8, 0x1D, 0x00, False, 0x00),
    "crc-8/i-code": Crc(8, 0x1D, 0xFD, False, 0x00),
    "crc-8/ebu": Crc(8, 0x1D, 0xFF, True, 0x00),
    "crc-8/autosar": Crc(8, 0x2F, 0xFF, False, 0xFF),
    "crc-8/cdma2000": Crc(8, 0x9B, 0xFF, False, 0x00),
    "crc-8/wcdma": Crc(8, 0x9B, 0x00, True, 0x00),
    "crc-8/darc": Crc(8, 0x39, 0x00, True, 0x00),
    "crc-8/dvb-s2": Crc(8, 0xD5, 0x00, False, 0x00),
    "crc-16/ccitt-false": Crc(16, 0x1021, 0xFFFF, False, 0x0000),
    "crc-16/xmodem": Crc(16, 0x1021, 0x0000, False, 0x0000),
    "crc-16/x-25": Crc(16, 0x1021, 0xFFFF, True, 0xFFFF),
    "crc-16/kermit": Crc(16, 0x1021, 0x0000, True, 0x0000),
    "crc-16/mcrf4xx": Crc(16, 0x1021, 0xFFFF, True, 0x0000),
    "crc-16/genibus": Crc(16, 0x1021, 0xFFFF, False, 0xFFFF),
    "crc-16/gsm": Crc(16, 0x1021, 0x0000, False, 0xFFFF),
    "crc-16/spi-fujitsu": Crc(16, 0x1021, 0x1D0F, False, 0x0000),
    "crc-16/riello": Crc(16, 0x1021, 0xB2AA, True, 0x0000),
    "crc-16/tms37157": Crc(16, 0x1021, 0x89EC, True, 0x0000),
    "crc-16/modbus": Crc(16, 0x8005, 0xFFFF, True, 0x0000),
    "crc-16/arc": Crc(16, 0x8005, 0x0000, True, 0x0000),
    "crc-16/usb": Crc(16, 0x8005, 0xFFFF, True, 0xFFFF),
    "crc-16/maxim": Crc(16, 0x8005, 0x0000, True, 0xFFFF),
    "crc-16/umts": Crc(16, 0x8005, 0x0000, False, 0x0000),
    "crc-16/cms": Crc(16, 0x8005, 0xFFFF, False, 0x0000),
    "crc-16/dds-110": Crc(16, 0x8005, 0x800D, False, 0x0000),
    "crc-16/dnp": Crc(16, 0x3D65, 0x0000, True, 0xFFFF),
    "crc-16/en-13757": Crc(16, 0x3D65, 0x0000, False, 0xFFFF),
    "crc-16/t10-dif": Crc(16, 0x8BB7, 0x0000, False, 0x0000),
    "crc-16/teledisk": Crc(16, 0xA097, 0x0000, False, 0x0000),
    "crc-16/cdma2000": Crc(16, 0xC867, 0xFFFF, False, 0x0000),
    "crc-16/dect-x": Crc(16, 0x0589, 0x0000, False, 0x0000),
    "crc-16/dect-r": Crc(16, 0x0589, 0x0000, False, 0x0001),
    "crc-16/profibus": Crc(16, 0x1DCF, 0xFFFF, False, 0xFFFF),
    "crc-24/openpgp": Crc(24, 0x864CFB, 0xB704CE, False, 0x000000),
    "crc-32": Crc(32, 0x04C11DB7, 0xFFFFFFFF, True, 0xFFFFFFFF),
    "crc-32/bzip2": Crc(32, 0x04C11DB7, 0xFFFFFFFF, False, 0xFFFFFFFF),
    "crc-32/mpeg-2": Crc(32, 0x04C11DB7, 0xFFFFFFFF, False, 0x00000000),
    "crc-32/cksum": Crc(32, 0x04C11DB7, 0x00000000, False, 0xFFFFFFFF),
    "crc-32/jamcrc": Crc(32, 0x04C11DB7, 0xFFFFFFFF, True, 0x00000000),
    "crc-32/iscsi": Crc(32, 0x1EDC6F41, 0xFFFFFFFF, True, 0xFFFFFFFF),
    "crc-32/base91-d": Crc(32, 0xA833982B, 0xFFFFFFFF, True, 0xFFFFFFFF),
    "crc-32/aixm": Crc(32, 0x814141AB, 0x00000000, False, 0x00000000),
    "crc-32/xfer": Crc(32, 0x000000AF, 0x00000000, False, 0x00000000),
}
"""Cyclic redundancy checks by name."""

CHECKSUMS = {
    "none": Checksum(lambda _: 0, 0),
    "sum-8": Checksum(lambda data: sum(data) & 0xFF, 1),
    "sum-8/negative": Checksum(lambda data: -sum(data) & 0xFF, 1),
    "sum-8/inverted": Checksum(lambda data: ~sum(data) & 0xFF, 1),
    "xor-8": Checksum(_xor, 1),
    "xor-8/inverted": Checksum(lambda data: _xor(data) ^ 0xFF, 1),
    "sum-16": Checksum(lambda data: sum(data) & 0xFFFF, 2),
    "sum-16/negative": Checksum(lambda data: -sum(data) & 0xFFFF, 2),
    "sum-16/inverted": Checksum(lambda data: ~sum(data) & 0xFFFF, 2),
    "fletcher-16": Checksum(lambda data: _fletcher(data, 255), 2),
    "fletcher-16/256": Checksum(lambda data: _fletcher(data, 256), 2),
    **{name: Checksum(crc, crc.width // 8) for name, crc in CRCS.items()},
}
"""All checksums by name. Negative: sum and checksum add up to 0; inverted: all bits turned round."""
