"""Consistent Overhead Byte Stuffing (Cheshire and Baker 1999): bytes without a zero, so that a zero can end a frame.

Each zero is replaced by the distance to the next one; the first byte is the distance to the first. A distance of 255
means 254 bytes without a zero after them.
"""

LONGEST_BLOCK = 254


def cobs_encode(data: bytes) -> bytes:
    """Bytes without zeros, longer than `data` by 1 + len(data) // 254 at most."""
    *blocks, last = data.split(b"\0")
    return b"".join(_stuff(block, ends_in_zero=True) for block in blocks) + _stuff(last, ends_in_zero=False)


def _stuff(block: bytes, *, ends_in_zero: bool) -> bytes:
    stuffed = bytearray()
    while len(block) > LONGEST_BLOCK or (len(block) == LONGEST_BLOCK and ends_in_zero):
        stuffed.append(LONGEST_BLOCK + 1)
        stuffed += block[:LONGEST_BLOCK]
        block = block[LONGEST_BLOCK:]
    stuffed.append(len(block) + 1)
    return bytes(stuffed + block)


def cobs_decode(data: bytes) -> bytes:
    """The bytes that `cobs_encode` was given.

    Raises:
        ValueError: If a distance points beyond the end, or there is a zero in `data`.
    """
    decoded, at = bytearray(), 0
    while at < len(data):
        code = data[at]
        block = data[at + 1 : at + code]
        if len(block) != code - 1 or 0 in block:
            raise ValueError(f"byte {at} is {code}, but {len(data) - at - 1} bytes or a zero follow")
        decoded += block
        at += code
        if code <= LONGEST_BLOCK and at < len(data):
            decoded.append(0)
    return bytes(decoded)
