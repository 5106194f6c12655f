"""Parser for boards that send frames as lines of text, and a function that writes frames as such lines.

A board writes each frame as one line, or as a cycle of lines that together contain all values of the frame. The module
`isocharge.serve.frames.text_lines` reads the numbers of each line. Lines with the same text between their numbers
have the same layout. The parser recognises a layout as soon as the same kind of line, or the same cycle of lines, has
occurred three times in succession. Lines that resemble a message, such as `Channel 3 is ready` or `load:0x3FCD6100`,
must occur ten times, because a board that starts often sends several similar messages. After the recognition, lines
with another layout are dropped and counted.

In lines such as `1000,0,3.2` and `1000,1,4.1`, the second column is the number of a channel, and the third column is
its charge. Lines with the number of a channel are not recognised, because they could be mistaken for frames with three
values. A frame counter without a name may look like the number of a channel during the first eight lines.

Reading may start in the middle of a cycle. A cycle is therefore assumed to begin with the line that contains the frame
counter. If there is no frame counter, it is assumed to begin with the line whose name comes first in alphabetical
order.

Reading may also start in the middle of a line. If the first line begins with a number, it is therefore dropped and
counted as malformed. The first line of a file or a pipe is dropped, too, because its bytes usually come from a port,
for example from `cat /dev/ttyACM0`. A program that begins with a complete line can send a header, a comment or a blank
line first. No frame is then dropped.

Text has no checksum, except for sentences in the style of NMEA 0183. The parser therefore cannot detect a damaged digit
in an otherwise intact line. If lines that never change stand between the frames, such as the echo of a request, the
layout is recognised all the same.

A column with the name `seq` is the frame counter. A column with the name `t_us`, `t_ms` or `t_s` is the clock of the
device. All other columns are channels. A frame counter is assumed to wrap at one of `SEQ_MODULI`: at 256 as long as it
has not exceeded 255, and at 65536 afterwards. If the counter returns to a small number after 99, 999 or 9999, it is
assumed to wrap at 100, 1000 or 10000. A clock in us or ms is assumed to have 32 bits, and a clock in s is assumed to be
a time of day.
"""

import json
import re
from collections import deque
from collections.abc import Mapping, Sequence
from string import ascii_uppercase
from typing import Literal

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import printable
from isocharge.serve.frames.frame import SEQ, SEQ_MODULUS, T_US_MODULUS, TIMES_US, Columns, DelimitedParser, Frame
from isocharge.serve.frames.line_notation import clean_text
from isocharge.serve.frames.text_lines import Line, header_names, line_values, parse_line

MAX_LINE_LENGTH = 4096
"""Length of the longest line that is parsed, bytes."""

CONTROL_CHARACTERS = bytes({*range(32)} - {*b"\t\x1b"})
"""Bytes that have no meaning at the ends of a line, such as the zero at the end of a C string, or STX and ETX."""

MAX_CYCLE_LINES = 64
"""Largest number of lines in one frame, and largest number of lines that are kept as possible headers."""

RECOGNITION_REPEATS = 3
"""Number of successive occurrences after which a layout is recognised."""

MESSAGE_REPEATS = 10
"""Number of successive occurrences after which a layout is recognised if its lines resemble messages."""

SEQ_MODULI = (256, SEQ_MODULUS, 100, 1000, 10_000)
"""Values at which a frame counter in text may wrap to 0, for counters of 8 and 16 bits, and of two to four digits."""


