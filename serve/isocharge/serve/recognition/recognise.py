"""What a board sends: our binary frames, lines of text, or frames of fixed length that are described."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from isocharge.serve.frames.binary import BinaryParser
from isocharge.serve.frames.frame import SEQ, Frame
from isocharge.serve.frames.frame_layout import DATAGRAM, PADDING, SYNC
from isocharge.serve.frames.text import Layout, TextParser
from isocharge.serve.frames.text_lines import Notation
from isocharge.serve.recognition.fields import (
    CONSTANT_SHARE,
    Part,
    Series,
    Split,
    Weights,
    clock_of,
    is_counter,
    number_values,
    split_frame,
)
from isocharge.serve.recognition.framing import FEWEST, MOST_BYTES, Bytes, FoundCheck, Windows, find_checks, framings

MOST_FRAMES = 300
"""Frames that are examined."""

MOST_BEGINS = 6
"""Bytes at each end of a run of constant bytes at which a frame may begin."""

WEIGHTS = Weights()


@dataclass(frozen=True)
class Candidate:
    """One description that windows allow.

    Attributes:
        windows: The frames.
        rows: Those that are examined, each from its begin on, shape (n, length).
        check: The checksum.
        split: The parts before it.
        rate_Hz: Frames per second.
        score: Bits for each byte of the stream, those too that are in no frame: frames of other lengths are compared.
    """

    windows: Windows
    rows: Bytes
    check: FoundCheck
    split: Split
    rate_Hz: float
    score: float


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
    for _, group in groupby(framings(chunks, are_datagrams=are_datagrams), key=lambda windows: windows.framing):
        candidates = [
            candidate
            for windows in group
            for candidate in _candidates(windows, _rate_Hz(windows, chunks, seconds), weights)
            if any(part.role == "channel" for part in candidate.split.parts)
        ]
        if candidates:
            return _table(min(candidates, key=lambda candidate: candidate.score))
    return None


def _rate_Hz(windows: Windows, chunks: Sequence[bytes], seconds: float) -> float:
    """Frames per second of a whole stream, of which the windows may be the first part."""
    size = sum(map(len, chunks))
    if windows.framing in (SYNC, DATAGRAM):
        return size / windows.length / seconds
    return len(windows.starts) / (seconds * min(1.0, MOST_BYTES / size))


def _candidates(windows: Windows, rate_Hz: float, weights: Weights) -> Iterator[Candidate]:
    """Every begin and checksum that the frames may have; without a checksum only if none fits."""
    needs_sync = windows.framing == SYNC
    covered = min(1.0, len(windows.starts) * windows.length / len(windows.stream))
    all_rows = [windows.rows(turn)[:MOST_FRAMES] for turn in (_turns(windows) if needs_sync else (0,))]
    checks = [(rows, check) for rows in all_rows for check in find_checks(rows)]
    for rows, check in checks or [(rows, FoundCheck()) for rows in all_rows]:
        order = check.order if check.size > 1 else None
        split = split_frame(rows, windows.length - check.size, rate_Hz, weights, needs_sync=needs_sync, order=order)
        if split is not None:
            score = split.score + (-weights.check_byte * check.size if check.size else weights.no_check)
            score = covered * score / windows.length + (1.0 - covered) * weights.noise
            yield Candidate(windows, rows, check, split, rate_Hz, score)


def _turns(windows: Windows) -> list[int]:
    """Where a frame may begin: at a constant byte, near the begin or the end of its run of such bytes."""
    rows = windows.rows()
    constant = [float(np.bincount(column).max()) >= CONSTANT_SHARE * len(column) for column in rows.T]
    if all(constant):
        return []
    length, first = len(constant), constant.index(False)
    turns: list[int] = []
    for is_constant, run in groupby((*range(first, length), *range(first)), key=lambda at: constant[at]):
        if is_constant:  # once round, from a byte that varies
            ats = list(run)
            turns += ats[:MOST_BEGINS] + ats[MOST_BEGINS:][-MOST_BEGINS:]
    return turns


def _table(best: Candidate) -> dict[str, Any]:
    windows, check, split = best.windows, best.check, best.split
    table: dict[str, Any] = {"format": "described"}
    if windows.framing != SYNC:
        table["framing"] = windows.framing
    if sync := sum(part.size for part in split.parts if part.role == "sync"):
        usual = [int(np.bincount(column).argmax()) for column in best.rows[:, :sync].T]
        table["sync"] = bytes(usual).hex(" ").upper()
    table |= {"length": windows.length, "byte_order": split.order}
    if check.size:
        table["checksum"] = check.checksum
    if check.begin:
        table["checksum_from"] = check.begin
    if check.size > 1 and check.order != split.order:
        table["checksum_order"] = check.order
    return table | {"fields": _fields(best)}


def _fields(best: Candidate) -> list[dict[str, Any]]:
    """The fields of a device file; neighbouring bytes without meaning are one padding."""
    fields: list[dict[str, Any]] = []
    roles = [part.role for part in best.split.parts]
    channels = 0
    for position, part in enumerate(best.split.parts):
        kind, is_first = f"{'f' if part.is_float else 'u'}{8 * part.size}", part.role not in roles[:position]
        if part.role == "channel":
            channels += 1
            fields.append({"name": f"ch{channels}", "type": _type(best, part)})
        elif part.role == "seq" and is_first:
            fields.append({"name": "seq", "type": kind})
        elif part.role == "clock" and is_first:
            name, scale = part.clock
            fields.append({"name": name, "type": kind} | ({"scale": scale} if scale != 1.0 else {}))
        elif part.role != "sync":
            size = part.size
            if fields and fields[-1]["type"] == PADDING:
                size += fields.pop().get("count", 1)
            fields.append({"type": PADDING} | ({"count": size} if size > 1 else {}))
    return fields


def _type(best: Candidate, part: Part) -> str:
    """The type of a channel; whether it has a sign is decided with all channels of its size."""
    if part.is_float:
        return f"f{8 * part.size}"
    alike = [other for other in best.split.parts if other.row == part.row]
    counts = [number_values(best.rows, other.at, other.size, best.split.order) for other in alike]
    return f"{'i' if sum(_sign_vote(values, 8 * part.size) for values in counts) > 0 else 'u'}{8 * part.size}"


def _sign_vote(counts: Series, bits: int) -> int:
    """1 for a signed channel, -1 for an unsigned one, 0 for one that does not say.

    The wrong reading jumps where the right one passes zero or the middle of its range. Without a jump, the one is right
    whose rest is farther from both its limits.
    """
    middle = 1 << (bits - 1)
    signed, unsigned = int(np.ptp(np.where(counts >= middle, counts - 2 * middle, counts))), int(np.ptp(counts))
    if signed != unsigned:
        return 1 if signed < unsigned else -1
    return 0 if not unsigned else -1 if middle / 2 < float(np.median(counts)) < 3 * middle / 2 else 1


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
