"""Recognition of what a board sends: our binary frames or lines of text. Described frames need a device file.

Both parsers read the bytes until one of them has a frame: a binary frame whose checksum fits, or a text layout that
came three times in a row. The bytes are cut where either of them could end a frame, so chunks do not matter.
"""

import re
from collections.abc import Mapping

from isocharge.serve.frames.binary import BinaryParser
from isocharge.serve.frames.frame import Frame, FrameCounts, Parser
from isocharge.serve.frames.text import TextParser

_STEP = re.compile(rb"[^\0\n]*[\0\n]|[^\0\n]+")


class AutoParser:
    """Bytes in, frames out, from the frames on by which the format was recognised."""

    def __init__(self, columns: tuple[str, ...] = (), meanings: Mapping[str, str] | None = None) -> None:
        """Set up both parsers.

        Args:
            columns, meanings: As `TextParser` takes them.
        """
        self._candidates: tuple[Parser, ...] = (BinaryParser(), TextParser(columns, meanings))
        self._chosen: Parser | None = None
        self._seen = 0

    @property
    def chosen(self) -> Parser | None:
        """The parser of the recognised format; None before."""
        return self._chosen

    @property
    def counts(self) -> FrameCounts:
        """The counters of the chosen parser; before, all bytes count as dropped."""
        return self._chosen.counts if self._chosen else FrameCounts(bytes_dropped=self._seen)

    @property
    def seq_modulus(self) -> int:
        """The number at which a frame's `seq` wraps to 0, of the chosen parser."""
        return (self._chosen or self._candidates[0]).seq_modulus

    @property
    def t_us_modulus(self) -> int:
        """The time at which a frame's `t_us` wraps to 0, of the chosen parser, us."""
        return (self._chosen or self._candidates[0]).t_us_modulus

    @property
    def format(self) -> str:
        """The recognised format, for people."""
        return self._chosen.format if self._chosen else "nothing recognised yet"

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that end within `data`."""
        if self._chosen is not None:
            return self._chosen.feed(data)
        for step in _STEP.finditer(data):
            frames = self._try(step.group())
            if self._chosen is not None:
                return frames + self._chosen.feed(data[step.end() :])
        return []

    def forget(self) -> None:
        """Drop what is unfinished: what comes next is from another connection."""
        for candidate in self._candidates if self._chosen is None else (self._chosen,):
            candidate.forget()

    def _try(self, step: bytes) -> list[Frame]:
        self._seen += len(step)
        for candidate in self._candidates:
            if frames := candidate.feed(step):
                self._chosen = candidate
                return frames
        return []
