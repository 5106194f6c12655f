"""Parser of frames in lines of text. The layout of the lines is recognised from the first good lines.

A board sends one row of numbers for each frame, or a cycle of several lines with one name each. The layout is
recognised when the same row or the same cycle has occurred three times in succession. After recognition, lines of
another layout are dropped and counted.

Reading may start in the middle of a cycle. The lines are therefore sorted by name, with the frame counter and the clock
before the channels, and the first line of this order begins the cycle. Reading may also start in the middle of a line,
so a first line of numbers without names is dropped.

Text has no checksum, except for sentences in the style of NMEA 0183. A damaged digit in an otherwise intact line is
therefore not detected. A line without a reading that occurs repeatedly, such as the echo of a request, is dropped and
does not prevent recognition.

A column with the name `seq` is the frame counter. A column with the name `t_us`, `t_ms` or `t_s` is the clock of the
device. All other names are channels. The values at which the counter and the clock wrap are learned when they wrap for
the first time.
"""

from collections.abc import Mapping, Sequence

from isocharge.common.printable_text import printable
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

MAX_LINE_LENGTH = 4096
"""Length of the longest line that is read, bytes."""

MAX_CYCLE_LINES = 64
"""Largest number of lines that make one frame."""

RECOGNITION_REPEATS = 3
"""Number of times that a layout must occur in a row to be recognised."""

MAX_VALUES = 256
"""Largest number of values in a line."""

SEQ_MODULI = (100, 256, 1000, 10_000, SEQ_MODULUS, 1 << 32)
"""Values at which frame counters usually wrap."""

MAX_SEQ_STEPS = 2
"""Largest step of the frame counter across a wrap, as a multiple of the previous step."""

MAX_TIME_STEPS = 16
"""Largest step of the clock across a wrap, as a multiple of the previous step."""


class Layout:
    """Layout of the values in one line, or in a cycle of several lines.

    Attributes:
        columns: Meaning of each value.
    """

    def __init__(self, notation: Notation, names: tuple[str, ...], width: int, lines: int = 1) -> None:
        """Store the layout.

        Args:
            notation: Notation of the lines.
            names: Names of all values; empty for a CSV without a header.
            width: Number of values.
            lines: Number of lines in a cycle; 1 for rows.
        """
        self.notation = notation
        self.names = names
        self.width = width
        self.lines = lines
        self.columns = Columns(names or ("",) * width, (1.0,) * width)


