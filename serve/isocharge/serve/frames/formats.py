"""The formats of frames that a device file can name in `[frames] format`, each with its keys and its parser."""

from collections.abc import Mapping
from typing import Any

from isocharge.common.errors import DeviceError
from isocharge.common.structs import convert
from isocharge.serve.frames.autodetect import AutoParser
from isocharge.serve.frames.binary import BinaryParser
from isocharge.serve.frames.frame import Parser
from isocharge.serve.frames.frame_layout import FrameLayout, FrameSection
from isocharge.serve.frames.layout_parser import described_parser
from isocharge.serve.frames.text import TextParser


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


class DescribedFrames(FrameLayout, tag="described", frozen=True):
    """Frames of a described layout."""

    def parser(self) -> Parser:
        """A new parser."""
        return described_parser(self)


def frame_layout(table: Mapping[str, Any], where: str) -> DescribedFrames:
    """Read the keys of a described frame; `where` opens messages.

    Raises:
        DeviceError: If a key is missing, unknown or wrong, or the length is not that of the fields.
    """
    return convert({"format": "described", **table}, DescribedFrames, where, DeviceError)


Frames = AutoFrames | TextFrames | BinaryFrames | DescribedFrames
