"""Recognition of what a board sends: our binary frames or lines of text. Described frames need a device file.

Both parsers read the bytes until one of them has a frame: a binary frame whose checksum fits, or a text layout that
came three times in a row. The bytes are cut where either of them could end a frame, so chunks do not matter.
"""

import re
from collections.abc import Mapping

from isocharge.serve.frames.binary import BinaryParser
from isocharge.serve.frames.frame import Frame, Parser
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