class TextParser(DelimitedParser):
    """Parser of lines of text, which recognises their layout.

    Attributes:
        layout: The layout; None until it is recognised.
    """

    def __init__(self, columns: tuple[str, ...] = (), meanings: Mapping[str, str] | None = None) -> None:
        """Begin without a layout.

        Args:
            columns: Names for the columns of a CSV.
            meanings: `seq`, `t_us`, `t_ms` or `t_s` by the name that the device uses.
        """
        super().__init__(b"\n", MAX_LINE_LENGTH, "text of a layout that is not clear yet")
        self.layout: Layout | None = None
        self._columns = columns
        self._meanings = dict(meanings or {})
        self._seq_wrap = CounterWrap(SEQ_MODULI, SEQ_MODULUS, MAX_SEQ_STEPS)
        self._clock_wrap = clock_wrap(1.0)
        self._last_unreadable_line = b""
        self._is_first_line = True

        # Lines from which the layout is recognised, with their sizes in bytes
        self._unrecognised: list[tuple[Line, int]] = []

        # Values by name, and number of bytes, of the present cycle of lines
        self._cycle_values: dict[str, float] = {}
        self._cycle_bytes = 0

    def reset(self) -> None:
        """Drop an unfinished frame, because the next bytes come from another connection."""
        super().reset()
        self._drop_cycle()
        self._is_first_line = True
        self._seq_wrap.update(None)
        self._clock_wrap.update(None)

    def _parse_piece(self, piece: bytes) -> list[Frame]:
        """Return the frames that a line completes. While the layout is not known, the line is used to recognise it."""
        size = len(piece) + 1  # with the line feed
        is_first_line = self._is_first_line
        self._is_first_line = False
        try:
            line = parse_line(piece)
        except ValueError:
            return self._reject_unreadable(piece, size)
        if self._meanings and line.names:
            line = line._replace(names=tuple(self._meanings.get(name, name) for name in line.names))

        # A first line may have lost its beginning: "801.2" cut to "1.2" is still a number.
        if is_first_line and line.notation is Notation.csv:
            self._reject_unrecognised()
            return self._reject(size)
        if line.notation is Notation.nothing:
            return []
        if line.notation is Notation.header:
            return self._name_columns(line, size)
        if self.layout is None:
            return self._recognise(line, size)
        return self._read(self.layout, line, size)

    def _reject(self, size: int) -> list[Frame]:
        """Count a rejected line."""
        self.counts.count_rejected(size)
        return []

    def _reject_unreadable(self, piece: bytes, size: int) -> list[Frame]:
        """Count a line that cannot be parsed.

        A line that is equal to the previous line that could not be parsed is the echo of a request. The other lines are
        then kept for recognition.

        Args:
            piece: The line.
            size: Number of bytes of the line.
        """
        if piece != self._last_unreadable_line:
            self._reject_unrecognised()
        self._last_unreadable_line = piece
        return self._reject(size)

    def _reject_unrecognised(self) -> None:
        """Count the lines that were collected to recognise a layout, and drop them."""
        for _, size in self._unrecognised:
            self.counts.count_rejected(size)
        self._unrecognised = []

    def _name_columns(self, header: Line, size: int) -> list[Frame]:
        """Use the names in a header as the names of the columns, unless the columns already have names.

        The header is counted as rejected if the columns cannot have its names. Such a header appears if the board was
        reset, or if a line only looks like a header. The result is always empty.

        Args:
            header: The header.
            size: Number of bytes of the line.
        """
        if self.layout is None:
            if not self._columns:
                self._columns = header.names
            return []
        can_be_named = self.layout.notation is Notation.csv and not self._columns
        if can_be_named and self.layout.width == len(header.names):
            self._set_layout(Layout(Notation.csv, header.names, self.layout.width))
            return []
        return self._reject(size)

    def _set_layout(self, layout: Layout) -> None:
        """Use a layout for all further lines."""
        self.layout = layout
        self._clock_wrap = clock_wrap(layout.columns.time_unit_us)
        names = ", ".join(layout.names) or f"{layout.width} columns without names"
        self.format = f"text, {layout.notation}: {printable(names)}"

    def _recognise(self, line: Line, size: int) -> list[Frame]:
        """Collect lines until their layout repeats, and return the frames in the lines with this layout.

        Until then, the result is empty. The lines before the repeated lines are counted as rejected.

        Args:
            line: The next line.
            size: Number of bytes of the line.
        """
        self._unrecognised.append((line, size))
        period = _period([collected for collected, _ in self._unrecognised])
        is_recognised = period > 0 and len(line.values) <= MAX_VALUES
        if not is_recognised:
            while len(self._unrecognised) > RECOGNITION_REPEATS * MAX_CYCLE_LINES:
                _, oldest_size = self._unrecognised.pop(0)
                self._reject(oldest_size)
            return []

        # The last lines form `RECOGNITION_REPEATS` cycles of `period` lines. The lines before them are rejected.
        first_repeated = len(self._unrecognised) - RECOGNITION_REPEATS * period
        repeated_lines = self._unrecognised[first_repeated:]
        self._unrecognised = self._unrecognised[:first_repeated]
        self._reject_unrecognised()

        # One cycle determines the layout, with which all repeated lines are read.
        first_cycle = [cycle_line for cycle_line, _ in repeated_lines[:period]]
        layout = self._layout_of(first_cycle)
        self._set_layout(layout)
        frames = []
        for repeated_line, repeated_size in repeated_lines:
            frames += self._read(layout, repeated_line, repeated_size)
        return frames

    def _layout_of(self, lines: list[Line]) -> Layout:
        """Return the layout of the lines of one cycle, which is a single line for most boards.

        The values of a single line without names get the names of the columns if there are as many columns as values.
        """
        first_line = lines[0]
        if len(lines) > 1:
            names = sorted({name for line in lines for name in line.names}, key=_sort_key)
            return Layout(first_line.notation, tuple(names), len(names), len(lines))
        width = len(first_line.values)
        names_of_row = first_line.names
        if not names_of_row and len(self._columns) == width:
            names_of_row = self._columns
        return Layout(first_line.notation, names_of_row, width)

    def _read(self, layout: Layout, line: Line, size: int) -> list[Frame]:
        """Return the frame that a line completes, in a list; empty if the line completes no frame or is rejected.

        Args:
            layout: The layout of the lines.
            line: The line.
            size: Number of bytes of the line.
        """
        if line.notation is not layout.notation:
            return self._reject(size)
        if layout.lines > 1:
            return self._read_cycle_line(layout, line, size)
        has_other_names = bool(line.names) and line.names != layout.names
        if len(line.values) != layout.width or has_other_names:
            return self._reject(size)
        return self._frame(layout, line.values, size)

    def _read_cycle_line(self, layout: Layout, line: Line, size: int) -> list[Frame]:
        """Store the values of a line of a cycle, and return the frame if the cycle is complete.

        Each line of a cycle may contain the clock in addition to its value. A cycle begins with the first name of the
        layout, or with a name that the present cycle already has.

        Args:
            layout: The layout of the lines.
            line: The line.
            size: Number of bytes of the line.
        """
        names = [name for name in line.names if name not in TIMES_US]
        if not names or not set(line.names) <= set(layout.names):
            return self._reject(size)
        first_name = next(name for name in layout.names if name not in TIMES_US)
        begins_cycle = names[0] == first_name or names[0] in self._cycle_values
        if begins_cycle:
            self._drop_cycle()
        self._cycle_values |= dict(zip(line.names, line.values, strict=True))
        self._cycle_bytes += size
        is_incomplete = len(self._cycle_values) < layout.width
        if is_incomplete:
            return []

        values = [self._cycle_values[name] for name in layout.names]
        cycle_bytes = self._cycle_bytes
        self._clear_cycle()
        return self._frame(layout, values, cycle_bytes)

    def _drop_cycle(self) -> None:
        """Count the lines of an unfinished cycle as dropped."""
        if self._cycle_values:
            self.counts.count_rejected(self._cycle_bytes)
        self._clear_cycle()

    def _clear_cycle(self) -> None:
        """Begin a new cycle of lines."""
        self._cycle_values = {}
        self._cycle_bytes = 0

    def _frame(self, layout: Layout, values: Sequence[float], size: int) -> list[Frame]:
        """Return a list with the frame that the values form, and update the moduli of the counter and the clock.

        Args:
            layout: The layout of the lines.
            values: Value of each column.
            size: Number of bytes that are dropped if the values are no frame.
        """
        frames = self._attempt(layout.columns.frame, values, size)
        for frame in frames:
            self.seq_modulus = self._seq_wrap.update(frame.seq)
            self.t_us_modulus = self._clock_wrap.update(frame.t_us)
        return frames


