"""Numbers and charges from a CSV file; contacts to one, or to prediction records.

`CsvNumbers` is the one place that knows header, blank lines, comments and cells of a table of presses. A line that
begins with # is a comment. Blanks round a name or a number do not matter. A number has a decimal point and at most an
exponent; `nan` and `inf` are none.

The header of the charges names the electrodes, in any order, and may have further columns. The rows are touch charges
in pC: no tare is subtracted. A row whose charges do not exceed the noise is out of contact.
"""

import csv
import math
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NoReturn, TextIO

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ChargeError, InputError, shown
from isocharge.common.number_text import number_of
from isocharge.serve.model.session import SEVEN
from isocharge.serve.prediction.contact import Contact, Contacts, Validity
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.prediction.record import OUT_OF_CONTACT, PredictionRecord

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


BLOCK = 4096
"""Rows that are worked on at a time."""

CHARGE = "a charge in pC"


def read_charges(
    lines: Iterable[str],
    electrodes: tuple[str, ...],
    where: str,
    warn: Callable[[str], None] = lambda _: None,
) -> Array:
    """Read a CSV of charges.

    Args:
        lines: Lines of the file; CRLF, blank lines and lines that begin with # do not matter.
        electrodes: The columns that are read; a file of measured presses may have more.
        where: The file, for messages.
        warn: Called with a sentence if columns are ignored.

    Returns:
        Charges in the order of `electrodes`, shape (n, electrodes), pC.

    Raises:
        ChargeError: If a column is missing or there twice, or a cell is not a finite number.
    """
    expected = f"a header with one column for each of the electrodes {electrodes} and charges in pC"
    table = CsvNumbers(lines, electrodes, where, ChargeError, expected)
    columns = table.columns(electrodes)
    ignored = [name for name in table.header if name not in columns]
    if ignored:
        warn(ignored_words(where, ignored))
    charges = array("d")
    for line, row in table.rows(columns, dict.fromkeys(electrodes, CHARGE)):
        if math.isnan(sum(row)):
            name = electrodes[[math.isnan(value) for value in row].index(True)]
            raise ChargeError(f"{where}, line {line}, column {name!r}: expected {CHARGE}, got an empty cell")
        charges.extend(row)
    return np.frombuffer(charges, dtype=np.float64).reshape(-1, len(electrodes))


def write_contacts(
    contacts: Contacts, out: TextIO, validity: Validity | None = None, charge_pC: Array | None = None
) -> None:
    """Write contacts as CSV, a row for each press, columns as in `Contact` up to the misfit, numbers to six decimals.

    Args:
        contacts: The contacts of n presses.
        out: Receives the text.
        validity: Limits of the model's validity. If given, a column `flags` is added: words separated by blanks.
        charge_pC: The charges of the presses, shape (n, electrodes), pC. If given together with `validity`, a row
            whose charges do not exceed the noise gets a force of 0 and otherwise empty cells.
    """
    touches = np.ones(len(contacts.x_mm), dtype=bool)
    if validity is not None and charge_pC is not None:
        touches = validity.is_touch(charge_pC)
    names = Contacts._fields[:SEVEN]
    no_contact = tuple("0.000000" if name == "force_N" else "" for name in names)

    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(names if validity is None else (*names, "flags"))
    rows = np.column_stack(contacts)
    for start in range(0, len(rows), BLOCK):
        block = rows[start : start + BLOCK]
        is_touch = touches[start : start + BLOCK]
        flags = [()] * len(block) if validity is None else validity.batch_flags(Contacts(*block.T))
        for numbers, row_touches, words in zip(block[:, :SEVEN].tolist(), is_touch.tolist(), flags, strict=True):
            cells = tuple(map("{:.6f}".format, numbers)) if row_touches else no_contact
            if validity is None:
                writer.writerow(cells)
            else:
                writer.writerow((*cells, " ".join(words) if row_touches else ""))


def blocks(rows: Array) -> Iterator[Array]:
    """Rows a block at a time: as Python's numbers, which take five times as much memory."""
    for start in range(0, len(rows), BLOCK):
        yield rows[start : start + BLOCK]


def table_records(charge_pC: Array, predictor: Predictor) -> Iterator[PredictionRecord]:
    """Yield a record for each row of charges, shape (n, electrodes), pC; what a table does not have is None.

    A row whose charges do not exceed the noise of the model is out of contact: its force is 0, and it has no position.

    Raises:
        ChargeError: If the charges do not fit the model.
    """
    metadata = predictor.metadata
    for block in blocks(charge_pC):
        contacts = predictor.predict_batch(block)
        flags = predictor.validity.batch_flags(contacts)
        touches = predictor.validity.is_touch(block)
        for row, charges in enumerate(block.tolist()):
            is_touch = bool(touches[row])
            contact = Contact(*(float(column[row]) for column in contacts))
            yield PredictionRecord(
                timestamp=None,
                t_device_us=None,
                seq=None,
                **(contact.fields() if is_touch else OUT_OF_CONTACT),
                contact=is_touch,
                charge_pC=dict(zip(metadata.electrodes, charges, strict=True)),
                charge_raw_pC=None,
                tare_pC=None,
                flags=flags[row] if is_touch else (),
                latency_us=None,
                model=metadata.label,
                frame_id=metadata.frame_id,
            )
