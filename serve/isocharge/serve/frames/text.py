"""Parser for boards that send frames as lines of text.

A board sends each frame either as a single line or as a cycle of several lines, each of which contains a part of the
frame. `isocharge.serve.frames.text_lines` takes the numbers out of each line. Lines with the same text between their
numbers are frames. The parser recognises this layout as soon as the same kind of line, or the same cycle of lines, has
occurred three times in succession. Lines that resemble a message, such as `Channel 3 is ready`, must occur ten times,
because a board that starts often sends several similar messages. After the recognition, lines with another layout
are dropped and counted.

Reading may start in the middle of a cycle. The lines of a cycle are therefore sorted by name, with the frame counter
and the clock before the channels. A cycle begins with the line whose name comes first in the sorted order.

Reading may also start in the middle of a line. If the first line begins with a number, it is therefore dropped and
counted as malformed. This also applies to files and pipes, because their bytes usually come from a port, for example
from `cat /dev/ttyACM0`. A program that begins with a complete line can send a header, a comment or a blank line first.
No frame is then dropped.

Text has no checksum, except for sentences in the style of NMEA 0183. The parser therefore cannot detect a damaged digit
in an otherwise intact line. Lines between the frames that never change, such as the echo of a request, do not prevent
the recognition of the layout.

A column with the name `seq` is the frame counter. A column with the name `t_us`, `t_ms` or `t_s` is the clock of the
device. All other columns are channels. At first, the values at which the counter and the clock wrap to 0 are unknown.
The parser estimates each value when the counter or the clock wraps for the first time.
"""

from collections import deque
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
from isocharge.serve.frames.text_lines import Line, Skeleton, clean_text, header_names, parse_line

MAX_LINE_LENGTH = 4096
"""Length of the longest line that is parsed, bytes."""

MAX_CYCLE_LINES = 64
"""Largest number of lines that make one frame."""

RECOGNITION_REPEATS = 3
"""Number of times in succession that a layout must occur before it is recognised."""

MESSAGE_REPEATS = 10
"""Number of times in succession that a layout that resembles a message must occur before it is recognised."""

MAX_VALUES = 256
"""Largest number of values in a line."""

MAX_HEADERS = 8
"""Number of lines without numbers that are kept, because one of them may be the header of the following lines."""

SEQ_MODULI = (100, 256, 1000, 10_000, SEQ_MODULUS, 1 << 32)
"""Values at which frame counters usually wrap to 0."""

MAX_SEQ_STEP_RATIO = 2
"""Largest ratio of the step of the frame counter across a wrap to the previous step."""

MAX_CLOCK_STEP_RATIO = 16
"""Largest ratio of the step of the clock across a wrap to the previous step."""

DAY_US = 86_400_000_000
"""Value at which a time of day wraps to 0, us."""


class Layout:
    """Arrangement of the values of a frame in one line, or in a cycle of several lines.

    Attributes:
        example: One of the lines, with which headers are compared.
        skeletons: Text between the numbers of each line of a frame.
        names: Names of all values; empty for a value without a name.
        unnamed: Indices of the values that have no names in the lines. A header or a device file may name them.
        first_name: The first name that is not the name of a clock; empty without such a name.
        columns: Meanings of the values as frame counter, clock or channels.
    """

    def __init__(self, cycles: Sequence[Sequence[Line]]) -> None:
        """Determine the layout from several frames, each of which is a single line or a cycle of lines.

        The names of a cycle are sorted, because the given lines may begin in the middle of a cycle.

        Args:
            cycles: Lines of each frame, shape (frames, lines).
        """
        self.example = cycles[0][0]
        self.skeletons = [Skeleton(lines) for lines in zip(*cycles, strict=True)]
        names = self.skeletons[0].names
        if len(self.skeletons) > 1:
            different_names = {name for skeleton in self.skeletons for name in skeleton.names}
            names = tuple(sorted(different_names, key=_counter_and_clock_first))
        self.unnamed = [index for index, name in enumerate(names) if not name]
        self.set_names(names)

    def set_names(self, names: Sequence[str]) -> None:
        """Store the names of all values, and find the columns of the frame counter, the clock and the channels."""
        self.names = tuple(names)
        self.first_name = next((name for name in names if name not in TIMES_US), "")
        scales = (1.0,) * len(self.names)  # values in text have no scale
        self.columns = Columns(self.names, scales)

    def name_unnamed(self, names: Sequence[str]) -> bool:
        """Give names to the values that have none in the lines, and return whether the number of names fits."""
        if not names or len(names) != len(self.unnamed):
            return False
        name_at_index = dict(zip(self.unnamed, names, strict=True))
        self.set_names([name_at_index.get(index, name) for index, name in enumerate(self.names)])
        return True