def clock_wrap(unit_us: float) -> CounterWrap:
    """Return the object that learns where a clock wraps.

    The clock may have 16, 24 or 32 bits, or may be computed from a 32-bit clock in us or ms.

    Args:
        unit_us: Unit of the clock, us.
    """
    unit = round(unit_us)
    usual_moduli = {T_US_MODULUS, 1000 * T_US_MODULUS}
    for bits in (16, 24, 32):
        usual_moduli.add((1 << bits) * unit)
    return CounterWrap(sorted(usual_moduli), T_US_MODULUS * unit, MAX_TIME_STEPS)


def _sort_key(name: str) -> tuple[bool, str]:
    """Return a key that sorts frame counter and clock before the channels."""
    is_channel = name != SEQ and name not in TIMES_US
    return is_channel, name


def _period(lines: list[Line]) -> int:
    """Return the number of lines in the cycle that has just occurred `RECOGNITION_REPEATS` times in succession.

    Two lines are equal if they have the same notation, the same names and the same number of values. The result is 0 if
    there is no cycle. Only lines with names form cycles of several lines.

    Args:
        lines: The latest lines, at least one.
    """
    signatures = [(line.notation, line.names, len(line.values)) for line in lines]
    *earlier_signatures, last_signature = signatures
    if last_signature not in earlier_signatures:
        return 0

    # The cycle begins again with the previous line that equals the last line.
    lines_back_to_front = earlier_signatures[::-1]
    period = lines_back_to_front.index(last_signature) + 1
    has_names = lines[-1].notation in (Notation.pairs, Notation.teleplot)
    if period > 1 and not has_names:
        return 0
    recent_signatures = signatures[-RECOGNITION_REPEATS * period :]
    is_repeated = recent_signatures == recent_signatures[:period] * RECOGNITION_REPEATS
    return period if is_repeated else 0
