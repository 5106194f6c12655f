"""Functions that recognise the format in which a board sends frames.

The format is the binary frames of isocharge, lines of text, or frames of fixed length.
"""

from collections.abc import Iterator, Sequence
from itertools import chain, count, product
from operator import itemgetter
from string import printable
from typing import Any

import numpy as np
from msgspec import structs, to_builtins

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.frames.formats import AutoParser
from isocharge.serve.frames.frame import SEQ, TIMES_US, Frame
from isocharge.serve.frames.frame_layout import PADDING, SYNC, Field, FrameLayout
from isocharge.serve.frames.text import Layout, TextParser
from isocharge.serve.recognition.fields import (
    CHANNEL,
    LARGEST_SIZE,
    Part,
    Weights,
    count_wraps,
    possible_meanings,
    possible_parts,
    split_frame,
)
from isocharge.serve.recognition.framing import (
    COVERED_SHARE,
    MAX_CONSTANT_BYTES,
    MAX_EXAMINED_BYTES,
    MIN_FRAMES,
    ORDERS,
    Bytes,
    Check,
    FrameDivision,
    count_leading,
    find_checks,
    possible_divisions,
    usual_bytes,
)


def described_frames_section(
    chunks: Sequence[bytes], seconds: float, *, are_datagrams: bool = False
) -> dict[str, Any] | None:
    """Recognise frames of fixed length, and return the section `[frames]` of a device file that describes them.

    The function tries the kinds of framing from the most certain to the least certain kind, until the frames can be
    described with one of them. A framing is the way in which the beginnings of frames are marked. If several
    descriptions with the same kind of framing are possible, the description with the lowest score is returned. The
    result is None if no frames of fixed length are recognised.

    Args:
        chunks: Received bytes, divided as they arrived.
        seconds: Time in which the bytes arrived, s. The unit of a clock is derived from this time.
        are_datagrams: Whether each chunk is a datagram.
    """
    # Only the first `MAX_EXAMINED_BYTES` bytes are examined. They have arrived in this part of the time.
    byte_count = sum(map(len, chunks))
    examined_seconds = seconds * min(1.0, MAX_EXAMINED_BYTES / max(1, byte_count))
    # A division states where the frames begin. Each kind of framing has a group of possible divisions.
    for divisions_of_framing in possible_divisions(chunks, are_datagrams=are_datagrams):
        scored_layouts = (_scored_layouts(division, examined_seconds) for division in divisions_of_framing)
        # Each element is a score and a description. The lowest score is the best.
        best = min(chain.from_iterable(scored_layouts), key=itemgetter(0), default=None)
        if best is not None:
            section: dict[str, Any] = to_builtins(best[1])  # the description as a dictionary
            return section
    return None


def _scored_layouts(division: FrameDivision, seconds: float) -> Iterator[tuple[float, FrameLayout]]:
    """Yield the score of each possible description of the frames, together with the description.

    At most one description is yielded for each combination of a first byte, a checksum and a byte order. Descriptions
    without a checksum are tried only if no checksum fits. Descriptions without a channel are not yielded.

    The score is the number of bits per byte of the stream, including the bytes outside of all frames. The scores of
    descriptions with different frame lengths can therefore be compared.

    Args:
        division: Division of the stream into frames.
        seconds: Time in which the stream arrived, s.
    """
    length = division.length
    if len(division.rows()) < MIN_FRAMES:
        return

    # It is not known which of the constant bytes is the first byte of a frame, so that the frames may begin at several
    # distances from `division.starts`. Find the checksums that fit at each distance.
    has_sync = division.framing == SYNC
    distances: list[int] = [0]
    if has_sync:
        # A frame begins with its sync pattern. Each byte that may belong to the pattern may be the first byte.
        distances = np.flatnonzero(_may_be_sync(division.rows()))[:MAX_CONSTANT_BYTES].tolist()
    rows_at = {distance: division.rows(distance) for distance in distances}
    checks = [(distance, check) for distance, rows in rows_at.items() for check in find_checks(rows)]
    if not checks:
        checks = [(distance, Check()) for distance in distances]

    # List the possible parts of frames that begin at `division.starts`, once for each byte order.
    frame_rate_Hz = len(division.stream) / length / seconds  # as if all bytes of the stream belonged to frames
    wide_rows = division.rows(next_bytes=LARGEST_SIZE)
    parts_of_order = {order: possible_parts(wide_rows, order, frame_rate_Hz) for order in ORDERS}

    # For each byte order and each checksum, find the division of the frame into parts with the lowest score.
    for order, (distance, check) in product(ORDERS, checks):
        # The bytes between `starts` and the beginning of a frame are the last bytes of the previous frame. Their parts
        # are therefore moved to the end of the list.
        parts = parts_of_order[order]
        parts_at_each_byte = parts[distance:] + parts[:distance]
        rows = rows_at[distance]
        sync_lengths: Sequence[int] = [0]
        if has_sync:
            # The first byte always belongs to the pattern, even if damaged frames hide that it is constant.
            max_sync_length = max(1, count_leading(_may_be_sync(rows)))
            sync_lengths = range(1, max_sync_length + 1)
        frame_score, best_parts, sync_length = split_frame(
            parts_at_each_byte[: length - check.size], sync_lengths, check.start
        )
        has_channel = any(part.name == CHANNEL for part in best_parts)
        if not has_channel:
            continue
        frame_bytes, _is_constant = usual_bytes(rows)
        sync = frame_bytes[:sync_length].tobytes()
        layout = FrameLayout(
            framing=division.framing,
            sync_bytes=sync.hex(" ").upper() or None,
            length=length,
            byte_order=order,
            checksum=check.name,
            checksum_from=check.start,
            checksum_order=check.order if check.order != order and check.size > 1 else None,
            fields_and_padding=_fields(best_parts),
        )
        # Each byte outside of all frames contributes `Weights.noise` bits.
        covered_share = division.covered_share
        score = covered_share * frame_score / length + (1.0 - covered_share) * Weights.noise
        yield score, layout


