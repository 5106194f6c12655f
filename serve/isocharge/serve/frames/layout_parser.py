"""Frames of one described layout (`isocharge.serve.frames.frame_layout`) from bytes.

Where a checksum does not fit, the parser goes on by one byte, so a sync pattern inside the data costs no intact frame.
"""

from collections.abc import Sequence
from typing import Any

from isocharge.serve.frames.frame import T_US_MODULUS, Frame, FrameCounts
from isocharge.serve.frames.frame_layout import FLAGS, FrameLayout
from isocharge.serve.frames.sequence import SEQ_MODULUS
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
        end = len(data) - self.layout.check.size
        if self.layout.checked(data[:end]) != data[end:]:
            self.counts.refuse(1, damaged=True)
            return None
        try:
            frame = self._frame(self.layout.body.unpack_from(data, len(self.layout.sync)))
        except (OverflowError, ValueError):  # a number or clock in floating point may be NaN or infinite
            self.counts.refuse(1)
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
