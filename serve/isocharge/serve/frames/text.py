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

from collections.abc import Mapping, Sequence

from isocharge.serve.frames.frame import (
    SEQ,
    SEQ_MODULUS,
    T_US_MODULUS,
    TIMES_US,
    Columns,
    CounterWrap,
    DelimitedParser,
    Frame,
)
from isocharge.serve.frames.text_lines import Line, Notation, parse_line

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


class Layout:
    """The layout of a row, or of a cycle of lines.

    Attributes:
        notation: How it is written.
        names: Names of all values; empty for CSV without header.
        width: Number of values.
        lines: Number of lines in a cycle; 1 for rows.
        columns: What the values are.
    """

    def __init__(self, notation: Notation, names: tuple[str, ...], width: int, lines: int = 1) -> None:
        self.notation, self.names, self.width, self.lines = notation, names, width, lines
        self.columns = Columns(names or ("",) * width, (1.0,) * width)


class TextParser(DelimitedParser):
    """Bytes in, frames out; the layout is recognised, and where number and clock wrap is learned.

    Attributes:
        layout: The layout; None before it is recognised.
    """

    def __init__(self, columns: tuple[str, ...] = (), meanings: Mapping[str, str] | None = None) -> None:
        """Set up the parser.

        Args:
            columns: Names for the columns of a CSV.
            meanings: `seq`, `t_us`, `t_ms` or `t_s` by the name that the device has for it.
        """
        super().__init__(b"\n", LONGEST_LINE, "text of a layout that is not clear yet")
        self.layout: Layout | None = None
        self._columns, self._meanings = columns, dict(meanings or {})
        self._seq_wrap = CounterWrap(SEQ_MODULI, SEQ_MODULUS, MOST_SEQ_STEPS)
        self._clock_wrap = clock_wrap(1.0)
        self._noise = b""
        self._gathered: list[tuple[Line, int]] = []
        self._cycle: dict[str, float] = {}
        self._cycle_bytes = 0
        self._is_first = True

    def forget(self) -> None:
        """Drop what is unfinished: what comes next is from another connection."""
        super().forget()
        self._drop_cycle()
        self._is_first = True
        self._seq_wrap.update(None)
        self._clock_wrap.update(None)

    def _take(self, piece: bytes) -> list[Frame]:
        size, is_first, self._is_first = len(piece) + 1, self._is_first, False
        try:
            line = parse_line(piece)
        except ValueError:
            if piece != self._noise:  # one that comes again is an echo: the lines around it stay gathered
                self._refuse_gathered()
            self._noise = piece
            return self._refuse(size)
        if self._meanings and line.names:
            line = line._replace(names=tuple(self._meanings.get(name, name) for name in line.names))
        if is_first and line.notation is Notation.csv:  # "801.2" may have been cut to "1.2": nothing would show it
            self._refuse_gathered()
            return self._refuse(size)
        if line.notation is Notation.nothing:
            return []
        if line.notation is Notation.header:
            return self._name_columns(line, size)
        return self._recognise(line, size) if self.layout is None else self._read(self.layout, line, size)

    def _refuse(self, size: int) -> list[Frame]:
        """Count a bad line."""
        self.counts.refuse(size)
        return []

    def _refuse_gathered(self) -> None:
        """Count the lines that were gathered to recognise a layout."""
        for _, size in self._gathered:
            self.counts.refuse(size)
        self._gathered = []

    def _name_columns(self, header: Line, size: int) -> list[Frame]:
        """Name the columns by a header; it comes again after a reset of the board."""
        layout = self.layout
        if layout is None:
            self._columns = self._columns or header.names
        elif layout.notation is Notation.csv and not self._columns and layout.width == len(header.names):
            self._adopt(Layout(Notation.csv, header.names, layout.width))
        else:
            return self._refuse(size)
        return []

    def _adopt(self, layout: Layout) -> None:
        self.layout, self._clock_wrap = layout, clock_wrap(layout.columns.us)
        names = ", ".join(layout.names) or f"{layout.width} columns without names"
        self.format = f"text, {layout.notation}: {names}"

    def _recognise(self, line: Line, size: int) -> list[Frame]:
        """Gather lines until they repeat; then read the gathered ones."""
        self._gathered.append((line, size))
        period = _period([gathered for gathered, _ in self._gathered])
        if not period or len(line.values) > MOST_VALUES:
            while len(self._gathered) > TIMES_TO_RECOGNISE * LONGEST_CYCLE:
                self._refuse(self._gathered.pop(0)[1])
            return []
        layout = self._layout([gathered for gathered, _ in self._gathered[-period:]])
        repeating = self._gathered[-TIMES_TO_RECOGNISE * period :]
        del self._gathered[-TIMES_TO_RECOGNISE * period :]
        self._refuse_gathered()
        self._adopt(layout)
        return [frame for gathered, length in repeating for frame in self._read(layout, gathered, length)]

    def _layout(self, lines: list[Line]) -> Layout:
        first, width = lines[0], len(lines[0].values)
        if len(lines) > 1:
            names = sorted({name for line in lines for name in line.names}, key=_before)
            return Layout(first.notation, tuple(names), len(names), len(lines))
        names_of_csv = self._columns if len(self._columns) == width else ()
        return Layout(first.notation, first.names or names_of_csv, width)

    def _read(self, layout: Layout, line: Line, size: int) -> list[Frame]:
        if line.notation is not layout.notation:
            return self._refuse(size)
        if layout.lines > 1:
            return self._gather(layout, line, size)
        if len(line.values) != layout.width or (line.names and line.names != layout.names):
            return self._refuse(size)
        return self._frame(layout, line.values, size)

    def _gather(self, layout: Layout, line: Line, size: int) -> list[Frame]:
        """Take a line of a cycle; the last one completes a frame. A clock may come with every value of a cycle."""
        new = [name for name in line.names if name not in TIMES_US]
        if not new or not set(line.names) <= set(layout.names):
            return self._refuse(size)
        begin = next(name for name in layout.names if name not in TIMES_US)
        if new[0] == begin or new[0] in self._cycle:
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
        frames = self._attempt(layout.columns.frame, values, size)
        for frame in frames:
            self.seq_modulus = self._seq_wrap.update(frame.seq)
            self.t_us_modulus = self._clock_wrap.update(frame.t_us)
        return frames


def clock_wrap(us: float) -> CounterWrap:
    """The watch over a clock in a unit, us: of 16, 24 or 32 bits, or computed from one of 32 bits in us or ms."""
    usual = {(1 << bits) * round(us) for bits in (16, 24, 32)} | {T_US_MODULUS, 1000 * T_US_MODULUS}
    return CounterWrap(sorted(usual), T_US_MODULUS * round(us), MOST_TIME_STEPS)


def _before(name: str) -> tuple[bool, str]:
    """Sort key: number and clock before the channels."""
    return name != SEQ and name not in TIMES_US, name


def _period(lines: list[Line]) -> int:
    """Number of lines in the cycle that has just come three times in a row, or 0; only named values make cycles."""
    signatures = [(line.notation, line.names, len(line.values)) for line in lines]
    last = signatures[-1]
    back = signatures[-2::-1]
    period = back.index(last) + 1 if last in back else 0
    if period > 1 and last[0] not in (Notation.pairs, Notation.teleplot):
        return 0
    tail = signatures[-TIMES_TO_RECOGNISE * period :] if period else []
    repeats = len(tail) == TIMES_TO_RECOGNISE * period and tail == tail[:period] * TIMES_TO_RECOGNISE
    return period if repeats else 0