def _may_be_sync(rows: Bytes) -> Booleans:
    """Return whether each byte of the frames may belong to a sync pattern, shape (length,).

    A byte of a sync pattern is constant and not 0, because zeros are mostly the high bytes of numbers.
    """
    usual, is_constant = usual_bytes(rows)
    may_be_sync: Booleans = is_constant & (usual != 0)
    return may_be_sync


def _fields(parts: Sequence[Part]) -> tuple[Field, ...]:
    """Convert the parts of a frame to fields and padding.

    Channels are called ch1, ch2, and so on. The names of fields must differ. A second counter therefore becomes
    padding, and so does a second clock with the same name as the first. Adjacent padding is joined.
    """
    fields: list[Field] = []
    channel_numbers = count(1)
    for part in parts:
        name = f"ch{next(channel_numbers)}" if part.name == CHANNEL else part.name
        if name and name not in [field.name for field in fields]:
            field = Field(name=name, type_name=part.type_name)
            if part.scale != 1.0:  # a device file states no scale of 1
                field = structs.replace(field, scale=part.scale)
            fields.append(field)
        else:
            padding_size = part.size
            if fields and fields[-1].type_name == PADDING:  # join the padding with that before it
                padding_size += fields.pop().count  # removes the padding before it
            fields.append(Field(type_name=PADDING, count=padding_size))
    return tuple(fields)


def recognise(chunks: Sequence[bytes], seconds: float, *, are_datagrams: bool = False) -> dict[str, Any] | None:
    """Recognise the format of a board, and return the section `[frames]` that describes this format in a device file.

    The function first tries the binary frames of isocharge and lines of text, and then other frames of fixed length.
    Bytes that are mostly printable characters are never taken for frames of fixed length.

    Args:
        chunks: Received bytes, divided as they arrived.
        seconds: Time in which the bytes arrived, s.
        are_datagrams: Whether each chunk is a datagram.

    Returns:
        The section as a dictionary; None if no format is recognised.
    """
    data = b"".join(chunks)
    parser = AutoParser()
    all_frames = parser.feed(data)
    # Use only the frames with as many values as the last frame. Earlier frames have another number of values if a
    # header later names one of the columns as counter or clock.
    frames = [frame for frame in all_frames if len(frame.values) == len(all_frames[-1].values)]
    section: dict[str, Any] | None = None
    if len(frames) >= MIN_FRAMES:
        section = {"format": "binary"}  # unless the parser has recognised text
        text_parser = parser.recognised
        if isinstance(text_parser, TextParser) and text_parser.layout is not None:
            frame_rate_Hz = len(all_frames) / seconds
            section = {"format": "text"} | _text_keys(text_parser.layout, frames, frame_rate_Hz)
    has_enough_frame_bytes = parser.counts.bytes_dropped <= (1.0 - COVERED_SHARE) * len(data)
    if _is_text(data) or (section and has_enough_frame_bytes):
        return section  # None for text in which no frames were recognised

    # The parser has found no frames, or has dropped most of the bytes. The board may send other frames, of which a few
    # resemble text or frames of isocharge. If no other frames are recognised either, the result of the parser is used.
    return described_frames_section(chunks, seconds, are_datagrams=are_datagrams) or section


