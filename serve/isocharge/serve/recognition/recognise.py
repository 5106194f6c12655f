"""What a board sends: our binary frames, lines of text, or frames of fixed length that are described."""

from collections.abc import Sequence
from typing import Any

from isocharge.serve.frames.binary import BinaryParser
from isocharge.serve.recognition.described import described_frames
from isocharge.serve.recognition.framing import FEWEST
from isocharge.serve.recognition.text_columns import text_frames

CLEAR_SHARE = 0.4
"""Share of bytes in good frames from which nothing else is looked for, dimensionless; echoes may stand between them."""


def recognise(chunks: Sequence[bytes], seconds: float, *, are_datagrams: bool = False) -> dict[str, Any] | None:
    """The section `[frames]` of a device file; None if nothing is recognised.

    Args:
        chunks: The bytes as they came.
        seconds: Time in which they came, s.
        are_datagrams: Whether each chunk is a datagram.
    """
    size = sum(map(len, chunks))
    binary = BinaryParser()
    frames = [frame for chunk in chunks for frame in binary.feed(chunk)]
    if len(frames) >= FEWEST and binary.counts.bytes_dropped < (1.0 - CLEAR_SHARE) * size:
        return {"format": "binary"}
    table, share = text_frames(chunks, seconds) or (None, 0.0)
    if share >= CLEAR_SHARE:
        return table
    return described_frames(chunks, seconds, are_datagrams=are_datagrams) or table
