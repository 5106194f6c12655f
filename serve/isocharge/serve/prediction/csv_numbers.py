"""Numbers from CSV text: the one place that knows header, blank lines, comments and cells of a table of presses.

A line that begins with # is a comment. Blanks round a name or a number do not matter. A number has a decimal point and
at most an exponent; `nan` and `inf` are none.
"""

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NoReturn

import numpy as np

from isocharge.common.errors import InputError, shown
from isocharge.common.number_text import number_of

MOST_COLUMNS = 1_000
"""Columns of a table."""

LARGEST = float(np.finfo(np.float32).max)
"""Largest number of a cell: that of the models' tensors."""

_SEPARATORS = {";": "tr ',;' '.,'", "\t": r"tr '\t' ','"}
"""Other separators of spreadsheets, and the command that turns such a file into CSV with decimal points."""


def ignored_words(where: str, names: Sequence[str]) -> str:
    """The sentence that says which columns of a file are not read."""
    return f"{where}: ignored columns: {shown(list(names))}"


class CsvNumbers:
    """A table with a header, read once from top to bottom.

    Attributes:
        where: The file, for messages.
        error: The error to raise.
        header: Names of the columns.
    """

    def __init__(
        self, lines: Iterable[str], names: Sequence[str], where: str, error: type[InputError], expected: str
    ) -> None:
        """Read the header.

        Args:
            lines: Lines of the file.
            names: Names with a meaning; only these may begin or end with a blank, or with #.
            where: The file, for messages.
            error: Raised for anything that is wrong.
            expected: What the header should have, for messages.
        """
        self.where, self.error, self._expected = where, error, expected
        self._rows = self._numbered_rows(lines, frozenset(names))
        _, header = next(self._rows, (0, None))
        if header is None:
            raise error(f"{where}: empty; expected {expected}")
        self.header = tuple(name if name in names else name.strip() for name in header)
        if len(header) > MOST_COLUMNS:
            raise error(f"{where}: expected at most {MOST_COLUMNS:,} columns, got {len(header):,}")

    def columns(self, required: Iterable[str], optional: Iterable[str] = ()) -> dict[str, int]:
        """Where the columns are; an optional one that is absent is left out.

        Raises:
            error: If a required column is missing, or one of these is there twice.
        """
        present = [*required, *(name for name in optional if name in self.header)]
        missing = [shown(name) for name in present if name not in self.header]
        repeated = [shown(name) for name in present if self.header.count(name) > 1]
        for what, names in (("missing", missing), ("repeated", repeated)):
            if names:
                more = f" and {len(names) - 10} more" if len(names) > 10 else ""
                self._refuse_header(f"{what}: {', '.join(names[:10])}{more}")
        return {name: self.header.index(name) for name in present}

    def rows(self, columns: Mapping[str, int], kinds: Mapping[str, str]) -> Iterator[tuple[int, list[float]]]:
        """Line and numbers of each row, in the order of `columns`; NaN for an empty cell.

        Args:
            columns: Names and places, from `columns`.
            kinds: What a column should hold, for messages: "a force in N".
        """
        for line, row in self._rows:
            if len(row) < len(self.header) or any(map(str.strip, row[len(self.header) :])):
                cells = f"expected {len(self.header)} cells as in the header, got {len(row)}: {shown(row)}"
                raise self.error(f"{self.where}, line {line}: {cells}")
            yield line, [self._number(row[place], line, name, kinds[name]) for name, place in columns.items()]

    def _number(self, cell: str, line: int, name: str, kind: str) -> float:
        text = cell.strip()
        if not text:
            return np.nan
        value = _number_or_nan(text)
        if not abs(value) <= LARGEST:
            point = _number_or_nan(text.replace(",", ".", 1))
            comma = "; write a decimal point" if "," in text and abs(point) <= LARGEST else ""
            got = f"expected {kind}, got {shown(cell)}{comma}"
            raise self.error(f"{self.where}, line {line}, column {shown(name)}: {got}")
        return value

    def _refuse_header(self, reason: str) -> NoReturn:
        got = f"{self.where}: expected {self._expected}, got the header {shown(list(self.header))}; {reason}"
        for separator, command in _SEPARATORS.items():
            if len(self.header) == 1 and separator in self.header[0]:
                raise self.error(
                    f"{got}; the columns are separated by {separator!r}: save the file with commas between columns and "
                    f"points in numbers, as with: {command} < FILE > NEW.csv"
                )
        raise self.error(got)

    def _numbered_rows(self, lines: Iterable[str], names: frozenset[str]) -> Iterator[tuple[int, list[str]]]:
        """Rows that are neither blank nor comments, with their line numbers from 1."""
        reader = csv.reader("\n" if _is_comment(line, names) else line for line in lines)
        try:
            for row in reader:
                if any(cell.strip() for cell in row):
                    yield reader.line_num, row
        except InputError:  # of whoever gives the lines
            raise
        except (csv.Error, ValueError) as cause:  # ValueError: no UTF-8, or a line that is too long to be held
            line = reader.line_num + (not isinstance(cause, csv.Error))  # a csv.Error is of a line that was counted
            raise self.error(f"{self.where}, line {line}: not CSV text in UTF-8 ({cause})") from cause


def _is_comment(line: str, names: frozenset[str]) -> bool:
    return line.lstrip().startswith("#") and line.partition(",")[0].strip() not in names


def _number_or_nan(text: str) -> float:
    try:
        return number_of(text)
    except ValueError:
        return np.nan
