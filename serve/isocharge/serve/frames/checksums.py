"""Checksums of frames. The checksums have the names that catalogues and manuals use.

A cyclic redundancy check (CRC) has the parameters of Williams's model ("A painless guide to CRC error detection
algorithms", 1993). Names and values are those of Cook's catalogue of parametrised CRC algorithms, where
CRC-16/CCITT-FALSE is called CRC-16/IBM-3740. A device file describes a check without a name by its parameters.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import xor


@dataclass(frozen=True)
class Crc:
    """A cyclic redundancy check.

    Attributes:
        width: Number of bits: 8, 16, 24 or 32.
        polynomial: Polynomial without its highest power. The highest bit is the coefficient of the highest power.
        start: Initial value of the register, in the bit order of the polynomial.
        reflected: Whether bytes and register are processed from the lowest bit.
        final: Value that is combined with the register by an exclusive or at the end.
    """

    width: int
    polynomial: int
    start: int
    reflected: bool
    final: int

    @cached_property
    def table(self) -> tuple[int, ...]:
        """Value of the register after each of the 256 possible bytes, if the register was zero before."""
        return tuple(map(self._table_entry, range(256)))

    @cached_property
    def initial_register(self) -> int:
        """Initial value of the register, in the bit order of the register."""
        return self._in_register_order(self.start)

    def _in_register_order(self, number: int) -> int:
        """Convert a number to the bit order of the register, which is reversed if the check is reflected."""
        if not self.reflected:
            return number
        bits = f"{number:0{self.width}b}"
        return int(bits[::-1], 2)

    def _table_entry(self, byte: int) -> int:
        """Return the value of the register after one byte, if the register was zero before.

        The register is shifted by one bit at a time. If the bit that leaves the register is 1, the polynomial is
        subtracted, which is an exclusive or.
        """
        polynomial = self._in_register_order(self.polynomial)
        if self.reflected:  # the byte enters at the low end of the register, and its lowest bit leaves first
            register = byte
            for _ in range(8):
                leaving_bit = register & 1
                register >>= 1
                if leaving_bit:
                    register ^= polynomial
            return register

        # The byte enters at the high end of the register, and its highest bit leaves first.
        highest_bit = 1 << (self.width - 1)
        register = byte << (self.width - 8)
        for _ in range(8):
            leaving_bit = register & highest_bit
            register <<= 1
            if leaving_bit:
                register ^= polynomial
        register_mask = (1 << self.width) - 1
        return register & register_mask

    def __call__(self, data: bytes) -> int:
        """Compute the check value of some bytes.

        For each byte, the register is shifted by 8 bits. The 8 bits that leave the register are combined with the byte
        by an exclusive or. The result is an index of the table, whose entry is combined with the register in the same
        way.
        """
        table = self.table
        register = self.initial_register
        if self.reflected:  # the lowest bit leaves the register first
            for byte in data:
                register = (register >> 8) ^ table[(register ^ byte) & 0xFF]
            return register ^ self.final

        # The highest bits leave the register first.
        shift = self.width - 8
        mask = (1 << self.width) - 1
        for byte in data:
            register = ((register << 8) & mask) ^ table[(register >> shift) ^ byte]
        return register ^ self.final


def _fletcher_16(data: bytes) -> int:
    """Compute Fletcher's checksum (1982).

    The low byte of the checksum is the sum of the bytes, and the high byte is the sum of all intermediate sums, both
    modulo 255.
    """
    byte_sum = 0
    sum_of_sums = 0
    for byte in data:
        byte_sum = (byte_sum + byte) % 255
        sum_of_sums = (sum_of_sums + byte_sum) % 255
    return sum_of_sums << 8 | byte_sum


@dataclass(frozen=True)
class Checksum:
    """A checksum.

    Attributes:
        compute: Function from the covered bytes to the checksum.
        size: Number of bytes that the checksum takes in a frame; 0 for a frame without one.
    """

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
"""Cyclic redundancy checks, by name."""

CHECKSUMS = {
    "none": Checksum(lambda _: 0, 0),
    "sum-8": Checksum(lambda data: sum(data) & 0xFF, 1),
    "sum-8/negative": Checksum(lambda data: -sum(data) & 0xFF, 1),
    "sum-8/inverted": Checksum(lambda data: ~sum(data) & 0xFF, 1),
    "xor-8": Checksum(lambda data: reduce(xor, data, 0), 1),
    "sum-16": Checksum(lambda data: sum(data) & 0xFFFF, 2),
    "fletcher-16": Checksum(_fletcher_16, 2),
    **{name: Checksum(crc, crc.width // 8) for name, crc in CRCS.items()},
}
"""All checksums, by name.

The checksum `sum-8/negative` makes the sum of all bytes zero. The checksum `sum-8/inverted` is the sum with every bit
inverted.
"""
