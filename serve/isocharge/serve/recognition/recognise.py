"""What a board sends: our binary frames, lines of text, or frames of fixed length that are described."""

from collections.abc import Iterator, Sequence
from itertools import count, groupby
from typing import Any

import numpy as np

from isocharge.serve.frames.binary import BinaryParser
from isocharge.serve.frames.frame import SEQ, Frame, Parser
from isocharge.serve.frames.frame_layout import PADDING, SYNC, ByteOrder
from isocharge.serve.frames.text import Layout, TextParser
from isocharge.serve.frames.text_lines import Notation
from isocharge.serve.recognition.fields import Part, Weights, clock_of, parts_of, split_frame, steady_step
from isocharge.serve.recognition.framing import (
    FEWEST,
    MOST_BYTES,
    ORDERS,
    Check,
    Windows,
    find_checks,
    framings,
    usual_bytes,
)

MOST_FRAMES = 300
"""Frames that are examined."""

MOST_TURNS = 24
"""Bytes at which a frame is tried to begin, of those that may be a sync."""

LONGEST_SYNC = 6
"""Longest sync, bytes: what follows may be constant for a while only."""

WEIGHTS = Weights()


def described_frames(
    chunks: Sequence[bytes], seconds: float, *, are_datagrams: bool = False, weights: Weights = WEIGHTS
) -> dict[str, Any] | None:
    """The section `[frames]` of a device file for frames of fixed length; None if the bytes are none.

    Args:
        chunks: The bytes as they came.
        seconds: Time in which they came, s; the unit of a clock follows from it.
        are_datagrams: Whether each chunk is a datagram.
        weights: Of the score.
    """
    seconds *= min(1.0, MOST_BYTES / max(1, sum(map(len, chunks))))
    for _, group in groupby(framings(chunks, are_datagrams=are_datagrams), key=lambda windows: windows.framing):
        tables = [scored for windows in group for scored in _scored_tables(windows, seconds, weights)]
        if tables:
            return min(tables, key=lambda scored: scored[0])[1]
    return None


def _scored_tables(windows: Windows, seconds: float, weights: Weights) -> Iterator[tuple[float, dict[str, Any]]]:
    """Every description of frames: of each begin, checksum and byte order; without a checksum only if none fits.

    The score is in bits for each byte of the stream, those too that are in no frame: frames of other lengths are
    compared.
    """
    length, rows = windows.length, windows.rows()[:MOST_FRAMES]
    if len(rows) < FEWEST - 1:
        return
    usual, constant = usual_bytes(rows[:, :length])
    fixed = constant & (usual != 0)  # zeros are the high bytes of numbers
    turns = np.flatnonzero(fixed)[:MOST_TURNS].tolist() if windows.framing == SYNC else [0]
    checks = [(turn, check) for turn in turns for check in find_checks(rows[:, turn : turn + length])]
    covered = min(1.0, len(windows.starts) * length / len(windows.stream))
    for order in ORDERS:
        parts_at = parts_of(rows, order, len(windows.stream) / length / seconds, weights)
        for turn, check in checks or [(turn, Check(0, order, {})) for turn in turns]:
            turned = (parts_at[turn:] + parts_at[:turn])[: length - check.size]
            longest = int(np.argmin([*np.roll(fixed, -turn)[:LONGEST_SYNC], False]))
            syncs = range(1, longest + 1) if windows.framing == SYNC else [0]
            score, sync, parts = split_frame(turned, syncs, weights)
            if any(part.role == "channel" for part in parts):
                begin = np.roll(usual, -turn)[:sync].tobytes()
                bits = covered * score / length + (1.0 - covered) * weights.noise
                yield bits, _table(windows, begin, check, order, parts)


def _table(windows: Windows, sync: bytes, check: Check, order: ByteOrder, parts: Sequence[Part]) -> dict[str, Any]:
    table = {"sync": sync.hex(" ").upper()} if windows.framing == SYNC else {"framing": windows.framing}
    orders = {"checksum_order": check.order} if check.size > 1 and check.order != order else {}
    layout = {"length": windows.length, "byte_order": order} | check.keys | orders
    return {"format": "described"} | table | layout | {"fields": _fields(parts)}


