"""Frames of one described layout (`isocharge.serve.frames.frame_layout`) from bytes.

Where a checksum does not fit, the parser goes on by one byte, so a sync pattern inside the data costs no intact frame.
Stuffed frames end at their delimiter, and datagrams hold whole frames alone; there a wrong piece is dropped whole.
"""

from collections.abc import Sequence
from typing import Any

from isocharge.serve.frames.frame import T_US_MODULUS, Frame, FrameCounts, Splitter
from isocharge.serve.frames.frame_layout import DATAGRAM, FLAGS, FrameLayout
from isocharge.serve.frames.sequence import SEQ_MODULUS
from isocharge.serve.frames.stuffing import STUFFINGS, Stuffing
from isocharge.serve.frames.text_lines import SEQ, TIMES_US


class DescribedParser:
    """Bytes in, frames out, for one layout."""

    def __init__(self, layout: FrameLayout) -> None:
        self.counts = FrameCounts()
        self.layout = layout
        self.format = f"described frames of {layout.length} bytes: {', '.join(field.name for field in layout.fields)}"
        self._names = tuple(field.name for field in layout.channels)
        positions = {field.name: position for position, field in enumerate(layout.fields)}
        self._channels = [(positions[field.name], field.scale) for field in layout.channels]
        self._seq, self._flags = positions.get(SEQ), positions.get(FLAGS)
        self._time = next((positions[name] for name in TIMES_US if name in positions), None)
        self._us = self._unit()
        self._has_triples = any(field.is_triple for field in layout.fields)
        self._tail = b""

    def _unit(self) -> float:
        """The time of one count of the clock, us."""
        clock = self.layout.fields[self._time] if self._time is not None else None
        return TIMES_US[clock.name] * clock.scale if clock else 1.0

    @property
    def seq_modulus(self) -> int:
        """The number at which the field `seq` wraps to 0."""
        return SEQ_MODULUS if self._seq is None else self.layout.fields[self._seq].modulus

    @property
    def t_us_modulus(self) -> int:
        """The time at which the clock's field wraps to 0, us."""
        return T_US_MODULUS if self._time is None else round(self.layout.fields[self._time].modulus * self._us)

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that end within `data`; an unfinished one waits for the next call."""
        data, at, frames, length = self._tail + data, 0, [], self.layout.length
        while (start := data.find(self.layout.sync, at)) >= 0 and start + length <= len(data):
            self._skip(start - at)
            frame = self._decode(data[start : start + length])
            at = start + (1 if frame is None else length)
            frames += [] if frame is None else [frame]
        unfinished = start if start >= 0 else max(at, len(data) - len(self.layout.sync) + 1)
        self._skip(unfinished - at)
        self._tail = data[unfinished:]
        return frames

    def forget(self) -> None:
        """Drop what is unfinished: what comes next is from another connection."""
        self._skip(len(self._tail))
        self._tail = b""

    def _skip(self, size: int) -> None:
        if size:
            self.counts.drop(size)

    def _decode(self, data: bytes) -> Frame | None:
        """The frame in exactly these bytes; None, which is counted, if its checksum, number or clock is wrong."""
        return self._read(data, 1)

    def _read(self, data: bytes, dropped: int) -> Frame | None:
        """The frame in exactly these bytes, or None; `dropped` are the bytes that a wrong one costs."""
        layout = self.layout
        end = len(data) - layout.check.size
        if layout.check.size and layout.checked(data[:end]) != data[end:]:
            self.counts.refuse(dropped, damaged=True)
            return None
        try:
            if layout.constants and any(not data.startswith(constant, at) for at, constant in layout.constants):
                raise ValueError("other constant bytes than the layout's")
            frame = self._frame(
                layout.counts(data) if self._has_triples else layout.body.unpack_from(data, len(layout.sync))
            )
        except (OverflowError, ValueError):  # a number or clock in floating point may be NaN or infinite
            self.counts.refuse(dropped)
            return None
        self.counts.accept()
        return frame

    def _frame(self, counts: Sequence[Any]) -> Frame:
        return Frame(
            None if self._seq is None else int(counts[self._seq]),
            None if self._time is None else round(counts[self._time] * self._us),
            tuple(counts[position] * scale for position, scale in self._channels),
            0 if self._flags is None else int(counts[self._flags]),
            self._names,
        )


class StuffedParser(DescribedParser):
    """Bytes in, frames out, for a layout with byte stuffing."""

    def __init__(self, layout: FrameLayout, stuffing: Stuffing) -> None:
        super().__init__(layout)
        self._decode_piece = stuffing.decode
        self._pieces = Splitter(stuffing.delimiter, 2 * layout.length + 2, self.counts)

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that end within `data`; the bytes after the last delimiter wait for the next call."""
        pieces = (piece for piece in self._pieces.feed(data) if piece)  # an empty one is an idle line
        return [frame for piece in pieces if (frame := self._take(piece)) is not None]

    def forget(self) -> None:
        """Drop what is unfinished: what comes next is from another connection."""
        self._pieces.forget()

    def _take(self, piece: bytes) -> Frame | None:
        try:
            data = self._decode_piece(piece)
        except ValueError:
            data = b""
        if len(data) != self.layout.length or not data.startswith(self.layout.sync):
            self.counts.refuse(len(piece) + 1)
            return None
        return self._read(data, len(piece) + 1)


class DatagramParser(DescribedParser):
    """Datagrams in, frames out: each chunk is a datagram, which holds one or more whole frames."""

    def feed(self, data: bytes) -> list[Frame]:
        """The frames of a datagram."""
        length = self.layout.length
        if len(data) % length:
            self.counts.refuse(len(data))
            return []
        pieces = [data[at : at + length] for at in range(0, len(data), length)]
        return [frame for piece in pieces if (frame := self._take(piece)) is not None]

    def _take(self, data: bytes) -> Frame | None:
        if data.startswith(self.layout.sync):
            return self._read(data, len(data))
        self.counts.refuse(len(data))
        return None


def described_parser(layout: FrameLayout) -> DescribedParser:
    """A new parser for frames of this layout, whatever their framing."""
    if layout.framing in STUFFINGS:
        return StuffedParser(layout, STUFFINGS[layout.framing])
    return DatagramParser(layout) if layout.framing == DATAGRAM else DescribedParser(layout)
