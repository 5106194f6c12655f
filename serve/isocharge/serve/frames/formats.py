"""The frame formats that a device file can name in `[frames] format`, each with its keys and its parser."""

import re
from collections.abc import Mapping

from isocharge.serve.frames.binary import BinaryParser
from isocharge.serve.frames.frame import Frame, Parser
from isocharge.serve.frames.frame_layout import FrameLayout, FrameSection
from isocharge.serve.frames.text import TextParser

_PIECE = re.compile(rb"[^\0\n]*[\0\n]|[^\0\n]+")
"""Bytes up to and including the end of a binary frame or of a line."""


class AutoParser(Parser):
    """Parser that recognises whether a board sends the binary frames of isocharge or lines of text.

    Bytes that come before the format is recognised are dropped.

    Args:
        columns: Names for the columns of a CSV; see `TextParser`.
        meanings: `seq`, `t_us`, `t_ms` or `t_s` by the name that the board uses; see `TextParser`.
    """

    def __init__(self, columns: tuple[str, ...] = (), meanings: Mapping[str, str] | None = None) -> None:
        """Begin with the parsers of all formats. The class describes the arguments."""
        super().__init__("nothing recognised yet")
        self._candidates: tuple[Parser, ...] = (BinaryParser(), TextParser(columns, meanings))

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that end within `data`.

        Until the format is recognised, each piece of the data is passed to the parsers of all formats. The first parser
        that finds a frame is used from then on.
        """
        if len(self._candidates) == 1:
            return self._feed_recognised(self._candidates[0], data)
        for match in _PIECE.finditer(data):
            piece = match.group()
            self.counts.count_dropped(len(piece))
            for candidate in self._candidates:
                frames = candidate.feed(piece)
                if frames:  # the format is recognised, and the rest of the data is passed to this parser alone
                    self._candidates = (candidate,)
                    self.counts = candidate.counts
                    return frames + self._feed_recognised(candidate, data[match.end() :])
        return []

    def reset(self) -> None:
        """Drop the bytes of an unfinished frame, because the next bytes come from another connection."""
        for candidate in self._candidates:
            candidate.reset()

    def _feed_recognised(self, parser: Parser, data: bytes) -> list[Frame]:
        """Return the frames that the parser of the recognised format finds, and copy its format and its moduli.

        The format and the moduli are copied in each call, because the parser may learn them only after many frames.

        Args:
            parser: Parser of the recognised format.
            data: The next bytes.
        """
        frames = parser.feed(data)
        self.format = parser.format
        self.seq_modulus = parser.seq_modulus
        self.t_us_modulus = parser.t_us_modulus
        return frames


class TextFrames(FrameSection, tag="text", frozen=True):
    """Lines of text.

    Attributes:
        columns: Names of the columns of a CSV.
        seq: Name that the board uses for its frame counter.
        t_us: Name that the board uses for a clock in us.
        t_ms: Name that the board uses for a clock in ms.
        t_s: Name that the board uses for a clock in s.
    """

    columns: tuple[str, ...] = ()
    seq: str | None = None
    t_us: str | None = None
    t_ms: str | None = None
    t_s: str | None = None

    @property
    def meanings(self) -> Mapping[str, str]:
        """Meaning of each name that the board uses: `seq`, `t_us`, `t_ms` or `t_s`."""
        meanings = {self.seq: "seq", self.t_us: "t_us", self.t_ms: "t_ms", self.t_s: "t_s"}
        return {name: meaning for name, meaning in meanings.items() if name}

    def parser(self) -> Parser:
        """Create a parser."""
        return TextParser(self.columns, self.meanings)


class AutoFrames(TextFrames, tag="auto", frozen=True):
    """The binary frames of isocharge, or lines of text. The parser recognises which of them the board sends."""

    def parser(self) -> Parser:
        """Create a parser."""
        return AutoParser(self.columns, self.meanings)


class BinaryFrames(FrameSection, tag="binary", frozen=True):
    """The binary frames of isocharge."""

    def parser(self) -> Parser:
        """Create a parser."""
        return BinaryParser()


Frames = AutoFrames | TextFrames | BinaryFrames | FrameLayout
"""The section `[frames]` of a device file."""
