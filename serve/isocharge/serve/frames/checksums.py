"""Checksums of frames, by the names that catalogues and manuals use.

The parameters of a cyclic redundancy check are those of Williams's model ("A painless guide to CRC error detection
algorithms", 1993), the names and values those of Cook's catalogue. CRC-16/CCITT-FALSE is IBM-3740 there. A check that
has no name is described by its parameters.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import xor


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


def _fletcher(data: bytes) -> int:
    """Fletcher's checksum (1982): the sum in the low byte, the sum of the sums in the high one, both modulo 255."""
    low = high = 0
    for byte in data:
        low = (low + byte) % 255
        high = (high + low) % 255
    return high << 8 | low


@dataclass(frozen=True)
class Checksum:
    """How to compute a checksum, and how many bytes it takes: 0 for a frame without one."""

    compute: Callable[[bytes], int]
    size: int


CRCS = {
    "crc-8": Crc(8, 0x07, 0x00, False, 0x00),
    "crc-8/maxim": Crc(8, 0x31, 0x00, True, 0x00),
    "crc-8/sae-j1850": Crc(8, 0x1D, 0xFF, False, 0xFF),
    "crc-16/ccitt-false": Crc(16, 0x1021, 0xFFFF, False, 0x0000),
    "crc-16/xmodem": Crc(16, 0x1021, 0x0000, False, 0x0000),
    "crc-16/x-25": Crc(16, 0x1021, 0xFFFF, True, 0xFFFF),
    "crc-16/kermit": Crc(16, 0x1021, 0x0000, True, 0x0000),
    "crc-16/modbus": Crc(16, 0x8005, 0xFFFF, True, 0x0000),
    "crc-16/arc": Crc(16, 0x8005, 0x0000, True, 0x0000),
    "crc-32": Crc(32, 0x04C11DB7, 0xFFFFFFFF, True, 0xFFFFFFFF),
    "crc-32/mpeg-2": Crc(32, 0x04C11DB7, 0xFFFFFFFF, False, 0x00000000),
    "crc-32/iscsi": Crc(32, 0x1EDC6F41, 0xFFFFFFFF, True, 0xFFFFFFFF),
}
"""Cyclic redundancy checks by name."""

CHECKSUMS = {
    "none": Checksum(lambda _: 0, 0),
    "sum-8": Checksum(lambda data: sum(data) & 0xFF, 1),
    "sum-8/negative": Checksum(lambda data: -sum(data) & 0xFF, 1),
    "sum-8/inverted": Checksum(lambda data: ~sum(data) & 0xFF, 1),
    "xor-8": Checksum(lambda data: reduce(xor, data, 0), 1),
    "sum-16": Checksum(lambda data: sum(data) & 0xFFFF, 2),
    "fletcher-16": Checksum(_fletcher, 2),
    **{name: Checksum(crc, crc.width // 8) for name, crc in CRCS.items()},
}
"""All checksums by name. Negative: sum and checksum add up to 0; inverted: all bits turned round."""