class TextParser(DelimitedParser):
    """Parser that recognises the layout of lines of text and converts the lines to frames.

    Attributes:
        layout: Layout of the lines; None until it is recognised.
    """

    def __init__(self, columns: tuple[str, ...] = (), meanings: Mapping[str, str] | None = None) -> None:
        """Begin without a layout. The parser recognises the layout from the first lines.

        Args:
            columns: Names for the values that have no names in the lines; empty if they are not known.
            meanings: Meaning of names that the device uses for its counter and its clock: for each such name, one of
                `seq`, `t_us`, `t_ms` and `t_s`.
        """
        super().__init__(b"\n", MAX_LINE_LENGTH, "text of a layout that is not clear yet")
        self.layout: Layout | None = None
        self._columns = columns
        self._meanings = dict(meanings or {})
        self._headers: deque[str] = deque(maxlen=MAX_HEADERS)  # lines without numbers
        self._seq_wrap = CounterWrap(SEQ_MODULI, SEQ_MODULUS, MAX_SEQ_STEP_RATIO)
        self._clock_wrap = create_clock_wrap(1.0)  # until the layout states the unit of the clock
        self._is_first_line = True  # whether the next line is the first line of a connection

        # Texts, skeletons and sizes in bytes of the lines from which the layout will be recognised
        self._collected_lines: list[tuple[str, str, int]] = []

        # Values (by name) and number of bytes of the present cycle of lines, which together contain one frame
        self._cycle_values: dict[str, float] = {}
        self._cycle_byte_count = 0

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames in the lines that end within `data`. A line ends with a line feed or a carriage return."""
        return super().feed(data.replace(b"\r", b"\n"))

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
        if not piece:
            return []
        try:
            text = piece.decode()
            # The beginning of the first line may be missing. For example, "801.2" may have become the number "1.2".
            if is_first_line and parse_line(clean_text(text)).starts[:1] == (0,):
                return self._reject(size)
            frames = None if text[0] in ">$" else self._read_line(text, size)  # these lines have to be cleaned first
            if frames is None:
                text = clean_text(text)
                frames = self._read_line(text, size) if text else []
            return self._examine_line(text, size) if frames is None else frames
        except ValueError:
            return self._reject(size)

    def _reject(self, size: int) -> list[Frame]:
        """Count a rejected line, and return an empty list, because a rejected line completes no frame."""
        self.counts.count_rejected(size)
        return []

    def _examine_line(self, text: str, size: int) -> list[Frame]:
        """Examine a line that does not have the recognised layout, and return the frames that become readable.

        A line without numbers may be a header. A line with numbers is collected until a layout is recognised.

        Args:
            text: The line.
            size: Number of bytes of the line.

        Raises:
            ValueError: If the line cannot be parsed.
        """
        line = parse_line(text)
        layout = self.layout
        self.unread_line = text
        if line.numbers:
            return self._recognise_layout(line, size) if layout is None else self._reject(size)
        if layout is None:
            self._headers.append(text)
            columns = text.replace(",", " ").replace(";", " ").split()
            is_plain_header = all(column[0].isalpha() for column in columns)
            return [] if is_plain_header else self._reject(size)
        if all(layout.names) or not layout.name_unnamed(header_names(text, layout.example)):
            return self._reject(size)
        self._describe_layout(layout)
        return []

    def _describe_layout(self, layout: Layout) -> None:
        """Describe the recognised layout in the attribute `format`."""
        self._clock_wrap = create_clock_wrap(layout.columns.clock_unit_us)
        is_unnamed = not any(layout.names)
        names = f"{len(layout.names)} columns without names" if is_unnamed else ", ".join(layout.names)
        self.format = f"text: {printable(names)}"

    def _recognise_layout(self, line: Line, size: int) -> list[Frame]:
        """Add a line to the collected lines. If their layout can now be recognised, return their frames.

        Collected lines before the lines that determine the layout are counted as rejected. Lines with more than
        `MAX_VALUES` values are never recognised.

        Args:
            line: The next line.
            size: Number of bytes of the line.

        Returns:
            The frames of all equal cycles; an empty list if no layout is recognised yet.
        """
        self._collected_lines.append((line.text, line.skeleton, size))
        repeats = MESSAGE_REPEATS if line.is_prose else RECOGNITION_REPEATS
        cycle_length = self._repeated_cycle_length(repeats) if len(line.numbers) <= MAX_VALUES else 0
        repeated_lines = self._collected_lines[-repeats * cycle_length :] if cycle_length > 0 else []
        parsed_lines = [self._with_meanings(parse_line(text)) for text, _, _ in repeated_lines]
        cycles = _frame_cycles(parsed_lines, cycle_length)
        if not cycles:
            # Keep as many lines as the longest cycles need, and reject the older lines.
            while len(self._collected_lines) > RECOGNITION_REPEATS * MAX_CYCLE_LINES:
                _, _, oldest_size = self._collected_lines.pop(0)
                self._reject(oldest_size)
            return []

        for _, _, rejected_size in self._collected_lines[: -len(repeated_lines)]:
            self._reject(rejected_size)
        self._collected_lines = []
        layout = Layout(cycles)
        is_named = layout.name_unnamed(self._columns)
        while self._headers and not is_named:
            is_named = layout.name_unnamed(header_names(self._headers.pop(), layout.example))
        self.layout = layout
        self._describe_layout(layout)
        frames = []
        for text, _, repeated_size in repeated_lines:
            frames_of_line = self._read_line(text, repeated_size)
            frames += self._reject(repeated_size) if frames_of_line is None else frames_of_line
        return frames

    def _repeated_cycle_length(self, repeats: int) -> int:
        """Return the number of lines in a cycle, or 0 if the collected lines do not repeat regularly.

        A cycle is a sequence of lines that repeats. It is recognised if the last lines consist of several equal cycles.
        Lines are equal if their skeletons are equal.

        Args:
            repeats: Number of equal cycles that are needed.
        """
        skeletons = [skeleton for _, skeleton, _ in self._collected_lines]
        *earlier_skeletons, last_skeleton = skeletons
        if last_skeleton not in earlier_skeletons:
            return 0

        # The length of the cycle is the distance from the last line to the latest earlier line that is equal.
        latest_skeletons_first = earlier_skeletons[::-1]
        cycle_length = latest_skeletons_first.index(last_skeleton) + 1

        # Compare the last lines with repetitions of the first cycle among them.
        recent_skeletons = skeletons[-repeats * cycle_length :]
        is_repeated = recent_skeletons == recent_skeletons[:cycle_length] * repeats
        return cycle_length if is_repeated else 0

    def _with_meanings(self, line: Line) -> Line:
        """Replace the names that the device uses for its counter and its clock by `seq`, `t_us`, `t_ms` or `t_s`."""
        return line._replace(names=tuple(self._meanings.get(name, name) for name in line.names))

    def _read_line(self, text: str, size: int) -> list[Frame] | None:
        """Return a list with the frame that a line completes.

        The list is empty if the line completes no frame. The result is None if the line does not have the recognised
        layout, or if no layout is recognised yet.

        Args:
            text: The line.
            size: Number of bytes of the line.
        """
        layout = self.layout
        if layout is None:
            return None
        for skeleton in layout.skeletons:
            values = skeleton.values(text)
            if values is not None:
                if len(layout.skeletons) == 1:
                    return self._frame_of_values(layout, values, size)
                return self._read_cycle_line(layout, skeleton, values, size)
        return None

    def _read_cycle_line(self, layout: Layout, skeleton: Skeleton, values: tuple[float, ...], size: int) -> list[Frame]:
        """Store the values of one line of a cycle. A cycle is a sequence of lines that together contain one frame.

        A line begins a new cycle in two cases: if its name comes first in the layout, or if the present cycle already
        contains its name. In the second case, some lines were lost.

        Args:
            layout: The recognised layout.
            skeleton: Skeleton of the line, with the names of the values.
            values: Values of the line.
            size: Number of bytes of the line.

        Returns:
            A list with the frame if the line completes the cycle, otherwise an empty list.
        """
        line_name = skeleton.line_name
        begins_cycle = line_name == layout.first_name or line_name in self._cycle_values
        if begins_cycle:
            self._drop_cycle()  # an earlier cycle, if it is unfinished
        self._cycle_values.update(zip(skeleton.names, values, strict=True))
        self._cycle_byte_count += size
        is_complete = len(self._cycle_values) == len(layout.names)
        if not is_complete:
            return []

        # The cycle is complete. Convert its values to a frame, in the order of the layout.
        frame_values = [self._cycle_values[name] for name in layout.names]
        cycle_byte_count = self._cycle_byte_count
        self._clear_cycle()
        return self._frame_of_values(layout, frame_values, cycle_byte_count)

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

    The estimator assumes that the clock has 16, 24 or 32 bits, that the board computes the time from a 32-bit clock in
    us or ms, or that the time is a time of day.

    Args:
        unit_us: Unit of the clock, us.
    """
    unit = round(unit_us)
    usual_moduli = {T_US_MODULUS, 1000 * T_US_MODULUS, DAY_US}  # of a 32-bit clock in us or ms; all moduli are in us
    for bits in (16, 24, 32):
        usual_moduli.add((1 << bits) * unit)
    initial_modulus = T_US_MODULUS * unit
    return CounterWrap(sorted(usual_moduli), initial_modulus, MAX_CLOCK_STEP_RATIO)


def _counter_and_clock_first(name: str) -> tuple[bool, str]:
    """Return the sorting key of a name, which sorts the frame counter and the clock before the channels."""
    is_channel = name != SEQ and name not in TIMES_US
    return is_channel, name


def _frame_cycles(lines: Sequence[Line], cycle_length: int) -> list[Sequence[Line]]:
    """Return the lines of each frame in repeated cycles of lines; empty if it is not clear which lines are frames.

    If every value has a name, a frame consists of all lines of a cycle. Otherwise, a frame is a single line, and the
    other lines of the cycle never change.

    Args:
        lines: Lines of whole cycles; may be empty.
        cycle_length: Number of lines in a cycle.
    """
    if not lines:
        return []
    has_line_names = all(set(line.names) - set(TIMES_US) and all(line.names) for line in lines)
    if cycle_length == 1 or has_line_names:
        return [lines[start : start + cycle_length] for start in range(0, len(lines), cycle_length)]
    lines_at_position = [lines[position::cycle_length] for position in range(cycle_length)]
    varying_lines = [lines for lines in lines_at_position if len({line.text for line in lines}) > 1]
    return [[line] for line in varying_lines[0]] if len(varying_lines) == 1 else []
