"""Parser for boards that send frames as lines of text.

A board sends each frame either as a single line or as a cycle of several lines. Each line of a cycle contains a part of
the frame. The parser recognises the layout as soon as the same kind of line, or the same cycle of lines, has occurred
three times in succession. After the recognition, lines with another layout are dropped and counted.

Reading may start in the middle of a cycle. The lines of a cycle are therefore sorted by name, with the frame counter
and the clock before the channels. A cycle begins with the line whose name comes first in the sorted order.

Reading may also start in the middle of a line. If the first line contains numbers without names, it is therefore
dropped and counted as malformed. This also applies to files and pipes, because their bytes usually come from a port,
for example from `cat /dev/ttyACM0`. A program that begins with a complete line can send a header, a comment or a blank
line first. No frame is then dropped.

Text has no checksum, except for sentences in the style of NMEA 0183. The parser therefore cannot detect a damaged digit
in an otherwise intact line. If the same line occurs repeatedly but cannot be parsed, for example because it is the echo
of a request, the line is dropped. Such a line does not prevent the recognition of the layout.

A column with the name `seq` is the frame counter. A column with the name `t_us`, `t_ms` or `t_s` is the clock of the
device. All other columns are channels. At first, the values at which the counter and the clock wrap to 0 are unknown.
The parser estimates each value when the counter or the clock wraps for the first time.
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
"""Length of the longest line that is parsed, bytes."""

MAX_CYCLE_LINES = 64
"""Largest number of lines that make one frame."""

RECOGNITION_REPEATS = 3
"""Number of times in succession that a layout must occur before it is recognised."""

MAX_VALUES = 256
"""Largest number of values in a line."""

SEQ_MODULI = (100, 256, 1000, 10_000, SEQ_MODULUS, 1 << 32)
"""Values at which frame counters usually wrap to 0."""

MAX_SEQ_STEP_RATIO = 2
"""Largest ratio of the step of the frame counter across a wrap to the previous step."""

MAX_CLOCK_STEP_RATIO = 16
"""Largest ratio of the step of the clock across a wrap to the previous step."""


class Layout:
    """Arrangement of the values of a frame in one line, or in a cycle of several lines.

    Attributes:
        columns: Meanings of the values as frame counter, clock or channels.
    """

    def __init__(self, notation: Notation, names: tuple[str, ...], value_count: int, line_count: int = 1) -> None:
        """Store the layout, and find the columns of the frame counter, the clock and the channels.

        Args:
            notation: Notation of the lines.
            names: Names of all values; empty for a CSV without a header.
            value_count: Number of values in a frame.
            line_count: Number of lines that contain the values of a frame; 1 if each line is a frame.
        """
        self.notation = notation
        self.names = names
        self.value_count = value_count
        self.line_count = line_count
        column_names = names or ("",) * value_count  # a column without a name has an empty name
        scales = (1.0,) * value_count  # values in text have no scale
        self.columns = Columns(column_names, scales)


class TextParser(DelimitedParser):
    """Parser that recognises the layout of lines of text and converts the lines to frames.

    Attributes:
        layout: Layout of the lines; None until it is recognised.
    """

    def __init__(self, columns: tuple[str, ...] = (), meanings: Mapping[str, str] | None = None) -> None:
        """Begin without a layout. The parser recognises the layout from the first lines.

        Args:
            columns: Names for the columns of a CSV; empty if they are not known.
            meanings: Meaning of names that the device uses for its counter and its clock: for each such name, one of
                `seq`, `t_us`, `t_ms` and `t_s`.
        """
        super().__init__(b"\n", MAX_LINE_LENGTH, "text of a layout that is not clear yet")
        self.layout: Layout | None = None
        self._columns = columns
        self._meanings = dict(meanings or {})
        self._seq_wrap = CounterWrap(SEQ_MODULI, SEQ_MODULUS, MAX_SEQ_STEP_RATIO)
        self._clock_wrap = create_clock_wrap(1.0)  # until the layout states the unit of the clock
        self._last_unreadable_line = b""
        self._is_first_line = True  # whether the next line is the first line of a connection

        # Lines from which the layout will be recognised, with their sizes in bytes
        self._collected_lines: list[tuple[Line, int]] = []

        # Values (by name) and number of bytes of the present cycle of lines, which together contain one frame
        self._cycle_values: dict[str, float] = {}
        self._cycle_byte_count = 0

    def reset(self) -> None:
        """Drop an unfinished frame, and treat the next line as the first line of another connection.

        A layout that was recognised stays recognised.
        """
        super().reset()
        self._drop_cycle()
        self._is_first_line = True
        self._seq_wrap.update(None)  # None means that the connection has ended
        self._clock_wrap.update(None)

    def _parse_piece(self, piece: bytes) -> list[Frame]:
        """Parse a line, and return the frames that the line completes.

        Lines are collected until their layout can be recognised. When the layout is recognised, the frames of the
        collected lines are returned. Comments and headers complete no frame.

        Args:
            piece: Bytes of the line, without the line feed.
        """
        size = len(piece) + 1  # with the line feed
        is_first_line = self._is_first_line
        self._is_first_line = False
        try:
            line = parse_line(piece)
        except ValueError:
            return self._reject_unreadable(piece, size)
        if self._meanings and line.names:
            # Replace the names that the device uses for its counter and its clock by `seq`, `t_us`, `t_ms` or `t_s`.
            names = tuple(self._meanings.get(name, name) for name in line.names)
            line = line._replace(names=names)

        # The beginning of the first line may be missing. For example, "801.2" may have become "1.2", a valid number.
        if is_first_line and line.notation is Notation.csv:
            self._reject_collected()
            return self._reject(size)
        if line.notation is Notation.nothing:  # such as a comment
            return []
        if line.notation is Notation.header:
            self._name_columns(line, size)
            return []
        if self.layout is None:
            return self._recognise_layout(line, size)
        return self._read_line(self.layout, line, size)

    def _reject(self, size: int) -> list[Frame]:
        """Count a rejected line, and return an empty list, because a rejected line completes no frame."""
        self.counts.count_rejected(size)
        return []

    def _reject_unreadable(self, line_bytes: bytes, size: int) -> list[Frame]:
        """Count a line as rejected, because it cannot be parsed.

        If the line is equal to the previous line that could not be parsed, it is probably the echo of a request. After
        an echo, the lines that were collected to recognise a layout are kept. After any other line, the collected lines
        are dropped.

        Args:
            line_bytes: Bytes of the line, without the line feed.
            size: Number of bytes of the line, with the line feed.

        Returns:
            An empty list.
        """
        is_echo = line_bytes == self._last_unreadable_line
        if not is_echo:
            self._reject_collected()
        self._last_unreadable_line = line_bytes
        return self._reject(size)

    def _reject_collected(self) -> None:
        """Drop all lines that were collected to recognise a layout, and count them as rejected."""
        for _, size in self._collected_lines:
            self.counts.count_rejected(size)
        self._collected_lines = []

    def _name_columns(self, header: Line, size: int) -> None:
        """Use the names in a header of a CSV as the names of the columns, unless names are already known.

        A header may arrive before or after the layout is recognised. It arrives afterwards if the board was reset, or
        if another line looks like a header. Such a later header is used only if the layout is a CSV with the same
        number of columns, and if no names were known when the layout was recognised. Otherwise it is counted as
        rejected.

        Args:
            header: Parsed line with the names of the columns.
            size: Number of bytes of the line.
        """
        are_names_known = bool(self._columns)
        layout = self.layout
        if layout is None:
            if not are_names_known:
                self._columns = header.names
            return
        fits_layout = layout.notation is Notation.csv and layout.value_count == len(header.names)
        if fits_layout and not are_names_known:
            self._set_layout(Layout(Notation.csv, header.names, layout.value_count))
        else:
            self._reject(size)

    def _set_layout(self, layout: Layout) -> None:
        """Use a layout for all further lines, and describe the layout in the attribute `format`."""
        self.layout = layout
        self._clock_wrap = create_clock_wrap(layout.columns.clock_unit_us)
        names = ", ".join(layout.names) or f"{layout.value_count} columns without names"
        self.format = f"text, {layout.notation}: {printable(names)}"

    def _recognise_layout(self, line: Line, size: int) -> list[Frame]:
        """Add a line to the collected lines. If their layout can now be recognised, return their frames.

        A layout is recognised if the latest lines consist of `RECOGNITION_REPEATS` equal cycles. A cycle consists of
        one or several lines that together contain one frame. Collected lines before the equal cycles are counted as
        rejected. Lines with more than `MAX_VALUES` values are never recognised.

        Args:
            line: The next line.
            size: Number of bytes of the line.

        Returns:
            The frames of all equal cycles; an empty list if no layout is recognised yet.
        """
        self._collected_lines.append((line, size))
        cycle_length = _repeated_cycle_length([collected_line for collected_line, _ in self._collected_lines])
        is_recognised = cycle_length > 0 and len(line.values) <= MAX_VALUES
        if not is_recognised:
            # Keep as many lines as the longest cycles need, and reject the older lines.
            while len(self._collected_lines) > RECOGNITION_REPEATS * MAX_CYCLE_LINES:
                _, oldest_size = self._collected_lines.pop(0)
                self._reject(oldest_size)
            return []

        first_repeated = len(self._collected_lines) - RECOGNITION_REPEATS * cycle_length
        repeated_lines = self._collected_lines[first_repeated:]
        self._collected_lines = self._collected_lines[:first_repeated]
        self._reject_collected()

        # One cycle determines the layout, with which all repeated lines are read.
        first_cycle = [cycle_line for cycle_line, _ in repeated_lines[:cycle_length]]
        layout = self._layout_of(first_cycle)
        self._set_layout(layout)
        frames = []
        for repeated_line, repeated_size in repeated_lines:
            frames += self._read_line(layout, repeated_line, repeated_size)
        return frames

    def _layout_of(self, lines: list[Line]) -> Layout:
        """Determine the layout of a frame from the lines of one cycle. For most boards, a cycle is a single line.

        If the cycle has several lines, their names are sorted, because the given lines may begin in the middle of a
        cycle. If the cycle is a single line without names, the values get the known names of the columns, provided that
        the number of names is equal to the number of values.
        """
        first_line = lines[0]
        notation = first_line.notation
        if len(lines) > 1:
            different_names = {name for line in lines for name in line.names}
            sorted_names = tuple(sorted(different_names, key=_counter_and_clock_first))
            return Layout(notation, sorted_names, len(sorted_names), len(lines))

        value_count = len(first_line.values)
        names = first_line.names
        if not names and len(self._columns) == value_count:
            names = self._columns
        return Layout(notation, names, value_count)

    def _read_line(self, layout: Layout, line: Line, size: int) -> list[Frame]:
        """Return a list with the frame that a line completes.

        The list is empty if the line completes no frame, or if the line is rejected because it has another layout.

        Args:
            layout: The recognised layout.
            line: The next line.
            size: Number of bytes of the line.
        """
        if line.notation is not layout.notation:
            return self._reject(size)
        has_cycles = layout.line_count > 1
        if has_cycles:
            return self._read_cycle_line(layout, line, size)
        has_other_names = bool(line.names) and line.names != layout.names
        if len(line.values) != layout.value_count or has_other_names:
            return self._reject(size)
        return self._frame_of_values(layout, line.values, size)

    def _read_cycle_line(self, layout: Layout, line: Line, size: int) -> list[Frame]:
        """Store the values of one line of a cycle. A cycle is a sequence of lines that together contain one frame.

        A line is identified by its first name. The names of clocks are ignored, because every line of a cycle may
        contain the clock. A line begins a new cycle in two cases: if its name comes first in the layout, or if the
        present cycle already contains its name. In the second case, some lines were lost.

        Args:
            layout: The recognised layout.
            line: The next line.
            size: Number of bytes of the line.

        Returns:
            A list with the frame if the line completes the cycle, otherwise an empty list.
        """
        names_without_clock = [name for name in line.names if name not in TIMES_US]
        has_unknown_names = not set(line.names) <= set(layout.names)
        if not names_without_clock or has_unknown_names:
            return self._reject(size)

        line_name = names_without_clock[0]
        first_line_name = next(name for name in layout.names if name not in TIMES_US)
        begins_cycle = line_name == first_line_name or line_name in self._cycle_values
        if begins_cycle:
            self._drop_cycle()  # an earlier cycle, if it is unfinished
        line_values = dict(zip(line.names, line.values, strict=True))
        self._cycle_values.update(line_values)
        self._cycle_byte_count += size
        is_complete = len(self._cycle_values) == layout.value_count
        if not is_complete:
            return []

        # The cycle is complete. Convert its values to a frame, in the order of the layout.
        values = [self._cycle_values[name] for name in layout.names]
        cycle_byte_count = self._cycle_byte_count
        self._clear_cycle()
        return self._frame_of_values(layout, values, cycle_byte_count)

    def _drop_cycle(self) -> None:
        """Drop the lines of an unfinished cycle, and count them as rejected."""
        if self._cycle_values:
            self.counts.count_rejected(self._cycle_byte_count)
        self._clear_cycle()

    def _clear_cycle(self) -> None:
        """Delete the stored values of the present cycle, so that a new cycle can begin."""
        self._cycle_values = {}
        self._cycle_byte_count = 0

    def _frame_of_values(self, layout: Layout, values: Sequence[float], size: int) -> list[Frame]:
        """Convert values to a frame, and update the moduli of the counter and the clock.

        Args:
            layout: The recognised layout.
            values: Value of each column.
            size: Number of bytes that are counted as dropped if the values are not a valid frame.

        Returns:
            A list with the frame; an empty list if the values are not a valid frame, for example because the counter is
            infinite.
        """
        frames = self._try_decode(layout.columns.frame, values, dropped_size=size)
        for frame in frames:
            self.seq_modulus = self._seq_wrap.update(frame.seq)
            self.t_us_modulus = self._clock_wrap.update(frame.t_us)
        return frames


def create_clock_wrap(unit_us: float) -> CounterWrap:
    """Create the estimator of the time at which a clock wraps to 0.

    The estimator assumes that the clock has 16, 24 or 32 bits, or that the board computes the time from a 32-bit clock
    in us or ms.

    Args:
        unit_us: Unit of the clock, us.
    """
    unit = round(unit_us)
    usual_moduli = {T_US_MODULUS, 1000 * T_US_MODULUS}  # of a 32-bit clock in us or ms; all moduli are in us
    for bits in (16, 24, 32):
        usual_moduli.add((1 << bits) * unit)
    initial_modulus = T_US_MODULUS * unit
    return CounterWrap(sorted(usual_moduli), initial_modulus, MAX_CLOCK_STEP_RATIO)


def _counter_and_clock_first(name: str) -> tuple[bool, str]:
    """Return the sorting key of a name, which sorts the frame counter and the clock before the channels."""
    is_channel = name != SEQ and name not in TIMES_US
    return is_channel, name


def _repeated_cycle_length(lines: list[Line]) -> int:
    """Return the number of lines in a cycle, or 0 if the lines do not repeat regularly.

    A cycle is a sequence of lines that together contain one frame. It is recognised if the last lines consist of
    `RECOGNITION_REPEATS` equal cycles. Lines are equal if their signatures are equal: the notation, the names and the
    number of values. Only in the notations `pairs` and `teleplot` may a cycle have several lines.

    Args:
        lines: The lines received last, at least one, in the order in which they arrived.
    """
    signatures = [(line.notation, line.names, len(line.values)) for line in lines]
    *earlier_signatures, last_signature = signatures
    if last_signature not in earlier_signatures:
        return 0

    # The length of the cycle is the distance from the last line to the latest earlier line that is equal.
    latest_signatures_first = earlier_signatures[::-1]
    cycle_length = latest_signatures_first.index(last_signature) + 1
    can_have_several_lines = lines[-1].notation in (Notation.pairs, Notation.teleplot)
    if cycle_length > 1 and not can_have_several_lines:
        return 0

    # Compare the last lines with repetitions of the first cycle among them.
    recent_signatures = signatures[-RECOGNITION_REPEATS * cycle_length :]
    is_repeated = recent_signatures == recent_signatures[:cycle_length] * RECOGNITION_REPEATS
    return cycle_length if is_repeated else 0
