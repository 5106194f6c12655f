"""Frames from lines of text, whose layout is recognised from the first good lines.

A layout is recognised when it has come three times in a row: three rows of the same width or names, or three times the
same cycle of lines with one name each. A reader may start in the middle of a cycle, so a cycle begins with the name
that sorts first, number and clock before channels; for the same reason a first line of bare numbers is dropped. After
recognition a line of another layout is dropped and counted. Text has no checksum, but for sentences in the manner of
NMEA: a damaged digit in an otherwise whole line cannot be noticed. A line that is no reading and comes again and again,
such as the echo of a request, is dropped and hinders no recognition.

Some names mean something: `seq` counts frames; `t_us`, `t_ms` or `t_s` is the device's clock. All others are channels.
Where number or clock wrap is learned when they do.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from isocharge.serve.frames.frame import T_US_MODULUS, Frame, FrameCounts, Splitter
from isocharge.serve.frames.sequence import SEQ_MODULUS, CounterWrap
from isocharge.serve.frames.text_lines import SEQ, TIMES_US, Line, Notation, parse_line

LONGEST_LINE = 4096
"""Longest line of a frame, bytes."""

LONGEST_CYCLE = 64
"""Largest number of lines that make a frame."""

TIMES_TO_RECOGNISE = 3
"""Number of times that a layout must come in a row to be recognised."""

MOST_VALUES = 256
"""Largest number of values in a line."""

SEQ_MODULI = (100, 256, 1000, 10_000, SEQ_MODULUS, 1 << 32)
"""Numbers at which counters of frames wrap."""

MOST_SEQ_STEPS, MOST_TIME_STEPS = 2, 16
"""Largest step of number and clock over a wrap, in steps before it."""


@dataclass(frozen=True, slots=True)
class Layout:
    """The layout of a row, or of a cycle of lines.

    Attributes:
        notation: How it is written.
        names: Names of all values; empty for CSV without header.
        width: Number of values.
        lines: Number of lines in a cycle; 1 for rows.
        channels: Positions of the channels among the values.
        seq, time: Positions of number and clock; None without them.
        us: Unit of the clock, us.
    """

    notation: Notation
    names: tuple[str, ...]
    width: int
    lines: int
    channels: tuple[int, ...]
    seq: int | None
    time: int | None
    us: float

    @classmethod
    def of(cls, notation: Notation, names: tuple[str, ...], width: int, lines: int) -> "Layout":
        """The layout of values with these names."""
        seq = names.index(SEQ) if SEQ in names else None
        time = next((names.index(name) for name in TIMES_US if name in names), None)
        channels = tuple(at for at in range(width) if at not in (seq, time))
        return cls(notation, names, width, lines, channels, seq, time, 1.0 if time is None else TIMES_US[names[time]])

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels; empty if they have none."""
        return tuple(self.names[at] for at in self.channels) if self.names else ()

    def frame(self, values: Sequence[float]) -> Frame:
        """The frame of a row.

        Raises:
            ValueError: If number or clock is not finite.
        """
        seq = None if self.seq is None else _whole(values[self.seq])
        t_us = None if self.time is None else _whole(values[self.time] * self.us)
        return Frame(seq, t_us, tuple(values[at] for at in self.channels), names=self.channel_names)


def _whole(value: float) -> int:
    if not math.isfinite(value):
        raise ValueError(f"expected a number or time, got {value}")
    return round(value)