def _fields(parts: Sequence[Part]) -> list[dict[str, Any]]:
    """The fields of a device file; a second number or clock is padding, and neighbouring paddings are one."""
    fields: list[dict[str, Any]] = []
    roles: list[str] = []
    for part in parts:
        roles.append(part.role)
        number = roles.count(part.role)
        if part.role == "channel":
            fields.append({"name": f"ch{number}", "type": part.kind})
        elif part.role != "pad" and number == 1:
            fields.append({"name": part.name, "type": part.kind} | ({"scale": part.scale} if part.scale != 1.0 else {}))
        elif fields and fields[-1]["type"] == PADDING:
            fields[-1]["count"] = fields[-1].get("count", 1) + part.size
        else:
            fields.append({"type": PADDING} | ({"count": part.size} if part.size > 1 else {}))
    return fields


CLEAR_SHARE = 0.4
"""Share of bytes in good frames from which nothing else is looked for, dimensionless; echoes may stand between them."""


def recognise(chunks: Sequence[bytes], seconds: float, *, are_datagrams: bool = False) -> dict[str, Any] | None:
    """The section `[frames]` of a device file; None if nothing is recognised.

    Args:
        chunks: The bytes as they came.
        seconds: Time in which they came, s.
        are_datagrams: Whether each chunk is a datagram.
    """
    frames, share = _read(BinaryParser(), chunks)
    if len(frames) >= FEWEST and share > CLEAR_SHARE:
        return {"format": "binary"}
    text, parser = None, TextParser()
    frames, share = _read(parser, chunks)
    frames = [frame for frame in frames if len(frame.values) == len(frames[-1].values)]
    if parser.layout is not None and len(frames) >= FEWEST:
        text = {"format": "text"} | _text_keys(parser.layout, frames, len(frames) / seconds)
        if share >= CLEAR_SHARE:
            return text
    return described_frames(chunks, seconds, are_datagrams=are_datagrams) or text


def _read(parser: Parser, chunks: Sequence[bytes]) -> tuple[list[Frame], float]:
    """The frames that a parser finds, and the share of bytes that they explain."""
    frames = [frame for chunk in chunks for frame in parser.feed(chunk)]
    return frames, 1.0 - parser.counts.bytes_dropped / max(1, sum(map(len, chunks)))


def _text_keys(layout: Layout, frames: Sequence[Frame], rate_Hz: float) -> dict[str, Any]:
    """The keys of a device file; columns without names get names, once one of them has a meaning.

    The header of a CSV is written down: who comes later will not see it.
    """
    last = frames[-1]
    meanings = _meanings(frames, rate_Hz)
    if layout.notation is Notation.csv and layout.names:
        columns = list(layout.names)
        for position, meaning in meanings.items():
            columns[layout.columns.channels[position][0]] = meaning
        return {"columns": columns}
    if last.names or not meanings:
        return {meaning: last.names[position] for position, meaning in meanings.items()}
    channels = map("ch{}".format, count(1))
    return {"columns": [meanings.get(position) or next(channels) for position in range(len(last.values))]}


@np.errstate(over="ignore", invalid="ignore")
def _meanings(frames: Sequence[Frame], rate_Hz: float) -> dict[int, str]:
    """`seq`, `t_us`, `t_ms` or `t_s` by position among the values, of columns that count frames or time."""
    meanings: dict[int, str] = {}
    has_number, has_clock = frames[-1].seq is not None, frames[-1].t_us is not None
    for position, step in enumerate(np.diff([frame.values for frame in frames], axis=0).T):
        name, scale = clock_of(step, rate_Hz) or ("", 0.0)
        if not has_number and steady_step(step) == 1.0:
            meanings[position], has_number = SEQ, True
        elif not has_clock and scale == 1.0:  # text has no scale
            meanings[position], has_clock = name, True
    return meanings
