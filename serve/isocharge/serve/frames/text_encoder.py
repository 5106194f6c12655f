"""Lines of text from frames."""

import json
from collections.abc import Callable

from isocharge.serve.frames.frame import SEQ, TIMES_US, Frame


def _csv_line(frame: Frame) -> str:
    return ",".join(f"{value:.7g}" for value in frame.values)


def _pairs_line(frame: Frame) -> str:
    return ",".join(f"{name}:{value}" for name, value in _fields(frame))


def _teleplot_lines(frame: Frame) -> str:
    stamp = "" if frame.t_us is None else f"{frame.t_us / 1e3:.3f}:"
    return "\n".join(f">{name}:{stamp}{value}" for name, value in _fields(frame) if name not in TIMES_US)


def _json_line(frame: Frame) -> str:
    return "{" + ", ".join(f"{json.dumps(name)}: {value}" for name, value in _fields(frame)) + "}"


def _fields(frame: Frame) -> list[tuple[str, str]]:
    """Number, clock and channels with their names, as text; channels without names are A, B, C, ..."""
    names = frame.names or tuple(chr(ord("A") + k) for k in range(len(frame.values)))
    values = [(name, f"{value:.7g}") for name, value in zip(names, frame.values, strict=True)]
    head = [(SEQ, frame.seq), ("t_us", frame.t_us)]
    return [(name, str(number)) for name, number in head if number is not None] + values


TEXT_FORMATS: dict[str, Callable[[Frame], str]] = {
    "csv": _csv_line,
    "pairs": _pairs_line,
    "teleplot": _teleplot_lines,
    "json": _json_line,
}
"""Notations by name, with their writers. CSV has only the channels and no header, as the simplest boards send it."""


def encode_text(frame: Frame, notation: str) -> bytes:
    """A frame as a line of text, or as several for Teleplot, line ends included; numbers to seven digits."""
    return (TEXT_FORMATS[notation](frame) + "\n").encode()
