"""Frames of one described layout (`isocharge.serve.frames.frame_layout`) from bytes.

Where a checksum does not fit, the parser goes on by one byte, so a sync pattern inside the data costs no intact frame.
Stuffed frames end at their delimiter, and datagrams hold whole frames alone; there a wrong piece is dropped whole.
"""

from isocharge.serve.frames.frame import DelimitedParser, Frame, Parser
from isocharge.serve.frames.frame_layout import DATAGRAM, FrameLayout
from isocharge.serve.frames.stuffing import STUFFINGS, Stuffing


def _about(layout: FrameLayout) -> tuple[str, int, int]:
    """The format for people, and where number and clock wrap."""
    names = ", ".join(field.name for field in layout.fields)
    return f"described frames of {layout.length} bytes: {names}", layout.seq_modulus, layout.t_us_modulus


class DescribedParser(Parser):
    """Bytes in, frames out, for a layout whose frames begin with a sync pattern."""

    def __init__(self, layout: FrameLayout) -> None:
        super().__init__(*_about(layout))
        self.layout = layout

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that end within `data`; an unfinished one waits for the next call."""
        sync, length, decode = self.layout.sync, self.layout.length, self.layout.decode
        data, at, frames = self._tail + data, 0, []
        while (start := data.find(sync, at)) >= 0 and start + length <= len(data):
            if start > at:
                self.counts.drop(start - at)
            read = self._attempt(decode, data[start : start + length], 1)
            at = start + (length if read else 1)
            frames += read
        unfinished = start if start >= 0 else max(at, len(data) - len(sync) + 1)
        self.counts.drop(unfinished - at)
        self._tail = data[unfinished:]
        return frames


class StuffedParser(DelimitedParser):
    """Bytes in, frames out, for a layout with byte stuffing."""

    def __init__(self, layout: FrameLayout, stuffing: Stuffing) -> None:
        super().__init__(stuffing.delimiter, 2 * layout.length + 2, *_about(layout))
        self.layout, self._unstuffed = layout, stuffing.decode

    def _take(self, piece: bytes) -> list[Frame]:
        """The frame of a piece; an empty one is an idle line."""
        return self._attempt(self._decode, piece, len(piece) + 1) if piece else []

    def _decode(self, piece: bytes) -> Frame:
        data = self._unstuffed(piece)
        if len(data) != self.layout.length or not data.startswith(self.layout.sync):
            raise ValueError("another length or sync")
        return self.layout.decode(data)


class DatagramParser(DescribedParser):
    """Datagrams in, frames out: each chunk is a datagram, which holds one or more whole frames."""

    def feed(self, data: bytes) -> list[Frame]:
        """The frames of a datagram."""
        length = self.layout.length
        if len(data) % length:
            self.counts.refuse(len(data))
            return []
        pieces = [data[at : at + length] for at in range(0, len(data), length)]
        return [frame for piece in pieces for frame in self._attempt(self._decode, piece, length)]

    def _decode(self, piece: bytes) -> Frame:
        if not piece.startswith(self.layout.sync):
            raise ValueError("another sync")
        return self.layout.decode(piece)


def described_parser(layout: FrameLayout) -> DescribedParser | StuffedParser:
    """A new parser for frames of this layout, whatever their framing."""
    if layout.framing in STUFFINGS:
        return StuffedParser(layout, STUFFINGS[layout.framing])
    return DatagramParser(layout) if layout.framing == DATAGRAM else DescribedParser(layout)