def _is_text(data: bytes, min_share: float = 0.85) -> bool:
    """Return whether bytes are text, and therefore no frames in a binary format.

    Args:
        data: The bytes.
        min_share: Smallest share of printable characters in text. The other bytes may be damaged characters, letters
            that are not ASCII, or control characters at the ends of the lines.
    """
    other_bytes = data.translate(None, delete=printable.encode() + b"\x1b")
    return len(other_bytes) <= (1.0 - min_share) * len(data)


@np.errstate(over="ignore", invalid="ignore")
def _text_keys(layout: Layout, frames: Sequence[Frame], frame_rate_Hz: float) -> dict[str, Any]:
    """Return the keys that describe the counter, the clock and the columns of lines of text in a device file.

    If each line names its values, the keys `seq`, `t_us`, `t_ms` and `t_s` state the names that the board uses for its
    counter and its clock. For values without names in the lines, the key `columns` lists the names. These names are
    copied from a header, because a program that starts later does not receive the header. No keys are needed if the
    board sends no names, no counter and no clock.

    Args:
        layout: Layout of the lines.
        frames: Frames in the lines. All frames have the same number of values.
        frame_rate_Hz: Number of frames per second, Hz.
    """
    # A column is the index of a value among all values of a frame. `unnamed` lists the columns without a name in the
    # lines. The name of a counter or a clock is replaced by its meaning, such as `seq`.
    resolved_names = list(layout.names)
    device_keys: dict[str, Any] = {}
    steps = np.diff([frame.values for frame in frames], axis=0)  # shape (n - 1, channels)
    for (column, _scale), channel_steps in zip(layout.columns.channels, steps.T, strict=True):
        name = resolved_names[column]
        meaning = _counter_or_clock(name, channel_steps, frame_rate_Hz, resolved_names)
        if meaning:
            resolved_names[column] = meaning
            if column not in layout.unnamed:  # the board sends a name with each value
                device_keys[meaning] = name  # the name that the board uses for its counter or clock

    # For the values without a name in each line, list the names from a header, and the names of the counter and the
    # clock. Other channels are numbered. If none of these names is known, the columns need no names.
    if any(resolved_names[column] for column in layout.unnamed):
        channel_numbers = count(1)
        device_keys["columns"] = [resolved_names[column] or f"ch{next(channel_numbers)}" for column in layout.unnamed]
    return device_keys


def _counter_or_clock(name: str, steps: Array, frame_rate_Hz: float, known_names: Sequence[str]) -> str:
    """Return `seq` if a column contains the frame counter, `t_us`, `t_ms` or `t_s` for a clock, otherwise "".

    A counter increases by 1 from frame to frame, and a clock increases at one of the usual rates. If one column
    contains the seconds of a time and another column the milliseconds, the milliseconds are no clock, because they
    return to 0 every second. A clock in ms that increases by about 1 could also be a counter. Such a clock is
    recognised by its name, or by values that occur twice, which `possible_meanings` finds.

    Args:
        name: Name of the column; empty if the board sends no name.
        steps: Differences of the values of consecutive frames, shape (n,).
        frame_rate_Hz: Number of frames per second, Hz.
        known_names: Names of all columns. If they contain a counter or a clock, the column is not a second one.
    """
    # Pairs of a meaning, such as `seq` or `t_ms`, and the duration of one tick in the unit of this meaning. The value
    # increases by 1 in each tick. The counter comes before a clock.
    possible = list(possible_meanings(steps, frame_rate_Hz))
    if any(word in name.lower() for word in ("ms", "milli", "time")):  # the column has the name of a clock
        possible = possible[-1:]  # do not take the column for a counter if it may be a clock
    has_counter = SEQ in known_names
    has_clock = not TIMES_US.keys().isdisjoint(known_names)
    for meaning, tick in possible:
        if meaning == SEQ and not has_counter:
            return meaning
        # The ticks of a clock must be those of the name, because a device file for lines of text cannot state their
        # duration. The milliseconds of a time wrap every second, but a clock wraps at most once.
        if meaning != SEQ and not has_clock and tick == 1.0 and count_wraps(steps) < 2:
            return meaning
    return ""