class Layout:
    """Arrangement of the values of a frame in one line, or in a cycle of several lines.

    Attributes:
        lines: The lines of a frame. Headers are compared with the first line.
        patterns: Regular expression of each line of a frame, in which the numbers are groups.
        names: Names of all values; empty for a value without a name.
        unnamed: Indices of the values that have no names in the lines. A header or a device file may name them.
        columns: Meanings of the values as frame counter, clock or channels.
    """

    def __init__(self, lines: Sequence[Line], new_names: Sequence[str], meanings: Mapping[str, str]) -> None:
        """Determine the layout from the lines of one frame.

        Args:
            lines: The lines.
            new_names: Names for the values that have no names in the lines; empty if they are not known.
            meanings: For each name that the device uses for its counter or its clock: `seq`, `t_us`, `t_ms` or `t_s`.
        """
        self.lines = lines
        self.patterns = [line.pattern for line in lines]
        self.names = [name for line in lines for name in line.names]
        self.unnamed = [index for index, name in enumerate(self.names) if not name]  # indices without a name
        for index, name in zip(self.unnamed, new_names, strict=False):  # does nothing if `new_names` is empty
            self.names[index] = meanings.get(name, name)
        words = tuple(word for line in lines for word in line.words)  # all text between the numbers except marks
        self.columns = Columns(self.names, (1.0,) * len(self.names), words=words)  # values in text have no scale


