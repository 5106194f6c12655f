"""Checksums of frames, by the names that catalogues and manuals use.

The parameters of a cyclic redundancy check are those of Williams's model ("A painless guide to CRC error detection
algorithms", 1993), the names and values those of Cook's catalogue. CRC-16/CCITT-FALSE is IBM-3740 there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property


@dataclass(frozen=True)
class Crc:
    """A cyclic redundancy check.

    Attributes:
        width: Bits; 8, 16 or 32.
        polynomial: Without its highest bit, highest power first.
        start: Register before the first byte.
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

    def _row(self, byte: int) -> int:
        register = byte if self.reflected else byte << (self.width - 8)
        polynomial = int(f"{self.polynomial:0{self.width}b}"[::-1], 2) if self.reflected else self.polynomial
        top = 1 if self.reflected else 1 << (self.width - 1)
        for _ in range(8):
            shifted = register >> 1 if self.reflected else register << 1
            register = shifted ^ polynomial if register & top else shifted
        return register & ((1 << self.width) - 1)

    def __call__(self, data: bytes) -> int:
        """The check value of some bytes."""
        table, register, high = self.table, self.start, self.width - 8
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


@dataclass(frozen=True)
class Checksum:
    """How to compute a checksum, and how many bytes it takes: 0 for a frame without one."""

    compute: Callable[[bytes], int]
    size: int


CHECKSUMS = {
    "none": Checksum(lambda _: 0, 0),
    "sum-8": Checksum(lambda data: sum(data) & 0xFF, 1),
    "xor-8": Checksum(_xor, 1),
    "sum-16": Checksum(lambda data: sum(data) & 0xFFFF, 2),
    "crc-8": Checksum(Crc(8, 0x07, 0x00, False, 0x00), 1),
    "crc-8/maxim": Checksum(Crc(8, 0x31, 0x00, True, 0x00), 1),
    "crc-16/ccitt-false": Checksum(Crc(16, 0x1021, 0xFFFF, False, 0x0000), 2),
    "crc-16/xmodem": Checksum(Crc(16, 0x1021, 0x0000, False, 0x0000), 2),
    "crc-16/x-25": Checksum(Crc(16, 0x1021, 0xFFFF, True, 0xFFFF), 2),
    "crc-16/modbus": Checksum(Crc(16, 0x8005, 0xFFFF, True, 0x0000), 2),
    "crc-16/arc": Checksum(Crc(16, 0x8005, 0x0000, True, 0x0000), 2),
    "crc-32": Checksum(Crc(32, 0x04C11DB7, 0xFFFFFFFF, True, 0xFFFFFFFF), 4),
}
