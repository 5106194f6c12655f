"""The formats of frames that a device file can name in `[frames] format`, each with its keys and its parser."""

import re
from collections.abc import Mapping

from isocharge.serve.frames.binary import BinaryParser
from isocharge.serve.frames.frame import Frame, Parser
from isocharge.serve.frames.frame_layout import FrameLayout, FrameSection
from isocharge.serve.frames.text import TextParser

_STEP = re.compile(rb"[^\0\n]*[\0\n]|[^\0\n]+")


class AutoParser(Parser):
    """Bytes in, frames out, from the frames on by which the format was recognised; until then all bytes are dropped."""

    def __init__(self, columns: tuple[str, ...] = (), meanings: Mapping[str, str] | None = None) -> None:
        """Set up both parsers.

        Args:
            columns, meanings: As `TextParser` takes them.
        """
        super().__init__("nothing recognised yet")
        self._candidates: tuple[Parser, ...] = (BinaryParser(), TextParser(columns, meanings))

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that end within `data`."""
        if len(self._candidates) == 1:
            return self._feed(self._candidates[0], data)
        for step in _STEP.finditer(data):
            self.counts.drop(len(step.group()))
            for candidate in self._candidates:
                if frames := candidate.feed(step.group()):
                    self._candidates, self.counts = (candidate,), candidate.counts
                    return frames + self._feed(candidate, data[step.end() :])
        return []

    def forget(self) -> None:
        """Drop what is unfinished: what comes next is from another connection."""
        for candidate in self._candidates:
            candidate.forget()

    def _feed(self, chosen: Parser, data: bytes) -> list[Frame]:
        """What the chosen parser reads; it also knows format and moduli, and text learns them as it comes."""
        frames = chosen.feed(data)
        self.format, self.seq_modulus, self.t_us_modulus = chosen.format, chosen.seq_modulus, chosen.t_us_modulus
        return frames


class TextFrames(FrameSection, tag="text", frozen=True):
    """Lines of text.

    Attributes:
        columns: Names of the columns of a CSV.
        seq, t_us, t_ms, t_s: The names that the board has for its number and its clock.
    """

    columns: tuple[str, ...] = ()
    seq: str | None = None
    t_us: str | None = None
    t_ms: str | None = None
    t_s: str | None = None

    @property
    def meanings(self) -> Mapping[str, str]:
        """`seq`, `t_us`, `t_ms` or `t_s` by the name that the board has for it."""
        names = {self.seq: "seq", self.t_us: "t_us", self.t_ms: "t_ms", self.t_s: "t_s"}
        return {name: meaning for name, meaning in names.items() if name}

    def parser(self) -> Parser:
        """A new parser."""
        return TextParser(self.columns, self.meanings)


class AutoFrames(TextFrames, tag="auto", frozen=True):
    """Our binary frames or lines of text, whichever come."""

    def parser(self) -> Parser:
        """A new parser."""
        return AutoParser(self.columns, self.meanings)


class BinaryFrames(FrameSection, tag="binary", frozen=True):
    """Our binary frames."""

    def parser(self) -> Parser:
        """A new parser."""
        return BinaryParser()


Frames = AutoFrames | TextFrames | BinaryFrames | FrameLayout
