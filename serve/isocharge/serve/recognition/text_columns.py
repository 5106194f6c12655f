"""Columns of text, recognised: which one is the number of the frame and which the clock, whatever their names."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from isocharge.serve.frames.frame import Frame
from isocharge.serve.frames.text import Layout, TextParser
from isocharge.serve.frames.text_lines import SEQ, Notation
from isocharge.serve.recognition.clock_unit import text_clock_name
from isocharge.serve.recognition.framing import FEWEST
from isocharge.serve.recognition.series import Series, clock_step, is_counter


def text_frames(chunks: Sequence[bytes], seconds: float) -> tuple[dict[str, Any], float] | None:
    """The section `[frames]` of a device file for lines of text, and the share of bytes that it explains.

    Args:
        chunks: The bytes as they came.
        seconds: Time in which they came, s; the unit of a clock follows from it.

    Returns:
        None if the bytes are no text.
    """
    parser = TextParser()
    frames = [frame for chunk in chunks for frame in parser.feed(chunk)]
    frames = [frame for frame in frames if len(frame.values) == len(frames[-1].values)]
    if parser.layout is None or len(frames) < FEWEST:
        return None
    meanings = _meanings(frames, len(frames) / seconds)
    share = 1.0 - parser.counts.bytes_dropped / max(1, sum(map(len, chunks)))
    return {"format": "text"} | _table(parser.layout, frames[-1], meanings), share


def _meanings(frames: Sequence[Frame], rate_Hz: float) -> dict[str, int]:
    """Positions among the values of number and clock, under the names that these have in a device file."""
    with np.errstate(over="ignore", invalid="ignore"):
        step = np.diff(np.array([frame.values for frame in frames]), axis=0)
    meanings: dict[str, int] = {}
    has_clock, has_number = frames[-1].t_us is not None, frames[-1].seq is not None
    for position, column in enumerate(step.T):
        if not np.isfinite(column).all():
            continue
        name = None if has_clock else _clock(column, rate_Hz)
        if not has_number and is_counter(column) and not (name and SEQ in meanings):
            meanings[SEQ], has_number = position, True
        elif name is not None:
            meanings[name], has_clock = position, True
    return meanings


def _clock(step: Series, rate_Hz: float) -> str | None:
    ticks = clock_step(step)
    return None if ticks is None else text_clock_name(ticks * rate_Hz)


def _table(layout: Layout, frame: Frame, meanings: dict[str, int]) -> dict[str, Any]:
    """The keys of a device file; columns without names get names, once one of them has a meaning.

    The header of a CSV is written down: who comes later will not see it.
    """
    if layout.notation is Notation.csv and layout.names:
        columns = list(layout.names)
        for key, position in meanings.items():
            columns[layout.channels[position]] = key
        return {"columns": columns}
    if frame.names:
        return {key: frame.names[position] for key, position in meanings.items()}
    if not meanings:
        return {}
    by_position = {position: key for key, position in meanings.items()}
    columns, number = [], 0
    for position in range(len(frame.values)):
        number += position not in by_position
        columns.append(by_position.get(position, f"ch{number}"))
    return {"columns": columns}