class TextParser:
    """Bytes in, frames out; the layout is recognised."""

    def __init__(self, columns: tuple[str, ...] = (), meanings: Mapping[str, str] | None = None) -> None:
        """Set up the parser.

        Args:
            columns: Names for the columns of a CSV.
            meanings: `seq`, `t_us`, `t_ms` or `t_s` by the name that the device has for it.
        """
        self.counts = FrameCounts()
        self.layout: Layout | None = None
        self._columns, self._meanings = columns, dict(meanings or {})
        self._seq_wrap = CounterWrap(SEQ_MODULI, SEQ_MODULUS, MOST_SEQ_STEPS)
        self._clock_wrap: CounterWrap | None = None
        self._noise = b""
        self._lines = Splitter(b"\n", LONGEST_LINE, self.counts)
        self._history: list[tuple[Line, int]] = []
        self._cycle: dict[str, float] = {}
        self._cycle_bytes = 0
        self._first = True

    @property
    def seq_modulus(self) -> int:
        """The number at which a frame's `seq` wraps to 0; 16 bits until it has wrapped."""
        return self._seq_wrap.modulus

    @property
    def t_us_modulus(self) -> int:
        """The time at which the clock wraps to 0, us; that of 32 bits in its unit until it has wrapped."""
        return self._clock_wrap.modulus if self._clock_wrap else T_US_MODULUS

    @property
    def format(self) -> str:
        """The layout, for people."""
        if self.layout is None:
            return "text of a layout that is not clear yet"
        names = ", ".join(self.layout.names) or f"{self.layout.width} columns without names"
        return f"text, {self.layout.notation}: {names}"

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that end within `data`; an unfinished line waits for the next call."""
        return [frame for line in self._lines.feed(data) for frame in self._take(line)]

    def forget(self) -> None:
        """Drop what is unfinished: what comes next is from another connection."""
        self._lines.forget()
        self._drop_cycle()
        self._first = True
        self._seq_wrap.forget()
        if self._clock_wrap:
            self._clock_wrap.forget()

    def _take(self, data: bytes) -> list[Frame]:
        """The frames that this line completes, usually one."""
        size, first, self._first = len(data) + 1, self._first, False
        try:
            line = parse_line(data)
        except ValueError:
            self._refuse_noise(data, size)
            return []
        if self._meanings and line.names:
            line = line._replace(names=tuple(self._meanings.get(name, name) for name in line.names))
        if first and line.notation is Notation.csv:  # "801.2" may have been cut to "1.2": nothing would show it
            self._refuse(size)
            return []
        if line.notation is Notation.nothing:
            return []
        if line.notation is Notation.header:
            return self._name_columns(line, size)
        return self._recognise(line, size) if self.layout is None else self._read(line, size)

    def _refuse_noise(self, data: bytes, size: int) -> None:
        """Count a line that is no reading; one that comes again is an echo, and the lines round it stay gathered."""
        if data == self._noise:
            self.counts.refuse(size)
            return
        self._noise = data
        self._refuse(size)

    def _refuse(self, size: int) -> None:
        """Count a bad line, and drop the lines that were gathered to recognise a layout."""
        self.counts.refuse(size)
        for _, length in self._history:
            self.counts.refuse(length)
        self._history.clear()

    def _name_columns(self, header: Line, size: int) -> list[Frame]:
        """Name the columns by a header; it comes again after a reset of the board."""
        if self.layout is not None and (self.layout.notation is not Notation.csv or self._columns):
            self.counts.refuse(size)
        elif self.layout is not None and self.layout.width == len(header.names):
            self.layout = Layout.of(Notation.csv, header.names, self.layout.width, 1)
        elif self.layout is None and not self._columns:
            self._columns = header.names
        return []

    def _recognise(self, line: Line, size: int) -> list[Frame]:
        """Gather lines until they repeat; then read the gathered ones."""
        self._history.append((line, size))
        period = _period([gathered for gathered, _ in self._history])
        if not period or len(line.values) > MOST_VALUES:
            while len(self._history) > TIMES_TO_RECOGNISE * LONGEST_CYCLE:
                self.counts.refuse(self._history.pop(0)[1])
            return []
        self.layout = self._layout([gathered for gathered, _ in self._history[-period:]])
        history, self._history = self._history, []
        before, repeating = history[: -TIMES_TO_RECOGNISE * period], history[-TIMES_TO_RECOGNISE * period :]
        for _, length in before:
            self.counts.refuse(length)
        return [frame for gathered, length in repeating for frame in self._read(gathered, length)]

    def _layout(self, lines: list[Line]) -> Layout:
        first, width = lines[0], len(lines[0].values)
        if len(lines) > 1:
            names = sorted({name for line in lines for name in line.names}, key=_before)
            return Layout.of(first.notation, tuple(names), len(names), len(lines))
        names_of_csv = self._columns if len(self._columns) == width else ()
        return Layout.of(first.notation, first.names or names_of_csv, width, 1)

    def _read(self, line: Line, size: int) -> list[Frame]:
        layout = self.layout
        assert layout is not None
        if line.notation is not layout.notation:
            self.counts.refuse(size)
            return []
        if layout.lines > 1:
            return self._gather(layout, line, size)
        if len(line.values) != layout.width or (line.names and line.names != layout.names):
            self.counts.refuse(size)
            return []
        return self._frame(layout, line.values, size)

    def _gather(self, layout: Layout, line: Line, size: int) -> list[Frame]:
        """Take a line of a cycle; the last one completes a frame."""
        new = [name for name in line.names if name not in TIMES_US]
        if not set(line.names) <= set(layout.names) or not new:
            self.counts.refuse(size)
            return []
        if new[0] == _start(layout) or new[0] in self._cycle:
            self._drop_cycle()
        self._cycle |= dict(zip(line.names, line.values, strict=True))
        self._cycle_bytes += size
        if len(self._cycle) < layout.width:
            return []
        values, size = [self._cycle[name] for name in layout.names], self._cycle_bytes
        self._cycle, self._cycle_bytes = {}, 0
        return self._frame(layout, values, size)

    def _drop_cycle(self) -> None:
        """Count the lines of an unfinished cycle as dropped."""
        if self._cycle:
            self.counts.refuse(self._cycle_bytes)
        self._cycle, self._cycle_bytes = {}, 0

    def _frame(self, layout: Layout, values: Sequence[float], size: int) -> list[Frame]:
        try:
            frame = layout.frame(values)
        except ValueError:
            self.counts.refuse(size)
            return []
        self.counts.accept()
        if frame.seq is not None:
            self._seq_wrap.update(frame.seq)
        if frame.t_us is not None:
            if self._clock_wrap is None:
                self._clock_wrap = clock_wrap(layout.us)
            self._clock_wrap.update(frame.t_us)
        return [frame]


def clock_wrap(us: float) -> CounterWrap:
    """The watch over a clock in a unit, us: of 16, 24 or 32 bits, or computed from one of 32 bits in us or ms."""
    moduli = {1 << bits for bits in (16, 24, 32)}
    usual = {modulus * round(us) for modulus in moduli} | {T_US_MODULUS, 1000 * T_US_MODULUS}
    return CounterWrap(sorted(usual), T_US_MODULUS * round(us), MOST_TIME_STEPS)


def _before(name: str) -> tuple[bool, str]:
    """Sort key: number and clock before the channels."""
    return name != SEQ and name not in TIMES_US, name


def _start(layout: Layout) -> str:
    """The name that begins a cycle; a clock may come with every value, so it is no beginning."""
    return next(name for name in layout.names if name not in TIMES_US)


def _period(lines: list[Line]) -> int:
    """Number of lines in the cycle that has just come three times in a row, or 0; only named values make cycles."""
    signatures = [line.signature for line in lines]
    last = signatures[-1]
    back = signatures[-2::-1]
    period = back.index(last) + 1 if last in back else 0
    if period > 1 and last[0] not in (Notation.pairs, Notation.teleplot):
        return 0
    tail = signatures[-TIMES_TO_RECOGNISE * period :] if period else []
    repeats = len(tail) == TIMES_TO_RECOGNISE * period and tail == tail[:period] * TIMES_TO_RECOGNISE
    return period if repeats else 0
