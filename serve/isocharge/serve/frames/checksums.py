"""Checksums of frames, under the names that catalogues and manuals use.

A cyclic redundancy check (CRC) is described by the parameters that Williams defines in "A painless guide to CRC error
detection algorithms" (1993). Names and parameters are taken from Cook's catalogue of parametrised CRC algorithms. The
catalogue also lists alternative names, for example CRC-16/IBM-3740 for CRC-16/CCITT-FALSE. If a CRC has no name in this
module, a device file can state the parameters of the CRC.
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
        reflected: Whether the bits of the bytes and of the register are processed from the lowest to the highest bit.
        final: Value with which the register is combined by an exclusive or after the last byte.
    """

    width: int
    polynomial: int
    start: int
    reflected: bool
    final: int

    @cached_property
    def table(self) -> tuple[int, ...]:
        """Lookup table with one entry for each of the 256 possible values of a byte.

        The entry for a byte is the register value that results if the byte is processed with a register of zero.
        """
        return tuple(map(self._table_entry, range(256)))

    @cached_property
    def initial_register(self) -> int:
        """Initial value of the register, which is `start`, with its bits reversed if the check is reflected."""
        return self._in_register_order(self.start)

    def _in_register_order(self, number: int) -> int:
        """Reverse the bits of a number if the check is reflected. Otherwise, return the number unchanged.

        A reflected check processes the lowest bit of each byte first, and its register has the reverse bit order.
        """
        if not self.reflected:
            return number
        bits = f"{number:0{self.width}b}"
        return int(bits[::-1], 2)

    def _table_entry(self, byte: int) -> int:
        """Compute the register value that results if one byte is processed with a register of zero.

        The register has `width` bits, and contains the remainder of a division by the polynomial. For each bit of the
        byte, the register is shifted by one bit. If the bit that leaves the register is 1, the polynomial is subtracted
        from the register. The subtraction is an exclusive or, because all coefficients are computed modulo 2.
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
        register_mask = (1 << self.width) - 1  # removes the bits that have left the register
        return register & register_mask

    def __call__(self, data: bytes) -> int:
        """Compute the check value of a sequence of bytes.

        For each byte, the register is shifted by 8 bits. The exclusive or of the byte and the 8 bits that leave the
        register is the index of an entry in `table`. The exclusive or of this entry and the shifted register is the new
        value of the register. After the last byte, the check value is the exclusive or of the register and the value
        `final`.
        """
        table = self.table
        register = self.initial_register
        if self.reflected:  # the lowest bit leaves the register first
            for byte in data:
                index = (register ^ byte) & 0xFF
                register = (register >> 8) ^ table[index]
            return register ^ self.final

        # The highest bits leave the register first.
        highest_byte_shift = self.width - 8
        register_mask = (1 << self.width) - 1  # removes the bits that have left the register
        for byte in data:
            index = (register >> highest_byte_shift) ^ byte
            register = ((register << 8) & register_mask) ^ table[index]
        return register ^ self.final


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


@dataclass(frozen=True)
class Checksum:
    """A checksum.

    Attributes:
        compute: Function that computes the checksum from the bytes that it covers.
        size: Number of bytes of the checksum in a frame; 0 if the frame has no checksum.
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

The checksum `sum-8/negative` is chosen such that the sum of all bytes, including the checksum, is zero modulo 256. The
checksum `sum-8/inverted` is the sum of the bytes with every bit inverted.
"""