class TextParser(DelimitedParser):
    """Parser that recognises the layout of lines of text and converts the lines to frames.

    Attributes:
        layout: Layout of the lines; None until it is recognised.
    """

    def __init__(self, columns: tuple[str, ...] = (), meanings: Mapping[str, str] | None = None) -> None:
        """Begin without a layout. The parser recognises the layout from the first lines.

        Args:
            columns: Names for the values that have no names in the lines; empty if they are not known.
            meanings: For each name that the device uses for its counter or its clock: the meaning of the name, which is
                `seq`, `t_us`, `t_ms` or `t_s`.
        """
        super().__init__("text of a layout that is not clear yet", b"\n", MAX_LINE_LENGTH)
        self.layout: Layout | None = None
        self._names_from_device_file = columns
        self._meanings = dict(meanings or {})
        self._headers: deque[str] = deque(maxlen=MAX_CYCLE_LINES)  # lines and comments without numbers
        self.seq_modulus = SEQ_MODULI[0]
        self._last_seq = 0
        self._is_first_line = True  # whether the next line is the first line of a connection

        # Lines from which the layout will be recognised, and their sizes in bytes
        self._collected_lines: list[tuple[Line, int]] = []

        # Values and sizes of the lines of the present cycle, which together contain one frame
        self._cycle: list[tuple[tuple[float, ...], int]] = []

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames in the lines that end within `data`. A line ends with a line feed or a carriage return."""
        return super().feed(data.replace(b"\r", b"\n"))

    def reset(self) -> None:
        """Drop an unfinished frame, and treat the next line as the first line of another connection.

        The parser keeps a layout that it has recognised.
        """
        super().reset()
        self._drop_cycle()
        self._is_first_line = True

    def _parse_piece(self, piece: bytes) -> list[Frame]:
        """Parse a line, and return the frames that the line completes.

        Lines are collected until their layout can be recognised. When the layout is recognised, the frames of the
        collected lines are returned. Comments and headers complete no frame.

        Args:
            piece: Bytes of the line, without the line feed.

        Raises:
            ValueError: If the line cannot be parsed. The caller then counts the line as rejected. A first line that may
                be incomplete raises no error, and is counted here.
        """
        size = len(piece) + 1  # number of bytes with the line feed
        is_first_line = self._is_first_line
        self._is_first_line = False
        line = _decoded(piece.strip(CONTROL_CHARACTERS)).strip()
        text = clean_text(line)
        if not text:  # the line is blank or a comment
            self.unread_line = line or self.unread_line  # for messages to the user
            # A comment without numbers, such as `# t_ms,A,B,C`, may be the header with the names of the columns. No
            # header is needed after a layout has been recognised.
            if self.layout is None and line and not parse_line(line).names:  # there is a name for each number
                self._headers.append(line)
            return []
        # The beginning of the first line may be missing, so that "1.2" may be the end of "801.2". The first line is
        # therefore rejected if a number begins at its first character.
        if is_first_line and 0 in parse_line(text).starts:
            return self._reject(size)
        return self._read_line(text, size)

    def _reject(self, size: int) -> list[Frame]:
        """Count a rejected line, and return an empty list, because a rejected line completes no frame."""
        self.counts.count_rejected(size)
        return []

    def _read_line(self, text: str, size: int) -> list[Frame]:
        """Return the frames that a line completes.

        Args:
            text: The line.
            size: Number of bytes of the line.

        Raises:
            ValueError: If the line cannot be parsed.
        """
        layout = self.layout
        if layout is None:
            return self._collect_line(text, size)
        for position, pattern in enumerate(layout.patterns):
            values = line_values(pattern, text)
            if values is not None:
                return self._add_values(layout, position, values, size)

        # The line has another layout. It may be a header that names the columns without names.
        line = parse_line(text)
        self.unread_line = text  # for messages to the user
        names_in_header = header_names(text, layout.lines[0])  # empty if the line is no header
        if line.names or not names_in_header or all(layout.names):  # only a line without numbers has no `line.names`
            return self._reject(size)
        self._set_layout(Layout(layout.lines, names_in_header, self._meanings))
        return []

    def _add_values(self, layout: Layout, position: int, values: tuple[float, ...], size: int) -> list[Frame]:
        """Add the values of a line to the present cycle, which are the lines of one frame.

        If the cycle is complete, a list with its frame is returned, and otherwise an empty list. If a line of the cycle
        is lost, the other lines of the cycle are rejected.

        Args:
            layout: Layout of the lines.
            position: Position of the line in its cycle.
            values: Numbers in the line.
            size: Number of bytes of the line.
        """
        if position != len(self._cycle):  # a line of a cycle is lost
            self._drop_cycle()
            if position > 0:  # otherwise, the line begins a new cycle
                return self._reject(size)
        self._cycle.append((values, size))
        if len(self._cycle) < len(layout.patterns):
            return []
        values_of_lines, sizes = zip(*self._cycle, strict=True)
        self._cycle = []
        # `sum` joins the tuples of values. The list contains one frame, or none if a value is not valid.
        frames = self._try_decode(layout.columns.frame, sum(values_of_lines, ()), dropped_size=sum(sizes))
        for frame in frames:
            self._update_seq_modulus(frame.seq or 0)
        return frames

    def _drop_cycle(self) -> None:
        """Drop the lines of an unfinished cycle, and count them as rejected."""
        if self._cycle:
            self.counts.count_rejected(sum(size for _, size in self._cycle))
        self._cycle = []

    def _update_seq_modulus(self, seq: int) -> None:
        """Update `seq_modulus`, the value at which the frame counter wraps to 0, from the next value of the counter.

        If the counter decreases from 99, 255, 999, 9999 or 65535, it has wrapped, and the modulus is the next number,
        such as 100. If the counter reaches the present modulus, this modulus is wrong: a counter stays below its
        modulus. A counter below 256 is then assumed to have 8 bits, and any other counter 16 bits.

        Args:
            seq: Next value of the frame counter.
        """
        previous_seq = self._last_seq
        self._last_seq = seq
        if seq < previous_seq and previous_seq + 1 in SEQ_MODULI:
            self.seq_modulus = previous_seq + 1
        elif seq >= self.seq_modulus:
            byte_modulus = SEQ_MODULI[0]  # 256; `SEQ_MODULUS` is 65536
            self.seq_modulus = byte_modulus if seq < byte_modulus else SEQ_MODULUS

    def _collect_line(self, text: str, size: int) -> list[Frame]:
        """Collect a line until a layout is recognised, and then return the frames in the collected lines.

        A line without numbers is stored as a possible header. Once `MAX_CYCLE_LINES` possible headers are stored, each
        further line without numbers is also counted as rejected.

        Args:
            text: The line.
            size: Number of bytes of the line.

        Raises:
            ValueError: If the line cannot be parsed.
        """
        line = parse_line(text, meanings=self._meanings)
        self.unread_line = text
        if not line.names:  # the line has no numbers, because each number has a name, which may be empty
            self._headers.append(text)
            if len(self._headers) == MAX_CYCLE_LINES:  # the largest length of `_headers`, which drops its oldest line
                return self._reject(size)
            return []
        if self._headers:  # if a header names the numbers, the words between the numbers are not their names
            line_below_header = parse_line(text, has_header=True, meanings=self._meanings)
            if any(header_names(header, line_below_header) for header in self._headers):
                line = line_below_header
        self._collected_lines.append((line, size))
        layout = self._recognised_layout([line for line, _ in self._collected_lines])
        if layout is None:
            # Keep as many lines as the longest cycles need, and reject the older lines.
            while len(self._collected_lines) > RECOGNITION_REPEATS * MAX_CYCLE_LINES:
                _oldest_line, oldest_size = self._collected_lines.pop(0)
                self._reject(oldest_size)
            return []

        self._set_layout(layout)
        collected_lines = self._collected_lines
        self._collected_lines = []
        return [frame for line, line_size in collected_lines for frame in self._read_line(line.text, line_size)]

    def _recognised_layout(self, lines: Sequence[Line]) -> Layout | None:
        """Return the layout of the frames, with names from the device file or from the latest header.

        The result is None if the layout cannot be recognised yet. The result is also None if the device file names more
        or fewer columns than a line has values without names, and no header names these values.

        Args:
            lines: The lines since the beginning.
        """
        frame_lines = _frame_lines(lines, MESSAGE_REPEATS if lines[-1].is_prose else RECOGNITION_REPEATS)
        if not frame_lines:
            return None
        # Name the values that have no names. The device file has priority, and then the latest header.
        unnamed_count = frame_lines[0].names.count("")  # 0 for a frame of several lines, whose values all have names
        names_in_headers = [header_names(header, frame_lines[0]) for header in reversed(self._headers)]
        possible_names = (self._names_from_device_file, *names_in_headers)
        names_of_unnamed = next((names for names in possible_names if len(names) == unnamed_count), ())
        layout = Layout(frame_lines, names_of_unnamed, self._meanings)
        if self._names_from_device_file and "" in layout.names:  # the device file names another number of columns
            return None
        # Hexadecimal digits and the number of a channel would be misread. Both occur only in frames of one line.
        has_one_line = len(layout.patterns) == 1
        if has_one_line and (_has_hexadecimal_digits(layout, lines) or _has_channel_number(layout, lines)):
            return None
        return layout

    def _set_layout(self, layout: Layout) -> None:
        """Set the layout, its description in the attribute `format`, and the modulus of the clock."""
        self.layout = layout
        # A clock in s is a time of day, which wraps after 86400 counts. Others wrap after `T_US_MODULUS` = 2^32 counts.
        unit_us = round(layout.columns.clock_unit_us)  # duration of one count of the clock
        is_time_of_day = unit_us == TIMES_US["t_s"]
        self.t_us_modulus = (86_400 if is_time_of_day else T_US_MODULUS) * unit_us
        names = [name for name in layout.names if name]
        unnamed_count = layout.names.count("")
        if unnamed_count > 0:
            names.append(f"{unnamed_count} columns without names")
        self.format = f"text: {printable(', '.join(names))}"


def _decoded(line: bytes) -> str:
    """Decode a line from UTF-8, or else from Latin-1, in which some instruments write the micro and degree signs.

    Raises:
        UnicodeDecodeError: If the line is not in UTF-8, and contains characters other than ASCII and these two signs.
    """
    try:
        return line.decode()
    except UnicodeDecodeError:
        text = line.decode("latin-1")
        if not text.replace("µ", "").replace("°", "").isascii():
            raise
        return text


def _frame_lines(lines: Sequence[Line], repeats: int) -> Sequence[Line]:
    """Return the lines of one frame; empty if the lines do not repeat, or if it is not clear which lines are frames.

    A cycle is a sequence of lines that repeats. A cycle is recognised if the last lines consist of several equal
    cycles. Lines are equal if their skeletons, the texts without the numbers, are equal. The last cycle consists of the
    lines after the previous occurrence of the last line, including the last line itself.

    If some lines occur several times in a cycle, the most frequent line is a frame. If all lines of a cycle differ and
    every value has a name, a frame consists of all lines of a cycle. If all lines of a cycle differ and some value has
    no name, a frame is the only line of the cycle whose text changes.

    Args:
        lines: The lines since the beginning.
        repeats: Number of equal cycles that are needed.
    """
    # Find the length of the cycle, which is the distance from the last line back to its previous occurrence.
    skeletons = [line.skeleton for line in lines]
    *earlier_skeletons, last_skeleton = skeletons
    if last_skeleton not in earlier_skeletons:
        return []
    cycle_length = earlier_skeletons[::-1].index(last_skeleton) + 1
    cycle_skeletons = skeletons[-cycle_length:]
    if skeletons[-repeats * cycle_length :] != repeats * cycle_skeletons:
        return []

    repeated_lines = lines[-repeats * cycle_length :]
    cycle_lines = repeated_lines[:cycle_length]
    has_equal_lines = len(set(cycle_skeletons)) < cycle_length  # for example, three frames and then a temperature
    if has_equal_lines or cycle_length == 1:  # the only line of a cycle is a frame
        most_frequent_line = max(cycle_lines, key=lambda line: skeletons.count(line.skeleton))
        return [most_frequent_line]
    if all(all(line.names) for line in cycle_lines):  # every value has a name
        start = _frame_start_index(repeated_lines, cycle_length)  # reading may have begun within a cycle
        return repeated_lines[start : start + cycle_length]
    # Collect the texts of the line at each position in the cycle. The frame is the line whose text varies, if there is
    # exactly one such line.
    texts = [{line.text for line in repeated_lines[position::cycle_length]} for position in range(cycle_length)]
    varying = [line for line, texts_of_line in zip(cycle_lines, texts, strict=True) if len(texts_of_line) > 1]
    return varying if len(varying) == 1 else []


def _has_hexadecimal_digits(layout: Layout, lines: Sequence[Line]) -> bool:
    """Return whether digits such as 07FD in other lines show that the numbers are hexadecimal without the prefix 0x.

    At least one line in ten must contain such digits, because a single damaged line may also contain them.

    Args:
        layout: Layout of a frame of one line.
        lines: The lines since the beginning.
    """
    other_texts = [line.text for line in lines if not layout.patterns[0].fullmatch(line.text)]
    shape, *other_shapes = [
        re.sub(r"\b[0-9][0-9A-Fa-f]*\b", "0", text) for text in (layout.lines[0].text, *other_texts)
    ]
    return 10 * other_shapes.count(shape) >= len(lines)


def _has_channel_number(layout: Layout, lines: Sequence[Line]) -> bool:
    """Return whether each line seems to contain the number of a channel and only the charge of this channel.

    The numbers of the channels increase by 1 from line to line and begin again after the last channel, as in
    `1000,0,3.2`, `1000,1,4.1`, `1000,2,3.7` and `1005,0,3.3`. A column is assumed to contain the numbers of channels if
    it fulfils these conditions:

    - The column contains three to eight different numbers, which are consecutive whole numbers. The smallest number is
      below 100.
    - At least half of the steps from line to line lead to the next number. Other steps may be due to missing lines.
    - The column does not have the name of a frame counter or of an electrode, such as A.
    - The other columns cannot be the charges of a film, because fewer than three of them sometimes decrease. A film has
      at least three charges, which increase and decrease, while counters and clocks only increase. However, if there
      are three or more other columns and all of them are constant, they may be the charges of an untouched film.

    A frame counter without a name also fulfils these conditions in its first eight lines.

    Args:
        layout: Layout of a frame of one line, with its names.
        lines: The lines since the beginning.
    """
    (pattern,) = layout.patterns
    values_of_lines = [line_values(pattern, line.text) for line in lines[-MAX_CYCLE_LINES:]]
    columns = np.array([values for values in values_of_lines if values]).T  # shape (n_column, n_line)

    n_varying = np.sum(np.ptp(columns, axis=1) > 0.0)
    if n_varying == 1 and len(columns) > 3:  # the other columns, at least three, may be constant charges
        return False

    decreases = np.any(columns != np.sort(columns), axis=1)  # whether each column decreases at least once
    for name, column, column_decreases in zip(layout.names, columns, decreases, strict=True):
        has_other_meaning = name in {SEQ, *ascii_uppercase}
        n_others_decreasing = decreases.sum() - column_decreases
        if not has_other_meaning and n_others_decreasing < 3 and _counts_up_repeatedly(column):
            return True
    return False


def _counts_up_repeatedly(column: Array) -> bool:
    """Return whether a column contains three to eight numbers of channels that count up repeatedly, such as 1 to 3.

    The numbers are consecutive whole numbers, and the smallest one is below 100. At least half of the steps from line
    to line lead to the next number, or from the last number to the first.

    Args:
        column: Numbers in the column, shape (lines,).
    """
    # The different numbers in ascending order, and for each line the index of its number among them
    numbers, ranks = np.unique(column, return_inverse=True)
    if not 3 <= len(numbers) <= 8 or numbers[0] not in range(100):  # the smallest must be a whole number
        return False
    are_consecutive = np.all(np.diff(numbers) == 1.0)
    leads_to_next = np.diff(ranks) % len(numbers) == 1  # the first number follows the last
    return bool(are_consecutive and leads_to_next.mean() >= 0.5)


def _frame_start_index(lines: Sequence[Line], cycle_length: int) -> int:
    """Find the line with which a frame begins in repeated cycles of lines, and return its index.

    Reading may start within a cycle. If every line has a clock, the first line is chosen so that the clocks of a frame
    differ least. If some line has no clock, the first line is the one that begins with the counter. Without a counter,
    it is the line that contains only the clock. If there is neither a counter nor a clock, it is the line whose first
    name comes first in alphabetical order.

    Args:
        lines: Lines of whole cycles, in which every value has a name.
        cycle_length: Number of lines in a cycle.
    """
    fields_of_lines = [  # for each line: its values by their names
        dict(zip(line.names, line_values(line.pattern, line.text) or (), strict=False)) for line in lines
    ]

    def sort_key(first: int) -> tuple[float, bool, str]:
        """Return the sort key of the line with index `first`. A frame begins with the line with the smallest key.

        The key has three elements. The first element is the time from the first to the last line of a frame that would
        begin with this line, or 0 if some line has no clock. The second element states whether the line begins without
        a counter. The third element is the first name in the line. A counter has the name `SEQ`, and a clock has one of
        the names in `TIMES_US`.
        """
        frame_fields = fields_of_lines[first : first + cycle_length]  # values by name, for each line of the frame
        clocks = [line_fields[name] for line_fields in frame_fields for name in TIMES_US if name in line_fields]
        duration = clocks[-1] - clocks[0] if len(clocks) == cycle_length else 0.0  # 0 unless every line has a clock
        first_name = next((name for name in frame_fields[0] if name not in TIMES_US), "")  # "" for only a clock
        begins_without_counter = first_name != SEQ  # False is sorted before True
        return duration, begins_without_counter, first_name

    return min(range(cycle_length), key=sort_key)


def encode_text(frame: Frame, notation: Literal["csv", "json"]) -> bytes:
    """Encode a frame as a line of text, in which the values of the channels have seven significant digits.

    Channels without names are called A, B, C, and so on.

    Args:
        frame: Frame to write.
        notation: Whether the line is a CSV row that contains only the channels, or a JSON object that also contains the
            frame counter and the clock.
    """
    numbers = [f"{value:.7g}" for value in frame.values]  # as texts
    if notation == "csv":
        return (",".join(numbers) + "\n").encode()
    # JSON needs numbers instead of texts. There may be more letters than channels, so `strict` is False.
    values = dict(zip(frame.names or ascii_uppercase, map(float, numbers), strict=False))
    fields = {SEQ: frame.seq, "t_us": frame.t_us} | values
    return f"{json.dumps({name: value for name, value in fields.items() if value is not None})}\n".encode()
