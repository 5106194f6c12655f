"""Frames of fixed length, recognised: from windows to the section `[frames]` that describes them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from isocharge.serve.frames.frame_layout import DATAGRAM, PADDING, SYNC
from isocharge.serve.recognition.check_search import FoundCheck, find_checks
from isocharge.serve.recognition.fields import CONSTANT_SHARE, Part, Split, Weights, number_values, split_frame
from isocharge.serve.recognition.framing import MOST_BYTES, Bytes, Windows, framings
from isocharge.serve.recognition.series import Series

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
