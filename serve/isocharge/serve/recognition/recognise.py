"""Recognition of the format of a board: the binary frames of isocharge, lines of text, or frames of fixed length."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from isocharge.common.arrays import Booleans
from isocharge.serve.frames.binary import BinaryParser
from isocharge.serve.frames.frame import SEQ, Frame, Parser
from isocharge.serve.frames.frame_field import PADDING, ByteOrder
from isocharge.serve.frames.frame_layout import SYNC
from isocharge.serve.frames.text import Layout, TextParser
from isocharge.serve.frames.text_lines import Notation
from isocharge.serve.recognition.fields import Part, Weights, clock_of, parts_of, split_frame, steady_step
from isocharge.serve.recognition.framing import (
    MAX_EXAMINED_BYTES,
    MIN_FRAMES,
    ORDERS,
    Check,
    Windows,
    find_checks,
    framings,
    usual_bytes,
)

MAX_EXAMINED_FRAMES = 300
"""Largest number of frames that are examined."""

MAX_FRAME_STARTS = 24
"""Number of constant bytes that are tried as the first byte of a frame."""

MAX_SYNC_BYTES = 6
"""Longest sync pattern, bytes. Further constant bytes may be constant by chance."""

WEIGHTS = Weights()
"""Weights that were fitted on random boards."""


def described_frames(
    chunks: Sequence[bytes], seconds: float, *, are_datagrams: bool = False, weights: Weights = WEIGHTS
) -> dict[str, Any] | None:
    """Return the section `[frames]` of a device file for frames of fixed length; None if there are no such frames.

    Args:
        chunks: The bytes as they arrived.
        seconds: Time in which they arrived, s, from which the unit of a clock follows.
        are_datagrams: Whether each chunk is a datagram.
        weights: Contributions to the score.
    """
    byte_count = sum(map(len, chunks))
    examined_share = min(1.0, MAX_EXAMINED_BYTES / max(1, byte_count))
    examined_seconds = seconds * examined_share
    all_windows = framings(chunks, are_datagrams=are_datagrams)
    for _, windows_of_framing in groupby(all_windows, key=lambda windows: windows.framing):
        scored_tables: list[tuple[float, dict[str, Any]]] = []
        for windows in windows_of_framing:
            scored_tables += _scored_tables(windows, examined_seconds, weights)
        if scored_tables:
            _, best_table = min(scored_tables, key=lambda score_and_table: score_and_table[0])
            return best_table
    return None


def _sync_lengths(may_be_sync: Booleans, start: int) -> Sequence[int]:
    """Return the possible lengths of the sync of a frame, bytes.

    Args:
        may_be_sync: Whether each byte may belong to a sync, shape (length,).
        start: Position of the first byte of the frame.
    """
    may_be_sync_from_start = np.roll(may_be_sync, -start)[:MAX_SYNC_BYTES]
    longest_sync = int(np.argmin([*may_be_sync_from_start, False]))  # the position of the first False
    return range(1, longest_sync + 1)


def _scored_tables(windows: Windows, seconds: float, weights: Weights) -> Iterator[tuple[float, dict[str, Any]]]:
    """Yield the possible descriptions of the frames with their scores.

    For each first byte of the frames, each checksum and each byte order, at most one description is yielded.
    Descriptions without a checksum are tried only if no checksum fits. The score is in bits for each byte of the
    stream, including the bytes outside of all frames, so that frames of different lengths can be compared.

    Args:
        windows: Frames of one length in the stream.
        seconds: Time in which the stream arrived, s.
        weights: Contributions to the score.
    """
    length = windows.length
    rows = windows.rows()[:MAX_EXAMINED_FRAMES]
    if len(rows) < MIN_FRAMES - 1:
        return

    # A frame with a sync pattern may begin at any constant byte of a window. Other windows begin with the frame.
    has_sync = windows.framing == SYNC
    usual, is_constant = usual_bytes(rows[:, :length])
    may_be_sync = is_constant & (usual != 0)  # zeros are mostly the high bytes of numbers
    starts = np.flatnonzero(may_be_sync)[:MAX_FRAME_STARTS].tolist() if has_sync else [0]

    # Pairs of a first byte and a checksum. If no checksum fits, frames without a checksum are tried.
    starts_and_checks = [(start, check) for start in starts for check in find_checks(rows[:, start : start + length])]
    has_check = bool(starts_and_checks)

    covered_share = min(1.0, len(windows.starts) * length / len(windows.stream))
    rate_Hz = len(windows.stream) / length / seconds
    for order in ORDERS:
        parts_at = parts_of(rows, order, rate_Hz, weights)
        if not has_check:
            starts_and_checks = [(start, Check(0, order, {})) for start in starts]
        for start, check in starts_and_checks:
            frame_parts = parts_at[start:] + parts_at[:start]  # from the first byte of the frame
            parts_before_check = frame_parts[: length - check.size]
            sync_lengths = _sync_lengths(may_be_sync, start) if has_sync else [0]
            score, sync_length, parts = split_frame(parts_before_check, sync_lengths, weights)
            has_channel = any(part.role == "channel" for part in parts)
            if has_channel:
                sync = np.roll(usual, -start)[:sync_length].tobytes()
                bits_per_byte = covered_share * score / length + (1.0 - covered_share) * weights.noise
                yield bits_per_byte, _frames_section(windows, sync, check, order, parts)


def _frames_section(
    windows: Windows, sync: bytes, check: Check, order: ByteOrder, parts: Sequence[Part]
) -> dict[str, Any]:
    """Return the section `[frames]` of a device file for a description of the frames.

    Args:
        windows: Frames of one length in the stream.
        sync: The sync pattern; empty if there is none.
        check: The checksum, whose size is 0 if there is none.
        order: Byte order of the numbers.
        parts: Parts of a frame between sync and checksum.
    """
    table: dict[str, Any] = {"format": "described"}
    if windows.framing == SYNC:
        table["sync"] = sync.hex(" ").upper()
    else:
        table["framing"] = windows.framing
    table["length"] = windows.length
    table["byte_order"] = order
    table |= check.keys
    if check.size > 1 and check.order != order:
        table["checksum_order"] = check.order
    table["fields"] = _field_tables(parts)
    return table


def _field_tables(parts: Sequence[Part]) -> list[dict[str, Any]]:
    """Return the list `fields` of a device file for the parts of a frame.

    A second counter or clock becomes padding, and adjacent padding is joined.
    """
    fields: list[dict[str, Any]] = []
    roles: list[str] = []
    for part in parts:
        roles.append(part.role)
        role_count = roles.count(part.role)  # number of parts with this role so far, including this part
        if part.role == "channel":
            fields.append({"name": f"ch{role_count}", "type": part.kind})
        elif part.role != "pad" and role_count == 1:
            field: dict[str, Any] = {"name": part.name, "type": part.kind}
            if part.scale != 1.0:
                field["scale"] = part.scale
            fields.append(field)
        elif fields and fields[-1]["type"] == PADDING:
            fields[-1]["count"] = fields[-1].get("count", 1) + part.size
        else:
            padding: dict[str, Any] = {"type": PADDING}
            if part.size > 1:
                padding["count"] = part.size
            fields.append(padding)
    return fields


CLEAR_SHARE = 0.4
"""Smallest share of bytes in intact frames with which no other format is tried. Echoes may lie between the frames."""


def recognise(chunks: Sequence[bytes], seconds: float, *, are_datagrams: bool = False) -> dict[str, Any] | None:
    """Return the section `[frames]` of a device file; None if no format is recognised.

    Args:
        chunks: The bytes as they arrived.
        seconds: Time in which they arrived, s.
        are_datagrams: Whether each chunk is a datagram.
    """
    binary_frames, binary_share = _parse_all(BinaryParser(), chunks)
    if len(binary_frames) >= MIN_FRAMES and binary_share > CLEAR_SHARE:
        return {"format": "binary"}

    # If most of the bytes are not lines of one layout, the board may send binary frames that resemble text in places.
    text_table = None
    text_parser = TextParser()
    all_text_frames, text_share = _parse_all(text_parser, chunks)
    text_frames = [frame for frame in all_text_frames if len(frame.values) == len(all_text_frames[-1].values)]
    if text_parser.layout is not None and len(text_frames) >= MIN_FRAMES:
        rate_Hz = len(text_frames) / seconds
        text_table = {"format": "text"} | _text_keys(text_parser.layout, text_frames, rate_Hz)
        if text_share >= CLEAR_SHARE:
            return text_table
    return described_frames(chunks, seconds, are_datagrams=are_datagrams) or text_table


def _parse_all(parser: Parser, chunks: Sequence[bytes]) -> tuple[list[Frame], float]:
    """Return the frames that a parser finds, and the share of the bytes that lie in these frames."""
    frames = [frame for chunk in chunks for frame in parser.feed(chunk)]
    byte_count = sum(len(chunk) for chunk in chunks)
    return frames, 1.0 - parser.counts.bytes_dropped / max(1, byte_count)


def _text_keys(layout: Layout, frames: Sequence[Frame], rate_Hz: float) -> dict[str, Any]:
    """Return the keys that a device file for lines of text needs.

    If the columns have no names and one of them is a counter or a clock, all columns get names. The header of a CSV
    stream is copied to the device file, because a program that starts later does not receive the header.

    Args:
        layout: Layout of the lines.
        frames: Frames of these lines.
        rate_Hz: Number of frames per second, Hz.
    """
    last_frame = frames[-1]
    meanings = _meanings(frames, rate_Hz)

    # The header of a CSV names all columns. All names are copied, except the names of counter and clock.
    if layout.notation is Notation.csv and layout.names:
        columns = list(layout.names)
        for position, meaning in meanings.items():
            column, _ = layout.columns.channels[position]
            columns[column] = meaning
        return {"columns": columns}

    # If each line contains the names, or no column is a counter or a clock, the names of the columns are not needed.
    if last_frame.names or not meanings:
        return {meaning: last_frame.names[position] for position, meaning in meanings.items()}

    column_names = []
    channel_count = 0
    for position in range(len(last_frame.values)):
        if position in meanings:
            column_names.append(meanings[position])
        else:
            channel_count += 1
            column_names.append(f"ch{channel_count}")
    return {"columns": column_names}


@np.errstate(over="ignore", invalid="ignore")
def _meanings(frames: Sequence[Frame], rate_Hz: float) -> dict[int, str]:
    """Find the columns that count frames or time, and return their names by their positions.

    Args:
        frames: Frames with the same number of values.
        rate_Hz: Number of frames per second, Hz.

    Returns:
        `seq`, `t_us`, `t_ms` or `t_s` for each position of such a column.
    """
    meanings: dict[int, str] = {}
    has_counter = frames[-1].seq is not None
    has_clock = frames[-1].t_us is not None
    steps = np.diff([frame.values for frame in frames], axis=0)  # shape (n - 1, columns)
    for position, column_steps in enumerate(steps.T):
        clock_name, clock_scale = clock_of(column_steps, rate_Hz) or ("", 0.0)  # no clock has an empty name
        if not has_counter and steady_step(column_steps) == 1.0:
            meanings[position] = SEQ
            has_counter = True
        elif not has_clock and clock_scale == 1.0:  # a device file for lines of text cannot state another scale
            meanings[position] = clock_name
            has_clock = True
    return meanings
