"""Frames of fixed length, recognised: from windows to the section `[frames]` that describes them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np

from isocharge.serve.frames.frame_layout import DATAGRAM, SYNC
from isocharge.serve.recognition.check_search import Check, checks
from isocharge.serve.recognition.clock_unit import clock_name
from isocharge.serve.recognition.field_search import (
    CONSTANT_SHARE,
    PRICE_OF_NOISE,
    Part,
    Role,
    Split,
    number_values,
    split_frame,
)
from isocharge.serve.recognition.framing import MOST_BYTES, Bytes, Windows, framings
from isocharge.serve.recognition.series import clock_step, steps

MOST_FRAMES = 300
"""Frames that are examined."""

MOST_BEGINS = 6
"""Bytes at each end of a run of constant bytes at which a frame may begin."""

PRICE_WITHOUT_CHECK = 4.0
"""For frames without a checksum, bits: most have one."""

BONUS_OF_CHECK = 1.0
"""For each byte of a checksum, bits: the low byte of a sum is a sum, too."""

NO_CHECK = Check(0, 0, "none", 0, "little")


def described_frames(chunks: Sequence[bytes], seconds: float, *, are_datagrams: bool = False) -> dict[str, Any] | None:
    """The section `[frames]` of a device file for frames of fixed length; None if the bytes are none.

    Args:
        chunks: The bytes as they came.
        seconds: Time in which they came, s; the unit of a clock follows from it.
        are_datagrams: Whether each chunk is a datagram.
    """
    for _, group in groupby(framings(chunks, are_datagrams=are_datagrams), key=lambda windows: windows.framing):
        readings = (reading for windows in group for reading in _readings(windows, _rate_Hz(windows, chunks, seconds)))
        best = min(
            (reading for reading in readings if reading.has_channels),
            key=lambda reading: reading.price_per_byte,
            default=None,
        )
        if best is not None:
            return _table(best, _rate_Hz(best.windows, chunks, seconds))
    return None


@dataclass(frozen=True)
class Reading:
    """One of the readings that windows allow.

    Attributes:
        windows: The frames.
        check: The checksum, and where a frame begins.
        split: Its parts.
        price: Bits.
    """

    windows: Windows
    check: Check
    split: Split
    price: float

    @property
    def price_per_byte(self) -> float:
        """Bits for each byte of the stream, those too that are in no frame: lengths of frames are compared by it."""
        windows = self.windows
        covered = min(1.0, len(windows.starts) * windows.length / len(windows.stream))
        return covered * self.price / windows.length + (1.0 - covered) * PRICE_OF_NOISE

    @property
    def has_channels(self) -> bool:
        """Whether anything in the frames may be a charge."""
        return any(part.role is Role.channel for part in self.split.parts)


def _rate_Hz(windows: Windows, chunks: Sequence[bytes], seconds: float) -> float:
    """Frames per second of a whole stream, of which the windows may be the first part."""
    size = sum(map(len, chunks))
    if windows.framing in (SYNC, DATAGRAM):
        return size / windows.length / seconds
    return len(windows.starts) / (seconds * min(1.0, MOST_BYTES / size))


def _readings(windows: Windows, rate_Hz: float) -> Iterator[Reading]:
    """Every begin and checksum that the frames may have."""
    needs_sync = windows.framing == SYNC
    turns = _turns(windows) if needs_sync else windows.turns
    has_check = False
    for turn in turns:
        rows = windows.rows(turn)[:MOST_FRAMES]
        for check in checks(rows, turn):
            split = split_frame(
                rows,
                windows.length - check.size,
                rate_Hz,
                needs_sync=needs_sync,
                order=check.order if check.size > 1 else None,
            )
            if split is not None:
                has_check = True
                yield Reading(windows, check, split, split.price - BONUS_OF_CHECK * check.size)
    for turn in turns if not has_check else ():
        split = split_frame(windows.rows(turn)[:MOST_FRAMES], windows.length, rate_Hz, needs_sync=needs_sync)
        if split is not None:
            yield Reading(windows, replace(NO_CHECK, turn=turn), split, split.price + PRICE_WITHOUT_CHECK)


def _turns(windows: Windows) -> list[int]:
    """Where a frame may begin: at a constant byte, near the begin or the end of its run of such bytes."""
    rows = windows.rows()
    constant = [float(np.bincount(column, minlength=1).max()) >= CONSTANT_SHARE * len(column) for column in rows.T]
    if all(constant):
        return []
    length, first = len(constant), constant.index(False)
    turns, run = [], []
    for turn in (*range(first, length), *range(first + 1)):  # once round, from a byte that varies
        if constant[turn]:
            run.append(turn)
            continue
        turns += run[:MOST_BEGINS] + run[MOST_BEGINS:][-MOST_BEGINS:]
        run = []
    return turns


def _table(reading: Reading, rate_Hz: float) -> dict[str, Any]:
    windows, check, split = reading.windows, reading.check, reading.split
    rows = windows.rows(check.turn)[:MOST_FRAMES]
    sync = sum(part.size for part in split.parts if part.role is Role.sync)
    table: dict[str, Any] = {"format": "described"}
    table |= {} if windows.framing == SYNC else {"framing": windows.framing}
    if sync:
        usual = [int(np.bincount(column).argmax()) for column in rows[:, :sync].T]
        table["sync"] = bytes(usual).hex(" ").upper()
    table |= {"length": windows.length, "byte_order": split.order}
    if check.size:
        table |= check.table
    if table.get("checksum_order") == split.order:
        del table["checksum_order"]
    return table | {"fields": _fields(rows, split, rate_Hz)}


def _fields(rows: Bytes, split: Split, rate_Hz: float) -> list[dict[str, Any]]:
    """The fields of a device file; neighbouring bytes without meaning are one padding."""
    fields: list[dict[str, Any]] = []
    taken: set[Role] = set()
    number = 0
    for part in split.parts:
        role = part.role
        if role is Role.sync:
            continue
        entry: dict[str, Any] | None = None
        if role is Role.seq and role not in taken:
            entry = {"name": "seq", "type": f"u{8 * part.size}"}
        elif role is Role.clock and role not in taken:
            entry = _clock(rows, part, split.order, rate_Hz)
        elif role is Role.channel:
            number += 1
            entry = {"name": f"ch{number}", "type": _kind(rows, part, split)}
        taken.add(role)
        if entry is not None:
            fields.append(entry)
        elif fields and fields[-1]["type"] == "pad":
            fields[-1]["count"] = fields[-1].get("count", 1) + part.size
        else:
            fields.append({"type": "pad"} | ({"count": part.size} if part.size > 1 else {}))
    return fields


def _clock(rows: Bytes, part: Part, order: str, rate_Hz: float) -> dict[str, Any] | None:
    values = number_values(rows, part, order)
    step = np.diff(values.astype(float)) if part.is_float else steps(values, 8 * part.size)
    ticks = clock_step(step) or 1.0
    name, scale = clock_name(ticks * rate_Hz)
    kind = f"f{8 * part.size}" if part.is_float else f"u{8 * part.size}"
    return {"name": name, "type": kind} | ({"scale": scale} if scale != 1.0 else {})


def _kind(rows: Bytes, part: Part, split: Split) -> str:
    """The type of a channel; whether it has a sign is decided with all channels of its size."""
    if part.is_float:
        return f"f{8 * part.size}"
    alike = [
        other for other in split.parts if other.role is Role.channel and other.size == part.size and not other.is_float
    ]
    votes = [_sign_vote(number_values(rows, other, split.order), 8 * part.size) for other in alike]
    return f"{'i' if sum(votes) > 0 else 'u'}{8 * part.size}"


def _sign_vote(values: Any, bits: int) -> int:
    """1 for a signed channel, -1 for an unsigned one, 0 for one that does not say.

    The wrong reading jumps where the right one passes zero or the middle of its range. Without a jump, the one is right
    whose rest is farther from both its limits.
    """
    counts = values.astype(np.int64)
    middle = 1 << (bits - 1)
    signed = np.where(counts >= middle, counts - 2 * middle, counts)
    spans = int(np.ptp(signed)), int(np.ptp(counts))
    if not spans[1]:
        return 0
    if spans[0] != spans[1]:
        return 1 if spans[0] < spans[1] else -1
    rest = float(np.median(counts))
    return -1 if middle / 2 < rest < 3 * middle / 2 else 1
