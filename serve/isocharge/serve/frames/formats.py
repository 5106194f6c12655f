"""Frame formats that a device file can select with the key `format` of its section `[frames]`.

Each format has a section class, which declares the keys of the format and creates the parser.
"""

from collections.abc import Mapping
from functools import cached_property

from isocharge.serve.frames.binary import BinaryParser
from isocharge.serve.frames.frame import SEQ, TIMES_US, Frame, Parser
from isocharge.serve.frames.frame_layout import FrameLayout, FrameSection
from isocharge.serve.frames.text import TextParser


class AutoParser(Parser):
    """Parser that recognises whether a board sends the binary frames of isocharge or lines of text.

    Bytes that arrive before the format is recognised are dropped.

    Args:
        columns: Names for the columns of a CSV; see `TextParser`.
        meanings: Meaning (`seq`, `t_us`, `t_ms` or `t_s`) of each name that the board uses; see `TextParser`.
    """

    def __init__(self, columns: tuple[str, ...] = (), meanings: Mapping[str, str] | None = None) -> None:
        """Begin without a recognised format. The class describes the arguments."""
        super().__init__("nothing recognised yet")
        self._columns = columns
        self._meanings = meanings
        self._binary = BinaryParser()

    @cached_property
    def _text(self) -> TextParser:
        """Parser of text, which is created when bytes arrive that are no binary frame."""
        return TextParser(self._columns, self._meanings)

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that end within `data`.

        Until the format is recognised, the data are passed to the parsers of all formats. The first parser that finds a
        frame receives all further data. The description of the format and the moduli of the counter and the clock are
        copied from the parser together with each frame, because the parser may determine them only after many frames.
        """
        parser = self.recognised or self._binary
        frames = parser.feed(data)
        if not (frames or self.recognised):
            parser = self._text
            frames = parser.feed(data)
        if frames:
            self.recognised = parser
            self.counts = parser.counts
            self.format = parser.format
            self.seq_modulus = parser.seq_modulus
            self.t_us_modulus = parser.t_us_modulus
            return frames
        self.unread_line = parser.unread_line or self.unread_line
        if self.recognised is None:  # a recognised parser counts its bytes itself
            self.counts.bytes_dropped += len(data)
        return []

    def reset(self) -> None:
        """Drop the bytes of an unfinished frame, because the next bytes come from another connection.

        A format that was recognised stays recognised.
        """
        super().reset()
        self._binary.reset()
        self._text.reset()


class TextFrames(FrameSection, tag="text", frozen=True):
    """Section for a board that sends lines of text.

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
        """Meaning (`seq`, `t_us`, `t_ms` or `t_s`) of each name that the board uses for its counter or a clock."""
        return {name: meaning for meaning in (SEQ, *TIMES_US) if (name := getattr(self, meaning))}

    def parser(self) -> Parser:
        """Create a parser."""
        return TextParser(self.columns, self.meanings)


class AutoFrames(TextFrames, tag="auto", frozen=True):
    """Section for a board that sends either the binary frames of isocharge or lines of text.

    The parser recognises which of the two formats the board sends.
    """

    def parser(self) -> Parser:
        """Create a parser."""
        return AutoParser(self.columns, self.meanings)


class BinaryFrames(FrameSection, tag="binary", frozen=True):
    """Section for a board that sends the binary frames of isocharge."""

    def parser(self) -> Parser:
        """Create a parser."""
        return BinaryParser()


Frames = AutoFrames | TextFrames | BinaryFrames | FrameLayout
"""The section `[frames]` of a device file."""
