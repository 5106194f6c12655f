"""What a board sends: our binary frames, lines of text, or frames of fixed length that are described."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from isocharge.serve.frames.binary import BinaryParser
from isocharge.serve.frames.frame import SEQ, Frame
from isocharge.serve.frames.text import Layout, TextParser
from isocharge.serve.frames.text_lines import Notation
from isocharge.serve.recognition.described import described_frames
from isocharge.serve.recognition.framing import FEWEST
from isocharge.serve.recognition.series import clock_of, is_counter

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
    table, share = _text_frames(chunks, seconds)
    if share >= CLEAR_SHARE:
        return table
    return described_frames(chunks, seconds, are_datagrams=are_datagrams) or table


def _text_frames(chunks: Sequence[bytes], seconds: float) -> tuple[dict[str, Any] | None, float]:
    """The section for lines of text, None if the bytes are none, and the share of bytes that it explains."""
    parser = TextParser()
    frames = [frame for chunk in chunks for frame in parser.feed(chunk)]
    frames = [frame for frame in frames if len(frame.values) == len(frames[-1].values)]
    if parser.layout is None or len(frames) < FEWEST:
        return None, 0.0
    share = 1.0 - parser.counts.bytes_dropped / max(1, sum(map(len, chunks)))
    names = _names_of_meanings(frames, len(frames) / seconds)
    return {"format": "text"} | _text_keys(parser.layout, frames[-1], names), share


def _names_of_meanings(frames: Sequence[Frame], rate_Hz: float) -> dict[int, str]:
    """`seq`, `t_us`, `t_ms` or `t_s` by position among the values, of columns that count frames or time."""
    with np.errstate(over="ignore", invalid="ignore"):
        step = np.diff(np.array([frame.values for frame in frames]), axis=0)
    names: dict[int, str] = {}
    has_clock, has_number = frames[-1].t_us is not None, frames[-1].seq is not None
    for position, column in enumerate(step.T):
        if not np.isfinite(column).all():
            continue
        clock = None if has_clock else clock_of(column, rate_Hz)
        is_clock = clock is not None and clock[1] == 1.0  # text has no scale
        if not has_number and is_counter(column) and not (is_clock and SEQ in names.values()):
            names[position], has_number = SEQ, True
        elif clock is not None and is_clock:
            names[position], has_clock = clock[0], True
    return names


def _text_keys(layout: Layout, frame: Frame, names: dict[int, str]) -> dict[str, Any]:
    """The keys of a device file; columns without names get names, once one of them has a meaning.

    The header of a CSV is written down: who comes later will not see it.
    """
    if layout.notation is Notation.csv and layout.names:
        columns = list(layout.names)
        for position, name in names.items():
            columns[layout.columns.channels[position][0]] = name
        return {"columns": columns}
    if frame.names:
        return {name: frame.names[position] for position, name in names.items()}
    if not names:
        return {}
    channels = iter(f"ch{number}" for number in range(1, len(frame.values) + 1))
    return {"columns": [names.get(position) or next(channels) for position in range(len(frame.values))]}
